"""Stiction (Stribeck friction)."""

from pipeline.plant.limits import LEAST_SLIDING
from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.coulomb_friction import FORCE
from pipeline.plant.nonlinear.effects.law import FrictionLaw, Growth

EFFECT = Effect(
    key="stiction",
    title="Stiction (Stribeck friction)",
    sentence="Dry friction that is larger at rest than in motion.",
    place="cart",
    law=FrictionLaw(
        "F + (S - F) * exp(-(v / w)**2)", at_rest="S", beyond="coulomb_friction", step=1.2e-3
    ),
    growth=Growth(("E", "w"), {"S": "F + E"}),
    parameters=(
        FORCE,
        EffectParameter("static_force", "S", "input", scale="stiffness * position", typical=0.06),
        EffectParameter("velocity", "w", "position/s", scale="velocity", typical=0.1),
    ),
    fingerprint="The cart sticks at its turning points and breaks loose with a jerk.",
    deciding_run="A slow ramp of the input: the cart needs more force to break loose than to keep "
    "moving.",
    reference="B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994)",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
    # Without a drop, this would be Coulomb's law. Every dry surface has some sliding friction.
    genuine=lambda p: LEAST_SLIDING * p["static_force"] < p["force"] < p["static_force"],
)
