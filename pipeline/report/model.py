"""The model as mathematics: equations of motion, matrices, transfer functions.

Symbolic terms follow the paper's notation; numbers are written with four digits.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.plant.chain import Array, Chain, ComplexArray, quadratic_factors
from pipeline.report.document import Formula
from pipeline.report.mathematics import (
    Math,
    Term,
    dot,
    fraction,
    lines,
    matrix,
    negative,
    number,
    parens,
    power,
    row,
    sub,
    symbol,
    to_text,
    total,
)
from pipeline.report.numbers import significant

_DIGITS = 4


def formula(math: Math) -> Formula:
    """Return a displayed equation with its reading in plain text."""
    return Formula(math=math, alt=to_text(math))


# ------------------------------------------------------------------- symbols


def _indexed(letter: str, i: int, *, n: int) -> Term:
    """Return m_i; a lone cart needs no index."""
    return letter if n == 1 else sub(letter, str(i))


def _springs_at(cart: int, springs: Sequence[bool]) -> list[Term]:
    """Return the symbols of the springs that end at a cart."""
    n = len(springs) - 1
    if n == 1:
        return ["k"] if any(springs) else []
    return [sub("k", str(j)) for j in (cart, cart + 1) if springs[j - 1]]


def _between(cart: int, neighbour: int, springs: Sequence[bool]) -> Term | None:
    """Return the symbol of the spring between two neighbours, None where there is none."""
    j = max(cart, neighbour)
    inside = 1 <= neighbour < len(springs)
    return sub("k", str(j)) if inside and springs[j - 1] else None


def equations_of_motion(springs: Sequence[bool]) -> Formula:
    """Return Newton's law for every cart, with the springs that are there."""
    n = len(springs) - 1
    equations = []
    for i in range(1, n + 1):
        x = sub("x", str(i))
        left: list[Term] = [
            row(_indexed("m", i, n=n), dot(x, order=2)),
            row(_indexed("c", i, n=n), dot(x)),
        ]
        held = _springs_at(i, springs)
        if held:
            left.append(row(held[0] if len(held) == 1 else parens(total(held)), x))
        equation: list[Term] = [total(left)]
        for neighbour in (i - 1, i + 1):
            if k := _between(i, neighbour, springs):
                equation += ["−", k, sub("x", str(neighbour))]
        equations.append(row(*equation, "=", "u" if i == 1 else "0"))
    return formula(lines(equations))


# ------------------------------------------------------------------ state space


def symbolic_state_space(springs: Sequence[bool]) -> Formula:
    """Return q' = A q + B u with the entries of A and B as fractions of m, c and k."""
    n = len(springs) - 1
    size = range(2 * n)
    A: list[list[Term]] = [["0"] * (2 * n) for _ in size]
    B: list[list[Term]] = [["0"] for _ in size]
    for i in range(1, n + 1):
        place, speed = 2 * i - 2, 2 * i - 1
        m = _indexed("m", i, n=n)
        A[place][speed] = "1"
        if held := _springs_at(i, springs):
            A[speed][place] = negative(fraction(total(held), m))
        A[speed][speed] = negative(fraction(_indexed("c", i, n=n), m))
        for neighbour in (i - 1, i + 1):
            if k := _between(i, neighbour, springs):
                A[speed][2 * neighbour - 2] = fraction(k, m)
    B[1][0] = fraction("1", _indexed("m", 1, n=n))
    states: list[Term] = [x for i in range(1, n + 1) for x in _position_and_speed(i)]
    return formula(
        row(
            matrix([[dot_of(x)] for x in states]), "=", matrix(A), matrix([[x] for x in states]),
            "+", matrix(B), "u",
        )
    )  # fmt: skip


def _position_and_speed(i: int) -> tuple[Math, Math]:
    x = sub("x", str(i))
    return x, dot(x)


def dot_of(term: Term) -> Math:
    """Return the time derivative of x or x'."""
    if isinstance(term, Math) and term.kind == "dot":
        return dot(term.parts[0], order=2)
    return dot(term)


def numeric_state_space(chain: Chain) -> tuple[Formula, ...]:
    """Return A, B, C and D with numbers, in s, position and input units."""
    A, B, C, D = chain.state_space()
    small = [row("B", "=", _numbers(B)), row("C", "=", _numbers(C)), row("D", "=", _numbers(D))]
    return formula(row("A", "=", _numbers(A))), formula(_side_by_side(small))


def _numbers(values: Array) -> Math:
    return matrix([[number(significant(v, digits=_DIGITS)) for v in line] for line in values])


def _side_by_side(terms: Sequence[Math]) -> Math:
    joined: list[Term] = []
    for term in terms:
        joined += [",", term] if joined else [term]
    return row(*joined)


# ----------------------------------------------------------- transfer functions


def symbolic_transfer_functions(springs: Sequence[bool]) -> Formula | None:
    """Return X_i/U as the paper writes them; None where they have no such names.

    Named are one to three carts that some spring ties to a wall.
    """
    n = len(springs) - 1
    if n > 3 or not all(springs[1:-1]) or not any(springs):
        return None
    modes = ["n"] if n == 1 else list("abc"[:n])
    nulls = {1: {1: []}, 2: {1: ["2"], 2: []}, 3: {1: ["x", "y"], 2: ["3"], 3: []}}[n]
    below = [_symbolic_factor(mode, lone=n == 1) for mode in modes]
    return formula(
        lines(
            row(
                _ratio(i),
                "=",
                fraction(
                    _product(
                        [_indexed("K", i, n=n), *(parens(_symbolic_factor(z)) for z in nulls[i])]
                    ),
                    below[0] if n == 1 else _product([parens(factor) for factor in below]),
                ),
            )
            for i in range(n, 0, -1)
        )
    )


def numeric_transfer_functions(chain: Chain) -> Formula:
    """Return X_i/U with numbers: static gain and quadratic factors, or polynomials.

    A chain that no wall holds has no static gain, so its polynomials are shown.
    """
    if not np.any(chain.k > 0) or np.min(np.abs(chain.poles)) == 0:
        return formula(lines(_polynomial_ratio(chain, i) for i in range(chain.n, 0, -1)))
    gains = chain.static_gains()
    below = _numeric_factors(chain.poles)
    return formula(
        lines(
            row(
                _ratio(i),
                "=",
                fraction(
                    _product(
                        [
                            _short(gains[i - 1]),
                            *(parens(z) for z in _numeric_factors(chain.zeros(i))),
                        ]
                    ),
                    below[0] if len(below) == 1 else _product([parens(f) for f in below]),
                ),
            )
            for i in range(chain.n, 0, -1)
        )
    )


def _ratio(i: int) -> Math:
    return fraction(row(sub("X", str(i)), parens("s")), row("U", parens("s")))


def _product(factors: Sequence[Term]) -> Term:
    return factors[0] if len(factors) == 1 else row(*factors)


def _symbolic_factor(index: str, *, lone: bool = False) -> Math:
    omega = symbol(f"omega_{index}")
    zeta = "ζ" if lone else symbol(f"zeta_{index}")
    return total_row(
        row(fraction("1", power(omega, "2")), power("s", "2")),
        row(fraction(row("2", zeta), omega), "s"),
    )


def _numeric_factors(roots: ComplexArray) -> list[Math]:
    return [
        total_row(
            row(fraction("1", power(_short(omega), "2")), power("s", "2")),
            row(fraction(row("2", "·", _short(zeta)), _short(omega)), "s"),
        )
        for omega, zeta in zip(*quadratic_factors(roots), strict=True)
    ]


def total_row(*terms: Term) -> Math:
    """Return the terms plus one: a quadratic factor in the paper's form."""
    return row(total([*terms, "1"]))


def _short(value: float) -> Term:
    return number(significant(float(value), digits=_DIGITS))


def _polynomial_ratio(chain: Chain, cart: int) -> Math:
    tails = chain.tails()
    gain = np.prod(chain.k[1:cart]) / np.prod(chain.m[:cart])
    above, below = gain * tails[cart], tails[0]
    return row(_ratio(cart), "=", fraction(_polynomial(above), _polynomial(below)))


def _polynomial(coefficients: Array) -> Term:
    degree = coefficients.size - 1
    terms: list[Term] = []
    for exponent, value in zip(range(degree, -1, -1), coefficients, strict=True):
        # Below this share the coefficient is the rounding of an exact zero.
        if abs(value) <= 1e-12 * np.abs(coefficients).max() and degree > 0:
            continue
        s: list[Term] = (
            [] if exponent == 0 else ["s" if exponent == 1 else power("s", str(exponent))]
        )
        terms.append(row(*([] if value == 1 and s else [_short(value)]), *s))
    return total(terms)
