"""First-order lag of the drive."""

from pipeline.plant.limits import MUCH_SHORTER
from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Built

EFFECT = Effect(
    key="actuator_lag",
    title="First-order lag of the drive",
    sentence="The force follows the input with a time constant.",
    place="input",
    law=Built("lag", r"\tau \dot u + u = u_\text{command}"),
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
    fingerprint="Edges of the input are rounded; at higher frequencies less force arrives, later.",
    deciding_run="A sweep beyond the resonances: a delay keeps the amplitude, a lag does not.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 3.2",
    axis="frequency",
    equivalent="A delay, where the time constant is much shorter than the sample time.",
    same_as="input_delay",
    same_below=MUCH_SHORTER,
)
