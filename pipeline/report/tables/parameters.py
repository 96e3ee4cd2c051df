"""What was identified: initial and final estimates, the chain."""

from collections.abc import Mapping, Sequence
from decimal import Decimal

import numpy as np

from pipeline.names import read_name
from pipeline.plant.linear.chain import Chain
from pipeline.report.document import Cell, Spans, Table, spans
from pipeline.report.numbers import (
    NOTHING,
    percent,
    significant,
    unit_text,
    with_error,
    with_errors,
)
from pipeline.report.phrases import phrases
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import SOURCES, clean, name_span, rich
from pipeline.results import ChainFit, Estimate, ParameterRow
from pipeline.stages.compare import SIGMA_LIMIT, change_limit

_WORDS = phrases("report")
_FEW = 1 / 3  # of the limit for initial and final: other ways through the same data differ so much


def parameter_table(rows: Sequence[ParameterRow], *, number: int, carts: int) -> Table:
    """Return initial and final estimates as the paper's Tables 1-3, with errors and a verdict."""
    words = {1: "one", 2: "two", 3: "three", 4: "four"}
    return make_table(
        number,
        _WORDS.text("parameter_table", carts=words.get(carts, carts)),
        (
            "Parameter",
            "Unit",
            "Initial estimate",
            "from",
            "Final estimate",
            "Change",
            "Limit",
            "Verdict",
        ),
        [_parameter_row(row) for row in rows],
        "lldlddrl",
    )


def _parameter_row(row: ParameterRow) -> list[Cell]:
    source = SOURCES.get(row.initial.source, clean(row.initial.source)) if row.initial else ""
    change = percent(row.change_percent, signed=True)
    if row.change_sigmas is not None:
        change += f" ({significant(row.change_sigmas, digits=2)} σ)"
    return [
        cell(name_span(row.name)),
        cell(unit_text(clean(row.unit)) or "1"),
        cell(_estimate(row.initial)),
        cell(source, "quiet"),
        cell(_estimate(row.final)),
        cell(change),
        cell(NOTHING if row.consistent is None else f"{change_limit(row.name):.0f} %", "quiet"),
        _verdict(row.consistent),
    ]


def _estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return NOTHING
    if estimate.source == "assumed":  # a guess has no more digits than were thought of
        return significant(estimate.value, digits=2)
    return with_error(estimate.value, estimate.std)


def _verdict(consistent: bool | None) -> Cell:
    if consistent is None:
        return cell(NOTHING, "quiet")
    return cell("agree", "good") if consistent else cell("differ", "bad")


def reported_table(
    rows: Sequence[ParameterRow], reported: Mapping[str, Mapping[str, Decimal]], *, number: int
) -> Table:
    """Return the students' own numbers beside those of their data.

    What is off beyond its rounding, three standard errors and a few percent says what to look at.
    """
    both = [
        (row.name, column, unit_text(clean(row.unit)) or "1", getattr(row, column), yours)
        for column, own in reported.items()
        for row in rows
        if (yours := own.get(row.name)) is not None
    ]
    head = ("Parameter", "Estimate", "Yours", "From your data", "Unit", "Off", "Look at")
    lines = [
        [
            cell(name_span(name)),
            cell(column),
            cell(f"{yours:f}".replace("-", "−")),
            cell(_estimate(found)),
            cell(unit),
            *_off(name, yours, found),
        ]
        for name, column, unit, found, yours in both
    ]
    return make_table(number, _WORDS.text("reported_table"), head, lines, "llddldl")


def _off(name: str, yours: Decimal, found: Estimate | None) -> tuple[Cell, Cell]:
    """Return how far a number is off, and what to look at where that is too far."""
    if found is None or not found.value or found.source == "assumed":
        return cell(NOTHING, "quiet"), cell("")
    off = float(yours) - found.value
    share = percent(100 * off / abs(found.value), signed=True)
    rounding = 0.5 * 10.0 ** int(yours.as_tuple().exponent)
    few = _FEW * change_limit(name) / 100 * abs(found.value)
    if abs(off) <= rounding + SIGMA_LIMIT * (found.std or 0.0) + few:
        return cell(share), cell("")
    read = read_name(name)
    kinds = {"gain": read.is_gain, "damping": read.is_ratio, "frequency": read.is_frequency}
    look = next((_WORDS.text(f"look_{kind}") for kind, is_it in kinds.items() if is_it), "")
    return cell(share, "bad"), cell(look)


def parameter_notes(rows: Sequence[ParameterRow]) -> list[Spans]:
    """Return the remarks on single parameters, equal remarks told once."""
    by_note: dict[str, list[str]] = {}
    for row in rows:
        if row.note:
            by_note.setdefault(row.note, []).append(row.name)
    return [spans(rich(", ".join(names)), ": ", rich(clean(n))) for n, names in by_note.items()]


def fitted_chain_table(fit: ChainFit, *, number: int, position_unit: str, input_unit: str) -> Table:
    """Return masses, dampings and springs of a joint fit."""
    std = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    return chain_table(
        fit.chain, std=std, number=number, position_unit=position_unit, input_unit=input_unit
    )


def chain_table(
    chain: Chain, *, std: Mapping[str, float], number: int, position_unit: str, input_unit: str
) -> Table:
    """Return masses, dampings and springs, each with its standard error where it was fitted."""
    kinds = (
        ("m", "mass", chain.m, f"{input_unit} s²/{position_unit}"),
        ("c", "damping", chain.c, f"{input_unit} s/{position_unit}"),
        ("k", "spring", chain.k, f"{input_unit}/{position_unit}"),
    )
    listed = [
        (letter, noun, unit, i, float(value), std.get(f"{letter}_{i}"))
        for letter, noun, values, unit in kinds
        for i, value in enumerate(values, start=1)
        if chain.n > 1 or letter != "k" or i == 1  # of a lone cart's springs the sum is known
    ]
    numbers = with_errors([(value, error) for *_, value, error in listed])
    rows = [
        [
            cell(name_span(f"{letter}_{i}" if chain.n > 1 else letter)),
            cell(_where(noun, i, chain.n)),
            cell(text if value or error else "none"),
            cell(unit_text(clean(unit))),
        ]
        for (letter, noun, unit, i, value, error), text in zip(listed, numbers, strict=True)
    ]
    head = ("Symbol", "Meaning", "Value", "Unit")
    return make_table(number, _WORDS.text("chain_table"), head, rows, "lldl")


def _where(noun: str, i: int, n: int) -> str:
    if noun != "spring":
        return f"{noun} of cart {i}" if n > 1 else noun
    if n == 1:
        return "springs, together"
    left, right = ("wall" if i == 1 else str(i - 1)), ("wall" if i == n + 1 else str(i))
    return f"spring {left}–{right}"
