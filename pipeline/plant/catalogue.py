"""The catalogue of effects: behaviour of a bench beyond the linear chain.

To add an effect: write an `Effect` here, list it in `CATALOGUE`, and run
`python -m pipeline.plant.simulator.codegen`.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from math import inf
from operator import attrgetter

from pipeline.errors import ConfigError
from pipeline.plant.effect import (
    BuiltLaw,
    ContactLaw,
    Effect,
    EffectParameter,
    FitCoordinates,
    ForceLaw,
    FrictionLaw,
    HysteresisLaw,
    InputLaw,
)
from pipeline.words.math import NO_BREAK, WIDE_SPACE, dot, function, parens, row, sub

# In sample times. A delay and a lag of the same size T delay the input equally on average. They
# first differ in the second moment, by T²/2. At this limit that is an eighth of a squared sample
# time.
MUCH_SHORTER = 0.5
LEAST_SLIDING = 0.01  # share of the friction at rest; any dry surface has more while it slides
FORCE = EffectParameter(
    "force", "F", "input", scale="stiffness * position", typical=0.012, neutral=0.0
)


def _coefficient(
    symbol: str, unit: str, *, scale: str, typical: float, signed: bool = False
) -> EffectParameter:
    """Return the parameter of a law that is proportional to it."""
    return EffectParameter(
        "coefficient", symbol, unit, scale=scale, typical=typical, signed=signed, neutral=0.0
    )


COULOMB_FRICTION = Effect(
    key="coulomb_friction",
    title="Dry (Coulomb) friction",
    sentence="A constant force opposes the motion and holds the cart when it stops.",
    place="cart",
    law=FrictionLaw("F"),
    parameters=(FORCE,),
    fingerprint="The peaks of a decay fall along a straight line, not an exponential. The cart "
    "stops abruptly, not always at the same position.",
    deciding_run="Free decays from two release distances: the fitted ζ is smaller for the larger "
    "swings.",
    shown_by="small motions",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
    family="dry friction",
)


def _drops(values: Mapping[str, float]) -> bool:
    """Whether friction drops as sliding begins, but not to nothing; otherwise it is Coulomb's."""
    return LEAST_SLIDING * values["static_force"] < values["force"] < values["static_force"]


STICTION = Effect(
    key="stiction",
    title="Stiction (Stribeck friction)",
    sentence="Dry friction that is larger at rest than in motion.",
    place="cart",
    law=FrictionLaw(
        "F + (S - F) * exp(-(v / w)**2)", at_rest="S", beyond="coulomb_friction", step=1.2e-3
    ),
    growth=FitCoordinates(("E", "w"), {"S": "F + E"}),
    parameters=(
        FORCE,
        EffectParameter("static_force", "S", "input", scale="stiffness * position", typical=0.06),
        EffectParameter("velocity", "w", "position/s", scale="velocity", typical=0.1),
    ),
    fingerprint="The cart sticks at its turning points and breaks loose with a jerk.",
    deciding_run="A slow ramp of the input: the cart needs more force to break loose than to keep "
    "moving.",
    shown_by="slow motions",
    reference="B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994)",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
    genuine=_drops,
)


PRESLIDING_FRICTION = Effect(
    key="presliding_friction",
    title="Presliding (Dahl) friction",
    sentence="Dry friction that builds up like a spring over a short distance after each reversal.",
    place="cart",
    law=HysteresisLaw("-F * z", rate="(v - abs(v) * z) / δ", step=2.3e-3),
    parameters=(
        FORCE,
        EffectParameter("distance", "δ", "position", scale="position", typical=0.02),
    ),
    fingerprint="The half periods become shorter as the amplitude falls. The cart ends with small, "
    "fast oscillations about its rest position.",
    deciding_run="Small free decays: the frequency rises as the amplitude falls below δ.",
    shown_by="small motions",
    reference="P. R. Dahl, AIAA Journal 14 (1976), 1675-1682",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
)


LOAD_FRICTION = Effect(
    key="load_friction",
    title="Friction that grows with the drive",
    sentence="The harder the motor pushes, the more the bearing or rack grips.",
    place="cart",
    law=FrictionLaw("μ * abs(u)"),
    parameters=(_coefficient("μ", "", scale="1", typical=0.03),),
    fingerprint="While the motor pushes, there is more dry friction than in a free decay.",
    deciding_run="Steps of two sizes: doubling the input doubles the added friction.",
    shown_by="driven motions",
    reference="B. Armstrong-Hélouvry, Control of Machines with Friction, chapter 2",
    axis="velocity",
)


QUADRATIC_DRAG = Effect(
    key="quadratic_drag",
    title="Quadratic drag",
    sentence="The drag of air or another fluid grows with the square of the speed.",
    place="cart",
    law=ForceLaw("-q * v * abs(v)"),
    parameters=(
        _coefficient("q", "input s^2/position^2", scale="damping / velocity", typical=1.0),
    ),
    fingerprint="Large swings decay faster than small ones.",
    deciding_run="Free decays from two release distances: the fitted ζ is larger for the larger "
    "swings.",
    shown_by="large motions",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
)


FORCE_OFFSET = Effect(
    key="force_offset",
    title="A constant force",
    sentence="The track is tilted, or the motor pushes even at zero input.",
    place="cart",
    law=ForceLaw("F"),
    parameters=(replace(FORCE, typical=0.03, signed=True),),
    fingerprint="In every recording the cart rests off zero, as if pushed by the same force.",
    deciding_run="Recordings with different carts held: the stiffer the springs on the cart, the "
    "less a force displaces it. A wrong encoder zero shifts the reading equally in all recordings.",
    shown_by="held carts",
    reference="the balance of forces in the chain at rest",
    axis="position",
    only_rest=True,
    equivalent="A wrong encoder zero, if the same carts are held in all recordings.",
)


CUBIC_SPRING = Effect(
    key="cubic_spring",
    title="Hardening or softening spring",
    sentence="The spring becomes stiffer (or softer) the more it is stretched or compressed.",
    place="spring",
    law=ForceLaw("a * d**3"),
    parameters=(
        _coefficient(
            "a", "input/position^3", scale="stiffness / position**2", typical=0.2, signed=True
        ),
    ),
    fingerprint="The frequency depends on the amplitude, and the static gain depends on the size "
    "of the step.",
    deciding_run="A free decay from a large distance: the first period differs from the last.",
    shown_by="large motions",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="stretch",
    equivalent="The same effect in the other wall spring, if there is only one cart.",
)


ASYMMETRIC_SPRING = Effect(
    key="asymmetric_spring",
    title="Asymmetric spring",
    sentence="The spring becomes stiffer the more it is stretched, and softer the more it is "
    "compressed, or the other way round.",
    place="spring",
    law=ForceLaw("b * d**2"),
    parameters=(
        _coefficient(
            "b", "input/position^2", scale="stiffness / position", typical=0.2, signed=True
        ),
    ),
    fingerprint="The swings are longer to one side than to the other, and the centre of a large "
    "oscillation is off the rest position.",
    deciding_run="Steps of the same size in both directions: the settled positions differ.",
    shown_by="both sides",
    reference="A. H. Nayfeh, D. T. Mook, Nonlinear Oscillations, section 2.3",
    axis="stretch",
    equivalent="The same effect with the opposite sign in the other wall spring, if there is only "
    "one cart.",
)


SLACK_SPRING = Effect(
    key="slack_spring",
    title="A spring with a jump in its stiffness",
    sentence="Beyond some stretch the spring goes slack, or its coils touch.",
    place="spring",
    law=ContactLaw("r * k * (d - s)", past="s", pulls=True),
    growth=FitCoordinates(("h", "s"), {"r": "h / k"}, signed=True),
    parameters=(
        EffectParameter(
            "stiffness_change",
            "r",
            "",
            scale="1",
            typical=0.3,
            signed=True,
            neutral=0.0,
            upper=50.0,
        ),
        EffectParameter("stretch", "s", "position", scale="position", typical=0.35, side=True),
    ),
    fingerprint="The swings change shape beyond some position, on one side only.",
    deciding_run="Steps of both signs and several sizes: plotted over the input, the settled "
    "position is a line with a corner.",
    shown_by="both sides",
    reference="S. W. Shaw, P. J. Holmes, Journal of Sound and Vibration 90 (1983), 129-155",
    axis="stretch",
    equivalent="The same effect in the other wall spring at the opposite stretch, if there is "
    "only one cart.",
)


COUPLING_DAMPER = Effect(
    key="coupling_damper",
    title="A damper between two carts",
    sentence="A spring, hose or cable between two carts damps changes in its length.",
    place="spring",
    law=ForceLaw("c * rate", step=inf),
    parameters=(_coefficient("c", "input s/position", scale="damping", typical=0.3),),
    fingerprint="Modes in which the carts move against each other are damped more than the others.",
    deciding_run="A free decay of each mode: compare their damping.",
    shown_by="held carts",
    reference="L. Meirovitch, Fundamentals of Vibrations, chapter 7",
    axis="velocity",
    between_carts=True,
    equivalent="The carts' own damping, if the spring ends at a wall.",
)


DRIVE_DAMPING = Effect(
    key="drive_damping",
    title="Braking by the driven motor",
    sentence="The motor brakes cart 1 while the input is on, but not while it is zero.",
    place="input",
    law=ForceLaw("-c * v * on", step=inf),
    parameters=(_coefficient("c", "input s/position", scale="damping", typical=0.2, signed=True),),
    fingerprint="The cart is damped more after the input steps on than after it steps off.",
    deciding_run="Steps of two sizes and a free decay: compared with the decay, both steps add the "
    "same damping.",
    shown_by="driven motions",
    reference="back-EMF of a voltage-driven DC motor; any text on electric drives",
    axis="velocity",
)


DEAD_ZONE = Effect(
    key="dead_zone",
    title="Dead zone of the input",
    sentence="The amplifier or motor does nothing until the input passes a threshold.",
    place="input",
    law=InputLaw("sign(u) * max(abs(u) - w, 0)"),
    parameters=(EffectParameter("width", "w", "input", scale="input", typical=0.08, neutral=0.0),),
    fingerprint="Small inputs move the cart too little: the static gain grows with the step.",
    deciding_run="Steps of three sizes: plotted over the input, the settled position is a line "
    "that misses the origin.",
    shown_by="small motions",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)


SATURATION = Effect(
    key="saturation",
    title="Saturation of the input",
    sentence="The amplifier clips: above a limit, more input gives no more force.",
    place="input",
    law=InputLaw("clip(u, -L, L)"),
    parameters=(EffectParameter("limit", "L", "input", scale="input", typical=0.65),),
    fingerprint="Large inputs move the cart too little: the static gain falls as the step grows.",
    deciding_run="Steps of three sizes: above the limit, a larger input moves the cart no further.",
    shown_by="large motions",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)


INPUT_DELAY = Effect(
    key="input_delay",
    title="Delay of the input",
    sentence="The force comes later (or earlier) than the logged input says.",
    place="input",
    law=BuiltLaw("delay", row("u", parens("t"), "→", "u", parens("t", "−", "T"))),
    parameters=(
        EffectParameter(
            "delay", "T", "s", scale="sample_time", typical=1.5, signed=True, neutral=0.0
        ),
    ),
    fingerprint="Every driven motion starts late by the same time. Free decays fit the linear "
    "model.",
    deciding_run="A step at a high sample rate: the cart starts to move some time after the edge.",
    shown_by="edges",
    reference="K. J. Åström, B. Wittenmark, Computer-Controlled Systems, section 2.3",
    axis="time",
    equivalent="A first-order lag whose time constant is much shorter than a sample.",
    same_as="actuator_lag",
    same_below=MUCH_SHORTER,
)


ACTUATOR_LAG = Effect(
    key="actuator_lag",
    title="First-order lag of the drive",
    sentence="The force follows the input gradually, with one time constant.",
    place="input",
    law=BuiltLaw("lag", row("τ", dot("u"), "+", "u", "=", sub("u", "command"))),
    parameters=(
        EffectParameter("time_constant", "τ", "s", scale="sample_time", typical=1.5, neutral=0.0),
    ),
    fingerprint="The cart responds to an edge of the input gradually. At high frequencies it "
    "moves less, and later.",
    deciding_run="A sweep beyond the resonances: a lag lowers the amplitude there, but a delay "
    "does not.",
    shown_by="sweeps",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 3.2",
    axis="frequency",
    equivalent="A delay, if the time constant is much shorter than a sample.",
    same_as="input_delay",
    same_below=MUCH_SHORTER,
)


_BEYOND_PLAY = ("|", "d", "|", ">", "g", "/", "2")
_PLAY = row(
    *(sub("f", "1"), "=", sub("k", "c"), parens("|", "d", "|", "−", "g", "/", "2")),
    *(*function("sign"), "d", ",", WIDE_SPACE),
    *("d", "=", sub("x", "m"), "−", sub("x", "1"), ",", NO_BREAK, *_BEYOND_PLAY),
)

BACKLASH = Effect(
    key="backlash",
    title="Backlash between motor and cart 1",
    sentence="Pinion and rack have play: at each reversal the motor runs free through a gap.",
    place="input",
    law=BuiltLaw("play", _PLAY),
    growth=FitCoordinates(
        ("g", "m_m", "e")
    ),  # e: speed after an impact, divided by the speed before it
    parameters=(
        EffectParameter(
            "gap",
            "g",
            "position",
            scale="position",
            typical=0.08,
            neutral=0.0,
            upper=1.0,  # in a wider gap, the motor would hardly reach the cart
        ),
        EffectParameter(
            "motor_mass",
            "m_m",
            "input s^2/position",
            scale="mass",
            typical=0.3,
            lower=0.02,
            upper=0.9,
            reported=False,
        ),
        EffectParameter(
            "contact_stiffness",
            "k_c",
            "input/position",
            scale="stiffness",
            typical=30.0,
            lower=3.0,
            upper=1000.0,
            reported=False,
        ),
        EffectParameter(
            "contact_damping",
            "c_c",
            "input s/position",
            # A third of critical damping, for the usual motor mass and contact stiffness.
            scale="(stiffness * mass) ** 0.5",
            typical=1.0,
            lower=0.02,
            upper=30.0,
            reported=False,
        ),
    ),
    fingerprint="At each reversal of the force there is a short pause, then a knock.",
    deciding_run="Small steps about zero, and the same steps on top of a constant input. Only the "
    "steps about zero cross the gap, so only they start late.",
    shown_by="about zero",
    reference="M. Nordin, P.-O. Gutman, Automatica 38 (2002), 1633-1649",
    axis="time",
)


COGGING = Effect(
    key="cogging",
    title="Cogging of the motor",
    sentence="The magnets of the motor (or the teeth of pinion and rack) push cart 1 forwards and "
    "backwards in turn as it travels.",
    place="input",
    law=ForceLaw("F * sin(2 * π * x / λ + φ)", on_motor=True, step=1e-3),
    growth=FitCoordinates(("a", "b", "λ"), {"F": "hypot(a, b)", "φ": "atan2(b, a)"}, signed=True),
    parameters=(
        replace(FORCE, typical=0.01),
        EffectParameter(
            "pitch",
            "λ",
            "position",
            scale="position",
            typical=0.2,
            lower=0.02,
            upper=1.0,  # with a longer period, it looks like a bent spring
            reach=0.03,  # a quarter of a tooth, if the travel has eight teeth
        ),
        EffectParameter("phase", "φ", "rad", scale="1", typical=3.142, signed=True),
    ),
    fingerprint="The cart tends to rest at evenly spaced positions. Plotted over position, the "
    "unexplained force is a sine wave, the same in both directions of travel.",
    deciding_run="A slow ramp of the input, up and down: the cart jumps between rest positions "
    "that are the same in both directions. With dry friction they differ.",
    shown_by="slow motions",
    reference="D. C. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed., chapter 5",
    axis="position",
)


END_STOP = Effect(
    key="end_stop",
    title="End stop",
    sentence="Beyond some position the cart runs against a stop.",
    place="cart",
    law=ContactLaw("-k * (x - p) - c * v", past="p"),
    growth=FitCoordinates(("k", "p", "c")),
    parameters=(
        EffectParameter(
            "position",
            "p",
            "position",
            scale="position",
            typical=0.8,
            side=True,
            lower=0.2,  # a stop nearer to the rest position would leave no motion
        ),
        EffectParameter(
            "stiffness",
            "k",
            "input/position",
            scale="stiffness",
            typical=20.0,
            lower=0.5,  # a softer stop is a spring
            upper=3000.0,
            neutral=0.0,
        ),
        EffectParameter(
            "damping",
            "c",
            "input s/position",
            scale="(stiffness * mass) ** 0.5",
            typical=0.5,
            reported=False,
        ),
    ),
    fingerprint="The largest swings are cut off on one side, always at the same position, with a "
    "bounce.",
    deciding_run="The same step, a third smaller: the swings are no longer cut off.",
    shown_by="large motions",
    reference="K. H. Hunt, F. R. E. Crossley, Journal of Applied Mechanics 42 (1975), 440-445",
    axis="position",
)


SENSOR_GAIN = Effect(
    key="sensor_gain",
    title="A sensor with a scale of its own",
    sentence="One encoder reads more (or less) than the others for the same motion.",
    place="cart",
    law=BuiltLaw("reading", row("y", "=", "g", "x")),
    growth=FitCoordinates(("e",), {"g": "1 + e"}, signed=True),
    parameters=(EffectParameter("gain", "g", "", scale="1", typical=0.97, neutral=1.0),),
    fingerprint="No chain of springs can give the measured ratio between the carts' amplitudes.",
    deciding_run="Move each cart along a ruler and compare the distance with its encoder.",
    shown_by="ruler",
    reference="the balance of forces in the chain at rest",
    axis="position",
    fewest_carts=2,
    same_as="sensor_gain",
    equivalent="The gain of another cart's sensor, because the data show only ratios of gains. "
    "If two carts have springs to both walls, the data show no gain at all.",
)


EXTRA_MODE = Effect(
    key="extra_mode",
    title="A hidden mass on a cart",
    sentence="Something on the cart (a weight, a cable, the post) swings on a spring of its own.",
    place="cart",
    law=BuiltLaw(
        "hidden mass",
        row(
            *("f", "=", "k", parens(sub("x", "h"), "−", "x")),
            *("+", "c", parens(sub("v", "h"), "−", "v"), ",", WIDE_SPACE),
            *("m", sub(dot("v"), "h"), "=", "−", "f"),
        ),
    ),
    growth=FitCoordinates(("m", "κ", "γ"), {"k": "m * κ", "c": "m * γ"}),
    parameters=(
        EffectParameter(
            "mass",
            "m",
            "input s^2/position",
            scale="mass",
            typical=0.1,
            lower=1e-3,
            upper=3.0,
            neutral=0.0,
        ),
        # A little faster than the cart itself, with 3 % of critical damping.
        EffectParameter(
            "stiffness",
            "k",
            "input/position",
            scale="stiffness",
            typical=0.1 * 1.05**2,
            upper=300.0,
        ),
        EffectParameter(
            "damping",
            "c",
            "input s/position",
            scale="(stiffness * mass) ** 0.5",
            typical=0.06 * 0.1 * 1.05,
        ),
    ),
    fingerprint="There is one more resonance than there are carts, or a resonance is split into "
    "two peaks.",
    deciding_run="A sweep through the extra resonance, then the same sweep with the suspected part "
    "held by hand.",
    shown_by="sweeps",
    reference="J. P. Den Hartog, Mechanical Vibrations, section 3.2",
    axis="frequency",
)


CATALOGUE: tuple[Effect, ...] = (
    COULOMB_FRICTION,
    STICTION,
    PRESLIDING_FRICTION,
    LOAD_FRICTION,
    QUADRATIC_DRAG,
    FORCE_OFFSET,
    CUBIC_SPRING,
    ASYMMETRIC_SPRING,
    SLACK_SPRING,
    COUPLING_DAMPER,
    DRIVE_DAMPING,
    DEAD_ZONE,
    SATURATION,
    INPUT_DELAY,
    ACTUATOR_LAG,
    BACKLASH,
    COGGING,
    END_STOP,
    SENSOR_GAIN,
    EXTRA_MODE,
)

_WORD = re.compile(r"[a-z]+")


def find_effect(key: str) -> Effect:
    """Return the effect with the given key.

    Raises
    ------
    ConfigError : there is no such effect; the message suggests similar names.
    """
    for effect in CATALOGUE:
        if effect.key == key:
            return effect
    keys = [effect.key for effect in CATALOGUE]
    near = _with_words(key) or get_close_matches(key, keys, n=1, cutoff=0.5)
    *others, last = map(repr, near or [""])
    meant = f"{', '.join(others)} or {last}" if others else last
    known = f"did you mean {meant}?" if near else f"known: {', '.join(keys)}"
    raise ConfigError(f"no effect {key[:60]!r}; {known}")


def _with_words(typed: str) -> list[str]:
    """Return the effects whose names contain all typed words, or else those whose titles do.

    They are in the order of the catalogue, which begins with the most common.
    """
    words = set(_WORD.findall(typed[:60].lower()))  # no name is longer
    for names in (attrgetter("key"), attrgetter("title")):
        found = [e.key for e in CATALOGUE if words and words <= {*_WORD.findall(names(e).lower())}]
        if found:
            return found
    return []
