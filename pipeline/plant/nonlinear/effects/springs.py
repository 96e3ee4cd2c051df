"""Springs that are not straight, and dampers between carts."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.tables import Spring

CUBIC = Effect(
    key="cubic_spring",
    title="Hardening or softening spring",
    sentence="The spring grows stiffer (or softer) the further it is stretched, either way.",
    place="spring",
    equation=r"f = k d + a d^3",
    parameters=(
        Parameter(
            "coefficient",
            "a",
            "input/position^3",
            scale=lambda s: s.stiffness / s.position**2,
            trials=(0.03, 0.2),
            signed=True,
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Spring.CUBIC: p["coefficient"]},
    fingerprint="The frequency changes with the amplitude; the static gain depends on the step's "
    "size.",
    deciding_run="Free decay from a large release: the period of the first swings against the "
    "last.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="stretch",
    equivalent="The other wall spring, on a single cart.",
)

SLACK = Effect(
    key="slack_spring",
    title="A spring that changes past a stretch",
    sentence="Past some stretch the spring goes slack, or coil meets coil.",
    place="spring",
    equation=r"f = k d + r k (d - s) \text{ past } s",
    parameters=(
        Parameter(
            "stiffness_change",
            "r",
            "",
            scale=lambda s: 1.0,
            trials=(0.3,),
            signed=True,
            neutral=0.0,
            upper=50.0,
        ),
        Parameter(
            "stretch",
            "s",
            "position",
            scale=lambda s: s.position,
            trials=(0.1, 0.35, 0.65),
            side=True,
        ),
    ),
    columns=lambda p: {Spring.CHANGE: p["stiffness_change"], Spring.STRETCH: p["stretch"]},
    fingerprint="The swing is of a different shape on one side, beyond one position.",
    deciding_run="Static steps of both signs and several sizes: the gain has a corner.",
    reference="S. W. Shaw, P. J. Holmes, Journal of Sound and Vibration 90 (1983), 129-155",
    axis="stretch",
    equivalent="The other wall spring with the stretch on the other side, on a single cart.",
)

COUPLING = Effect(
    key="coupling_damper",
    title="A damper between two carts",
    sentence="The spring (or a hose, a cable) dissipates as it is stretched.",
    place="spring",
    equation=r"f = c\, \dot d",
    parameters=(
        Parameter(
            "coefficient",
            "c",
            "input s/position",
            scale=lambda s: s.damping,
            trials=(0.3,),
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Spring.COUPLING: p["coefficient"]},
    fingerprint="Modes in which the carts move against each other are damped more.",
    deciding_run="Free decay of each mode: damping of the in-phase against the opposed mode.",
    reference="L. Meirovitch, Fundamentals of Vibrations, chapter 7",
    axis="velocity",
    between_carts=True,
    equivalent="The carts' own damping, where the spring ends at a wall.",
)
