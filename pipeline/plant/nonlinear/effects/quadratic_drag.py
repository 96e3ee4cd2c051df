"""Quadratic drag."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="quadratic_drag",
    title="Quadratic drag",
    sentence="The drag of air or another fluid grows with the square of the speed.",
    place="cart",
    law=ForceLaw("-q * v * abs(v)"),
    parameters=(
        EffectParameter(
            "coefficient",
            "q",
            "input s^2/position^2",
            scale="damping / velocity",
            typical=1.0,
            neutral=0.0,
        ),
    ),
    fingerprint="Large swings decay faster than small ones.",
    deciding_run="Free decays from two release distances: the fitted ζ is larger for the larger "
    "swings.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
)
