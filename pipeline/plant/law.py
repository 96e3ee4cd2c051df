"""The law of an effect, written once as expressions in Python's syntax.

On a cart (cart 1, for the input) the symbols are `x` and `v`. On a spring they are the stretch `d`,
its `rate` of change, and the stiffness `k`. Everywhere, `u` is the force of the drive on its body.
`on` is 1 while the drive is powered, otherwise 0. `z` is an internal state of the law. All other
names are symbols of parameters. The functions are abs, sign, exp, sin, cos, min, max, clip.

`python -m docs.codegen` generates compiled code from the laws, with all derivatives.
"""

import ast
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from math import atan2, hypot, inf
from typing import Literal

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
