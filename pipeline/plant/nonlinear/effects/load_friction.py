"""Friction that grows with the drive."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Friction

EFFECT = Effect(
    key="load_friction",
    title="Friction that grows with the drive",
    sentence="The harder the motor pushes, the more the bearing or rack grips.",
    place="cart",
    law=Friction("μ * abs(u)"),
    parameters=(
        Parameter(
            "coefficient", "μ", "", scale=lambda s: 1.0, trials=(0.01, 0.03, 0.1), neutral=0.0
        ),
    ),
    fingerprint="More damping while the motor pushes than in free decay, in proportion to the "
    "push, and constant over the swing.",
    deciding_run="Steps of two sizes: the extra friction doubles with the input.",
    reference="G. Amontons' law applied to the rack; see Armstrong-Hélouvry, Control of Machines "
    "with Friction, chapter 2",
    axis="velocity",
)
