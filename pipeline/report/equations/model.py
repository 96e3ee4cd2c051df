"""The model as mathematics: equations of motion, matrices, transfer functions.

Symbols follow the paper's notation; numbers have four digits.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.report.document import Formula
from pipeline.report.equations.algebra import shown
from pipeline.report.equations.derivation import neighbours, of_cart, springs_at
from pipeline.words.math import (
    Math,
    Term,
    dot,
    fraction,
    lines,
    matrix,
    number,
    parens,
    power,
    row,
    sub,
    symbol,
    to_text,
    total,
)
from pipeline.words.numbers import significant

_DIGITS = 4
_ALL_DIGITS = 10  # the same number as in results.json


def formula(math: Math, *, copy: str = "") -> Formula:
    """Return a displayed equation; its text alternative is made from it."""
    return Formula(math=math, alt=to_text(math), copy=copy)


# --------------------------------------------------- motion and state space, in names


def equations_of_motion(
    springs: Sequence[bool], *, forces: Sequence[Term] | None = None
) -> Formula:
    """Return Newton's law of every cart, with the springs that exist.

    Parameters
    ----------
    forces : the right-hand side of each cart's equation; by default, the input acts on cart 1.
    """
    n = len(springs) - 1
    equations = []
    for i in range(1, n + 1):
        text = f"{of_cart('m', i, n)}*ddx_{i}+{of_cart('c', i, n)}*dx_{i}"
        if held := springs_at(i, springs):
            text += f"+({'+'.join(held)})*x_{i}"
        text += "".join(f"-{k}*x_{j}" for j, k in neighbours(i, springs))
        force = forces[i - 1] if forces else "u" if i == 1 else "0"
        equations.append(row(shown(text), "=", force))
    return formula(lines(equations))


def symbolic_state_space(springs: Sequence[bool]) -> Formula:
    """Return q' = A q + B u, with the entries of A and B as fractions of m, c and k."""
    n = len(springs) - 1
    A = [["0"] * (2 * n) for _ in range(2 * n)]
    B = [["0"] for _ in range(2 * n)]
    for i in range(1, n + 1):
        place, speed, m = 2 * i - 2, 2 * i - 1, of_cart("m", i, n)
        A[place][speed] = "1"
        if held := springs_at(i, springs):
            A[speed][place] = f"-(({'+'.join(held)})/{m})"
        A[speed][speed] = f"-({of_cart('c', i, n)}/{m})"
        for j, k in neighbours(i, springs):
            A[speed][2 * j - 2] = f"{k}/{m}"
    B[1][0] = f"1/{of_cart('m', 1, n)}"
    numbers = range(1, n + 1)
    q = [[_position(i, derivative=order)] for i in numbers for order in (0, 1)]
    q_dot = [[_position(i, derivative=order)] for i in numbers for order in (1, 2)]
    A_shown, B_shown = (matrix([[shown(entry) for entry in r] for r in rows]) for rows in (A, B))
    return formula(row(matrix(q_dot), "=", A_shown, matrix(q), "+", B_shown, "u"))


def _position(i: int, *, derivative: int = 0) -> Math:
    return sub(dot("x", order=derivative) if derivative else "x", str(i))


def numeric_state_space(chain: Chain) -> tuple[Formula, ...]:
    """Return A, B, C and D with numbers, in s and in the units of position and input."""
    A, B, C, D = chain.state_space()
    small = [
        row("B", "=", number_matrix(B)),
        row("C", "=", number_matrix(C)),
        row("D", "=", number_matrix(D)),
    ]
    return (
        formula(row("A", "=", number_matrix(A)), copy=matlab_matrix("A", A)),
        formula(
            _side_by_side(small),
            copy="\n".join(matlab_matrix(name, M) for name, M in (("B", B), ("C", C), ("D", D))),
        ),
    )


def matlab_matrix(name: str, values: Array) -> str:
    """Return "A = [0 1; −2 −3];" with all digits, as MATLAB, Octave and Julia read it."""
    rows = "; ".join(
        " ".join(f"{value + 0.0:.{_ALL_DIGITS}g}" for value in line) for line in values
    )
    return f"{name} = [{rows}];"


def number_matrix(values: Array) -> Math:
    """Return a matrix of numbers with four digits."""
    return matrix([[_short(v) for v in line] for line in values])


def _side_by_side(terms: Sequence[Math]) -> Math:
    joined: list[Term] = []
    for term in terms:
        joined += [",", term] if joined else [term]
    return row(*joined)


# ----------------------------------------------------------- transfer functions


def symbolic_transfer_functions(springs: Sequence[bool]) -> Formula | None:
    """Return X_i/U as in the paper; None if the parameters have no names.

    Parameters have names if the chain has one to three carts and is tied to a wall by a spring.
    """
    n = len(springs) - 1
    if n > 3 or not all(springs[1:-1]) or not (springs[0] or springs[-1]):
        return None
    nulls = {1: [[]], 2: [["2"], []], 3: [["x", "y"], ["3"], []]}[n]
    above = [[_symbolic_factor(null) for null in of_cart] for of_cart in nulls]
    below = [_symbolic_factor(mode) for mode in (["n"] if n == 1 else "abc"[:n])]
    gains = [shown(of_cart("K", i, n)) for i in range(1, n + 1)]
    return _over_common_denominator(gains, above, below)


def numeric_transfer_functions(chain: Chain) -> Formula:
    """Return X_i/U with numbers: as static gain and quadratic factors, or as polynomials.

    A chain without a spring to a wall has no static gain, so its polynomials are shown.
    """
    if not chain.is_tied:
        return formula(lines(_polynomial_ratio(chain, i) for i in range(chain.n, 0, -1)))
    gains = [_short(gain) for gain in chain.static_gains()]
    below = _numeric_factors(chain.poles)
    above = [_numeric_factors(chain.zeros(i)) for i in range(1, chain.n + 1)]
    return _over_common_denominator(gains, above, below)


def _over_common_denominator(
    gains: Sequence[Term], above: Sequence[Sequence[Math]], below: Sequence[Math]
) -> Formula:
    """Return every X_i/U, the last cart first, and then the common denominator D(s)."""
    D = row("D", parens("s"))
    equations = [
        row(_ratio(i), "=", fraction(gains[i - 1], D), *map(parens, above[i - 1]))
        for i in range(len(gains), 0, -1)
    ]
    factors = below if len(below) == 1 else [parens(factor) for factor in below]
    return formula(lines([*equations, row(D, "=", *factors)]))


def _ratio(i: int) -> Math:
    return fraction(row(sub("X", str(i)), parens("s")), row("U", parens("s")))


def _symbolic_factor(index: str) -> Math:
    omega = symbol(f"omega_{index}")
    # A single cart has no index, as in Table 1.
    zeta = "ζ" if index == "n" else symbol(f"zeta_{index}")
    return _factor(
        row(fraction("1", power(omega, "2")), power("s", "2")),
        row(fraction(row("2", zeta), omega), "s"),
    )


def _numeric_factors(roots: ComplexArray) -> list[Math]:
    return [
        _factor(
            row(fraction("1", power(_short(omega), "2")), power("s", "2")),
            row(fraction(row("2", "·", _short(zeta)), _short(omega)), "s"),
        )
        for omega, zeta in zip(*quadratic_factors(roots), strict=True)
    ]


def _factor(*terms: Term) -> Math:
    """Return a quadratic factor in the paper's form, in which the constant term is one."""
    return row(total([*terms, "1"]))


def _short(value: float) -> Term:
    exact = value in (0.0, 1.0, -1.0)
    return number(significant(float(value), digits=1 if exact else _DIGITS))


def _polynomial_ratio(chain: Chain, cart: int) -> Math:
    above, below = chain.transfer_function(cart)
    return row(_ratio(cart), "=", fraction(_polynomial(above), _polynomial(below)))


def _polynomial(coefficients: Array) -> Term:
    degree = coefficients.size - 1
    terms: list[Term] = []
    for exponent, value in zip(range(degree, -1, -1), coefficients, strict=True):
        # A coefficient below this limit would be zero without rounding errors.
        if abs(value) <= 1e-12 * np.abs(coefficients).max() and degree > 0:
            continue
        s: list[Term] = (
            [] if exponent == 0 else ["s" if exponent == 1 else power("s", str(exponent))]
        )
        terms.append(row(*([] if value == 1 and s else [_short(value)]), *s))
    return total(terms)
