"""In the worked reference, every printed formula is true, and the numbers are the model's."""

import json
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal
from html import unescape
from typing import Any, get_args

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from sympy.parsing.sympy_parser import parse_expr

from pipeline.errors import ConfigError
from pipeline.estimation.state_feedback import design_feedback
from pipeline.grading.rubric_file import load_rubric
from pipeline.plant.chain import PRESETS, Chain
from pipeline.report.document import Formula
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import evaluate, shown, shown_with, value_term, work_out
from pipeline.report.equations.derivation import work_state_model
from pipeline.report.html import render_html
from pipeline.report.sections.questions import Asked, QuestionKind, ask
from pipeline.report.solution.expected import (
    check_carts,
    default_rubric,
    expected_model,
    expected_parameters,
    solution_text,
)
from pipeline.report.solution.worked import work_design
from pipeline.report.solution.write import build_solution, model_answer
from pipeline.resources import RUBRICS
from pipeline.setup import Setup
from pipeline.submission import Design
from pipeline.words.math import to_text
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.grading_students import student
from tests.helpers.pages import sections
from tests.plant.test_chain import chains

s = sympy.Symbol("s")
SPRINGS = [(True, True), (False, True, True), (True, True, False), (True,) * 3]
SPRINGS += [(False, True, True, True), (True,) * 4]


def parsed(text: str, names: Mapping[str, Any] | None = None) -> Any:
    """Return an expression of the derivation as a SymPy expression."""
    return parse_expr(text, local_dict=dict(names or {}))


class Truth:
    """A chain in symbols, solved directly from its impedance matrix."""

    def __init__(self, springs) -> None:
        n = self.n = len(springs) - 1
        self.m, self.c = (sympy.symbols(f"{x}_1:{n + 1}", positive=True) for x in "mc")
        k = sympy.symbols(f"k_1:{n + 2}", positive=True)
        self.k = [k[j] if springs[j] else sympy.Integer(0) for j in range(n + 1)]
        if n == 1:
            self.k = [sympy.Symbol("k", positive=True), sympy.Integer(0)]
            self.m, self.c = (
                (sympy.Symbol("m", positive=True),),
                (sympy.Symbol("c", positive=True),),
            )
        Z = sympy.zeros(n, n)
        for i in range(n):
            Z[i, i] = self.m[i] * s**2 + self.c[i] * s + self.k[i] + self.k[i + 1]
            if i:
                Z[i, i - 1] = Z[i - 1, i] = -self.k[i]
        self.Z = Z
        self.X = (Z.adjugate()[:, 0] / Z.det()).applyfunc(sympy.together)

    def polynomial(self, first: int) -> Any:
        """Return the monic characteristic polynomial of the carts from `first` on."""
        det = self.Z[first - 1 :, first - 1 :].det() if first <= self.n else sympy.Integer(1)
        return sympy.expand(det / sympy.prod(self.m[first - 1 :]))

    def names(self) -> dict[str, Any]:
        """Return each name in the derivation as an expression in masses, dampings and springs."""
        n, m, k = self.n, self.m, self.k
        found: dict[str, Any] = {"s": s, "U": sympy.Integer(1), "u": sympy.Integer(1)}
        for i in range(1, n + 1):
            index = "" if n == 1 else f"_{i}"
            omega = sympy.sqrt((k[i - 1] + k[i]) / m[i - 1])
            found |= {
                f"m{index}": m[i - 1], f"c{index}": self.c[i - 1], f"X_{i}": self.X[i - 1],
                f"x_{i}": self.X[i - 1], f"dx_{i}": s * self.X[i - 1],
                f"ddx_{i}": s**2 * self.X[i - 1], f"omega_{i}": omega, f"w_{i}": omega**2,
                f"zeta_{i}": self.c[i - 1] / (2 * m[i - 1] * omega),
                f"g_{i}": self.c[i - 1] / m[i - 1],
                f"left_{i}": k[i - 1] / m[i - 1], f"right_{i}": k[i] / m[i - 1],
                f"P_{i}": sympy.expand(self.Z[i - 1, i - 1] / m[i - 1]),
                f"K_{i}": sympy.simplify(self.X[i - 1].subs(s, 0)),
                f"inverse_m{index}": 1 / m[i - 1],
            }  # fmt: skip
            if i > 1:
                found[f"kappa_{i}"] = k[i - 1] ** 2 / (m[i - 2] * m[i - 1])
        for j, stiffness in enumerate(k, start=1):
            found["k" if n == 1 else f"k_{j}"] = stiffness if n > 1 else k[0]
        for i, letter in enumerate("dnr"[: max(n - 1, 0)], start=1):
            whole = self.polynomial(i)
            found[("Delta", "N", "R")[i - 1]] = whole
            found |= {f"{letter}_{p}": whole.coeff(s, p) for p in range(2 * (n - i + 1))}
        if n == 1:
            found |= {"K": 1 / k[0], "omega_n": sympy.sqrt(k[0] / m[0])}
            found["zeta"] = self.c[0] / (2 * m[0] * found["omega_n"])
        return found


def is_zero(text: str, names: dict[str, Any]) -> bool:
    """Return whether an expression vanishes identically after all its names are substituted."""
    return sympy.fraction(sympy.together(parsed(text, names)))[0].expand() == 0


def numbered(springs) -> str:
    return "".join("01"[present] for present in springs)


@pytest.fixture(scope="module", params=SPRINGS, ids=numbered)
def truth(request):
    return request.param, Truth(request.param)


def way_there(springs) -> list[Any]:
    """Return every printed step from Newton's laws to the transfer functions."""
    n = len(springs) - 1
    steps = [*derivation.newton(springs), *derivation.laplace(springs)]
    if n > 1:
        steps += [
            *derivation.single_carts(springs), *derivation.per_mass(n),
            *derivation.elimination(n), *derivation.transfer(n), *derivation.static_gains(n),
        ]  # fmt: skip
    return steps


def way_back(springs) -> list[Any]:
    """Return every printed step from coefficients back to masses and springs."""
    n = len(springs) - 1
    steps = [*derivation.couplings(n), *derivation.physical(springs)]
    return [*steps, *derivation.carts_alone(n), *derivation.redundancies(n)] if n > 1 else steps


@pytest.mark.slow
@pytest.mark.sample
def test_each_printed_step_is_true(truth):
    """Each printed step from Newton's laws to the transfer functions and back is an identity."""
    springs, chain = truth
    names = chain.names()
    for step in [*way_there(springs), *way_back(springs)]:
        assert is_zero(f"({step.left})-({step.right})", names), step


@pytest.mark.parametrize("n", [2, 3, 4])
def test_coefficients_are_those_of_the_product_of_factors(n):
    """The printed coefficients are correct: the quadratic factors, multiplied out, give them."""
    modes = {"d": "abcd"[:n]} | ({"n": "xy"} if n == 3 else {})
    table = {
        f"{greek}_{mode}": sympy.Symbol(f"{greek}_{mode}")
        for mode in "".join(modes.values())
        for greek in ("omega", "zeta")
    }
    found: dict[str, Any] = dict(table)
    for equation in derivation.coefficients(n):
        found[equation.left] = parsed(equation.right, found)
    for letter, group in modes.items():
        factors = (
            s**2
            + 2 * table[f"zeta_{mode}"] * table[f"omega_{mode}"] * s
            + table[f"omega_{mode}"] ** 2
            for mode in group
        )
        whole = sympy.Poly(sympy.prod(factors), s)
        for power in range(2 * len(group)):
            difference = found[f"{letter}_{power}"] - whole.coeff_monomial(s**power)
            assert sympy.expand(difference) == 0


def test_the_redundancies_are_as_many_as_the_checks():
    """The solution gives as many redundancies as the checks test: 1 for two carts, 5 for three."""
    assert [len(derivation.redundancies(n)) for n in (1, 2, 3)] == [0, 1, 5]


@given(chains())
def test_numbers_worked_step_by_step_give_the_state_model(chain):
    """A and B computed step by step from the named parameters equal the chain's matrices."""
    values = work_state_model(chain)
    n = chain.n
    A, B, _, _ = chain.state_space()
    entries, column = derivation.state_entries(n)
    got = np.array([[evaluate(text, values) for text in line] for line in entries])
    # kappa is a small difference of products of omega², so its rounding error is larger.
    scale = np.abs(A).max() * (chain.poles.__abs__().max() / np.abs(chain.poles).min()) ** 2
    assert_allclose(got, A, rtol=1e-9, atol=1e-13 * scale)
    assert_allclose([evaluate(text, values) for text in column], B[:, 0], rtol=1e-9)


# ------------------------------------- the displayed formulas are those tested above

WRITTEN = {
    "ω": "omega", "ζ": "zeta", "κ": "kappa", "Δ": "Delta", "·": "*",
}  # fmt: skip


def read_back(term) -> str:
    """Return a displayed formula as a reader understands it: adjacent parts are multiplied."""
    if isinstance(term, str):
        return WRITTEN.get(term, term.replace("−", "-"))
    parts = [read_back(part) for part in term.parts]
    match term.kind:
        case "fraction":
            return f"(({parts[0]})/({parts[1]}))"
        case "sub":
            return f"{parts[0]}_{parts[1]}"
        case "sup":
            return f"({parts[0]})**({parts[1]})"
        case "parens":
            return f"({''.join(side_by_side(parts))})"
        case "dot" | "ddot":
            return f"{'d' * (len(term.kind) - 2)}{parts[0]}"
        case _:
            return f"{''.join(side_by_side(parts))}"


def side_by_side(parts):
    for before, part in zip(["+", *parts], parts, strict=False):
        operator = part[:1] in "+-*" or before[-1:] in "+-*" or part == "(s)"
        yield ("" if operator else "*") + ("" if part == "(s)" else part)


@pytest.mark.parametrize("springs", SPRINGS, ids=numbered)
def test_a_displayed_formula_equals_the_tested_one(springs):
    """Every displayed formula, read with its brackets, equals the tested expression."""
    n = len(springs) - 1
    equations = [*way_there(springs), *way_back(springs)]
    equations += derivation.coefficients(n) if n > 1 else []
    spelt: dict[str, Any] = {f"w_{i}": sympy.Symbol(f"omega_{i}") ** 2 for i in range(1, n + 1)}
    for i in range(1, n + 1):
        spelt |= {
            f"left_{i}": sympy.Symbol(f"k_{i}") / sympy.Symbol(f"m_{i}"),
            f"right_{i}": sympy.Symbol(f"k_{i + 1}") / sympy.Symbol(f"m_{i}"),
            f"inverse_m_{i}": 1 / sympy.Symbol(f"m_{i}"),
        }
    spelt |= {
        "inverse_m": 1 / sympy.Symbol("m"),
        **{x: sympy.Symbol(x) for x in ("Delta", *"NRUs", "zeta")},
    }
    for text in (side for equation in equations for side in (equation.left, equation.right)):
        seen = parsed(read_back(shown(text)), spelt)
        assert sympy.expand(seen - parsed(text, spelt)) == 0, text


def test_a_line_with_numbers_gives_the_right_result():
    """A line with numbers in place of names gives the right result when evaluated as displayed.

    The numbers have signs and powers of ten.
    """
    values = {"a": -2.0, "b": 3e-7, "c": 0.5}
    for text in ("a*b-c", "(a-b)/c", "c-a*(b+a)", "-a**2+c", "a-(b-c)", "a/b*c"):
        seen = parsed(read_back(shown_with(text, values)))
        assert_allclose(float(seen), evaluate(text, values), rtol=1e-4)


# ------------------------------------------------------------------------- the design


@pytest.mark.parametrize("method", ["lqr", "poles"])
@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof", "throne-3dof"])
def test_the_worked_gains_are_the_designed_ones(preset, method):
    """The worked Riccati and Ackermann solutions give the gains of the design stage."""
    chain = PRESETS[preset]
    design = design_feedback(
        chain,
        Design(cart=chain.n, reference=1.0, overshoot_percent=10, settling_time=1.0, method=method),
    )
    worked = work_design(chain, design)
    # With six poles near 1, the controllability matrix loses about nine digits.
    assert_allclose(worked.gains, design.gains, rtol=1e-5, atol=1e-6 * np.abs(design.gains).max())
    assert_allclose(worked.prefilter, design.prefilter, rtol=1e-6)
    if worked.P is not None and design.Q is not None and design.R is not None:
        R, P, phi = design.R, worked.P, worked.phi
        G = worked.gains
        residual = (
            design.Q
            + phi.T @ P @ phi
            - P
            - (R + worked.gamma @ P @ worked.gamma) * (np.outer(G, G))
        )
        assert_allclose(residual, 0.0, atol=1e-9 * np.abs(P).max())


# ------------------------------------------------------------------- expected values


def test_expected_values_pass_and_mistakes_fail():
    """Every expected value is within its own tolerance; Hz or a doubled gain is far outside."""
    analysis = make_analysis(3)
    for p in expected_parameters(analysis, default_rubric(analysis)):
        assert p.tolerance is not None
        assert p.low is not None
        assert p.high is not None
        assert p.low < p.value < p.high
        wrong = {"o": p.value / (2 * np.pi), "K": 2 * p.value}.get(p.name[0])
        assert wrong is None or abs(wrong - p.value) > p.tolerance


@pytest.mark.parametrize(
    ("carts", "hide"),
    [
        (1, ()),
        pytest.param(3, (), marks=[pytest.mark.slow, pytest.mark.sample]),
        pytest.param(1, ("dead_zone",), id="not linear"),
    ],
)
def test_bounds_in_the_solution_earn_all_points(carts, hide):
    """A student's number at a bound of the solution earns all points, and one beyond it fewer."""
    one = student(carts, hide=hide)
    expected = expected_parameters(one.analysis, one.rubric)
    assert len(expected) == len(one.rubric.names)
    for p in expected:
        assert p.low is not None
        assert p.high is not None
        for bound, out in ((p.low, 0.995), (p.high, 1.005)):
            if bound == 0:  # a bound of 0 means that there is no lower bound
                continue
            shares = []
            for value in (bound * (2 - out), bound * out**4):
                typed = {p.name: Decimal(f"{value:.8f}")}
                graded = one.reporting(final=typed).grade().criteria
                (judged,) = (c for c in graded if c.id.startswith("final") and p.name in c.found)
                shares.append("you report" not in judged.message)
            assert shares == [True, False], (p, bound)


def test_another_rubric_has_other_bounds(tmp_path):
    """With another rubric, the page and the file show its bounds and title."""
    analysis = make_analysis(2)
    text = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
    text = text.replace(
        'parameters = ["zeta_*"]', 'parameters = ["zeta_a"]\ndamping_full_percent = 7'
    )
    (tmp_path / "lab.toml").write_text(text.replace("Two carts:", "Strict:"), encoding="utf-8")
    rubric = load_rubric(tmp_path / "lab.toml")
    found = json.loads(solution_text(analysis, rubric=rubric))
    accepted = {p["name"]: p["percent"] for p in found["parameters"]}
    assert (accepted["zeta_a"], accepted["K_1"], accepted["zeta_b"]) == (7, 5, None)
    assert found["rubric"] == rubric.title
    page = render_html(build_solution(analysis, rubric=rubric))
    assert rubric.title in page
    assert "not judged" in page
    with pytest.raises(ConfigError, match="2 carts"):
        check_carts(rubric, carts=1)


@given(chains(min_carts=2, max_carts=3), st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_tolerances_of_entries_cover_tolerated_tables(chain, seed):
    """If a table's errors are within its tolerances, most entries of A are within theirs."""
    rng = np.random.default_rng(seed)
    table = derivation.given(chain)
    tolerances = {name: 1e-3 * value for name, value in table.items()}
    model = expected_model(chain, tolerances)
    rows, _ = derivation.state_entries(chain.n)
    inside = []
    for _ in range(20):
        moved = {
            name: value * (1 + 1e-3 / 3 * rng.standard_normal()) for name, value in table.items()
        }
        worked = work_out(derivation.state_steps(chain.n), moved)
        A = np.array([[evaluate(text, worked) for text in line] for line in rows])
        inside.append(np.abs(A - model.A) <= model.A_tolerance + 1e-6 * np.abs(model.A))
    # A third of the tolerance is one standard deviation, so 99.7 % of the errors are tolerated.
    assert np.mean(inside) > 0.97


# ------------------------------------------------------------------------- the document


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_the_document_works_everything_out(carts):
    """The document has every worked section with the model's numbers."""
    analysis = make_analysis(carts)
    found = sections(build_solution(analysis))
    assert [*found][:6] == [
        "summary", "motion", "transfer-functions", "state-model", "worked-design", "expected",
    ]  # fmt: skip
    blocks = [block for section in found.values() for block in section.blocks]
    alts = " ".join(block.alt for block in blocks if isinstance(block, Formula))
    assert analysis.chain is not None
    A, B, _, _ = analysis.chain.state_space()
    for value in (*A[(A != 0) & (A != 1)], *B[B != 0]):
        assert to_text(value_term(float(abs(value)))) in alts


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_the_solution_has_no_text_by_students(carts):
    """The solution has no students' notes, but a model answer for each question of the report."""
    analysis = make_analysis(carts)
    asked = ask(analysis)
    notes = "# Discussion\n\nOurs alone.\n" + "".join(
        f"\n## {a.id}\n\nNo idea.\n" for a in asked[1:]
    )
    page = render_html(build_solution(replace(analysis, discussion=notes)))
    for words in ("Ours alone", "No idea", "To be answered", "notes.md"):
        assert words not in page
    for question in asked:
        answer = plain(model_answer(question).text).removeprefix("Model answer: ")
        assert f"Model answer: </strong>{answer[:30]}" in unescape(page)


@pytest.mark.parametrize("kind", get_args(QuestionKind))
def test_every_kind_of_question_has_a_model_answer(kind):
    """Each kind of question has a model answer, which is a text without a question."""
    answer = model_answer(Asked(kind=kind, id="x", section="x", text="x"))
    assert len(plain(answer.text)) > 100
    assert "?" not in plain(answer.text)


def test_without_a_fit_the_solution_is_only_the_derivation():
    """Without a fit, the solution is only the derivation; a fitted rigid cart has a state model."""
    found = sections(build_solution(replace(make_analysis(2), fit=None, rows=(), feedback=None)))
    assert [*found][1:3] == ["motion", "transfer-functions"]
    assert not {"state-model", "worked-design", "expected"} & found.keys()
    analysis = make_analysis(1)
    assert analysis.fit is not None
    chain = Chain(m=np.array([2e-4]), c=np.array([5e-4]), k=np.zeros(2))
    fit = replace(
        analysis.fit, chain=chain, names=("m_1", "c_1"), covariance=1e-12 * np.eye(2), parameters={}
    )
    bench = Setup(springs=(False, False))
    rigid = build_solution(replace(analysis, bench=bench, fit=fit, rows=(), feedback=None))
    assert {"motion", "transfer-functions", "state-model"} <= sections(rigid).keys()


def test_solution_json_is_the_reference_for_programs():
    """`solution.json` has parameters, A, B and gains with tolerances, and always the same bytes."""
    analysis = make_analysis(2)
    text = solution_text(analysis)
    assert text == solution_text(analysis)
    found = json.loads(text)
    assert found["schema"] == "cartlab-solution/1"
    assert {p["name"] for p in found["parameters"]} == {row.name for row in analysis.rows}
    assert np.shape(found["state_space"]["A_tolerance"]) == (4, 4)
    assert len(found["feedback"]["gains"]) == 4


def test_a_reference_that_failed_a_check_has_a_warning():
    """If the reference failed a check, a warning is shown under the title and above the values."""
    doubtful = make_analysis(2)
    (failed,) = doubtful.failed_checks
    sound = replace(doubtful, checks=tuple(c for c in doubtful.checks if c != failed))
    pages = [build_solution(analysis) for analysis in (doubtful, sound)]
    told, silent = (sections(page)["expected"].blocks for page in pages)
    (doubt,) = json.loads(solution_text(doubtful))["doubts"]
    assert doubt == {"id": failed.id, "message": failed.message}
    assert told[2:] == silent
    assert pages[0].subtitle.startswith(pages[1].subtitle)
    assert pages[0].subtitle != pages[1].subtitle
    assert json.loads(solution_text(sound))["doubts"] == []
