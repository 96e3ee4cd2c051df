"""What a rubric would expect: every number with its tolerance, and why so wide."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.names import read_name
from pipeline.plant.linear.chain import Chain
from pipeline.report import limits
from pipeline.report.document import Block, Span, bullet_list, cell, paragraph, spans
from pipeline.report.equations import derivation
from pipeline.report.equations.algebra import evaluate, work_out
from pipeline.report.numbers import NOTHING, percent, significant, unit_text
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page
from pipeline.report.words import clean, name_span, rich
from pipeline.results import Analysis
from pipeline.results_json import provenance
from pipeline.schemas import solution as schema
from pipeline.schemas.base import fields_of, json_text

_WORDS = phrases("solution")
SCHEMA = "cartlab-solution/1"


@dataclass(frozen=True, kw_only=True)
class Expected:
    """A parameter with the half-width of what is accepted, both in its unit."""

    name: str
    unit: str
    value: float
    std: float | None
    tolerance: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ExpectedModel:
    """A (2n, 2n) and B (2n,) with what the parameters' tolerances make of every entry."""

    A: Array
    B: Array
    A_tolerance: Array
    B_tolerance: Array


def expected_parameters(analysis: Analysis) -> tuple[Expected, ...]:
    """Return the final estimates with their tolerances."""
    found = []
    for row in analysis.rows:
        if row.final is None:
            continue
        share = _share(row.name) * abs(row.final.value)
        found.append(
            Expected(
                name=row.name,
                unit=row.unit,
                value=row.final.value,
                std=row.final.std,
                tolerance=max(share, limits.SIGMAS * (row.final.std or 0.0)),
            )
        )
    return tuple(found)


def _share(name: str) -> float:
    return (
        limits.DAMPING_TOLERANCE
        if read_name(name).is_damping
        else (limits.GAIN_AND_FREQUENCY_TOLERANCE)
    )


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


def expected_blocks(page: Page) -> list[Block]:
    """Return the tables of what is expected, and how to judge a hand-in by them."""
    analysis = page.analysis
    parameters = expected_parameters(analysis)
    if not parameters or analysis.chain is None:
        return []
    blocks: list[Block] = []
    if failed := analysis.failed_checks:
        blocks += [
            paragraph(Span(_WORDS.text("doubtful"), "strong")),
            bullet_list(rich(clean(check.message)) for check in failed),
        ]
    blocks += [
        paragraph(
            _WORDS.text(
                "accepted",
                share=f"{100 * limits.GAIN_AND_FREQUENCY_TOLERANCE:g}",
                damping_share=f"{100 * limits.DAMPING_TOLERANCE:g}",
                sigmas=f"{limits.SIGMAS:g}",
            )
        ),
        page.table(
            _WORDS.text("expected_table"),
            ("Parameter", "Unit", "Expected", "± accepted", "from", "to", "In Hz: a slip"),
            [
                [
                    cell(name_span(p.name)),
                    cell(unit_text(clean(p.unit)) or "1"),
                    cell(significant(p.value)),
                    cell(percent(100 * p.tolerance / abs(p.value)) if p.value else NOTHING),
                    cell(significant(p.value - p.tolerance)),
                    cell(significant(p.value + p.tolerance)),
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
        model = expected_model(analysis.chain, {p.name: p.tolerance for p in parameters})
        blocks += [_state_table(page, model)]
    return [*blocks, paragraph("How to judge a hand-in:"), _advice(analysis)]


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
    return page.table(_WORDS.text("state_table"), ("Entry", "Expected", "± accepted"), rows, "lrr")


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


def solution_text(analysis: Analysis) -> str:
    """Return `solution.json` as text, numbers at ten significant digits."""
    parameters = expected_parameters(analysis)
    chain, design = analysis.chain, analysis.feedback
    model = chain and expected_model(chain, {p.name: p.tolerance for p in parameters})
    content = {
        "schema": SCHEMA,
        "submission": fields_of(
            schema.SolutionSubmission,
            analysis,
            units={"position": analysis.position_unit, "input": analysis.input_unit},
        ),
        "parameters": [fields_of(schema.ExpectedParameter, p) for p in parameters],
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
