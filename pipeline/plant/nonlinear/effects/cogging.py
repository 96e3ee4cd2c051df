"""Cogging of the motor."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw, Growth

EFFECT = Effect(
    key="cogging",
    title="Cogging of the motor",
    sentence="The magnets of the motor (or the teeth of pinion and rack) push cart 1 forwards and "
    "backwards in turn as it travels.",
    place="input",
    law=ForceLaw("F * sin(2 * π * x / λ + φ)", on_motor=True, step=1e-3),
    growth=Growth(("a", "b", "λ"), {"F": "hypot(a, b)", "φ": "atan2(b, a)"}, signed=True),
    parameters=(
        EffectParameter(
            "force", "F", "input", scale="stiffness * position", typical=0.01, neutral=0.0
        ),
        EffectParameter(
            "pitch",
            "λ",
            "position",
            scale="position",
            typical=0.2,
            lower=0.02,
            upper=1.0,  # with a longer period, it looks like a bent spring
            reach=0.03,  # a quarter of a tooth, if the travel has eight teeth
        ),
        EffectParameter("phase", "φ", "rad", scale="1", typical=3.142, signed=True),
    ),
    fingerprint="The cart tends to rest at evenly spaced positions. Plotted over position, the "
    "unexplained force is a sine wave, the same in both directions of travel.",
    deciding_run="A slow ramp of the input, up and down: the cart jumps between rest positions "
    "that are the same in both directions. With dry friction they differ.",
    reference="D. C. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed., chapter 5",
    axis="position",
)
