"""The model as mathematics: equations of motion, matrices, transfer functions, effects, controller.

Symbols follow the paper's notation; numbers have four digits.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from string import ascii_lowercase
from textwrap import wrap

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.effect import EffectTerm, ForceLaw, input_steps
from pipeline.plant.sampled_loop import VELOCITY_CORRECTION
from pipeline.report.document import Formula
from pipeline.report.equations.algebra import shown
from pipeline.report.equations.derivation import neighbours, of_cart, springs_at
from pipeline.results import FeedbackDesign
from pipeline.words.math import (
    WIDE_SPACE,
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
    upright,
)
from pipeline.words.numbers import significant

_DIGITS = 4
_ALL_DIGITS = 10  # the same number as in results.json

_LINEAR_PART = ("k", "d", "+")  # start of a spring's law that is already part of the linear chain
_ACTS = ("f", "=")
_COMMAND = sub("u", "command")
_MOTOR_MASS = sub("m", "m")

_LONGEST_LINE = 72  # characters of code in a line of the PDF
_APART = 1e-3  # relative distance; MATLAB's `place` refuses poles that coincide


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
    """Return X_i/U with numbers, as static gain and quadratic factors; its copy has polynomials.

    A chain without a spring to a wall has no static gain, so its polynomials are shown.
    """
    ratios = [chain.transfer_function(i) for i in range(1, chain.n + 1)]
    copy = "\n".join(
        [
            matlab_matrix("D", ratios[0][1][None]),
            *(
                f"{matlab_matrix(f'N{i}', above[None])}\nG{i} = tf(N{i}, D);"
                for i, (above, _) in enumerate(ratios, start=1)
            ),
        ]
    )
    if not chain.is_tied:
        numerators = [_polynomial(above) for above, _ in ratios]
        below = [row(_polynomial(ratios[0][1]))]
        return _over_common_denominator(numerators, [[]] * chain.n, below, copy=copy)
    gains = [_short(gain) for gain in chain.static_gains()]
    below = _numeric_factors(chain.poles)
    above = [_numeric_factors(chain.zeros(i)) for i in range(1, chain.n + 1)]
    return _over_common_denominator(gains, above, below, copy=copy)


def _over_common_denominator(
    gains: Sequence[Term],
    above: Sequence[Sequence[Math]],
    below: Sequence[Math],
    *,
    copy: str = "",
) -> Formula:
    """Return every X_i/U, the last cart first, and then the common denominator D(s)."""
    D = row("D", parens("s"))
    equations = [
        row(_ratio(i), "=", fraction(gains[i - 1], D), *map(parens, above[i - 1]))
        for i in range(len(gains), 0, -1)
    ]
    factors = below if len(below) == 1 else [parens(factor) for factor in below]
    return formula(lines([*equations, row(D, "=", *factors)]), copy=copy)


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


def in_order(terms: Sequence[EffectTerm]) -> list[int]:
    """Return the indices of the effects in the order in which they get their letters.

    This is the order of `terms`, except that effects on the input follow the simulator's order.
    """
    steps = input_steps(terms)
    after = iter(steps)
    return [terms.index(next(after) if term in steps else term) for term in terms]


def augmented_equations(springs: Sequence[bool], terms: Sequence[EffectTerm]) -> Formula:
    """Return Newton's law of every cart, in which each effect adds a force.

    The forces are named by the letters a, b, … of the effects. Cart 1 is driven by the input as
    changed by all effects on the input. If there is play between the motor and cart 1, the force of
    the contact drives the cart, and the motor's mass is subtracted from the cart's mass.
    """
    n = len(springs) - 1
    letters = _letters(terms)
    forces: list[list[Term]] = [[] for _ in range(n)]
    play = _play(terms)
    if play is None:
        forces[0] = [_arriving(terms)]
    else:
        forces[0] = [sub("f", letters[play]), "+", _MOTOR_MASS, sub(dot("x", order=2), "1")]
    for index in in_order(terms):
        term, f = terms[index], sub("f", letters[index])
        if term.effect.formula.parts[:2] != _ACTS or (play is not None and _on_motor(term)):
            continue
        if "spring" in term.where:
            spring = term.place
            if spring <= n:
                forces[spring - 1] += ["−", f]
            if spring > 1:
                forces[spring - 2] += ["+", f]
        else:
            forces[max(term.place, 1) - 1] += ["+", f]
    return equations_of_motion(springs, forces=[_sum(parts) for parts in forces])


def law(terms: Sequence[EffectTerm], index: int) -> Formula:
    """Return the law of one effect, marked with the effect's letter.

    Effects on the input form a sequence: each one changes the output of the previous one. A force
    that depends on the input uses the last output.
    """
    term, letter = terms[index], _letters(terms)[index]
    effect, parts = term.effect, term.effect.formula.parts
    steps = input_steps(terms)
    if term in steps:
        before, after = _arriving(terms, before=term), sub("u", letter)
        if "→" in parts:
            at = parts.index("→")
            changed = _replaced(parts[at + 1 :], {"u": before})
            return formula(row(after, *parts[1:at], "=", *changed))
        own = {_COMMAND: before, "u": after, dot("u"): sub(dot("u"), letter)}
        return formula(row(*_replaced(parts, own)))
    if effect.has_play:
        return formula(row(*_across(terms, index)))
    if parts[:2] != _ACTS:
        return formula(effect.formula)  # a sensor
    force = parts[2:]
    if effect.place == "spring" and force[:3] == _LINEAR_PART:
        force = force[3:]
    # A drive is powered while its logged input is not zero.
    powered = upright(" while ")
    end = force.index(powered) if powered in force else len(force)
    symbols: dict[Term, Term] = {"u": _arriving(terms), "f": sub("f", letter)}
    if _on_motor(term) and _play(terms) is not None:
        symbols |= {sub(letter, "1"): sub(letter, "m") for letter in "xv"}
    return formula(row(sub("f", letter), "=", *_replaced(force[:end], symbols), *force[end:]))


def _across(terms: Sequence[EffectTerm], index: int) -> list[Term]:
    """Return the contact force between motor and cart 1, and Newton's law of the motor."""
    letters = _letters(terms)
    force = sub("f", letters[index])
    motor: list[Term] = [_arriving(terms), "−", force]
    for i in in_order(terms):
        if _on_motor(terms[i]):
            motor += ["+", sub("f", letters[i])]
    contact = _replaced(terms[index].effect.formula.parts, {sub("f", "1"): force})
    return [*contact, ",", WIDE_SPACE, _MOTOR_MASS, sub(dot("x", order=2), "m"), "=", *motor]


def _letters(terms: Sequence[EffectTerm]) -> dict[int, str]:
    """Return the letter of each effect, by its index."""
    return dict(zip(in_order(terms), ascii_lowercase, strict=False))


def _arriving(terms: Sequence[EffectTerm], *, before: EffectTerm | None = None) -> Term:
    """Return the symbol of the input after all effects on it, or only those before `before`."""
    steps = input_steps(terms)
    done = steps if before is None else steps[: steps.index(before)]
    return sub("u", _letters(terms)[terms.index(done[-1])]) if done else "u"


def _play(terms: Sequence[EffectTerm]) -> int | None:
    """Return the index of the play between motor and cart 1; None if there is no play."""
    return next((i for i, term in enumerate(terms) if term.effect.has_play), None)


def _on_motor(term: EffectTerm) -> bool:
    """Return whether the force acts on the motor, rather than on cart 1, if there is play."""
    return isinstance(term.effect.law, ForceLaw) and term.effect.law.on_motor


def _replaced(terms: Sequence[Term], by: Mapping[Term, Term]) -> list[Term]:
    """Return the terms with symbols replaced, also inside nested terms."""
    return [
        by[term]
        if term in by
        else replace(term, parts=tuple(_replaced(term.parts, by)))
        if isinstance(term, Math)
        else term
        for term in terms
    ]


def _sum(parts: list[Term]) -> Term:
    if not parts:
        return "0"
    return row(*(parts[1:] if parts[0] == "+" else parts))


def controller_equations() -> Formula:
    """Return how the observer and the gains make the next effort from the readings y.

    q is the state with the readings and the corrected velocities v; p is the state predicted at the
    last tick, with positions z and velocities w.
    """
    share = fraction(str(VELOCITY_CORRECTION), "T")
    return formula(
        lines(
            [
                row(_at("v"), "=", _at("w"), "+", share, parens(_at("y"), "−", _at("z"))),
                row(_at("p", 1), "=", "Φ", _at("q"), "+", "Γ", _at("u")),
                row(_at("u", 1), "=", "prefilter", "·", "r", "−", "G", _at("p", 1)),
            ]
        )
    )


def _at(symbol: str, later: int = 0) -> Math:
    return sub(symbol, row("k", "+", str(later)) if later else "k")


def weights_formula(Q: Array) -> Formula:
    """Return the weights of the state in the cost, which can be copied with all digits."""
    return formula(row("Q", "=", number_matrix(Q)), copy=matlab_matrix("Q", Q))


def matlab_code(chain: Chain, design: FeedbackDesign) -> str:
    """Return MATLAB commands that compute gains, prefilter and margins from the fitted carts."""
    n, states = chain.n, 2 * chain.n
    first = "; ".join("1" if i == 0 else "0" for i in range(n))
    statements = [
        "% The carts; the state is (x1, v1, x2, v2, ...)",
        _diagonal("M", chain.m),
        _diagonal("C", chain.c),
        matlab_matrix("K", chain.stiffness),
        f"A = kron(eye({n}), [0 1; 0 0]);",
        "A = A - kron(M\\K, [0 0; 1 0]) - kron(M\\C, [0 0; 0 1]);",
        f"B = kron(M\\[{first}], [0; 1]);",
        "% Sampled, with the input held from tick to tick",
        f"T = {_number(design.sample_time)};",
        f"E = expm(T*[A B; zeros(1, {states + 1})]);",
        f"Phi = E(1:{states}, 1:{states});",
        f"Gamma = E(1:{states}, {states + 1});",
        "% Gains and prefilter",
        *_gains(design),
        f"c = zeros(1, {states});",
        f"c({2 * design.cart - 1}) = 1;",
        f"prefilter = 1/(c/(eye({states}) - Phi + Gamma*G)*Gamma)",
        "% Observer: reads the positions, corrects the predicted velocities",
        f"S = kron(eye({n}), [1 0; {VELOCITY_CORRECTION}/T 0]);",
        "% Loop from the input of cart 1 to minus the effort;",
        "% its state is (x, prediction, effort)",
        f"P = [Phi*S, Phi*(eye({states}) - S), Gamma];",
        f"F = [Phi, zeros({states}, {states + 1}); P; -G*P];",
        f"H = [Gamma; zeros({states + 1}, 1)];",
        f"L = ss(F, H, [zeros(1, {2 * states}) -1], 0, T);",
        "margins = allmargin(L)",
        "modulus = 1/norm(feedback(1, L), inf)",
    ]
    return "\n".join(_broken(statement) for statement in statements)


def _gains(design: FeedbackDesign) -> list[str]:
    if design.Q is not None and design.R is not None:
        weights = [matlab_matrix("Q", design.Q), f"R = {_number(design.R)};"]
        return [*weights, "G = dlqr(Phi, Gamma, Q, R)"]
    poles = design.poles if design.requested_poles is None else design.requested_poles
    listed = "; ".join(
        f"{_number(p.real)}{p.imag:+.10g}i" if p.imag else _number(p.real) for p in poles
    )
    others = np.abs(poles[:, None] - poles) + np.diag(np.full(poles.size, np.inf))
    place = "place" if np.all(others > _APART * np.abs(poles)) else "acker"
    return [f"poles = [{listed}];", f"G = {place}(Phi, Gamma, exp(T*poles))"]


def _diagonal(name: str, values: Array) -> str:
    return f"{name} = diag([{' '.join(map(_number, values))}]);"


def _number(value: float) -> str:
    return f"{value:.10g}"


def _broken(statement: str) -> str:
    """Return a statement in lines that fit on the page; "..." continues it in MATLAB.

    A matrix breaks between its rows first.
    """
    if len(statement) <= _LONGEST_LINE:
        return statement
    pieces = [
        piece
        for part in re.split(r"(?<=;) +", statement)
        for piece in wrap(part, _LONGEST_LINE - 8, break_long_words=False, break_on_hyphens=False)
    ]
    return " ...\n    ".join(pieces)
