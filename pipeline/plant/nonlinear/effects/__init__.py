"""The catalogue of effects: what a bench may do beyond the linear chain.

To add one: write an `Effect` in a file here and list it below.
"""

import re
from difflib import get_close_matches
from operator import attrgetter

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

_WORD = re.compile(r"[a-z]+")
_LONGEST = 60  # letters of a name that are looked at

__all__ = ["CATALOGUE", "AugmentedChain", "Effect", "Parameter", "Term", "find_effect", "make_term"]


def find_effect(key: str) -> Effect:
    """Return the effect of that name.

    Raises
    ------
    ConfigError : no such effect; the message has the names that share a word, or the nearest.
    """
    for effect in CATALOGUE:
        if effect.key == key:
            return effect
    keys = [effect.key for effect in CATALOGUE]
    near = _with_words(key) or get_close_matches(key, keys, n=1, cutoff=0.5)
    *others, last = map(repr, near or [""])
    meant = f"{', '.join(others)} or {last}" if others else last
    known = f"did you mean {meant}?" if near else f"known: {', '.join(keys)}"
    raise ConfigError(f"no effect {key[:60]!r}; {known}")


def _with_words(typed: str) -> list[str]:
    """Return the effects that have all the words typed in their name, else in their title.

    In the order of the catalogue, which begins with the commonest.
    """
    words = set(_WORD.findall(typed[:_LONGEST].lower()))
    for names in (attrgetter("key"), attrgetter("title")):
        found = [e.key for e in CATALOGUE if words and words <= {*_WORD.findall(names(e).lower())}]
        if found:
            return found
    return []
