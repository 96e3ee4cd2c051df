"""Dry friction, drag and offset: forces on a cart that depend on how it moves."""

from pipeline.plant.limits import LEAST_SLIDING
from pipeline.plant.nonlinear.effects.base import Effect, Parameter, Scales
from pipeline.plant.nonlinear.tables import Cart


def _spring_force(s: Scales) -> float:
    return s.stiffness * s.position


_FORCE = Parameter(
    "force", "F", "input", scale=_spring_force, trials=(0.003, 0.012, 0.04), neutral=0.0
)

COULOMB = Effect(
    key="coulomb_friction",
    title="Dry (Coulomb) friction",
    sentence="A constant force opposes the motion and holds the cart when it stops.",
    place="cart",
    equation=r"f = -F \operatorname{sign} v, \quad |f| \le F \text{ at rest}",
    parameters=(_FORCE,),
    columns=lambda p: {Cart.COULOMB: p["force"]},
    fingerprint="Peaks fall along a straight line, not an exponential; the cart stops dead and "
    "its rest point scatters.",
    deciding_run="Free decay from two release heights: the fitted ζ falls as the amplitude grows.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
    family="dry friction",
)

STICTION = Effect(
    key="stiction",
    title="Stiction (Stribeck friction)",
    sentence="Dry friction that holds more firmly at rest than it drags in motion.",
    place="cart",
    equation=r"f = -\left(F + (S - F)\, e^{-(v/w)^2}\right) \operatorname{sign} v, "
    r"\quad |f| \le S \text{ at rest}",
    parameters=(
        _FORCE,
        Parameter("static_force", "S", "input", scale=_spring_force, trials=(0.02, 0.06)),
        Parameter("velocity", "w", "position/s", scale=lambda s: s.velocity, trials=(0.02, 0.1)),
    ),
    columns=lambda p: {
        Cart.COULOMB: p["force"],
        Cart.STATIC: max(p["static_force"] - p["force"], 0.0),
        Cart.STRIBECK: p["velocity"],
    },
    fingerprint="The cart sticks at its turning points and breaks loose with a jerk; the last "
    "swings end abruptly.",
    deciding_run="A slow ramp of the input: the force at which the cart breaks loose is above the "
    "force that keeps it moving.",
    reference="B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994)",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
    # Without a drop it is Coulomb's law; without sliding friction no dry surface behaves like it.
    genuine=lambda p: LEAST_SLIDING * p["static_force"] < p["force"] < p["static_force"],
)

PRESLIDING = Effect(
    key="presliding_friction",
    title="Presliding (Dahl) friction",
    sentence="Dry friction that builds up like a spring over a short distance after each reversal.",
    place="cart",
    equation=r"f = -F z, \quad \dot z = (v - |v|\, z)/\delta",
    parameters=(
        _FORCE,
        Parameter(
            "distance", "δ", "position", scale=lambda s: s.position, trials=(0.005, 0.02, 0.06)
        ),
    ),
    columns=lambda p: {Cart.DAHL: p["force"], Cart.DISTANCE: p["distance"]},
    fingerprint="The half period shortens as the amplitude falls, and the cart never quite stops "
    "dead: it rings stiffly about where it came to rest.",
    deciding_run="Small free decays: the frequency rises as the swing comes below δ.",
    reference="P. R. Dahl, AIAA Journal 14 (1976), 1675-1682",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
)

LOAD = Effect(
    key="load_friction",
    title="Friction that grows with the drive",
    sentence="The harder the motor pushes, the more the bearing or rack grips.",
    place="cart",
    equation=r"f = -\mu |u| \operatorname{sign} v",
    parameters=(
        Parameter(
            "coefficient", "μ", "", scale=lambda s: 1.0, trials=(0.01, 0.03, 0.1), neutral=0.0
        ),
    ),
    columns=lambda p: {Cart.LOAD: p["coefficient"]},
    fingerprint="More damping while the motor pushes than in free decay, in proportion to the "
    "push, and constant over the swing.",
    deciding_run="Steps of two sizes: the extra friction doubles with the input.",
    reference="G. Amontons' law applied to the rack; see Armstrong-Hélouvry, Control of Machines "
    "with Friction, chapter 2",
    axis="velocity",
)

DRAG = Effect(
    key="quadratic_drag",
    title="Quadratic drag",
    sentence="Air or fluid resists with the square of the speed.",
    place="cart",
    equation=r"f = -q\, v |v|",
    parameters=(
        Parameter(
            "coefficient",
            "q",
            "input s^2/position^2",
            scale=lambda s: s.damping / s.velocity,
            trials=(0.2, 1.0),
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Cart.DRAG: p["coefficient"]},
    fingerprint="Large swings die faster than small ones: the fitted ζ grows with the amplitude.",
    deciding_run="Free decay from two release heights: the fitted ζ grows with the amplitude.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
)

OFFSET = Effect(
    key="force_offset",
    title="A constant force",
    sentence="A tilted track, or a motor that pushes a little at zero input.",
    place="cart",
    equation=r"f = F",
    parameters=(
        Parameter(
            "force", "F", "input", scale=_spring_force, trials=(0.03,), signed=True, neutral=0.0
        ),
    ),
    columns=lambda p: {Cart.OFFSET: p["force"]},
    fingerprint="The rest point is displaced by the same force in every run, whatever is held.",
    deciding_run="Runs with different carts held: an encoder's zero stays, a force's displacement "
    "changes with the springs that carry it.",
    reference="statics of the chain",
    axis="position",
    only_rest=True,
    equivalent="The encoder zero, in one configuration of held carts alone.",
)
