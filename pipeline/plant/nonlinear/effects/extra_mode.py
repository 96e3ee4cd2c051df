"""A hidden mass on a cart."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import BuiltLaw, Growth
from pipeline.words.math import WIDE_SPACE, dot, parens, row, sub

EFFECT = Effect(
    key="extra_mode",
    title="A hidden mass on a cart",
    sentence="Something on the cart (a weight, a cable, the post) swings on a spring of its own.",
    place="cart",
    law=BuiltLaw(
        "hidden mass",
        row(
            *("f", "=", "k", parens(sub("x", "h"), "−", "x")),
            *("+", "c", parens(sub("v", "h"), "−", "v"), ",", WIDE_SPACE),
            *("m", sub(dot("v"), "h"), "=", "−", "f"),
        ),
    ),
    growth=Growth(("m", "κ", "γ"), {"k": "m * κ", "c": "m * γ"}),
    parameters=(
        EffectParameter(
            "mass",
            "m",
            "input s^2/position",
            scale="mass",
            typical=0.1,
            lower=1e-3,
            upper=3.0,
            neutral=0.0,
        ),
        # A little faster than the cart itself, with 3 % of critical damping.
        EffectParameter(
            "stiffness",
            "k",
            "input/position",
            scale="stiffness",
            typical=0.1 * 1.05**2,
            upper=300.0,
        ),
        EffectParameter(
            "damping",
            "c",
            "input s/position",
            scale="(stiffness * mass) ** 0.5",
            typical=0.06 * 0.1 * 1.05,
        ),
    ),
    fingerprint="There is one more resonance than there are carts, or a resonance is split into "
    "two peaks.",
    deciding_run="A sweep through the extra resonance, then the same sweep with the suspected part "
    "held by hand.",
    reference="J. P. Den Hartog, Mechanical Vibrations, section 3.2",
    axis="frequency",
)
