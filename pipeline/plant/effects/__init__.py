"""The catalogue of effects: what a bench may do beyond the linear chain.

To add one: write an `Effect` in a file here and list it below.
"""

from pipeline.errors import ConfigError
from pipeline.plant.effects import actuator, friction, springs, structure
from pipeline.plant.effects.base import AugmentedChain, Effect, Parameter, Term, make_term

CATALOGUE: tuple[Effect, ...] = (
    friction.COULOMB,
    friction.STICTION,
    friction.PRESLIDING,
    friction.LOAD,
    friction.DRAG,
    friction.OFFSET,
    springs.CUBIC,
    springs.SLACK,
    springs.COUPLING,
    actuator.DRIVE_DAMPING,
    actuator.DEAD_ZONE,
    actuator.SATURATION,
    actuator.DELAY,
    actuator.LAG,
    actuator.BACKLASH,
    structure.END_STOP,
    structure.SENSOR_GAIN,
    structure.EXTRA_MODE,
)

__all__ = ["CATALOGUE", "AugmentedChain", "Effect", "Parameter", "Term", "find_effect", "make_term"]


def find_effect(key: str) -> Effect:
    """Return the effect of that name.

    Raises
    ------
    ConfigError : no such effect.
    """
    for effect in CATALOGUE:
        if effect.key == key:
            return effect
    raise ConfigError(f"no effect {key!r}; known: {', '.join(e.key for e in CATALOGUE)}")
