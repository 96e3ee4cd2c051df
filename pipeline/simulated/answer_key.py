"""Benches that are drawn for one team each, and the answer key with their true values.

The draw depends on a secret in the key, so that nobody can repeat it without the key.
"""

import hashlib
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.errors import ConfigError, DataError
from pipeline.json_files import json_text, read_json, result, written
from pipeline.lock import lock_when_free
from pipeline.output import write_file
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, EffectTerm
from pipeline.setup import Units
from pipeline.simulated.bench import SimulatedBench
from pipeline.submission.toml import nearest, read_text
from pipeline.words.numbers import count

MOST_PERCENT = 50.0  # a larger change may exchange the order of resonances
_MOST_BYTES = 10_000_000


@result(eq=False)
class TeamBench:
    """The bench of a team.

    Attributes
    ----------
    model : its carts, springs and effects, in the form of a `gap.json`.
    parameters : the true values of the report's parameters.
    found : the values that an analysis of the team's recordings gives.
    """

    model: AugmentedChain = written()
    parameters: dict[str, float] = written("true values of the report's parameters")
    units: Units = written()
    found: dict[str, float] = written("values from the team's recordings", default_factory=dict)


@result(eq=False)
class AnswerKey:
    """A secret, and the bench that was drawn for each team, by the name of its folder."""

    schema: Literal["cartlab-key/1"] = written(default_factory=lambda: "cartlab-key/1")
    secret: str = written("anybody who knows it can draw the same benches")
    teams: dict[str, TeamBench] = written()

    def generator(self, team: str, *, seed: int) -> np.random.Generator:
        """Return the random numbers of a team."""
        drawn = hashlib.sha256(f"{self.secret}\0{team}\0{seed}".encode()).digest()
        return np.random.default_rng(int.from_bytes(drawn, "big"))

    def enter(self, team: str, bench: TeamBench) -> None:
        """Add the bench of a team.

        Raises
        ------
        ConfigError : the key has another bench for this team.
        """
        known = self.teams.setdefault(team, bench)
        if json_text(known.model) != json_text(bench.model):
            raise ConfigError(
                f"the answer key has another bench for {team}: give the team's folder another "
                "name, or use another key"
            )


@contextmanager
def changing_key(path: Path) -> Iterator[AnswerKey]:
    """Open an answer key, new or not, and write it again at the end, for its owner only.

    Raises
    ------
    ConfigError : the file is not an answer key.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with lock_when_free(path.parent):
        key = read_key(path) if path.exists() else AnswerKey(secret=secrets.token_hex(16), teams={})
        yield key
        write_file(path, json_text(key), private=True)


def read_key(path: Path) -> AnswerKey:
    """Return an answer key.

    Raises
    ------
    ConfigError : the file is not an answer key.
    """
    text = read_text(path, where=str(path), limit=_MOST_BYTES, error=ConfigError)
    try:
        return read_json(AnswerKey, text)
    except (ValueError, KeyError, TypeError):
        raise ConfigError(
            f"{path}: is not an answer key; give the file that an earlier `simulate --vary` "
            "wrote, or a new one"
        ) from None


def bench_of_team(bench: SimulatedBench, *, team: str, key: Path) -> SimulatedBench:
    """Return a bench with the carts, springs and effects that an answer key has for a team.

    Raises
    ------
    ConfigError : the file is not an answer key, or has no bench with so many carts for this team.
    """
    teams = read_key(key).teams
    if team not in teams:
        raise ConfigError(f"{key}: has no bench for {team!r}{nearest(team, [*teams])}")
    model = teams[team].model
    if model.chain.n != bench.chain.n:
        raise ConfigError(
            f"{key}: the bench of {team} has {count(model.chain.n, 'cart')}, {bench.name} has "
            f"{bench.chain.n}; name the preset that `simulate` had"
        )
    return replace(bench, name=team, chain=model.chain, effects=model.terms, effect_sentences=())


def draw_bench(
    bench: SimulatedBench, *, percent: float, rng: np.random.Generator
) -> tuple[SimulatedBench, TeamBench]:
    """Return a bench with drawn masses, dampings, springs and effects, and its true values.

    Each mass, damping and spring is multiplied by a factor between 1 - percent/100 and
    1 + percent/100. An effect has one factor, which scales its distance from no effect. So its
    values stay possible together.

    Raises
    ------
    ConfigError : the percentage is not above 0, or is too large.
    """
    if not 0 < percent <= MOST_PERCENT:
        raise ConfigError(f"--vary {percent:g}: give a percentage up to {MOST_PERCENT:g}")
    share, chain = percent / 100, bench.chain

    def factors(n: int) -> np.ndarray:
        return rng.uniform(1 - share, 1 + share, size=n)

    drawn = Chain(
        m=chain.m * factors(chain.m.size),
        c=chain.c * factors(chain.c.size),
        k=chain.k * factors(chain.k.size),
    )
    effects = tuple(_scaled(term, float(factors(1)[0])) for term in bench.effects)
    try:
        parameters = drawn.parameters()
    except DataError:  # no spring to a wall, so there are no static gains
        parameters = {}
    own = replace(bench, chain=drawn, effects=effects, effect_sentences=(), name="")
    model = AugmentedChain(chain=drawn, terms=effects)
    units = Units(position=bench.position_unit, input=bench.input_unit)
    return own, TeamBench(model=model, parameters=parameters, units=units)


def _scaled(term: EffectTerm, factor: float) -> EffectTerm:
    values = [
        value if not parameter.reported else _moved(value, parameter.neutral or 0.0, factor)
        for parameter, value in zip(term.effect.parameters, term.values, strict=True)
    ]
    return replace(term, values=tuple(values))


def _moved(value: float, neutral: float, factor: float) -> float:
    return neutral + factor * (value - neutral)
