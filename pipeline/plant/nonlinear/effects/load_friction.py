"""Friction that grows with the drive."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import FrictionLaw

EFFECT = Effect(
    key="load_friction",
    title="Friction that grows with the drive",
    sentence="The harder the motor pushes, the more the bearing or rack grips.",
    place="cart",
    law=FrictionLaw("μ * abs(u)"),
    parameters=(EffectParameter("coefficient", "μ", "", scale="1", typical=0.03, neutral=0.0),),
    fingerprint="While the motor pushes, there is more dry friction than in a free decay.",
    deciding_run="Steps of two sizes: doubling the input doubles the added friction.",
    reference="B. Armstrong-Hélouvry, Control of Machines with Friction, chapter 2",
    axis="velocity",
)
