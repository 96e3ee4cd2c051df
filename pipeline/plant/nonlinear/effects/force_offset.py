"""A constant force."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter, spring_force
from pipeline.plant.nonlinear.effects.law import Force

EFFECT = Effect(
    key="force_offset",
    title="A constant force",
    sentence="A tilted track, or a motor that pushes a little at zero input.",
    place="cart",
    law=Force("F"),
    parameters=(
        Parameter(
            "force", "F", "input", scale=spring_force, trials=(0.03,), signed=True, neutral=0.0
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
