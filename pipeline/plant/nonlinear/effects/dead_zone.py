"""Dead zone of the input."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import InputLaw

EFFECT = Effect(
    key="dead_zone",
    title="Dead zone of the input",
    sentence="The amplifier or motor does nothing until the input passes a threshold.",
    place="input",
    law=InputLaw("sign(u) * max(abs(u) - w, 0)"),
    parameters=(EffectParameter("width", "w", "input", scale="input", typical=0.08, neutral=0.0),),
    fingerprint="Small inputs move the cart too little: the static gain grows with the step.",
    deciding_run="Steps of three sizes: plotted over the input, the settled position is a line "
    "that misses the origin.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)
