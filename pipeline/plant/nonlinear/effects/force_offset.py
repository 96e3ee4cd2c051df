"""A constant force."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="force_offset",
    title="A constant force",
    sentence="A tilted track, or a motor that pushes a little at zero input.",
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
    fingerprint="The rest point is displaced by the same force in every run, whatever is held.",
    deciding_run="Runs with different carts held: an encoder's zero stays, a force's displacement "
    "changes with the springs that carry it.",
    reference="statics of the chain",
    axis="position",
    only_rest=True,
    equivalent="The encoder zero, in one configuration of held carts alone.",
)
