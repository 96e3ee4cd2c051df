"""The formulas printed for a model give the same values as its chain."""

from math import prod
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.plant.chain import PRESETS, Chain
from pipeline.report.equations.model import (
    equations_of_motion,
    numeric_state_space,
    numeric_transfer_functions,
    symbolic_state_space,
    symbolic_transfer_functions,
)
from pipeline.words.math import Math, Term, number, row, symbol, to_mathml, to_text

FOUR = Chain(
    m=np.array([3e-4, 2.5e-4, 2e-4, 1.8e-4]),
    c=np.array([1.5e-3, 4e-4, 3e-4, 3e-4]),
    k=np.array([0.05, 0.12, 0.07, 0.06, 0.06]),
)


def evaluate(term: Term, values: dict[str, complex]) -> complex:
    """Return a formula's value.

    Adjacent parts are multiplied; an unknown name is an error.
    """
    if isinstance(term, str):
        return complex(values[term] if term in values else float(term))
    parts = term.parts
    match term.kind:
        case "fraction":
            return evaluate(parts[0], values) / evaluate(parts[1], values)
        case "sup":
            return evaluate(parts[0], values) ** int(str(parts[1]))
        case "sub":
            return complex(values[f"{parts[0]}_{parts[1]}"])
        case "row" | "parens":
            result, sign, factors = 0j, 1, []
            for part in (*parts, "+"):
                if part in ("+", "−"):
                    result += sign * prod(factors) if factors else 0
                    sign, factors = (1 if part == "+" else -1), []
                elif part != "·":
                    factors.append(evaluate(part, values))
            return result
    raise AssertionError(f"{term.kind} has no value")


def kinds(term: Term, kind: str) -> list[Math]:
    """Return all nodes of one kind, outermost first."""
    if isinstance(term, str):
        return []
    below = [node for part in term.parts for node in kinds(part, kind)]
    return [term, *below] if term.kind == kind else below


def physical_values(chain: Chain) -> dict[str, complex]:
    """Return m_1, c_1, k_1, … as named in the formulas; a single cart's names have no index."""
    if chain.n == 1:
        return {"m": chain.m[0], "c": chain.c[0], "k": chain.k.sum()}
    named = {"m": chain.m, "c": chain.c, "k": chain.k}
    return {f"{name}_{i}": v for name, vs in named.items() for i, v in enumerate(vs, start=1)}


def springs_of(chain: Chain) -> tuple[bool, ...]:
    return tuple(bool(k > 0) for k in chain.k)


LOOSE = Chain(m=np.array([2e-4, 2e-4]), c=np.array([5e-4, 5e-4]), k=np.array([0.0, 0.1, 0.0]))
CHAINS = [*PRESETS.values(), FOUR]


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: f"{chain.n}-carts")
def test_symbolic_matrices_are_those_of_the_chain(chain):
    """The printed A and B have the values of the chain's state-space model."""
    formula = symbolic_state_space(springs_of(chain)).math
    _, A, _, B = kinds(formula, "matrix")
    values = physical_values(chain)

    got_A = np.array([evaluate(t, values).real for t in A.parts]).reshape(-1, A.columns)
    got_B = np.array([evaluate(t, values).real for t in B.parts]).reshape(-1, B.columns)

    expected_A, expected_B, _, _ = chain.state_space()
    assert_allclose(got_A, expected_A, rtol=1e-12)  # only the order of operations differs
    assert_allclose(got_B, expected_B, rtol=1e-12)


@pytest.mark.parametrize("chain", CHAINS[:3], ids=lambda chain: f"{chain.n}-carts")
def test_symbolic_transfer_functions_are_those_of_the_chain(chain):
    """The printed transfer functions, evaluated at any s, give the chain's response."""
    formula = symbolic_transfer_functions(springs_of(chain))
    assert formula is not None
    names = {"zeta": "ζ", "omega": "ω", "K": "K"}
    values = {}
    for name, value in chain.parameters().items():
        base, _, index = name.partition("_")
        values[names[base] + (f"_{index}" if index else "")] = value

    # The numbers are exact, so only rounding errors remain.
    assert_responses(formula.math, values, chain=chain, rtol=1e-9)


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: f"{chain.n}-carts")
def test_numeric_transfer_functions_are_those_of_the_chain(chain):
    """The printed numbers, with four digits each, give each cart's response."""
    formula = numeric_transfer_functions(chain)

    # Each of up to 17 numbers is rounded by at most 5e-4; the frequency is off resonance.
    assert_responses(formula.math, {}, chain=chain, rtol=1e-2)


def assert_responses(math: Math, values, *, chain: Chain, rtol: float) -> None:
    """Compare each printed transfer function with the chain's response at one frequency."""
    omega = 11.0  # rad/s, between the resonances
    values = {**values, "s": 1j * omega}
    *lines, (_, _, *denominator) = [line.parts for line in math.parts if isinstance(line, Math)]
    divisor = evaluate(row(*denominator), values)
    got = []
    for _, equals, quotient, *zeros in lines:
        assert equals == "="
        assert isinstance(quotient, Math)
        assert to_text(quotient.parts[1]) == "D(s)"
        got.append(
            evaluate(quotient.parts[0], values) / divisor * evaluate(row(*zeros, "1"), values)
        )
    expected = chain.frequency_response(np.array([omega]))[::-1, 0]
    assert_allclose(np.array(got), expected, rtol=rtol)


def test_a_missing_spring_is_not_in_the_equations():
    """A missing wall spring does not appear in the equations.

    The two springs of a single cart appear as one sum.
    """
    assert "k_1" not in to_text(equations_of_motion((False, True, True)).math)
    assert "k_1" in to_text(equations_of_motion((True, True, True)).math)
    assert to_text(equations_of_motion((True, True)).math) == "mx″_1 + cx′_1 + kx_1 = u"
    assert to_text(equations_of_motion((False, False)).math) == "mx″_1 + cx′_1 = u"


def test_a_chain_without_walls_is_shown_as_polynomials():
    """If a chain has no walls, its transfer functions are polynomials over one denominator.

    Without a static gain, the factors of the paper's form do not exist.
    """
    rigid = Chain(m=np.array([2e-4]), c=np.array([5e-4]), k=np.zeros(2))
    text = to_text(numeric_transfer_functions(rigid).math)
    assert text == "(X_1(s))/(U(s)) = (5000)/(D(s)); D(s) = s^2 + 2.500s"
    assert symbolic_transfer_functions((False, False)) is None
    assert to_text(numeric_transfer_functions(LOOSE).math).count("s^4") == 1


@pytest.mark.parametrize("chain", [*CHAINS, LOOSE], ids=lambda chain: f"{chain.n}-carts")
def test_copied_polynomials_are_those_of_the_chain(chain):
    """The copy of the transfer functions has each polynomial once, with all its digits."""
    lines = numeric_transfer_functions(chain).copy.splitlines()
    copied = {
        name: np.array(values.strip("[];").split(), dtype=float)
        for name, values in (line.split(" = ") for line in lines)
        if values.startswith("[")
    }
    assert [*copied] == ["D", *(f"N{i}" for i in range(1, chain.n + 1))]
    s = 11.0j
    got = [
        np.polyval(copied[f"N{i}"], s) / np.polyval(copied["D"], s) for i in range(1, chain.n + 1)
    ]
    # Each number has ten digits; at this frequency, the terms nearly cancel by at most 100.
    assert_allclose(got, chain.frequency_response(np.array([11.0]))[:, 0], rtol=1e-7)


@pytest.mark.parametrize("chain", CHAINS, ids=lambda chain: f"{chain.n}-carts")
def test_every_formula_is_well_formed_mathml(chain):
    """All formulas of a model are valid XML."""
    springs = springs_of(chain)
    formulas = [
        equations_of_motion(springs),
        symbolic_state_space(springs),
        numeric_transfer_functions(chain),
        *numeric_state_space(chain),
    ]
    for formula in formulas:
        root = ElementTree.fromstring(to_mathml(formula.math, display=True))
        assert root.tag == "math"
        assert formula.alt


def test_a_name_with_markup_is_escaped():
    """A name with markup adds no tag to the page."""
    assert "<script>" not in to_mathml(row("<script>", symbol("<b>_<i>")))


def test_numbers_with_a_power_of_ten_keep_it():
    """A number with a power of ten, such as −1.5 × 10⁻⁷, is read as one number."""
    assert to_text(number("−1.500 × 10⁻⁷")) == "−1.500·10^−7"
    assert to_text(number("24.02")) == "24.02"
