"""What a rubric expects: every number with its tolerance, and the reason for the tolerance."""

from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.references.reference import in_doubt, recompute
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.rubric_file import shipped_rubric
from pipeline.json_files import Matrix, computed, json_text, result, written
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.report.document import Block, Cell, bullet_list, cell, paragraph
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import evaluate, work_out
from pipeline.report.sections.page import Page
from pipeline.results import Analysis, Check, FeedbackDesign, Provenance, Submitted
from pipeline.submission import InputScale, System
from pipeline.words.numbers import NOTHING, count, percent, significant, unit_text
from pipeline.words.phrases import phrases
from pipeline.words.spans import Span
from pipeline.words.text import clean, name_span, rich

_WORDS = phrases("solution")


@result()
class Expected:
    """A parameter and its range for full points; the range is null if no criterion judges it."""

    name: str = written()
    unit: str = written()
    value: float = written()
    std: float | None = written()
    percent: float | None = written("added to the bounds of the reference value")
    low: float | None = written("lowest value for full points, in its unit")
    high: float | None = written("highest value for full points, in its unit")

    @property
    @computed()
    def tolerance(self) -> float | None:
        """Half the width of the range."""
        return None if self.low is None or self.high is None else (self.high - self.low) / 2


@result(eq=False)
class ExpectedModel:
    """The state model, and how much each entry changes within the tolerances of the parameters.

    A is (2n, 2n), B is (2n, 1).
    """

    A: Matrix = written()
    A_tolerance: Matrix = written()
    B: Matrix = written()
    B_tolerance: Matrix = written()


@result(eq=False)
class Solution:
    """The content of `solution.json`: what a rubric expects, with tolerances."""

    schema: Literal["cartlab-solution/1"] = written(default="cartlab-solution/1")
    submission: Submitted = written(part=("title", "carts", "springs", "units"))
    rubric: str = written("title of the rubric that sets the accepted ranges")
    parameters: tuple[Expected, ...] = written()
    state_space: ExpectedModel | None = written()
    feedback: FeedbackDesign | None = written(
        "the reference design; gains are not unique, so others may be right too",
        part=(
            "cart", "method", "sample_time", "gains", "prefilter", "poles", "overshoot_percent",
            "settling_time", "peak_input", "margins",
        ),
    )  # fmt: skip
    doubts: tuple[Check, ...] = written(
        "the checks that failed: explain them before you use these numbers as a reference",
        part=("id", "message"),
        older=(),
    )
    provenance: Provenance = written()


def default_rubric(analysis: Analysis) -> Rubric:
    """Return the shipped rubric for this number of carts; if none, one with the default limits."""
    if shipped := shipped_rubric(analysis.bench.n):
        return shipped
    checks = (
        asked.Parameters(id="final", points=1.0, check="final"),
        asked.StateModel(id="state-model", points=1.0, check="state_space"),
    )
    system = System(
        carts=analysis.bench.n, springs=analysis.bench.springs, input=InputScale(unit="V")
    )
    return Rubric(version=1, title=_WORDS.text("no_rubric"), system=system, criteria=checks)


def check_carts(rubric: Rubric, *, carts: int) -> None:
    """Refuse a rubric for another number of carts.

    Raises
    ------
    ConfigError : the rubric is for another number of carts.
    """
    if rubric.system.carts != carts:
        for_ = count(rubric.system.carts, "cart")
        raise ConfigError(f"the rubric is for {for_}, the submission for {carts}")


def expected_parameters(analysis: Analysis, rubric: Rubric) -> tuple[Expected, ...]:
    """Return the final estimates with the ranges that the rubric accepts.

    The ranges come from the references that grading uses.
    """
    known, found = in_doubt(recompute(analysis), analysis=analysis).final, []
    for row in analysis.rows:
        if row.final is None:
            continue
        asks, reference = _final_check(rubric, row.name), known.get(row.name)
        share = low = high = None
        if asks is not None and reference is not None and reference.low > 0:
            damping = read_name(row.name).is_damping
            share = asks.damping_full_percent if damping else asks.full_percent
            slack, factor = asks.sigmas * reference.std, 1 + share / 100
            low, high = (reference.low - slack) / factor, (reference.high + slack) * factor
        found.append(
            Expected(
                name=row.name,
                unit=row.unit,
                value=row.final.value,
                std=row.final.std,
                percent=share,
                low=None if low is None else max(low, 0.0),
                high=high,
            )
        )
    return tuple(found)


def _final_check(rubric: Rubric, name: str) -> asked.Parameters | None:
    """Return the criterion that judges a final estimate; None if the rubric lacks it."""
    for criterion in rubric.criteria:
        if isinstance(criterion, asked.Parameters) and criterion.check == "final":
            if matching(criterion.parameters, [name]):
                return criterion
    return None


def expected_model(chain: Chain, tolerances: Mapping[str, float]) -> ExpectedModel:
    """Return A and B, and how much each entry changes within the tolerances of the table.

    The changes due to single parameters are combined as independent errors: root of the sum of
    squares.
    """
    A, B, _, _ = chain.state_space()
    if not chain.is_tied or chain.n > derivation.MOST_CARTS:
        zero = np.zeros_like(A)
        return ExpectedModel(A=A, B=B, A_tolerance=zero, B_tolerance=zero[:, :1])
    table = derivation.given(chain)
    steps = derivation.state_steps(chain.n)
    rows, column = derivation.state_entries(chain.n)
    texts = [*(text for row in rows for text in row), *column]

    def entries(values: Mapping[str, float]) -> Array:
        worked = work_out(steps, values)
        return np.array([evaluate(text, worked) for text in texts])

    exact = entries(table)
    moves = [
        entries({**table, name: table[name] + tolerance}) - exact
        for name, tolerance in tolerances.items()
        if name in table
    ]
    moved = np.sqrt(np.sum(np.square(moves), axis=0))
    size = A.size
    return ExpectedModel(
        A=A, B=B, A_tolerance=moved[:size].reshape(A.shape), B_tolerance=moved[size:, None]
    )


def expected_blocks(page: Page, rubric: Rubric) -> list[Block]:
    """Return the tables of expected numbers, and how to judge a submission by them."""
    analysis = page.analysis
    parameters = expected_parameters(analysis, rubric)
    if not parameters or analysis.chain is None:
        return []
    blocks: list[Block] = []
    if failed := analysis.failed_checks:
        blocks += [
            paragraph(Span(_WORDS.text("doubtful"), "strong")),
            bullet_list(rich(clean(check.message)) for check in failed),
        ]
    blocks += [
        paragraph(_WORDS.text("accepted", rubric=clean(rubric.title) or _WORDS.text("untitled"))),
        page.table(_WORDS, "expected_table", map(_expected_row, parameters), "llrrrrr"),
    ]
    if analysis.chain.is_tied and analysis.chain.n <= derivation.MOST_CARTS:
        model = expected_model(analysis.chain, _tolerances(parameters))
        blocks += [_state_table(page, model), *_state_judged(rubric)]
    advice = ("order", "large", "initial", *(["laws"] if analysis.bench.n > 1 else []))
    judged = bullet_list(_WORDS.spans(f"advice_{what}") for what in advice)
    return [*blocks, paragraph(_WORDS.text("how_to_judge")), judged]


def _expected_row(p: Expected) -> list[Cell]:
    hertz = significant(p.value / (2 * np.pi)) if read_name(p.name).is_frequency else NOTHING
    return [
        cell(name_span(p.name)),
        cell(unit_text(clean(p.unit)) or "1"),
        cell(significant(p.value)),
        cell(f"{p.percent:g} %" if p.percent is not None else "not judged"),
        cell(significant(p.low)),
        cell(significant(p.high)),
        cell(hertz, "quiet"),
    ]


def _tolerances(parameters: Iterable[Expected]) -> dict[str, float]:
    return {p.name: p.tolerance for p in parameters if p.tolerance is not None}


def _state_judged(rubric: Rubric) -> list[Block]:
    """Return how the rubric judges A and B; empty if it does not."""
    return [
        paragraph(
            _WORDS.text(
                "state_judged",
                full=f"{criterion.full_percent:g}",
                damping=f"{criterion.damping_full_percent:g}",
            )
        )
        for criterion in rubric.criteria
        if isinstance(criterion, asked.StateModel)
    ]


def _state_table(page: Page, model: ExpectedModel) -> Block:
    B, B_tolerance = model.B.ravel(), model.B_tolerance.ravel()
    A, B = (
        zip(np.ndindex(M.shape), M.flat, tolerance.flat, strict=True)
        for M, tolerance in ((model.A, model.A_tolerance), (B, B_tolerance))
    )
    rows = [
        (
            f"{name}({', '.join(str(i + 1) for i in at)})",
            significant(float(value)),
            percent(100 * float(tolerance) / abs(float(value))),
        )
        for name, entries in (("A", A), ("B", B))
        for at, value, tolerance in entries
        if tolerance > 0
    ]
    return page.table(_WORDS, "state_table", rows, "lrr")


def solution_text(analysis: Analysis, *, rubric: Rubric | None = None) -> str:
    """Return `solution.json` as text, with ten significant digits.

    Parameters
    ----------
    rubric : the rubric that states the ranges; `default_rubric` by default.
    """
    rubric = rubric or default_rubric(analysis)
    parameters = expected_parameters(analysis, rubric)
    solution = Solution(
        submission=analysis.submission,
        rubric=rubric.title,
        parameters=parameters,
        state_space=analysis.chain and expected_model(analysis.chain, _tolerances(parameters)),
        feedback=analysis.feedback,
        doubts=analysis.failed_checks,
        provenance=analysis.provenance,
    )
    return json_text(solution)
