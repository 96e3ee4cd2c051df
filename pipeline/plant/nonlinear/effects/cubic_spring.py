"""Hardening or softening spring."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="cubic_spring",
    title="Hardening or softening spring",
    sentence="The spring grows stiffer (or softer) the further it is stretched, either way.",
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
    fingerprint="The frequency changes with the amplitude; the static gain depends on the step's "
    "size.",
    deciding_run="Free decay from a large release: the period of the first swings against the "
    "last.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="stretch",
    equivalent="The other wall spring, on a single cart.",
)
