"""End stop."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Contact, Growth

EFFECT = Effect(
    key="end_stop",
    title="End stop",
    sentence="Past some position the cart runs against a stop.",
    place="cart",
    law=Contact("-k * (x - p) - c * v", past="p"),
    growth=Growth(("k", "p", "c")),
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
    fingerprint="The largest swings are cut off on one side, at one position, with a bounce.",
    deciding_run="The same step a third smaller: the cut disappears.",
    reference="K. H. Hunt, F. R. E. Crossley, Journal of Applied Mechanics 42 (1975), 440-445",
    axis="position",
)
