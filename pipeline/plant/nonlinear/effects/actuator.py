"""What happens to the input on its way to cart 1."""

from pipeline.plant.limits import MUCH_SHORTER
from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.tables import Drive

DRIVE_DAMPING = Effect(
    key="drive_damping",
    title="Braking by the driven motor",
    sentence="The motor brakes cart 1 while it is powered, and runs free when it is off.",
    place="input",
    equation=r"f = -c\, v_1 \text{ while } u \ne 0",
    parameters=(
        Parameter(
            "coefficient",
            "c",
            "input s/position",
            scale=lambda s: s.damping,
            trials=(0.2,),
            signed=True,
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Drive.DAMPING: p["coefficient"]},
    fingerprint="More damping after the step on than after the step off.",
    deciding_run="A step of zero mean after the first: the same displaced position with and "
    "without the drive.",
    reference="back-EMF of a voltage-driven DC motor; any text on electric drives",
    axis="velocity",
)

DEAD_ZONE = Effect(
    key="dead_zone",
    title="Dead zone of the input",
    sentence="The amplifier or motor does nothing until the input passes a threshold.",
    place="input",
    equation=r"u \to \operatorname{sign} u \cdot \max(|u| - w, 0)",
    parameters=(
        Parameter(
            "width", "w", "input", scale=lambda s: s.input, trials=(0.02, 0.08, 0.25), neutral=0.0
        ),
    ),
    columns=lambda p: {Drive.DEAD_ZONE: p["width"]},
    fingerprint="Small inputs move the cart less than in proportion; the static gain grows with "
    "the step.",
    deciding_run="Steps of three sizes: level against input is a line that misses the origin.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)

SATURATION = Effect(
    key="saturation",
    title="Saturation of the input",
    sentence="The amplifier clips: above a limit more input gives no more force.",
    place="input",
    equation=r"u \to \operatorname{clip}(u, -L, L)",
    parameters=(
        Parameter("limit", "L", "input", scale=lambda s: s.input, trials=(0.97, 0.85, 0.65, 0.45)),
    ),
    columns=lambda p: {Drive.LIMIT: p["limit"]},
    fingerprint="Large inputs move the cart less than in proportion.",
    deciding_run="Steps of three sizes: the level stops growing.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)

DELAY = Effect(
    key="input_delay",
    title="Delay of the input",
    sentence="The force comes later (or earlier) than the logged input says.",
    place="input",
    equation=r"u(t) \to u(t - T)",
    parameters=(
        Parameter(
            "delay",
            "T",
            "s",
            scale=lambda s: s.sample_time,
            trials=(0.3, 1.5),
            signed=True,
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Drive.DELAY: p["delay"]},
    fingerprint="Every motion starts late by the same time; free decays show nothing.",
    deciding_run="A sharp edge of the input at a high sample rate.",
    reference="K. J. Åström, B. Wittenmark, Computer-Controlled Systems, section 2.3",
    axis="time",
    equivalent="A lag much shorter than the sample time.",
    same_as="actuator_lag",
    same_below=MUCH_SHORTER,
)

LAG = Effect(
    key="actuator_lag",
    title="First-order lag of the drive",
    sentence="The force follows the input with a time constant.",
    place="input",
    equation=r"\tau \dot u + u = u_\text{command}",
    parameters=(
        Parameter(
            "time_constant",
            "τ",
            "s",
            scale=lambda s: s.sample_time,
            trials=(0.3, 1.5, 5.0),
            neutral=0.0,
        ),
    ),
    columns=lambda p: {Drive.LAG: p["time_constant"]},
    fingerprint="Edges of the input are rounded; at higher frequencies less force arrives, later.",
    deciding_run="A sweep beyond the resonances: a delay keeps the amplitude, a lag does not.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 3.2",
    axis="frequency",
    equivalent="A delay, where the time constant is much shorter than the sample time.",
    same_as="input_delay",
    same_below=MUCH_SHORTER,
)

BACKLASH = Effect(
    key="backlash",
    title="Backlash between motor and cart 1",
    sentence="Pinion and rack have play: at each reversal the motor runs free through a gap.",
    place="input",
    equation=r"f_1 = k_c (|d| - g/2) \operatorname{sign} d, \quad d = x_m - x_1, \ |d| > g/2",
    parameters=(
        Parameter(
            "gap", "g", "position", scale=lambda s: s.position, trials=(0.02, 0.08), neutral=0.0
        ),
        Parameter(
            "motor_mass",
            "m_m",
            "input s^2/position",
            scale=lambda s: s.mass,
            trials=(0.1, 0.3),
            lower=0.02,
            upper=0.9,
            reported=False,
        ),
        Parameter(
            "contact_stiffness",
            "k_c",
            "input/position",
            scale=lambda s: s.stiffness,
            trials=(30.0,),
            lower=3.0,
            upper=1000.0,
            reported=False,
        ),
        Parameter(
            "contact_damping",
            "c_c",
            "input s/position",
            # A third of critical for the motor's share of the mass on the usual contact.
            scale=lambda s: (s.stiffness * s.mass) ** 0.5,
            trials=(1.0,),
            lower=0.02,
            upper=30.0,
            reported=False,
        ),
    ),
    columns=lambda p: {
        Drive.BACKLASH: p["gap"],
        Drive.MOTOR_MASS: p["motor_mass"],
        Drive.CONTACT_STIFFNESS: p["contact_stiffness"],
        Drive.CONTACT_DAMPING: p["contact_damping"],
    },
    fingerprint="A short pause and a knock at each reversal of the force; small inputs are lost.",
    deciding_run="Small steps about zero against the same steps on a bias that keeps contact.",
    reference="M. Nordin, P.-O. Gutman, Automatica 38 (2002), 1633-1649",
    axis="time",
)
