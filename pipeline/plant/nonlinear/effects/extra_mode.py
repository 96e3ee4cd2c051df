"""A hidden mass on a cart."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Built, Growth

EFFECT = Effect(
    key="extra_mode",
    title="A hidden mass on a cart",
    sentence="Something on the cart (a weight, a cable, the post) moves on its own spring.",
    place="cart",
    law=Built("hidden mass", r"f = k (x_h - x) + c (v_h - v), \quad m \dot v_h = -f"),
    growth=Growth(("m", "κ", "γ"), {"k": "m * κ", "c": "m * γ"}),
    parameters=(
        Parameter(
            "mass",
            "m",
            "input s^2/position",
            scale=lambda s: s.mass,
            lower=1e-3,
            upper=3.0,
            neutral=0.0,
        ),
        Parameter("stiffness", "k", "input/position", scale=lambda s: s.stiffness, upper=300.0),
        Parameter(
            "damping", "c", "input s/position", scale=lambda s: (s.stiffness * s.mass) ** 0.5
        ),
    ),
    # Light and heavy, from slower to faster than the cart itself, with 3 % of critical damping.
    trials=tuple(
        (mass, mass * omega**2, 0.06 * mass * omega)
        for omega in (0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.7, 2.3)
        for mass in (0.02, 0.1)
    ),
    fingerprint="One resonance more than there are carts, or one that is split.",
    deciding_run="A sweep through the extra resonance; then hold the suspect part by hand.",
    reference="J. P. Den Hartog, Mechanical Vibrations, section 3.2",
    axis="frequency",
)
