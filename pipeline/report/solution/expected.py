"""What a rubric would expect: every number with its tolerance, and why so wide."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.references.reference import in_doubt, recompute
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.rubric_file import load_rubric
from pipeline.names import read_name
from pipeline.plant.linear.chain import Chain
from pipeline.report.document import Block, Span, bullet_list, cell, paragraph, spans
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import evaluate, work_out
from pipeline.report.numbers import NOTHING, count, percent, significant, unit_text
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page
from pipeline.report.words import clean, name_span, rich
from pipeline.resources import RUBRICS
from pipeline.results import Analysis
from pipeline.results_json import provenance
from pipeline.schemas import solution as schema
from pipeline.schemas.base import fields_of, json_text
from pipeline.submission import Input, System

_WORDS = phrases("solution")
SCHEMA = "cartlab-solution/1"


@dataclass(frozen=True, kw_only=True)
class Expected:
    """A final estimate, and from where to where the rubric gives full points for it.

    Attributes
    ----------
    percent : that the rubric allows beyond the reference's own bounds; None if it is not judged.
    low, high : the bounds for full points, in the parameter's unit; None if it is not judged.
    """

    name: str
    unit: str
    value: float
    std: float | None
    percent: float | None
    low: float | None
    high: float | None

    @property
    def tolerance(self) -> float | None:
        """Half of the way between the bounds."""
        return None if self.low is None or self.high is None else (self.high - self.low) / 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedModel:
    """A (2n, 2n) and B (2n,) with what the parameters' tolerances make of every entry."""

    A: Array
    B: Array
    A_tolerance: Array
    B_tolerance: Array


def default_rubric(analysis: Analysis) -> Rubric:
    """Return the shipped rubric for so many carts, else one with the checks' own limits."""
    shipped = RUBRICS / f"throne-{analysis.carts}dof.toml"
    if shipped.is_file():
        return load_rubric(shipped)
    checks = (
        asked.Parameters(id="final", points=1.0, check="final"),
        asked.StateModel(id="state-model", points=1.0, check="state_space"),
    )
    system = System(carts=analysis.carts, springs=analysis.springs, input=Input(unit="V"))
    return Rubric(version=1, title=_WORDS.text("no_rubric"), system=system, criteria=checks)


def check_carts(rubric: Rubric, *, carts: int) -> None:
    """Insist that a rubric is for so many carts.

    Raises
    ------
    ConfigError : it is for others.
    """
    if rubric.system.carts != carts:
        for_ = count(rubric.system.carts, "cart")
        raise ConfigError(f"the rubric is for {for_}, the submission for {carts}")


def expected_parameters(analysis: Analysis, rubric: Rubric) -> tuple[Expected, ...]:
    """Return the final estimates with what the rubric accepts, by the grading's own reference."""
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
    """Return the criterion that judges a final estimate, None if nothing judges it."""
    for criterion in rubric.criteria:
        if isinstance(criterion, asked.Parameters) and criterion.check == "final":
            if matching(criterion.parameters, [name]):
                return criterion
    return None


def expected_model(chain: Chain, tolerances: Mapping[str, float]) -> ExpectedModel:
    """Return A and B, and how far each entry moves when the table moves within its tolerances.

    The moves are combined as independent errors are, by the root of the sum of squares.
    """
    A, B, _, _ = chain.state_space()
    if not chain.is_tied or chain.n > derivation.MOST_CARTS:
        zero = np.zeros_like(A)
        return ExpectedModel(A=A, B=B[:, 0], A_tolerance=zero, B_tolerance=zero[:, 0])
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
        A=A, B=B[:, 0], A_tolerance=moved[:size].reshape(A.shape), B_tolerance=moved[size:]
    )


def expected_blocks(page: Page, rubric: Rubric) -> list[Block]:
    """Return the tables of what is expected, and how to judge a hand-in by them."""
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
        page.table(
            _WORDS.text("expected_table"),
            ("Parameter", "Unit", "Expected", "Full points within", "from", "to", "In Hz: a slip"),
            [
                [
                    cell(name_span(p.name)),
                    cell(unit_text(clean(p.unit)) or "1"),
                    cell(significant(p.value)),
                    cell(f"{p.percent:g} %" if p.percent is not None else "not judged"),
                    cell(significant(p.low)),
                    cell(significant(p.high)),
                    cell(
                        significant(p.value / (2 * np.pi))
                        if read_name(p.name).is_frequency
                        else NOTHING,
                        "quiet",
                    ),
                ]
                for p in parameters
            ],
            "llrrrrr",
        ),
    ]
    if analysis.chain.is_tied and analysis.chain.n <= derivation.MOST_CARTS:
        model = expected_model(analysis.chain, _tolerances(parameters))
        blocks += [_state_table(page, model), *_state_judged(rubric)]
    return [*blocks, paragraph("How to judge a hand-in:"), _advice(analysis)]


def _tolerances(parameters: Iterable[Expected]) -> dict[str, float]:
    return {p.name: p.tolerance for p in parameters if p.tolerance is not None}


def _state_judged(rubric: Rubric) -> list[Block]:
    """Return how the rubric judges A and B; nothing where it does not."""
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
    rows = []
    for i, line in enumerate(model.A):
        for j, value in enumerate(line):
            if model.A_tolerance[i, j] > 0:
                name = f"A({i + 1}, {j + 1})"
                rows.append(_state_row(name, float(value), float(model.A_tolerance[i, j])))
    rows += [
        _state_row(f"B({i + 1})", float(value), float(tolerance))
        for i, (value, tolerance) in enumerate(zip(model.B, model.B_tolerance, strict=True))
        if tolerance > 0
    ]
    return page.table(_WORDS.text("state_table"), ("Entry", "Expected", "moves by ±"), rows, "lrr")


def _state_row(name: str, value: float, tolerance: float) -> list:
    return [cell(name), cell(significant(value)), cell(percent(100 * tolerance / abs(value)))]


def _advice(analysis: Analysis) -> Block:
    advice = [
        _WORDS.text("advice_order"),
        _WORDS.text("advice_large"),
        _WORDS.text("advice_initial"),
    ]
    if analysis.carts > 1:
        advice.append(_WORDS.text("advice_laws"))
    return bullet_list(spans(text) for text in advice)


def solution_text(analysis: Analysis, *, rubric: Rubric | None = None) -> str:
    """Return `solution.json` as text, numbers at ten significant digits.

    `rubric` says what is accepted; by default that of `default_rubric`.
    """
    rubric = rubric or default_rubric(analysis)
    parameters = expected_parameters(analysis, rubric)
    chain, design = analysis.chain, analysis.feedback
    model = chain and expected_model(chain, _tolerances(parameters))
    content = {
        "schema": SCHEMA,
        "submission": fields_of(
            schema.SolutionSubmission,
            analysis,
            units={"position": analysis.position_unit, "input": analysis.input_unit},
        ),
        "rubric": rubric.title,
        "parameters": [
            fields_of(schema.ExpectedParameter, p, tolerance=p.tolerance) for p in parameters
        ],
        "state_space": model
        and {
            "A": model.A,
            "A_tolerance": model.A_tolerance,
            "B": model.B[:, None],
            "B_tolerance": model.B_tolerance[:, None],
        },
        "feedback": design
        and fields_of(
            schema.ReferenceFeedback,
            design,
            poles=[[pole.real, pole.imag] for pole in design.poles],
            margins=design.margins and vars(design.margins),
        ),
        "doubts": [fields_of(schema.Doubt, check) for check in analysis.failed_checks],
        "provenance": provenance(analysis),
    }
    return json_text(content)
