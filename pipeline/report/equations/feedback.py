"""The designed controller: its equations, and commands that compute it and its margins again."""

import re
from textwrap import wrap

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import VELOCITY_CORRECTION
from pipeline.report.document import Formula
from pipeline.report.equations.model import formula, matlab_matrix, number_matrix
from pipeline.results import FeedbackDesign
from pipeline.words.math import Math, fraction, lines, parens, row, sub

_LONGEST_LINE = 72  # characters of code in a line of the PDF
_APART = 1e-3  # relative distance; MATLAB's `place` refuses poles that coincide


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
