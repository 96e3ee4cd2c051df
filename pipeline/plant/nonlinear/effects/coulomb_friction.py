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
    fingerprint="Peaks fall along a straight line, not an exponential; the cart stops dead and "
    "its rest point scatters.",
    deciding_run="Free decay from two release heights: the fitted ζ falls as the amplitude grows.",
    reference="D. J. Inman, Engineering Vibration, 4th ed., section 1.10",
    axis="velocity",
    family="dry friction",
)
