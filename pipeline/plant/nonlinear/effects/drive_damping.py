"""Braking by the driven motor."""

from math import inf

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="drive_damping",
    title="Braking by the driven motor",
    sentence="The motor brakes cart 1 while the input is on, but not while it is zero.",
    place="input",
    law=ForceLaw("-c * v * on", step=inf),
    parameters=(
        EffectParameter(
            "coefficient",
            "c",
            "input s/position",
            scale="damping",
            typical=0.2,
            signed=True,
            neutral=0.0,
        ),
    ),
    fingerprint="The cart is damped more after the input steps on than after it steps off.",
    deciding_run="Steps of two sizes and a free decay: compared with the decay, both steps add the "
    "same damping.",
    reference="back-EMF of a voltage-driven DC motor; any text on electric drives",
    axis="velocity",
)
