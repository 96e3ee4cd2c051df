"""Presliding (Dahl) friction."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.coulomb_friction import FORCE
from pipeline.plant.nonlinear.effects.law import HysteresisLaw

EFFECT = Effect(
    key="presliding_friction",
    title="Presliding (Dahl) friction",
    sentence="Dry friction that builds up like a spring over a short distance after each reversal.",
    place="cart",
    law=HysteresisLaw("-F * z", rate="(v - abs(v) * z) / δ", step=2.3e-3),
    parameters=(
        FORCE,
        EffectParameter("distance", "δ", "position", scale="position", typical=0.02),
    ),
    fingerprint="The half periods become shorter as the amplitude falls. The cart ends with small, "
    "fast oscillations about its rest position.",
    deciding_run="Small free decays: the frequency rises as the amplitude falls below δ.",
    reference="P. R. Dahl, AIAA Journal 14 (1976), 1675-1682",
    axis="velocity",
    family="dry friction",
    grows_from="coulomb_friction",
)
