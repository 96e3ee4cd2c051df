"""A constant force."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="force_offset",
    title="A constant force",
    sentence="A tilted track, or a motor at zero input, pushes the cart with a constant force.",
    place="cart",
    law=ForceLaw("F"),
    parameters=(
        EffectParameter(
            "force",
            "F",
            "input",
            scale="stiffness * position",
            typical=0.03,
            signed=True,
            neutral=0.0,
        ),
    ),
    fingerprint="In every run the cart rests off zero, as if pushed by the same force.",
    deciding_run="Runs with different carts held: against stiffer springs a force displaces the "
    "cart less, but a wrong encoder zero stays the same.",
    reference="the balance of forces in the chain at rest",
    axis="position",
    only_rest=True,
    equivalent="A wrong encoder zero, if the same carts are held in all runs.",
)
