"""A damper between two carts."""

from math import inf

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ForceLaw

EFFECT = Effect(
    key="coupling_damper",
    title="A damper between two carts",
    sentence="A spring, hose or cable between two carts damps changes in its length.",
    place="spring",
    law=ForceLaw("c * rate", step=inf),
    parameters=(
        EffectParameter(
            "coefficient", "c", "input s/position", scale="damping", typical=0.3, neutral=0.0
        ),
    ),
    fingerprint="Modes in which the carts move against each other are damped more than the others.",
    deciding_run="A free decay of each mode: compare their damping.",
    reference="L. Meirovitch, Fundamentals of Vibrations, chapter 7",
    axis="velocity",
    between_carts=True,
    equivalent="The carts' own damping, if the spring ends at a wall.",
)
