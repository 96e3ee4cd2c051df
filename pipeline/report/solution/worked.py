"""The worked model and controller: derivations from free bodies to gains, with numbers inserted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from scipy.linalg import solve_discrete_are

from pipeline.arrays import Array, ComplexArray
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import discretise
from pipeline.report.builder import Page
from pipeline.report.document import Block, Formula, Heading, Paragraph, bullet_list, paragraph
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import (
    Equation,
    addends,
    evaluate,
    shown,
    shown_with,
    value_term,
    work_out,
)
from pipeline.report.equations.model import (
    formula,
    matlab_matrix,
    number_matrix,
    symbolic_transfer_functions,
    weights_formula,
)
from pipeline.report.figures import MEASURED, MODEL, QUIET
from pipeline.report.figures.style import WIDTH
from pipeline.report.sections.parameters import chain_table
from pipeline.results import FeedbackDesign
from pipeline.words.math import Math, Term, fraction, lines, matrix, parens, power, row, total
from pipeline.words.numbers import complex_text, count, percent, significant, subscript
from pipeline.words.phrases import phrases
from pipeline.words.text import rich, spans

_WORDS = phrases("solution")
_MOST_ADDENDS = 3  # a longer sum is not written out with numbers for each product
_A_LINE = 7  # most terms of a sum in one line
# Inches:
_CART = 0.54  # width and height of a cart in the drawing
_GAP = 0.05  # distance between an arrow and its name
_ROW = 0.9  # height of the figure for each cart

_INVERSE = row("−", "1")
_PHI_T, _GAMMA_T = power("Φ", "T"), power("Γ", "T")
_WEIGHED = row("R", "+", _GAMMA_T, "P", "Γ")


def motion_blocks(page: Page) -> list[Block]:
    """Return the equations of motion, derived from free-body diagrams."""
    springs = page.analysis.bench.springs
    n = len(springs) - 1
    return [
        paragraph(_WORDS.text("cut_free")),
        page.picture("free-bodies", free_body_figure(springs), _WORDS, "free_bodies", n=n),
        paragraph(_WORDS.text("newton")),
        _written(derivation.newton(springs)),
        paragraph(_WORDS.text("laplace")),
        _written(derivation.laplace(springs)),
    ]


def transfer_blocks(page: Page) -> list[Block]:
    """Return the transfer functions, derived by eliminating carts from the last to the first."""
    springs = page.analysis.bench.springs
    n = len(springs) - 1
    symbolic = symbolic_transfer_functions(springs)
    if not all(springs[1:-1]) or n > derivation.MOST_CARTS:
        return []
    if n == 1:
        text = rich(_WORDS.text("one_cart" if symbolic else "one_cart_no_spring"))
        return [
            Paragraph(text),
            symbolic or _written([Equation("X_1/U", "1/(m*s**2+c*s)")]),
        ]
    last = "Neighbouring carts" if n > 2 else "The two carts"
    blocks: list[Block] = [
        paragraph(_WORDS.text("carts_alone")),
        _written(derivation.single_carts(springs)),
        paragraph(_WORDS.text("per_mass")),
        _written(derivation.per_mass(n)),
        paragraph(_WORDS.text("eliminate", last=last)),
        _written(derivation.elimination(n)),
        paragraph(_WORDS.text("characteristic_3" if n == 3 else "characteristic")),
        _written(derivation.transfer(n)),
        paragraph(_WORDS.text("static_gains")),
        _written(derivation.static_gains(n)),
    ]
    if symbolic:
        blocks += [paragraph(_WORDS.text("paper_form")), symbolic]
    return blocks


# ------------------------------------------------------------------- the state model


def state_blocks(page: Page) -> list[Block]:
    """Return the steps, with numbers, from the table to A and B, and to masses and springs."""
    analysis = page.analysis
    fit, chain, springs = analysis.fit, analysis.chain, analysis.bench.springs
    if fit is None or chain is None:
        return []
    n = chain.n
    table = chain_table(page, chain, std=fit.std)
    if not chain.is_tied or n > derivation.MOST_CARTS:
        return [paragraph(_WORDS.text("no_wall")), table]
    values = derivation.work_state_model(chain)
    values = work_out(derivation.physical(springs), values)
    blocks: list[Block] = [
        paragraph(_WORDS.text("to_entries", position=page.position, drive=page.drive))
    ]
    if unnamed := derivation.unnamed(chain):
        known: list[Math] = [row(shown(k), "=", value_term(v)) for k, v in unnamed.items()]
        blocks += [paragraph(_WORDS.text("unnamed")), _together(known)]
    for title, words, equations in _steps(n):
        blocks += [Heading(spans(title)), *([Paragraph(rich(words))] if words else [])]
        blocks += worked(equations, values)
    blocks += [Heading(spans("The state model")), *_matrices(n, values)]
    blocks += [
        Heading(spans("Masses, damping coefficients and stiffnesses")),
        *worked(derivation.physical(springs), values),
        table,
    ]
    if laws := derivation.redundancies(n):
        blocks += [Heading(spans("What must agree")), *_redundancies(laws, values)]
    return blocks


def _steps(n: int) -> Iterable[tuple[str, str, Sequence[Equation]]]:
    """Yield title, explanation and equations of each step from the table to A and B."""
    if n > 1:
        what = "Δ(s) and N(s)" if n == 3 else "Δ(s)"
        yield (f"Coefficients of {what}", _WORDS.text("coefficients"), derivation.coefficients(n))
        yield ("Each cart alone", _WORDS.text("alone_from_last"), derivation.carts_alone(n))
    yield (
        "Couplings and input" if n > 1 else "The input",
        _WORDS.text("couplings") if n > 1 else "",
        derivation.couplings(n),
    )


def _matrices(n: int, values: Mapping[str, float]) -> list[Block]:
    A, B = derivation.state_entries(n)
    names = "(x1, v1)" if n == 1 else "(x1, v1, x2, v2)" if n == 2 else "(x1, v1, x2, v2, …)"
    return [
        paragraph(_WORDS.text("with_state", names=names)),
        formula(row("A", "=", matrix([[shown(entry) for entry in line] for line in A]))),
        formula(row("B", "=", matrix([[shown(entry)] for entry in B]))),
        paragraph(_WORDS.text("with_numbers")),
        formula(row("A", "=", matrix([[_entry(entry, values) for entry in line] for line in A]))),
        formula(row("B", "=", matrix([[_entry(entry, values)] for entry in B]))),
    ]


def _entry(text: str, values: Mapping[str, float]) -> Term:
    return text if text in ("0", "1") else value_term(evaluate(text, values))


def _redundancies(laws: Sequence[Equation], values: Mapping[str, float]) -> list[Block]:
    relations = count(len(laws), "relation")
    return [
        paragraph(_WORDS.text("laws_left", relations=relations)),
        *(_law(law, values) for law in laws),
    ]


def _law(law: Equation, values: Mapping[str, float]) -> Formula:
    left, right = (value_term(evaluate(side, values)) for side in (law.left, law.right))
    return formula(lines([row(shown(law.left), "=", shown(law.right)), row(left, "=", right)]))


# ------------------------------------------------------------------------- formulas


def worked(equations: Sequence[Equation], values: Mapping[str, float]) -> list[Block]:
    """Return each equation with symbols, with numbers, and with its result.

    Short equations share a block, one per line. A sum of several terms gets lines of its own.
    """
    blocks: list[Block] = []
    short: list[Math] = []
    for equation in equations:
        terms = addends(equation.right)
        left, right = shown(equation.left), shown(equation.right)
        result = value_term(evaluate(equation.right, values))
        if len(terms) == 1 and "-" not in equation.right:
            put_in = row(shown_with(equation.right, values), "≈", result)
            # If both sides are the same symbol, such as the square of a frequency in the table,
            # show it once.
            short.append(row(left, "=", *(() if left == right else (right, row("="))), put_in))
            continue
        blocks += [_together(short)] if short else []
        short = []
        blocks.append(formula(lines(_long(left, terms, equation.right, values, result))))
    return [*blocks, *([_together(short)] if short else [])]


def _long(
    left: Term, terms: Sequence[str], text: str, values: Mapping[str, float], result: Term
) -> list[Math]:
    """Return a long sum: terms in several lines, then numbers, then the result."""
    if len(terms) <= _MOST_ADDENDS:
        put_in = row("=", shown_with(text, values), "≈", result)
        return [row(left, "=", shown(text)), put_in]
    # Products in a long sum are computed first, to keep it readable.
    numbers = [value_term(evaluate(term, values)) for term in terms]
    return [
        *_broken((left, "="), [shown(term) for term in terms]),
        *_broken(("=",), numbers),
        row("=", result),
    ]


def _broken(head: Sequence[Term], terms: Sequence[Term]) -> list[Math]:
    """Return a sum in as many lines as it needs."""
    rows = [total(terms[i : i + _A_LINE]) for i in range(0, len(terms), _A_LINE)]
    return [row(*head, rows[0]), *(row("+", terms) for terms in rows[1:])]


def _together(equations: Sequence[Math]) -> Formula:
    return formula(equations[0] if len(equations) == 1 else lines(equations))


def _written(equations: Sequence[Equation]) -> Formula:
    return _together([row(shown(e.left), "=", shown(e.right)) for e in equations])


# ----------------------------------------------------------------------------------- free bodies


def free_body_figure(springs: Sequence[bool]) -> Figure:
    """Draw each cart alone with the forces on it and the positive direction.

    The figure has no axes, because there is nothing to zoom into.
    """
    n = len(springs) - 1
    figure = Figure(figsize=(WIDTH, _ROW * n))
    for i in range(1, n + 1):
        _draw_cart(figure, i, springs, y=_ROW * (n - i) + 0.4 * _ROW)
    return figure


def _draw_cart(figure: Figure, i: int, springs: Sequence[bool], *, y: float) -> None:
    n = len(springs) - 1
    middle, half = WIDTH / 2, _CART / 2
    cart = Rectangle(
        (middle - half, y - half),
        _CART,
        _CART,
        facecolor="#ececec",
        edgecolor=MEASURED,
        lw=1.0,
        transform=figure.dpi_scale_trans,
    )
    figure.add_artist(cart)
    _write(figure, middle, y, f"m{'' if n == 1 else subscript(i)}", "center")
    top = y + half + 0.08
    _arrow(figure, (middle - half / 2, top), half, colour=QUIET)
    _write(figure, middle + half / 2 + _GAP, top, _x(i), "left", colour=QUIET)
    reach = 0.68  # length of an arrow
    for sign, forces in ((-1, _left_forces(i, springs)), (1, _right_forces(i, springs))):
        for k, label in enumerate(forces):
            level = y + (0.5 - (k + 0.5) / len(forces)) * _CART
            start = middle + sign * half
            _arrow(figure, (start, level), sign * reach, colour=MODEL)
            side = "left" if sign > 0 else "right"
            _write(figure, start + sign * (reach + _GAP), level, label, side)


def _left_forces(i: int, springs: Sequence[bool]) -> list[str]:
    """Return the forces to the left while the cart is right of its rest and moves right."""
    n = len(springs) - 1
    index = "" if n == 1 else subscript(i)
    forces = []
    if n == 1:
        forces += ["k x₁"] if any(springs) else []
    elif springs[i - 1]:
        k = f"k{subscript(i)}"
        forces.append(f"{k} x₁" if i == 1 else f"{k} ({_x(i)} − {_x(i - 1)})")
    forces.append(f"c{index} d{_x(i)}/dt")
    if n > 1 and i == n and springs[n]:
        forces.append(f"k{subscript(n + 1)} {_x(i)}")
    return forces


def _right_forces(i: int, springs: Sequence[bool]) -> list[str]:
    n = len(springs) - 1
    forces = ["u"] if i == 1 else []
    if i < n and springs[i]:
        k = f"k{subscript(i + 1)}"
        forces.append(f"{k} ({_x(i + 1)} − {_x(i)})")
    return forces


def _x(i: int) -> str:
    return f"x{subscript(i)}"


def _arrow(figure: Figure, start: tuple[float, float], length: float, *, colour: str) -> None:
    arrow = FancyArrowPatch(
        start,
        (start[0] + length, start[1]),
        arrowstyle="-|>",
        mutation_scale=8.0,
        color=colour,
        lw=1.2,
        shrinkA=0,
        shrinkB=0,
        transform=figure.dpi_scale_trans,
    )
    figure.add_artist(arrow)


def _write(
    figure: Figure, x: float, y: float, text: str, side: str, *, colour: str = MEASURED
) -> None:
    figure.text(x, y, text, ha=side, va="center", color=colour, transform=figure.dpi_scale_trans)


@dataclass(frozen=True, kw_only=True, eq=False)
class WorkedDesign:
    """The numbers in the derivation of the gains.

    Attributes
    ----------
    phi : (2n, 2n), how the plant's state changes over one sample without input.
    gamma : (2n,), how a constant input of 1 changes the state over one sample.
    z : (2n,) closed-loop poles in the z plane, as requested or as given by the regulator.
    open_loop, closed_loop : (2n + 1,) characteristic polynomials without and with feedback, in
        falling powers.
    P : (2n, 2n) cost matrix of the linear quadratic regulator; None for pole placement.
    gains : (2n,) state feedback gains from the formula in the text.
    prefilter : prefilter for these gains.
    """

    phi: Array
    gamma: Array
    z: ComplexArray
    open_loop: Array
    closed_loop: Array
    P: Array | None
    gains: Array
    prefilter: float


def work_design(chain: Chain, design: FeedbackDesign) -> WorkedDesign:
    """Compute the gains of a design again with textbook formulas."""
    phi, gamma = discretise(chain, design.sample_time)
    poles = design.poles if design.requested_poles is None else design.requested_poles
    z = np.exp(poles * design.sample_time)
    wanted = _polynomial_of(z)
    if design.Q is None:
        P, gains = None, ackermann(phi, gamma, wanted)
    else:
        R = float(design.R or 1.0)
        P = np.asarray(solve_discrete_are(phi, gamma[:, None], design.Q, [[R]]))
        gains = (gamma @ P @ phi) / (R + gamma @ P @ gamma)
    loop = np.eye(gamma.size) - phi + np.outer(gamma, gains)
    level = np.linalg.solve(loop, gamma)[2 * design.cart - 2]
    return WorkedDesign(
        phi=phi,
        gamma=gamma,
        z=z,
        open_loop=_polynomial_of(np.linalg.eigvals(phi)),
        closed_loop=wanted,
        P=P,
        gains=gains,
        prefilter=float(1 / level),
    )


def _polynomial_of(roots: np.ndarray) -> Array:
    """Return the monic polynomial, in falling powers, of roots in conjugate pairs."""
    return np.asarray(np.real(np.poly(roots)), dtype=np.float64)


def ackermann(phi: Array, gamma: Array, wanted: Array) -> Array:
    """Return the gains G for which phi - gamma G has the polynomial `wanted` (in falling powers).

    The columns of the controllability matrix are scaled to one. The formula is the same, but
    rounding errors are smaller.
    """
    n = gamma.size
    columns, value = [gamma], np.zeros_like(phi)
    for _ in range(n - 1):
        columns.append(phi @ columns[-1])
    reach = np.column_stack(columns)
    scale = np.abs(reach).max(axis=0)
    last = np.linalg.solve((reach / scale).T, np.eye(n)[-1])
    for coefficient in wanted:
        value = value @ phi + coefficient * np.eye(n)
    return last @ value / scale[-1]


def design_blocks(page: Page) -> list[Block]:
    """Return the derivation of the state feedback, with all numbers that students compute."""
    design, chain = page.analysis.feedback, page.analysis.chain
    if design is None or chain is None:
        return []
    try:
        worked = work_design(chain, design)
    except np.linalg.LinAlgError:
        return [paragraph(_WORDS.text("too_far_apart"))]
    T = significant(design.sample_time)
    loop = parens("I", "−", "Φ", "+", "Γ", "G")
    return [
        paragraph(_WORDS.text("sampled", seconds=T)),
        formula(
            row(
                matrix([["Φ", "Γ"], ["0", "1"]]),
                "=",
                "exp",
                parens(matrix([["A", "B"], ["0", "0"]]), "T"),
            )
        ),
        _numbers("Φ", worked.phi, "Phi"),
        _numbers("Γ", worked.gamma[:, None], "Gamma"),
        *(
            _placement(design, worked)
            if worked.P is None
            else _regulator(design, worked, tied=chain.is_tied)
        ),
        _numbers("G", worked.gains[None, :], "G"),
        paragraph(_WORDS.text("prefilter", cart=design.cart)),
        formula(
            row(
                row("prefilter", "=", fraction(row("1"), row("c", power(loop, _INVERSE), "Γ"))),
                "≈",
                value_term(worked.prefilter),
            )
        ),
        _pole_table(page, design, worked),
        paragraph(_simulated(design, drive=page.drive)),
        paragraph(_WORDS.text("not_unique")),
        bullet_list(
            _WORDS.spans(f"right_{what}", cart=str(design.cart))
            for what in ("poles", "prefilter", "step")
        ),
    ]


def _simulated(design: FeedbackDesign, *, drive: str) -> str:
    """Return a sentence on the simulated step, with the delay and the limit of the input."""
    settled = design.settling_time
    return _WORDS.text(
        "simulated" if settled is not None else "simulated_unsettled",
        overshoot=percent(design.overshoot_percent),
        seconds=significant(settled, digits=3),
        peak=significant(design.peak_input, digits=3),
        drive=drive,
    )


def _regulator(design: FeedbackDesign, worked: WorkedDesign, *, tied: bool) -> list[Block]:
    assert design.Q is not None
    assert worked.P is not None
    weight = _WORDS.text("weight_tied" if tied else "weight_free")
    return [
        paragraph(_WORDS.text("regulator", weight=weight)),
        weights_formula(design.Q),
        formula(row("R", "≈", value_term(float(design.R or 1.0)))),
        paragraph(_WORDS.text("riccati")),
        formula(
            row(
                *("P", "=", "Q", "+", _PHI_T, "P", "Φ", "−"),
                fraction(row(_PHI_T, "P", "Γ", _GAMMA_T, "P", "Φ"), _WEIGHED),
            )
        ),
        _numbers("P", worked.P, "P"),
        paragraph(_WORDS.text("riccati_gains")),
        formula(row("G", "=", fraction(row(_GAMMA_T, "P", "Φ"), _WEIGHED))),
    ]


def _numbers(letter: str, values: Array, name: str) -> Block:
    """Return a matrix with numbers; it can be copied with all digits.

    Parameters
    ----------
    name : name of the matrix in the copied text.
    """
    return formula(row(letter, "=", number_matrix(values)), copy=matlab_matrix(name, values))


def _placement(design: FeedbackDesign, worked: WorkedDesign) -> list[Block]:
    poles = design.poles if design.requested_poles is None else design.requested_poles
    slow = poles[np.argmin(np.abs(poles))]
    zeta = float(-slow.real / abs(slow))
    slowest, n = "", worked.gamma.size
    if slow.imag != 0 and slow.real < 0:
        slowest = _WORDS.text(
            "slowest",
            omega=significant(float(abs(slow)), digits=3),
            zeta=significant(zeta, digits=3),
            overshoot=percent(_overshoot(zeta)),
            seconds=significant(float(-4 / slow.real), digits=3),
        )
    last = matrix([[*["0"] * (n - 1), "1"]])
    gains = row("G", "=", last, power(_controllability(n), _INVERSE), "p", parens("Φ"))
    return [
        paragraph(_WORDS.text("placed", slowest=slowest)),
        formula(_polynomial("p", worked.closed_loop)),
        formula(_polynomial("a", worked.open_loop)),
        paragraph(_WORDS.text("ackermann")),
        formula(gains),
    ]


def _controllability(n: int) -> Math:
    columns: list[Term] = ["Γ", row("Φ", "Γ")]
    columns += ["…", row(power("Φ", str(n - 1)), "Γ")] if n > 2 else []
    return matrix([columns])


def _polynomial(name: str, falling: Array) -> Math:
    degree = falling.size - 1
    terms: list[Term] = []
    for power_, value in zip(range(degree, -1, -1), falling, strict=True):
        z: list[Term] = [power("z", str(power_))] if power_ > 1 else ["z"] if power_ else []
        number = [] if power_ == degree else [value_term(value)]
        terms.append(row(*number, *z))
    return row(name, parens("z"), "=", total(terms))


def _overshoot(zeta: float) -> float:
    return 100 * float(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2))) if zeta < 1 else 0.0


def _pole_table(page: Page, design: FeedbackDesign, worked: WorkedDesign) -> Block:
    order = np.lexsort((worked.z.imag, -np.abs(worked.z)))
    s = np.log(worked.z[order]) / design.sample_time
    rows = [
        (
            complex_text(z, digits=4),
            significant(abs(z)),
            complex_text(pole, digits=4),
            significant(abs(pole), digits=3),
            significant(-pole.real / abs(pole), digits=3),
        )
        for z, pole in zip(worked.z[order], s, strict=True)
    ]
    return page.table(_WORDS, "worked_poles", rows, "rrrrr")
