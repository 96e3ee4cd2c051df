"""End stop."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ContactLaw, Growth

EFFECT = Effect(
    key="end_stop",
    title="End stop",
    sentence="Beyond some position the cart runs against a stop.",
    place="cart",
    law=ContactLaw("-k * (x - p) - c * v", past="p"),
    growth=Growth(("k", "p", "c")),
    parameters=(
        EffectParameter("position", "p", "position", scale="position", typical=0.8, side=True),
        EffectParameter(
            "stiffness",
            "k",
            "input/position",
            scale="stiffness",
            typical=20.0,
            lower=0.05,
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
    reference="K. H. Hunt, F. R. E. Crossley, Journal of Applied Mechanics 42 (1975), 440-445",
    axis="position",
)
