"""The laws of effects, the effects as hypotheses about a bench, and a chain with effects."""

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from enum import IntEnum
from math import atan2, hypot, inf
from typing import ClassVar, Literal

import numpy as np
from pydantic_core import CoreSchema, core_schema

from pipeline.arrays import Array
from pipeline.json_files import computed, result, written
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.tables import TABLES, Tables, linear_tables
from pipeline.words.math import (
    WIDE_SPACE,
    Math,
    Term,
    dot,
    function,
    parens,
    power,
    row,
    sub,
    upright,
)

# --------------------------------------- the law, written once as expressions in Python's syntax
#
# On a cart (cart 1, for the input) the symbols are `x` and `v`. On a spring they are the stretch
# `d`, its `rate` of change, and the stiffness `k`. Everywhere, `u` is the force of the drive on its
# body. `on` is 1 while the drive is powered, otherwise 0. `z` is an internal state of the law. All
# other names are symbols of parameters. The functions are abs, sign, exp, sin, cos, min, max, clip.
#
# `python -m pipeline.plant.simulator.codegen` generates compiled code from the laws, with all
# derivatives.


@dataclass(frozen=True)
class ForceLaw:
    """A force on a cart, or an additional tension of a spring; smooth except at corners.

    Attributes
    ----------
    step : the longest time, in s, over which the force may be held constant.
    on_motor : for an effect of the input with backlash, whether the force acts on the motor instead
        of on cart 1.
    """

    force: str
    _: KW_ONLY
    step: float = 2.5e-3
    on_motor: bool = False


@dataclass(frozen=True)
class FrictionLaw:
    """Dry friction: `size` is the force while sliding, and the largest force held at rest.

    Attributes
    ----------
    at_rest : the largest force at rest, if it differs from `size`.
    beyond : key of the friction that this effect contains, and with which it shares parameters.
    """

    size: str
    _: KW_ONLY
    at_rest: str = ""
    beyond: str = ""
    step: float = inf


@dataclass(frozen=True)
class HysteresisLaw:
    """Dry friction with its own state `z`, from -1 to 1; force and rate are linear in it."""

    force: str
    _: KW_ONLY
    rate: str
    step: float = inf


@dataclass(frozen=True)
class ContactLaw:
    """A force beyond a position or stretch; it may only push, or also pull.

    The sign of the position selects the side. The simulators switch the force at the exact instant.
    """

    force: str
    _: KW_ONLY
    past: str
    pulls: bool = False
    step: float = inf


@dataclass(frozen=True)
class InputLaw:
    """The part of the input `u` that arrives at the body."""

    arrives: str
    step: float = inf


@dataclass(frozen=True)
class BuiltLaw:
    """A law with its own state, built into the simulators."""

    kind: Literal["hidden mass", "play", "delay", "lag", "reading"]
    formula: Math
    step: float = inf


Law = ForceLaw | FrictionLaw | HysteresisLaw | ContactLaw | InputLaw | BuiltLaw


@dataclass(frozen=True)
class FitCoordinates:
    """Coordinates in which the force grows in proportion from zero, for a fit that starts at zero.

    Attributes
    ----------
    coordinates : symbols of the coordinates. The symbol of a parameter stands for that parameter.
    parameters : expressions for the other parameters, by symbol. They may use the coordinates,
        `hypot` and `atan2`, the spring's stiffness `k` and the shared parameters.
    signed : whether the first coordinate may be negative.
    """

    coordinates: tuple[str, ...]
    parameters: Mapping[str, str] = field(default_factory=dict)
    signed: bool = False


def evaluate(text: str, values: Mapping[str, float]) -> float:
    """Return the value of an expression."""
    names = {"hypot": hypot, "atan2": atan2, **values}
    return float(eval(text, {"__builtins__": {}}, names))


def names_in(text: str) -> set[str]:
    """Return the names in an expression, including functions."""
    return {node.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Name)}


def formula_of(law: Law, *, place: str, unseen: set[str]) -> Math:
    """Return the law as mathematics, without the terms in `unseen` symbols."""
    written = _Formula(place=place, unseen=unseen)
    before = ("k", "d", "+") if place == "spring" else ()
    match law:
        case BuiltLaw():
            return law.formula
        case InputLaw():
            return row("u", "→", *written(law.arrives))
        case ForceLaw():
            powered = (upright(" while "), "u", "≠", "0") if "on" in names_in(law.force) else ()
            return row("f", "=", *before, *written(law.force), *powered)
        case HysteresisLaw():
            rate = (dot("z"), "=", *written(law.rate))
            return row("f", "=", *written(law.force), ",", WIDE_SPACE, *rate)
        case ContactLaw():
            past = (upright(" past "), *written(law.past))
            never = () if law.pulls else (",", upright(" never pulling"))
            return row("f", "=", *before, *written(law.force), *past, *never)
        case FrictionLaw():
            slides = ("−", *written(law.size, least=_PRODUCT), *function("sign"), "v")
            held = ("|", "f", "|", "≤", *written(law.at_rest or law.size), upright(" at rest"))
            return row("f", "=", *slides, ",", WIDE_SPACE, *held)


_SUM, _PRODUCT, _POWER, _ATOM = range(4)  # precedence of an operation


class _Formula:
    """Turns expressions into lists of mathematical terms."""

    def __init__(self, *, place: str, unseen: set[str]) -> None:
        on_cart_1 = {"x": sub("x", "1"), "v": sub("v", "1")} if place == "input" else {}
        self._names: dict[str, Term] = {"rate": dot("d"), **on_cart_1}
        self._unseen = unseen | {"on"}

    def __call__(self, text: str, *, least: int = _SUM) -> list[Term]:
        return self._terms(ast.parse(text, mode="eval").body, least)

    def _terms(self, node: ast.expr, least: int = _SUM) -> list[Term]:
        terms, binds = self._bound(node)
        return terms if binds >= least else [parens(*terms)]

    def _bound(self, node: ast.expr) -> tuple[list[Term], int]:
        """Return the terms of an expression, and its precedence."""
        match node:
            case ast.Constant(value=value):
                return [str(value)], _ATOM
            case ast.Name(id=name):
                return [self._names.get(name, name)], _ATOM
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                if not self._seen(right):
                    return self._bound(left)
                sign = "+" if isinstance(op, ast.Add) else "−"
                return [*self._terms(left), sign, *self._terms(right, _PRODUCT)], _SUM
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                return [*self._terms(left, _PRODUCT), "/", *self._terms(right, _POWER)], _PRODUCT
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                base, exponent = self._terms(left, _ATOM), self._terms(right, _ATOM)
                return [power(base[0], exponent[0])], _POWER
            case ast.BinOp(op=ast.Mult()) | ast.UnaryOp():
                return self._product(node)
            case ast.Call(func=ast.Name(id=name), args=arguments):
                return self._call(name, arguments)
        raise ValueError(f"no part of a law: {ast.unparse(node)}")

    def _product(self, node: ast.expr) -> tuple[list[Term], int]:
        factors: list[ast.expr] = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            factors.insert(0, node.right)
            node = node.left
        minus = isinstance(node, ast.UnaryOp)
        factors.insert(0, node.operand if isinstance(node, ast.UnaryOp) else node)
        seen = [factor for factor in factors if self._seen(factor)]
        terms = [term for factor in seen for term in self._terms(factor, _PRODUCT)]
        return (["−", *terms], _SUM) if minus else (terms, _PRODUCT)

    def _call(self, name: str, arguments: list[ast.expr]) -> tuple[list[Term], int]:
        first, *others = (self._terms(argument) for argument in arguments)
        if name == "abs":
            return ["|", *first, "|"], _ATOM
        if name == "exp":
            return [power("e", row(*first))], _ATOM
        if name == "sign":
            return [*function("sign"), *self._terms(arguments[0], _ATOM), "·"], _PRODUCT
        inside = [*first, *(term for other in others for term in (",", *other))]
        return [*function(name, parens(*inside))], _ATOM

    def _seen(self, node: ast.expr) -> bool:
        return not self._unseen & names_in(ast.unparse(node))


# ---------------------------------------------------------------------- the effect

Place = Literal["cart", "spring", "input"]
Axis = Literal["velocity", "position", "stretch", "input", "time", "frequency"]
# The motions that show an effect best; `templates/words/effects.toml` describes each kind.
Motions = Literal[
    "small motions",
    "large motions",
    "both sides",
    "about zero",
    "slow motions",
    "driven motions",
    "held carts",
    "edges",
    "sweeps",
    "ruler",
]


@dataclass(frozen=True, kw_only=True)
class PlaceScales:
    """Typical sizes at one cart or spring of a bench, from its recordings and its linear model.

    Attributes
    ----------
    position, velocity : the largest values for the cart, or for the stretch of the spring.
    input : the largest input.
    mass, damping, stiffness : values for the cart with all its springs, or for the spring and a
        cart at its end.
    """

    position: float
    velocity: float
    input: float
    sample_time: float
    mass: float
    damping: float
    stiffness: float


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Attributes
    ----------
    unit : unit in terms of "position", "input" and "s"; empty for a pure number.
    scale : typical size at a place, as an expression in the fields of `PlaceScales`. Starting
        values and steps of a fit are multiples of it.
    typical : the multiple of `scale` that makes the effect clearly visible. It is used to hide
        effects in a practice bench.
    signed : whether the parameter may change its sign in a fit.
    side : whether the parameter's sign selects a side. Such a sign never changes.
    neutral : the value at which the effect vanishes, if there is one.
    lower, upper : bounds of the magnitude, in multiples of `scale`.
    reach : the largest step of the parameter's logarithm in a fit.
    reported : False for a detail of a contact, which the simulation needs but users do not ask for.
    """

    name: str
    symbol: str
    unit: str
    _: KW_ONLY
    scale: str
    typical: float = 1.0
    signed: bool = False
    side: bool = False
    neutral: float | None = None
    lower: float = 0.0
    upper: float = np.inf
    reach: float = 0.4
    reported: bool = True

    def size(self, scales: PlaceScales) -> float:
        """Return the typical size at a place."""
        return evaluate(self.scale, vars(scales))

    def unit_text(self, *, position: str, input: str) -> str:
        """Return the unit in terms of the submission's own units."""
        return self.unit.replace("position", position).replace("input", input)


def always(values: Mapping[str, float]) -> bool:
    """Return True. A function with a name, unlike a lambda, can be sent to another process."""
    return True


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One physical effect of the catalogue.

    Attributes
    ----------
    key : the effect's name in files.
    sentence : an explanation for a student.
    law : the law, in the symbols of the parameters.
    growth : the coordinates in which a fit grows the effect from zero. None if the
        parameters serve as coordinates.
    fingerprint : how the effect shows in the data.
    deciding_run : the experiment that confirms the effect or rules it out.
    shown_by : the kind of motions that show the effect best.
    axis : the quantity on which the force (or reading) depends.
    between_carts : whether the effect exists only on springs between carts. On a spring to a wall
        it would be part of the linear chain.
    fewest_carts : number of carts below which the effect is part of the linear chain.
    family : name of a group of effects that exclude each other at one place. The same family on
        several carts counts as one effect.
    grows_from : key of the simpler effect whose fit is the start of this one's fit.
    only_rest : whether only rest positions show the effect, as for an encoder zero. It is then
        found from them.
    equivalent : which other effects the data cannot distinguish from this one, and why.
    same_as, same_below : key of an effect that provably cannot be distinguished from this one while
        this one's first parameter is below `same_below` sample times.
    genuine : a function of the parameter values that returns False if they amount to another law.
    """

    written_as: ClassVar[str] = "key"

    key: str
    title: str
    sentence: str
    place: Place
    law: Law
    parameters: tuple[EffectParameter, ...]
    fingerprint: str
    deciding_run: str
    shown_by: Motions
    reference: str
    axis: Axis
    growth: FitCoordinates | None = None
    family: str = ""
    between_carts: bool = False
    fewest_carts: int = 1
    grows_from: str | None = None
    only_rest: bool = False
    equivalent: str = ""
    same_as: str = ""
    same_below: float = np.inf
    genuine: Callable[[Mapping[str, float]], bool] = always

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> CoreSchema:
        """Return how pydantic reads an effect: a file names it."""
        from pipeline.plant.catalogue import find_effect  # the catalogue imports this file

        return core_schema.no_info_after_validator_function(find_effect, core_schema.str_schema())

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters' names, in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def contact(self) -> bool:
        """Whether the effect has a contact, some of whose parameters are not reported."""
        return not all(p.reported for p in self.parameters)

    @property
    def formula(self) -> Math:
        """The law as mathematics, without details of the contact."""
        unseen = {p.symbol for p in self.parameters if not p.reported}
        return formula_of(self.law, place=self.place, unseen=unseen)

    @property
    def dry(self) -> bool:
        """Whether the effect is dry friction, whose size may differ between runs."""
        return isinstance(self.law, FrictionLaw | HysteresisLaw)

    @property
    def many_rests(self) -> bool:
        """Whether carts may rest away from the equilibrium of their springs."""
        repeats = isinstance(self.law, ForceLaw) and {"x", "sin"} <= names_in(self.law.force)
        return self.dry or repeats

    @property
    def has_play(self) -> bool:
        """Whether the motor may lose contact with cart 1."""
        return self.is_built("play")

    @property
    def hides_mass(self) -> bool:
        """Whether a body moves that no sensor reads."""
        return self.is_built("hidden mass")

    @property
    def needs_input(self) -> bool:
        """Whether the effect changes nothing in a motion without input."""
        powered = isinstance(self.law, ForceLaw) and "on" in names_in(self.law.force)
        return powered or isinstance(self.law, InputLaw) or self.is_built("delay", "lag")

    @property
    def needs_drive(self) -> bool:
        """Whether the law uses the input."""
        match self.law:
            case ForceLaw(force=text) | FrictionLaw(size=text):
                return bool({"u", "on"} & names_in(text)) or self.place == "input"
        return self.place == "input"

    def is_built(self, *kinds: str) -> bool:
        """Whether the law is one of the given kinds, which are built into the simulators."""
        return isinstance(self.law, BuiltLaw) and self.law.kind in kinds

    @property
    def own(self) -> tuple[EffectParameter, ...]:
        """The parameters, without those shared with the friction that this effect contains."""
        if not (isinstance(self.law, FrictionLaw) and self.law.beyond):
            return self.parameters
        mine = {*self.grown.coordinates, *self.grown.parameters}
        return tuple(p for p in self.parameters if p.symbol in mine)

    @property
    def grown(self) -> FitCoordinates:
        """The coordinates in which the law grows from zero; by default its parameters."""
        symbols = tuple(p.symbol for p in self.parameters)
        return self.growth or FitCoordinates(symbols, signed=self.parameters[0].signed)

    def column_name(self, parameter: EffectParameter) -> str:
        """Return the name of the column that holds a parameter."""
        shared = isinstance(self.law, FrictionLaw) and parameter not in self.own
        owner = self.law.beyond if isinstance(self.law, FrictionLaw) and shared else self.key
        return f"{owner}_{parameter.name}".upper()

    def columns(self, values: Mapping[str, float]) -> dict[IntEnum, float]:
        """Return the entries in the simulator's tables for given parameter values."""
        table = TABLES[self.place]
        by_name = {p.name: table[self.column_name(p)] for p in self.parameters}
        return {by_name[name]: value for name, value in values.items()}

    def grown_values(self, coordinates: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters by symbol, for given coordinates (and shared parameters)."""
        values = {p.name: coordinates[p.symbol] for p in self.own if p.symbol in coordinates}
        for p in self.own:
            if p.symbol in self.grown.parameters:
                values[p.name] = evaluate(self.grown.parameters[p.symbol], coordinates)
        return values

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Return parameter values by their names."""
        return dict(zip(self.names, values, strict=True))

    def places(self, springs: Sequence[bool]) -> tuple[int, ...]:
        """Return the possible places of the effect: cart or spring numbers, or 0 for the input.

        The two wall springs of a single cart act only through their sum, so one represents both.
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
        """Return the place in the form used in files: {"cart": 2}, {"spring": 1} or {}."""
        return {} if self.place == "input" else {self.place: place}

    def fill(self, tables: Tables, place: int, values: Sequence[float]) -> None:
        """Write this effect into the simulator's tables."""
        table = dict(zip(TABLES, tables, strict=True))[self.place]
        row = table if self.place == "input" else table[place - 1]
        for column, value in self.columns(self.named(values)).items():
            row[column] = value


@result()
class EffectTerm:
    """An effect at a place, with its parameter values in the effect's order."""

    effect: Effect = written("name of the effect in the catalogue")
    place: int
    values: tuple[float, ...]

    @computed()
    def where(self) -> dict[str, int]:
        """The place: {"cart": 1} or {"spring": 2}; empty for the input."""
        return self.effect.where(self.place)

    @computed()
    def parameters(self) -> dict[str, float]:
        """The values by name."""
        return self.effect.named(self.values)

    @classmethod
    def from_written(
        cls, *, effect: Effect, where: Mapping[str, int], parameters: Mapping[str, float]
    ) -> "EffectTerm":
        """Return the effect that a file states; raise `KeyError` if a parameter is missing."""
        values = tuple(parameters[name] for name in effect.names)
        return cls(effect=effect, place=next(iter(where.values()), 0), values=values)

    @property
    def label(self) -> str:
        """Effect and place in one word, for messages."""
        return self.effect.key + (f"@{self.place}" if self.place else "")


@result(eq=False)
class AugmentedChain:
    """The linear chain and the effects that act on it."""

    chain: Chain = written()
    terms: tuple[EffectTerm, ...] = written(key="effects", default_factory=tuple)

    def tables(self) -> Tables:
        """Return the simulator's tables."""
        tables = linear_tables(self.chain)
        for term in self.terms:
            term.effect.fill(tables, term.place, term.values)
        return tables


def input_steps(terms: Sequence[EffectTerm]) -> list[EffectTerm]:
    """Return the effects that change the input, in the order of the simulator.

    The dead zone comes first, then the saturation, the delay and the lag.
    """
    laws = [term for term in terms if isinstance(term.effect.law, InputLaw)]
    laws.sort(key=lambda term: term.effect.key)
    built = [[term for term in terms if term.effect.is_built(kind)] for kind in ("delay", "lag")]
    return [*laws, *built[0], *built[1]]


def chain_scales(
    chain: Chain,
    *,
    place: Place,
    at: int,
    largest: tuple[Array, Array] | None = None,
    input: float = 1.0,
    sample_time: float = 0.01,
) -> PlaceScales:
    """Return the typical sizes at a place.

    `largest` holds the largest positions and velocities, (n + 1,) each, of the carts or of the
    spring stretches. By default they are 1.
    """
    position, velocity = np.ones((2, chain.n + 1)) if largest is None else largest
    i = max(at - 1, 0)
    near = min(i, chain.n - 1)
    stiffness = chain.k[i] if place == "spring" else float(np.diag(chain.stiffness)[near])
    if stiffness <= 0.0:
        # For a cart without springs, the inertial force replaces the spring force.
        stiffness = chain.m[near] * (velocity[i] / position[i]) ** 2
    return PlaceScales(
        position=float(position[i]),
        velocity=float(velocity[i]),
        input=input,
        sample_time=sample_time,
        mass=float(chain.m[near]),
        damping=float(max(chain.c[near], 0.02 * np.sqrt(chain.m[near] * stiffness))),
        stiffness=float(stiffness),
    )


def effect_name(effect: Effect, where: Mapping[str, int]) -> str:
    """Return an effect's name inside a sentence: "dry (Coulomb) friction on cart 2"."""
    title = effect.title[:1].lower() + effect.title[1:]
    place = place_name(where)
    if not place:
        return title
    named = any(kind in title for kind in where)  # for example "a hidden mass on a cart"
    return f"{title} ({place})" if named else f"{title} on {place}"


def place_name(where: Mapping[str, int]) -> str:
    """Return "cart 2" or "spring 1"; "" for the input."""
    return " ".join(f"{kind} {number}" for kind, number in where.items())
