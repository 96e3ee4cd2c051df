"""First-order lag of the drive."""

from pipeline.plant.limits import MUCH_SHORTER
from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import BuiltLaw
from pipeline.words.math import dot, row, sub

EFFECT = Effect(
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
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 3.2",
    axis="frequency",
    equivalent="A delay, if the time constant is much shorter than a sample.",
    same_as="input_delay",
    same_below=MUCH_SHORTER,
)
