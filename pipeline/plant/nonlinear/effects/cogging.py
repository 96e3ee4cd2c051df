"""Cogging of the motor."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Force, Growth

EFFECT = Effect(
    key="cogging",
    title="Cogging of the motor",
    sentence="The teeth of the motor (or of pinion and rack) pull cart 1 to and fro as it travels.",
    place="input",
    law=Force("F * sin(2 * π * x / λ + φ)", on_motor=True, step=1e-3),
    growth=Growth(("a", "b", "λ"), {"F": "hypot(a, b)", "φ": "atan2(b, a)"}, signed=True),
    parameters=(
        Parameter(
            "force",
            "F",
            "input",
            scale=lambda s: s.stiffness * s.position,
            trials=(0.01,),
            neutral=0.0,
        ),
        Parameter(
            "pitch",
            "λ",
            "position",
            scale=lambda s: s.position,
            trials=(0.1, 0.2, 0.4),
            lower=0.02,
            upper=1.0,  # a longer one is a spring that is not straight
            reach=0.03,  # a quarter of a tooth, where the travel has eight
        ),
        Parameter(
            "phase",
            "φ",
            "rad",
            scale=lambda s: 1.0,
            trials=(0.0, 1.571, 3.142, -1.571),
            signed=True,
        ),
    ),
    fingerprint="The cart rests at some positions rather than at others, evenly apart; the "
    "residual force is a wave over the position, alike in both directions.",
    deciding_run="A slow ramp of the input, up and down: the cart moves in even steps, at the same "
    "positions both ways, where dry friction shifts them.",
    reference="D. C. Hanselman, Brushless Permanent Magnet Motor Design, 2nd ed., chapter 5",
    axis="position",
)
