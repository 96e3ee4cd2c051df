"""Hardening or softening spring."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="cubic_spring",
    title="Hardening or softening spring",
    sentence="The spring becomes stiffer (or softer) the more it is stretched or compressed.",
    place="spring",
    law=ForceLaw("a * d**3"),
    parameters=(
        EffectParameter(
            "coefficient",
            "a",
            "input/position^3",
            scale="stiffness / position**2",
            typical=0.2,
            signed=True,
            neutral=0.0,
        ),
    ),
    fingerprint="The frequency depends on the amplitude, and the static gain depends on the size "
    "of the step.",
    deciding_run="A free decay from a large distance: the first period differs from the last.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="stretch",
    equivalent="The same effect in the other wall spring, if there is only one cart.",
)
