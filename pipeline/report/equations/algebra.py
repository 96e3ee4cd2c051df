"""Equations as text: shown as mathematics, worked out with numbers, and checked by tests.

A derivation is a list of `Equation`s. Each side is a line of Python arithmetic, such as
"K_2/K_1*w_2". The same text is shown to readers, computed with numbers, and checked in the tests by
a computer algebra system. Names are shown in usual notation: `w_2` is the square of omega_2,
`left_2` is the ratio k_2/m_2.
"""

import ast
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from pipeline.names import read_name
from pipeline.words.math import (
    GREEK,
    Math,
    Term,
    dot,
    fraction,
    negative,
    number,
    parens,
    power,
    row,
    sub,
)
from pipeline.words.numbers import significant

DIGITS = 5  # digits shown; all digits are used in calculations
_IN_S = ("Delta", "N", "R", "P", "X", "U")  # names that are functions of s


@dataclass(frozen=True)
class Equation:
    """An equation `left` = `right`; if `left` is a single name, the equation defines it."""

    left: str
    right: str


def work_out(equations: Iterable[Equation], values: Mapping[str, float]) -> dict[str, float]:
    """Return `values` together with the names that the equations define, computed in order."""
    known = dict(values)
    for equation in equations:
        known[equation.left] = evaluate(equation.right, known)
    return known


def evaluate(text: str, values: Mapping[str, float]) -> float:
    """Return the value of an expression."""
    return _value(_parse(text), values)


def _parse(text: str) -> ast.expr:
    return ast.parse(text, mode="eval").body


def _value(node: ast.expr, values: Mapping[str, float]) -> float:
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=int(value)):
            return float(value)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_value(operand, values)
        case ast.BinOp(left=left, op=op, right=right):
            a, b = _value(left, values), _value(right, values)
            match op:
                case ast.Add():
                    return a + b
                case ast.Sub():
                    return a - b
                case ast.Mult():
                    return a * b
                case ast.Div():
                    return a / b
                case ast.Pow():
                    return a**b
    raise ValueError(f"no arithmetic: {ast.unparse(node)}")


def addends(text: str) -> list[str]:
    """Return the terms of a sum."""
    node, found = _parse(text), []
    while isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        found.insert(0, ast.unparse(node.right))
        node = node.left
    return [ast.unparse(node), *found]


# ------------------------------------------------------------------- as mathematics


def shown(text: str) -> Term:
    """Return an expression as mathematics with symbols."""
    return _term(_parse(text), name_term)


def shown_with(text: str, values: Mapping[str, float]) -> Term:
    """Return an expression as mathematics with numbers in place of the names."""
    return _term(_parse(text), lambda name: value_term(values[name]), numeric=True)


def value_term(value: float) -> Term:
    """Return a number as a term."""
    return number(significant(value, digits=DIGITS))


def name_term(name: str) -> Term:
    """Return a name in usual notation."""
    read = read_name(name)
    base, index = read.symbol, read.suffix
    match base:
        case "w":
            return power(sub("ω", index), "2")
        case "left":
            return fraction(sub("k", index), sub("m", index))
        case "right":
            return fraction(sub("k", str(int(index) + 1)), sub("m", index))
        case "ddx" | "dx":
            return sub(dot("x", order=base.count("d")), index)
        case "inverse":  # for example inverse_m_1
            return fraction("1", name_term(index))
    letter = _GREEK.get(base, base)
    term = sub(letter, index) if index else letter
    return row(term, parens("s")) if base in _IN_S else term


_GREEK = {**GREEK, "kappa": "κ", "Delta": "Δ"}

_SUM, _PRODUCT, _POWER = 1, 2, 3  # precedence of an operation


def _binding(node: ast.expr) -> int:
    match node:
        case ast.BinOp(op=ast.Add() | ast.Sub()) | ast.UnaryOp():
            return _SUM
        case ast.BinOp(op=ast.Mult()):
            return _PRODUCT
        case _:  # a name, number, power or fraction needs no brackets
            return _POWER


def _term(node: ast.expr, name: Callable[[str], Term], *, numeric: bool = False) -> Term:
    def inside(part: ast.expr, *, at_least: int) -> Term:
        term = _term(part, name, numeric=numeric)
        loose = _binding(part) < at_least or (at_least > _SUM and _is_negative(term))
        return parens(term) if loose else term

    match node:
        case ast.Name(id=text):
            return name(text)
        case ast.Constant(value=value):
            return str(value)
        case ast.UnaryOp(operand=operand):
            return negative(inside(operand, at_least=_PRODUCT))
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
            sign = "+" if isinstance(op, ast.Add) else "−"
            b = inside(right, at_least=_SUM if sign == "+" else _PRODUCT)
            if _is_negative(b):
                b = parens(b)
            return row(inside(left, at_least=_SUM), sign, b)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            a, b = (inside(part, at_least=_PRODUCT) for part in (left, right))
            return row(a, "·", b) if numeric else row(a, b)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            return fraction(*(_term(part, name, numeric=numeric) for part in (left, right)))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            base = inside(left, at_least=_POWER)
            compound = isinstance(base, Math) and base.kind not in ("sub", "parens")
            return power(parens(base) if compound else base, _term(right, name))
    raise ValueError(f"no arithmetic: {ast.unparse(node)}")


def _is_negative(term: Term) -> bool:
    return isinstance(term, Math) and term.kind == "row" and term.parts[:1] == ("−",)
