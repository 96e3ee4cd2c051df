"""Stiction (Stribeck friction)."""

from collections.abc import Mapping

from pipeline.plant.limits import LEAST_SLIDING
from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.coulomb_friction import FORCE
from pipeline.plant.nonlinear.effects.law import FrictionLaw, Growth


def _drops(values: Mapping[str, float]) -> bool:
    """Whether friction drops as sliding begins, but not to nothing; otherwise it is Coulomb's."""
    return LEAST_SLIDING * values["static_force"] < values["force"] < values["static_force"]


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
    genuine=_drops,
)
