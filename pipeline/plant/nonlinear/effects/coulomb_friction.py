"""Dry (Coulomb) friction."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import FrictionLaw

FORCE = EffectParameter(
    "force", "F", "input", scale="stiffness * position", typical=0.012, neutral=0.0
)
EFFECT = Effect(
    key="coulomb_friction",
    title="Dry (Coulomb) friction",
    sentence="A constant force opposes the motion and holds the cart when it stops.",
    place="cart",
    law=FrictionLaw("F"),
    parameters=(FORCE,),
    fingerprint="The peaks of a decay fall along a straight line, not an exponential. The cart "
    "stops abruptly, not always at the same position.",
    deciding_run="Free decays from two release distances: the fitted ζ is smaller for the larger "
    "swings.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
    family="dry friction",
)
