"""The catalogue of effects: behaviour of a bench beyond the linear chain.

To add an effect: write an `Effect` in a file here, list it below, and run `python -m docs.codegen`.
"""

import re
from difflib import get_close_matches
from operator import attrgetter

from pipeline.errors import ConfigError
from pipeline.plant.nonlinear.effects import (
    actuator_lag,
    backlash,
    cogging,
    coulomb_friction,
    coupling_damper,
    cubic_spring,
    dead_zone,
    drive_damping,
    end_stop,
    extra_mode,
    force_offset,
    input_delay,
    load_friction,
    presliding_friction,
    quadratic_drag,
    saturation,
    sensor_gain,
    slack_spring,
    stiction,
)
from pipeline.plant.nonlinear.effects.base import (
    AugmentedChain,
    Effect,
    EffectParameter,
    EffectTerm,
)

CATALOGUE: tuple[Effect, ...] = (
    coulomb_friction.EFFECT,
    stiction.EFFECT,
    presliding_friction.EFFECT,
    load_friction.EFFECT,
    quadratic_drag.EFFECT,
    force_offset.EFFECT,
    cubic_spring.EFFECT,
    slack_spring.EFFECT,
    coupling_damper.EFFECT,
    drive_damping.EFFECT,
    dead_zone.EFFECT,
    saturation.EFFECT,
    input_delay.EFFECT,
    actuator_lag.EFFECT,
    backlash.EFFECT,
    cogging.EFFECT,
    end_stop.EFFECT,
    sensor_gain.EFFECT,
    extra_mode.EFFECT,
)

_WORD = re.compile(r"[a-z]+")

__all__ = [
    "CATALOGUE",
    "AugmentedChain",
    "Effect",
    "EffectParameter",
    "EffectTerm",
    "find_effect",
]


def find_effect(key: str) -> Effect:
    """Return the effect with the given key.

    Raises
    ------
    ConfigError : there is no such effect; the message suggests similar names.
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
    """Return the effects whose names contain all typed words, or else those whose titles do.

    They are in the order of the catalogue, which begins with the most common.
    """
    words = set(_WORD.findall(typed[:60].lower()))  # no name is longer
    for names in (attrgetter("key"), attrgetter("title")):
        found = [e.key for e in CATALOGUE if words and words <= {*_WORD.findall(names(e).lower())}]
        if found:
            return found
    return []
