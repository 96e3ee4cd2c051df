"""Quadratic drag."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="quadratic_drag",
    title="Quadratic drag",
    sentence="Air or fluid resists with the square of the speed.",
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
    fingerprint="Large swings die faster than small ones: the fitted ζ grows with the amplitude.",
    deciding_run="Free decay from two release heights: the fitted ζ grows with the amplitude.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
)
