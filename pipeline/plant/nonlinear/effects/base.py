"""What an effect is: a hypothesis about the bench, with an equation, a fingerprint and a test."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from enum import IntEnum
from itertools import product
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects.law import (
    Built,
    Force,
    Friction,
    Growth,
    Hysteresis,
    Input,
    Law,
    equation_of,
    evaluate,
    names_in,
)
from pipeline.plant.nonlinear.tables import TABLES, Cart, Drive, Tables, linear_tables

Place = Literal["cart", "spring", "input"]
Axis = Literal["velocity", "position", "stretch", "input", "time", "frequency"]


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Typical sizes at one place of one bench, from its records and its linear model.

    Attributes
    ----------
    position, velocity : the largest of the cart, or of the spring's stretch.
    input : the largest input; sample_time in s.
    mass, damping, stiffness : of the cart (all its springs), or of the spring and its carts.
    """

    position: float
    velocity: float
    input: float
    sample_time: float
    mass: float
    damping: float
    stiffness: float


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes
    ----------
    unit : in terms of "position", "input" and "s"; "" for a pure number.
    scale : its typical size at a place; starts and steps are multiples of it.
    trials : the multiples of `scale` to try first, all combinations; or see the effect's.
    signed : may be of either sign. A sign that picks a side (`side`) stays as it started.
    neutral : the value that gives the base model (where one exists).
    lower, upper : bounds of the magnitude, in multiples of `scale`.
    reach : how far its logarithm goes in one step of a fit.
    reported : False for a detail of the contact that the data need but nobody asks for.
    """

    name: str
    symbol: str
    unit: str
    _: KW_ONLY
    scale: Callable[[Scales], float]
    trials: tuple[float, ...] = ()
    signed: bool = False
    side: bool = False
    neutral: float | None = None
    lower: float = 0.0
    upper: float = np.inf
    reach: float = 0.4
    reported: bool = True

    def unit_text(self, *, position: str, input: str) -> str:
        """Return the unit with the submission's own units in it."""
        return self.unit.replace("position", position).replace("input", input)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One physical effect of the catalogue.

    Attributes
    ----------
    key : its name in files; `sentence` tells a student what it is.
    law : in the symbols of the parameters; growth : its coordinates in a fit from nothing, where
        they are others.
    trials : multiples of all scales to try first, where not all combinations make sense.
    fingerprint : what it does to the data; deciding_run: the experiment that settles it.
    axis : what to plot the force (or reading) against, to see it.
    between_carts : on a spring to a wall it would be part of the linear chain.
    fewest_carts : with fewer it is part of the linear chain.
    family : effects of one family exclude each other at one place; on several carts they are one.
    grows_from : the simpler effect whose fit is the start of this one's.
    only_rest : shows in nothing but where the carts rest, like an encoder's zero; found from those.
    equivalent : what the data cannot tell from it, and why.
    same_as, same_below : the key of an effect that provably cannot be told from it while its first
        parameter is below this many sample times.
    genuine : False where the values have degenerated into another law.
    """

    key: str
    title: str
    sentence: str
    place: Place
    law: Law
    parameters: tuple[Parameter, ...]
    fingerprint: str
    deciding_run: str
    reference: str
    axis: Axis
    growth: Growth | None = None
    trials: tuple[tuple[float, ...], ...] = ()
    family: str = ""
    between_carts: bool = False
    fewest_carts: int = 1
    grows_from: str | None = None
    only_rest: bool = False
    equivalent: str = ""
    same_as: str = ""
    same_below: float = np.inf
    genuine: Callable[[Mapping[str, float]], bool] = lambda p: True

    @property
    def trial_points(self) -> tuple[tuple[float, ...], ...]:
        """The multiples of the parameters' scales to try first."""
        return self.trials or tuple(product(*(p.trials for p in self.parameters)))

    @property
    def typical(self) -> tuple[float, ...]:
        """Multiples of the parameters' scales that make the effect plain to see."""
        if self.trials:
            return self.trials[len(self.trials) // 2]
        return tuple(p.trials[len(p.trials) // 2] for p in self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def contact(self) -> bool:
        """Whether bodies meet: it then has details of the contact that nobody asks for."""
        return not all(p.reported for p in self.parameters)

    @property
    def equation(self) -> str:
        """TeX of the law, without details of the contact."""
        unseen = {p.symbol for p in self.parameters if not p.reported}
        return equation_of(self.law, place=self.place, unseen=unseen)

    @property
    def dry(self) -> bool:
        """Whether it is friction whose size differs from run to run."""
        return isinstance(self.law, Friction | Hysteresis)

    @property
    def many_rests(self) -> bool:
        """Whether carts may lie still elsewhere than where their springs alone would let them."""
        repeats = isinstance(self.law, Force) and {"x", "sin"} <= names_in(self.law.force)
        return self.dry or repeats

    @property
    def has_play(self) -> bool:
        """Whether the motor may leave cart 1."""
        return self.is_built("play")

    @property
    def hides_mass(self) -> bool:
        """Whether something moves that no sensor reads."""
        return self.is_built("hidden mass")

    @property
    def needs_input(self) -> bool:
        """Whether it changes nothing in a motion without an input."""
        powered = isinstance(self.law, Force) and "on" in names_in(self.law.force)
        return powered or isinstance(self.law, Input) or self.is_built("delay", "lag")

    @property
    def needs_drive(self) -> bool:
        """Whether its law asks for the input."""
        law = self.law
        text = (
            law.force if isinstance(law, Force) else law.size if isinstance(law, Friction) else ""
        )
        return bool({"u", "on"} & names_in(text)) or self.place == "input"

    def is_built(self, *kinds: str) -> bool:
        """Whether its law is one of those that the simulators have built in."""
        return isinstance(self.law, Built) and self.law.kind in kinds

    @property
    def own(self) -> tuple[Parameter, ...]:
        """The parameters but those that it shares with the friction within it."""
        if not (isinstance(self.law, Friction) and self.law.beyond):
            return self.parameters
        mine = {*self.grown.coordinates, *self.grown.parameters}
        return tuple(p for p in self.parameters if p.symbol in mine)

    @property
    def grown(self) -> Growth:
        """The coordinates in which the law grows from nothing: its parameters, if no others."""
        symbols = tuple(p.symbol for p in self.parameters)
        return self.growth or Growth(symbols, signed=self.parameters[0].signed)

    def column_name(self, parameter: Parameter) -> str:
        """Return the name of the column that holds a parameter."""
        shared = isinstance(self.law, Friction) and parameter not in self.own
        owner = self.law.beyond if isinstance(self.law, Friction) and shared else self.key
        return f"{owner}_{parameter.name}".upper()

    def columns(self, values: Mapping[str, float]) -> dict[IntEnum, float]:
        """Return what parameter values fill of the simulator's tables."""
        table = TABLES[self.place]
        by_name = {p.name: table[self.column_name(p)] for p in self.parameters}
        return {by_name[name]: value for name, value in values.items()}

    def grown_values(self, coordinates: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters that go with coordinates (and shared parameters), by symbol."""
        values = {p.name: coordinates[p.symbol] for p in self.own if p.symbol in coordinates}
        for p in self.own:
            if p.symbol in self.grown.parameters:
                values[p.name] = evaluate(self.grown.parameters[p.symbol], coordinates)
        return values

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Return parameter values by their names."""
        return dict(zip(self.names, values, strict=True))

    def places(self, springs: Sequence[bool]) -> tuple[int, ...]:
        """Return where it can sit on a bench: cart or spring numbers, or 0 for the input.

        The two wall springs of a single cart only act through their sum, so one stands for both.
        """
        n = len(springs) - 1
        if n < self.fewest_carts:
            return ()
        if self.place == "input":
            return (0,)
        if self.place == "cart":
            return tuple(range(1, n + 1))
        present = tuple(j for j, there in enumerate(springs, start=1) if there)
        if self.between_carts:
            return tuple(j for j in present if 1 < j <= n)
        return present[:1] if n == 1 else present

    def where(self, place: int) -> dict[str, int]:
        """Return the place as it is written to files: {"cart": 2}, {"spring": 1} or {}."""
        return {} if self.place == "input" else {self.place: place}

    def fill(self, tables: Tables, place: int, values: Sequence[float]) -> None:
        """Write this effect into the simulator's tables."""
        cart, spring, drive = tables
        columns = self.columns(self.named(values))
        for column, value in columns.items():
            if isinstance(column, Drive):
                drive[column] = value
            elif isinstance(column, Cart):
                cart[place - 1, column] = value
            else:
                spring[place - 1, column] = value


@dataclass(frozen=True, kw_only=True)
class Term:
    """An effect at a place, with its parameter values in the effect's order."""

    effect: Effect
    place: int
    values: tuple[float, ...]

    @property
    def where(self) -> dict[str, int]:
        """The place as it is written to files."""
        return self.effect.where(self.place)

    @property
    def label(self) -> str:
        """Effect and place in one word, for messages."""
        return self.effect.key + (f"@{self.place}" if self.place else "")


@dataclass(frozen=True, kw_only=True, eq=False)
class AugmentedChain:
    """The linear chain and the effects that act on it."""

    chain: Chain
    terms: tuple[Term, ...] = ()

    def tables(self) -> Tables:
        """Return the simulator's tables."""
        tables = linear_tables(self.chain)
        for term in self.terms:
            term.effect.fill(tables, term.place, term.values)
        return tables


def spring_force(scales: Scales) -> float:
    """Return the usual size of a force: that of the springs."""
    return scales.stiffness * scales.position


def make_term(effect: Effect, *, place: int, values: Mapping[str, float], chain: Chain) -> Term:
    """Make a term from named values; contact details not given get their usual size.

    Raises
    ------
    ConfigError : a place or a parameter the effect does not have, or a missing one.
    """
    springs = tuple(bool(k > 0) for k in chain.k)
    # Either wall spring of a single cart will do: they act through their sum.
    either_wall = effect.place == "spring" and chain.n == 1 and place in (1, 2)
    if place not in effect.places(springs) and not either_wall:
        raise ConfigError(f"{effect.key}: no {effect.place} {place} on this bench")
    unknown = [name for name in values if name not in effect.names]
    if unknown:
        raise ConfigError(f"{effect.key}: has {', '.join(effect.names)}, found {unknown[0]}")
    mirrored = either_wall and chain.k[place - 1] == 0.0
    place = 3 - place if mirrored else place
    scales = chain_scales(chain, place=effect.place, at=place)
    chosen: list[float] = []
    for parameter in effect.parameters:
        if parameter.name in values:
            # The other spring is stretched where this one is slackened.
            side = -1.0 if mirrored and parameter.side else 1.0
            chosen.append(side * float(values[parameter.name]))
        elif parameter.reported:
            raise ConfigError(f"{effect.key}: needs {parameter.name}")
        else:
            chosen.append(parameter.scale(scales) * parameter.trials[0])
    return Term(effect=effect, place=place, values=tuple(chosen))


def chain_scales(
    chain: Chain,
    *,
    place: Place,
    at: int,
    position: Array | None = None,
    velocity: Array | None = None,
    input: float = 1.0,
    sample_time: float = 0.01,
) -> Scales:
    """Return the typical sizes at a place.

    `position` and `velocity` (n + 1,) are the largest of each cart or spring stretch; default 1.
    """
    position = np.ones(chain.n + 1) if position is None else position
    velocity = np.ones(chain.n + 1) if velocity is None else velocity
    i = max(at - 1, 0)
    near = min(i, chain.n - 1)
    stiffness = chain.k[i] if place == "spring" else float(np.diag(chain.stiffness)[near])
    if stiffness <= 0.0:
        # A cart without springs: what its inertia needs stands in for the spring force.
        stiffness = chain.m[near] * (velocity[i] / position[i]) ** 2
    return Scales(
        position=float(position[i]),
        velocity=float(velocity[i]),
        input=input,
        sample_time=sample_time,
        mass=float(chain.m[near]),
        damping=float(max(chain.c[near], 0.02 * np.sqrt(chain.m[near] * stiffness))),
        stiffness=float(stiffness),
    )
