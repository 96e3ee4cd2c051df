"""A constant force."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="force_offset",
    title="A constant force",
    sentence="The track is tilted, or the motor pushes even at zero input.",
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
    deciding_run="Runs with different carts held: the stiffer the springs on the cart, the less a "
    "force displaces it. A wrong encoder zero shifts the reading equally in all runs.",
    reference="the balance of forces in the chain at rest",
    axis="position",
    only_rest=True,
    equivalent="A wrong encoder zero, if the same carts are held in all runs.",
)
