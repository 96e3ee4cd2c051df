"""Backlash between motor and cart 1."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import BuiltLaw, Growth
from pipeline.words.math import NO_BREAK, WIDE_SPACE, function, parens, row, sub

_PAST = ("|", "d", "|", ">", "g", "/", "2")
_FORMULA = row(
    *(sub("f", "1"), "=", sub("k", "c"), parens("|", "d", "|", "−", "g", "/", "2")),
    *(*function("sign"), "d", ",", WIDE_SPACE),
    *("d", "=", sub("x", "m"), "−", sub("x", "1"), ",", NO_BREAK, *_PAST),
)

EFFECT = Effect(
    key="backlash",
    title="Backlash between motor and cart 1",
    sentence="Pinion and rack have play: at each reversal the motor runs free through a gap.",
    place="input",
    law=BuiltLaw("play", _FORMULA),
    growth=Growth(("g", "m_m", "e")),  # e: speed after an impact, divided by the speed before it
    parameters=(
        EffectParameter("gap", "g", "position", scale="position", typical=0.08, neutral=0.0),
        EffectParameter(
            "motor_mass",
            "m_m",
            "input s^2/position",
            scale="mass",
            typical=0.3,
            lower=0.02,
            upper=0.9,
            reported=False,
        ),
        EffectParameter(
            "contact_stiffness",
            "k_c",
            "input/position",
            scale="stiffness",
            typical=30.0,
            lower=3.0,
            upper=1000.0,
            reported=False,
        ),
        EffectParameter(
            "contact_damping",
            "c_c",
            "input s/position",
            # A third of critical damping, for the usual motor mass and contact stiffness.
            scale="(stiffness * mass) ** 0.5",
            typical=1.0,
            lower=0.02,
            upper=30.0,
            reported=False,
        ),
    ),
    fingerprint="At each reversal of the force there is a short pause, then a knock.",
    deciding_run="Small steps about zero, and the same steps on top of a constant input. Only the "
    "steps about zero cross the gap, so only they start late.",
    reference="M. Nordin, P.-O. Gutman, Automatica 38 (2002), 1633-1649",
    axis="time",
)
