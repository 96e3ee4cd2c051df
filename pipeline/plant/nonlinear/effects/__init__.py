"""The catalogue of effects: what a bench may do beyond the linear chain.

To add one: write an `Effect` in a file here and list it below.
"""

from difflib import get_close_matches

from pipeline.errors import ConfigError
from pipeline.plant.nonlinear.effects import actuator, cogging, friction, springs, structure
from pipeline.plant.nonlinear.effects.base import AugmentedChain, Effect, Parameter, Term, make_term

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
    cogging.COGGING,
    structure.END_STOP,
    structure.SENSOR_GAIN,
    structure.EXTRA_MODE,
)

__all__ = ["CATALOGUE", "AugmentedChain", "Effect", "Parameter", "Term", "find_effect", "make_term"]


def find_effect(key: str) -> Effect:
    """Return the effect of that name.

    Raises
    ------
    ConfigError : no such effect; the message has the nearest name, or all.
    """
    for effect in CATALOGUE:
        if effect.key == key:
            return effect
    keys = [effect.key for effect in CATALOGUE]
    close = get_close_matches(key, keys, n=1, cutoff=0.5)
    known = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(keys)}"
    raise ConfigError(f"no effect {key[:60]!r}; {known}")
