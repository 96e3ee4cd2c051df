"""What a rubric expects: every number with its tolerance, and the reason for the tolerance."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.reference import in_doubt, recompute
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.rubric_file import shipped_rubric
from pipeline.json_files import (
    FiniteNumbers,
    Matrix,
    Number,
    Poles,
    computed,
    json_text,
    result,
    written,
)
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.plant.margins import Margins
from pipeline.report.builder import Page
from pipeline.report.document import Block, Cell, bullet_list, cell, paragraph
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import evaluate, work_out
from pipeline.results import Analysis, FeedbackDesign, Provenance
from pipeline.setup import Units
from pipeline.submission import InputScale, System
from pipeline.words.numbers import NOTHING, count, percent, significant, unit_text
from pipeline.words.phrases import phrases
from pipeline.words.text import Span, clean, name_span, rich

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


@result()
class ReferenceBench:
    """The title and the bench of the reference submission."""

    title: str = written()
    carts: int = written()
    springs: tuple[bool, ...] = written("wall-1, 1-2, …, n-wall")
    units: Units = written()


@result(eq=False)
class ReferenceDesign:
    """The designed state feedback u = prefilter r - gains [x1, v1, x2, v2, …]."""

    cart: int = written()
    method: Literal["poles", "lqr"] = written()
    sample_time: float = written("s; the delay of one sample is part of the model")
    gains: FiniteNumbers = written("(2n)")
    prefilter: Number = written("1 / DC gain of the loop for the chosen cart")
    poles: Poles = written("closed-loop poles as [re, im]: log z / sample_time, in rad/s")
    overshoot_percent: Number = written("overshoot of the simulated step")
    settling_time: float | None = written("s, to within 2 %")
    peak_input: Number = written()
    margins: Margins | None = written(
        "margins of the loop with its observer and delay, opened at the motor", default=None
    )


@result()
class Doubt:
    """A check that failed."""

    id: str = written()
    message: str = written()


@result(eq=False)
class Solution:
    """The content of `solution.json`: what a rubric expects, with tolerances."""

    schema: Literal["cartlab-solution/1"] = written(default_factory=lambda: "cartlab-solution/1")
    submission: ReferenceBench = written()
    rubric: str = written("title of the rubric that sets the accepted ranges")
    parameters: tuple[Expected, ...] = written()
    state_space: ExpectedModel | None = written()
    feedback: ReferenceDesign | None = written(
        "the reference design; gains are not unique, so others may be right too"
    )
    doubts: tuple[Doubt, ...] = written(
        "the checks that failed: explain them before you use these numbers as a reference",
        default=(),
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
        submission=ReferenceBench(
            title=analysis.title,
            carts=analysis.bench.n,
            springs=analysis.bench.springs,
            units=analysis.bench.units,
        ),
        rubric=rubric.title,
        parameters=parameters,
        state_space=analysis.chain and expected_model(analysis.chain, _tolerances(parameters)),
        feedback=analysis.feedback and _reference(analysis.feedback),
        doubts=tuple(Doubt(id=c.id, message=c.message) for c in analysis.failed_checks),
        provenance=analysis.provenance,
    )
    return json_text(solution)


def _reference(design: FeedbackDesign) -> ReferenceDesign:
    """Return what a reference says of a design."""
    return ReferenceDesign(
        **{own.name: getattr(design, own.name) for own in fields(ReferenceDesign)}
    )
