"""Saturation of the input."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import InputLaw

EFFECT = Effect(
    key="saturation",
    title="Saturation of the input",
    sentence="The amplifier clips: above a limit, more input gives no more force.",
    place="input",
    law=InputLaw("clip(u, -L, L)"),
    parameters=(EffectParameter("limit", "L", "input", scale="input", typical=0.65),),
    fingerprint="Large inputs move the cart too little: the static gain falls as the step grows.",
    deciding_run="Steps of three sizes: above the limit, a larger input moves the cart no further.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)
