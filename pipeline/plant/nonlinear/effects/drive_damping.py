"""Braking by the driven motor."""

from math import inf

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="drive_damping",
    title="Braking by the driven motor",
    sentence="The motor brakes cart 1 while it is powered, and runs free when it is off.",
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
    fingerprint="More damping after the step on than after the step off.",
    deciding_run="A step of zero mean after the first: the same displaced position with and "
    "without the drive.",
    reference="back-EMF of a voltage-driven DC motor; any text on electric drives",
    axis="velocity",
)
