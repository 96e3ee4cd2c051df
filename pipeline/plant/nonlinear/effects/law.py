"""The law of an effect, written once: expressions in Python's syntax, over symbols.

Quantities on a cart (of cart 1, for the input): `x`, `v`. On a spring: its stretch `d`, `rate` and
stiffness `k`. Everywhere: `u`, the force that arrives from the drive; `on`, 1 while the drive is
powered and 0 else; `z`, a state of the law's own. All other names are symbols of parameters. The
functions are abs, sign, exp, sin, cos, min, max, clip.

`python -m docs.codegen` makes compiled code, with all derivatives.
"""

import ast
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from math import atan2, hypot, inf
from typing import Literal

_QUANTITIES = {"x": "x", "v": "v", "d": "d", "rate": r"\dot d", "u": "u", "k": "k"}
_GREEK = {"μ": r"\mu", "λ": r"\lambda", "φ": r"\phi", "π": r"\pi", "δ": r"\delta"}
_HELD = 2.5e-3  # s; nonlinear forces are held over a step


@dataclass(frozen=True)
class Force:
    """A force on a cart, or the tension that a spring has more; smooth but for corners.

    Attributes
    ----------
    step : the longest step in s over which the force may be held.
    on_motor : of an input: it acts on the motor, not on cart 1, where there is play between them.
    """

    force: str
    _: KW_ONLY
    step: float = _HELD
    on_motor: bool = False


@dataclass(frozen=True)
class Friction:
    """Dry friction: its size while the cart slides; at rest it holds up to as much.

    Attributes
    ----------
    at_rest : what it holds, where that is not the same.
    beyond : key of the friction that it has within, whose parameters it shares.
    """

    size: str
    _: KW_ONLY
    at_rest: str = ""
    beyond: str = ""
    step: float = inf


@dataclass(frozen=True)
class Hysteresis:
    """Dry friction with a state `z`, from -1 to 1, of its own: force and rate are linear in it."""

    force: str
    _: KW_ONLY
    rate: str
    step: float = inf


@dataclass(frozen=True)
class Contact:
    """A force past a position (or stretch), whose sign is the side; it may only push, or pull too.

    The simulators switch it at its very instant.
    """

    force: str
    _: KW_ONLY
    past: str
    pulls: bool = False
    step: float = inf


@dataclass(frozen=True)
class Input:
    """What arrives of the input `u`."""

    arrives: str
    step: float = inf


@dataclass(frozen=True)
class Built:
    """A law with a state of its own, which the simulators have built in; its equation in TeX."""

    kind: Literal["hidden mass", "play", "delay", "lag", "reading"]
    equation: str
    step: float = inf


Law = Force | Friction | Hysteresis | Contact | Input | Built


@dataclass(frozen=True)
class Growth:
    """Coordinates in which a law grows from nothing in proportion, for a fit from nothing.

    Attributes
    ----------
    coordinates : symbols; those of parameters mean these.
    parameters : the other parameters, by symbol: expressions in the coordinates, with `hypot` and
        `atan2`, the spring's stiffness `k` and the parameters that are shared.
    signed : the first one may be of either sign.
    """

    coordinates: tuple[str, ...]
    parameters: Mapping[str, str] = field(default_factory=dict)
    signed: bool = False


def evaluate(text: str, values: Mapping[str, float]) -> float:
    """Return the value of an expression."""
    names = {"hypot": hypot, "atan2": atan2, **values}
    return float(eval(text, {"__builtins__": {}}, names))


def names_in(text: str) -> set[str]:
    """Return the names that an expression has, functions too."""
    return {node.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Name)}


def equation_of(law: Law, *, place: str, unseen: set[str]) -> str:
    """Return the law as TeX, without the terms of `unseen` symbols."""
    tex = _Tex(place=place, unseen=unseen)
    before = "k d + " if place == "spring" else ""
    match law:
        case Built():
            return law.equation
        case Input():
            return rf"u \to {tex(law.arrives)}"
        case Force():
            while_on = r" \text{ while } u \ne 0" if "on" in names_in(law.force) else ""
            return f"f = {before}{tex(law.force)}{while_on}"
        case Hysteresis():
            return rf"f = {tex(law.force)}, \quad \dot z = {tex(law.rate)}"
        case Contact():
            never = "" if law.pulls else r", \text{ never pulling}"
            return rf"f = {before}{tex(law.force)} \text{{ past }} {tex(law.past)}{never}"
        case Friction():
            size = tex(law.size)
            size = rf"\left({size}\right)" if " + " in size or " - " in size else size
            held = tex(law.at_rest or law.size)
            return rf"f = -{size} \operatorname{{sign}} v, \quad |f| \le {held} \text{{ at rest}}"


_SUM, _PRODUCT, _POWER, _ATOM = range(4)


class _Tex:
    """Turns expressions into TeX."""

    def __init__(self, *, place: str, unseen: set[str]) -> None:
        index = "_1" if place == "input" else ""
        self._names = {**_QUANTITIES, "x": f"x{index}", "v": f"v{index}", **_GREEK}
        self._unseen = unseen | {"on"}

    def __call__(self, text: str) -> str:
        return self._term(ast.parse(text, mode="eval").body)

    def _term(self, node: ast.expr, least: int = _SUM) -> str:
        text, binds = self._bound(node)
        return text if binds >= least else f"({text})"

    def _bound(self, node: ast.expr) -> tuple[str, int]:
        """Return an expression and how firmly it binds."""
        match node:
            case ast.Constant(value=value):
                return str(value), _ATOM
            case ast.Name(id=name):
                return self._names.get(name, name), _ATOM
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                if not self._seen(right):
                    return self._bound(left)
                sign = "+" if isinstance(op, ast.Add) else "-"
                return f"{self._term(left)} {sign} {self._term(right, _PRODUCT)}", _SUM
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                return f"{self._term(left, _PRODUCT)}/{self._term(right, _POWER)}", _PRODUCT
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return f"{self._term(left, _ATOM)}^{self._term(right, _ATOM)}", _POWER
            case ast.BinOp(op=ast.Mult()) | ast.UnaryOp():
                return self._product(node)
            case ast.Call(func=ast.Name(id=name), args=arguments):
                return self._call(name, arguments)
        raise ValueError(f"no part of a law: {ast.unparse(node)}")

    def _product(self, node: ast.expr) -> tuple[str, int]:
        factors: list[ast.expr] = []
        while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            factors.insert(0, node.right)
            node = node.left
        minus = isinstance(node, ast.UnaryOp)
        factors.insert(0, node.operand if isinstance(node, ast.UnaryOp) else node)
        text = " ".join(self._term(factor, _PRODUCT) for factor in factors if self._seen(factor))
        return (f"-{text}", _SUM) if minus else (text, _PRODUCT)

    def _call(self, name: str, arguments: list[ast.expr]) -> tuple[str, int]:
        texts = [self._term(argument) for argument in arguments]
        if name == "abs":
            return f"|{texts[0]}|", _ATOM
        if name == "exp":
            return f"e^{{{texts[0]}}}", _ATOM
        if name == "sign":
            return rf"\operatorname{{sign}} {self._term(arguments[0], _ATOM)} \cdot", _PRODUCT
        command = (
            rf"\{name}" if name in ("sin", "cos", "min", "max") else rf"\operatorname{{{name}}}"
        )
        return f"{command}({', '.join(texts)})", _ATOM

    def _seen(self, node: ast.expr) -> bool:
        return not self._unseen & names_in(ast.unparse(node))
