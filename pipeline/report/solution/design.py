"""Work out the controller: sampled plant, gains by Ackermann's formula or Riccati's equation."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from pipeline.arrays import Array, ComplexArray
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import discretise
from pipeline.report.builder import Page
from pipeline.report.document import Block, bullet_list, paragraph
from pipeline.report.equations.algebra import value_term
from pipeline.report.equations.model import formula, matlab_matrix, number_matrix, weights_formula
from pipeline.results import FeedbackDesign
from pipeline.words.math import Math, Term, fraction, matrix, parens, power, row, total
from pipeline.words.numbers import complex_text, percent, significant
from pipeline.words.phrases import phrases

_WORDS = phrases("solution")
_INVERSE = row("−", "1")
_PHI_T, _GAMMA_T = power("Φ", "T"), power("Γ", "T")
_WEIGHED = row("R", "+", _GAMMA_T, "P", "Γ")


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
