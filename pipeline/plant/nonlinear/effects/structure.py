"""Things on the bench that the chain leaves out: end stops, hidden masses, a sensor's scale."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.tables import Cart

END_STOP = Effect(
    key="end_stop",
    title="End stop",
    sentence="Past some position the cart runs against a stop.",
    place="cart",
    equation=r"f = -k\,(x - p) \text{ past } p, \text{ never pulling}",
    parameters=(
        Parameter(
            "position",
            "p",
            "position",
            scale=lambda s: s.position,
            trials=(0.6, 0.8, 0.93),
            side=True,
        ),
        Parameter(
            "stiffness",
            "k",
            "input/position",
            scale=lambda s: s.stiffness,
            trials=(20.0,),
            lower=0.05,
            upper=3000.0,
            neutral=0.0,
        ),
        Parameter(
            "damping",
            "c",
            "input s/position",
            scale=lambda s: (s.stiffness * s.mass) ** 0.5,
            trials=(0.5,),
            reported=False,
        ),
    ),
    columns=lambda p: {
        Cart.STOP: p["position"],
        Cart.STOP_STIFFNESS: p["stiffness"],
        Cart.STOP_DAMPING: p["damping"],
    },
    fingerprint="The largest swings are cut off on one side, at one position, with a bounce.",
    deciding_run="The same step a third smaller: the cut disappears.",
    reference="K. H. Hunt, F. R. E. Crossley, Journal of Applied Mechanics 42 (1975), 440-445",
    axis="position",
)

SENSOR_GAIN = Effect(
    key="sensor_gain",
    title="A sensor with a scale of its own",
    sentence="One encoder reads more (or less) than the others for the same motion.",
    place="cart",
    equation=r"y = g x",
    parameters=(Parameter("gain", "g", "", scale=lambda s: 1.0, trials=(1.03, 0.97), neutral=1.0),),
    columns=lambda p: {Cart.GAIN: p["gain"]},
    fingerprint="The carts' amplitudes are in a ratio that no chain of springs gives.",
    deciding_run="Move the carts by a ruler and read the encoders.",
    reference="statics of the chain",
    axis="position",
    fewest_carts=2,
    same_as="sensor_gain",
    equivalent="Another cart's gain: only ratios show, and none without a spring at both ends.",
)

EXTRA_MODE = Effect(
    key="extra_mode",
    title="A hidden mass on a cart",
    sentence="Something on the cart (a weight, a cable, the post) moves on its own spring.",
    place="cart",
    equation=r"f = k (x_h - x) + c (v_h - v), \quad m \dot v_h = -f",
    parameters=(
        Parameter(
            "mass",
            "m",
            "input s^2/position",
            scale=lambda s: s.mass,
            lower=1e-3,
            upper=3.0,
            neutral=0.0,
        ),
        Parameter("stiffness", "k", "input/position", scale=lambda s: s.stiffness, upper=300.0),
        Parameter(
            "damping", "c", "input s/position", scale=lambda s: (s.stiffness * s.mass) ** 0.5
        ),
    ),
    # Light and heavy, from slower to faster than the cart itself, with 3 % of critical damping.
    trials=tuple(
        (mass, mass * omega**2, 0.06 * mass * omega)
        for omega in (0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.7, 2.3)
        for mass in (0.02, 0.1)
    ),
    columns=lambda p: {
        Cart.HIDDEN_MASS: p["mass"],
        Cart.HIDDEN_STIFFNESS: p["stiffness"],
        Cart.HIDDEN_DAMPING: p["damping"],
    },
    fingerprint="One resonance more than there are carts, or one that is split.",
    deciding_run="A sweep through the extra resonance; then hold the suspect part by hand.",
    reference="J. P. Den Hartog, Mechanical Vibrations, section 3.2",
    axis="frequency",
)
