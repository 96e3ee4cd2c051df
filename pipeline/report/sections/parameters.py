"""The identified parameters: initial and final estimates, the students' numbers, the chain."""

from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal

from pipeline.estimation.estimates import change_limit, is_off
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.report.builder import Page
from pipeline.report.document import Block, Cell, Heading, Table, bullet_list, cell, paragraph
from pipeline.results import EXPLAINED, Analysis, Estimate, ParameterRow
from pipeline.words.numbers import (
    NOTHING,
    listing,
    percent,
    significant,
    unit_text,
    with_error,
    with_errors,
)
from pipeline.words.phrases import phrases
from pipeline.words.text import Spans, clean, name_span, names_spans, rich, spans

_WORDS = phrases("report")


def parameter_blocks(page: Page) -> list[Block]:
    """Return the estimates, remarks on them, and the students' numbers."""
    rows, reported = page.analysis.rows, page.analysis.reported
    if not rows:
        return []
    if not any(reported.values()) and not any(row.initial or row.final for row in rows):
        return [paragraph(_WORDS.spans("no_estimate"))]
    table = parameter_table(page)
    blocks: list[Block] = [paragraph(_origins(page.analysis)), table]
    blocks += _fit_quality(page.analysis)
    if remarks := _parameter_notes(rows):
        blocks.append(bullet_list(remarks))
    if staged := _staged_differences(page.analysis):
        blocks.append(staged)
    if any(reported.values()):
        blocks += [
            Heading(spans(_WORDS.text("reported"))),
            reported_table(page, beside=table.number),
        ]
    return blocks


def _origins(analysis: Analysis) -> Spans:
    """Return a sentence with the sources of the estimates that exist."""
    names: dict[str, list[str]] = {}
    for row in analysis.rows:
        if row.initial:
            names.setdefault(row.initial.source, []).append(row.name)
    sources = [
        _WORDS.text(f"from_{source}", names=listing(names[source]))
        for source in ("step", "log_decrement", "frequency_response", "assumed")
        if source in names
    ]
    fit = analysis.fit
    return rich(
        _WORDS.text(
            "parameters",
            initial=_WORDS.text("initial_from", sources=listing(sources)) if sources else "",
            final=_WORDS.text("final_from", fit=_WORDS.text(f"from_{fit.method}"))
            if fit and fit.converged
            else "",
        ).strip()
    )


def _fit_quality(analysis: Analysis) -> list[Block]:
    """Return how well the fit explains the data."""
    fit = analysis.fit
    if fit is None or not fit.converged:
        return []
    said = _WORDS.text(
        "fit_quality",
        chi_square=significant(fit.chi_square_per_dof, digits=3),
        points=fit.n_points,
        limit=f"{EXPLAINED:g}",
    )
    return [paragraph(said)]


def parameter_table(page: Page) -> Table:
    """Return initial and final estimates with errors and verdicts, as in the paper's Tables 1-3."""
    words, carts = {1: "one", 2: "two", 3: "three", 4: "four"}, page.analysis.bench.n
    rows, steps = page.analysis.rows, page.analysis.steps
    # Without a fit, only the first four columns are filled.
    columns = None if any(row.final for row in rows) else 4
    shown = [_parameter_row(row, steps=steps)[:columns] for row in rows]
    align, carts_text = "lldlddrl"[:columns], words.get(carts, carts)
    return page.table(_WORDS, "parameter_table", shown, align, carts=carts_text)


def _parameter_row(row: ParameterRow, *, steps: Collection[str]) -> list[Cell]:
    change = percent(row.change_percent, signed=True)
    if row.change_sigmas is not None:
        change += f" ({significant(row.change_sigmas, digits=2)} σ)"
    judged = row.consistent is not None
    return [
        cell(name_span(row.name)),
        cell(_unit(row)),
        cell(_of_column(row, "initial")),
        cell(source_text(row.initial, steps=steps), "quiet"),
        cell(_of_column(row, "final")),
        cell(change),
        cell(f"{change_limit(row.name):.0f} %" if judged else NOTHING, "quiet"),
        _verdict(row.consistent),
    ]


def source_text(estimate: Estimate | None, *, steps: Collection[str]) -> str:
    """Return the source of an estimate in words.

    Parameters
    ----------
    steps : ids of step recordings; ringing after a step is not called a decay.
    """
    if estimate is None:
        return ""
    if estimate.source == "log_decrement" and set(estimate.experiments) & set(steps):
        return "ringing after a step"
    sources = {
        "step": "step",
        "log_decrement": "decay",
        "bode_fit": "Bode fit",
        "time_fit": "time-domain fit",
        "assumed": "assumed",
        "frequency_response": "response",
    }
    return sources.get(estimate.source, clean(estimate.source))


def _unit(row: ParameterRow) -> str:
    return unit_text(clean(row.unit))


def _of_column(row: ParameterRow, column: str) -> str:
    """Return the initial or the final estimate of a row."""
    estimate: Estimate | None = getattr(row, column)
    if estimate is None:
        return NOTHING
    if estimate.source == "assumed":  # a guess has few meaningful digits
        return significant(estimate.value, digits=2)
    if column == "final" and row.extrapolated:  # its standard error assumes the right model
        return f"{significant(estimate.value, digits=3)}, extrapolated"
    return with_error(estimate.value, estimate.std)


def _verdict(consistent: bool | None) -> Cell:
    if consistent is None:
        return cell(NOTHING, "quiet")
    return cell("agree", "good") if consistent else cell("differ", "bad")


def reported_table(page: Page, *, beside: int) -> Table:
    """Return the students' numbers next to the numbers from their data.

    For a wrong number, the table says what to look at. A number may be off by rounding, three
    standard errors and a few percent.

    Parameters
    ----------
    beside : number of the table of parameters.
    """
    reported = page.analysis.reported
    lines = []
    for row in page.analysis.rows:
        claimed = [
            (reported.get("initial", {}).get(row.name), row.initial),
            (reported.get("final", {}).get(row.name), row.final),
        ]
        if any(yours is not None for yours, _ in claimed):
            cells = [one for yours, found in claimed for one in _claim(row.name, yours, found)]
            off = any(yours is not None and is_off(row.name, yours, e) for yours, e in claimed)
            look = _look_at(row.name) if off else ""
            lines.append([cell(name_span(row.name)), cell(_unit(row)), *cells, cell(look)])
    return page.table(_WORDS, "reported_table", lines, "llddlddll", table=beside)


def _claim(name: str, yours: Decimal | None, found: Estimate | None) -> list[Cell]:
    """Return a student's number, the number from the data, and their difference."""
    value = NOTHING
    if found is not None:
        digits = 2 if found.source == "assumed" else 4
        value = significant(found.value, digits=digits)
    if yours is None:
        return [cell(NOTHING, "quiet"), cell(value), cell(NOTHING, "quiet")]
    text = cell(f"{yours:f}".replace("-", "−"))
    if found is None or not found.value or found.source == "assumed":
        return [text, cell(value), cell(NOTHING, "quiet")]
    off = percent(100 * (float(yours) - found.value) / abs(found.value), signed=True)
    return [text, cell(value), cell(off, "bad" if is_off(name, yours, found) else "")]


def _look_at(name: str) -> str:
    """Return what to look at if a number is wrong."""
    read = read_name(name)
    kinds = {"gain": read.is_gain, "damping": read.is_ratio, "frequency": read.is_frequency}
    return next((_WORDS.text(f"look_{kind}") for kind, is_it in kinds.items() if is_it), "")


def _parameter_notes(rows: Sequence[ParameterRow]) -> list[Spans]:
    """Return remarks on single parameters; equal remarks are combined."""
    by_note: dict[str, list[str]] = {}
    for row in rows:
        if row.note:
            by_note.setdefault(row.note, []).append(row.name)
    if same := [row.name for row in rows if row.independent is False]:
        by_note[_WORDS.text("same_recordings")] = same
    return [spans(rich(", ".join(names)), ": ", rich(clean(n))) for n, names in by_note.items()]


def _staged_differences(analysis: Analysis) -> Block | None:
    """Return how much the cart-by-cart fit differs from the joint fit."""
    fit = analysis.fit
    if fit is None or not fit.converged or fit.chain.n == 1:
        return None
    changes = {
        name: abs(100 * (value / fit.parameters[name].value - 1))
        for name, value in fit.staged.items()
        if name in fit.parameters and fit.parameters[name].value
    }
    if not changes:
        return None
    worst = max(changes, key=changes.__getitem__)
    if changes[worst] < 0.05:  # percent; a smaller difference is not worth mentioning
        return paragraph(_WORDS.text("staged_same"))
    differs = {"share": percent(changes[worst]), "name": names_spans([worst])}
    return paragraph(_WORDS.spans("staged_differs", **differs))


def chain_table(page: Page, chain: Chain, *, std: Mapping[str, float]) -> Table:
    """Return masses, dampings and springs, with the standard errors of the fitted ones."""
    units = page.units
    kinds = (
        ("m", "mass", chain.m, units.mass),
        ("c", "damping", chain.c, units.damping),
        ("k", "spring", chain.k, units.stiffness),
    )
    listed = [
        (letter, noun, unit, i, float(value), std.get(f"{letter}_{i}"))
        for letter, noun, values, unit in kinds
        for i, value in enumerate(values, start=1)
        # On a single cart only the sum of the springs is known.
        if chain.n > 1 or letter != "k" or i == 1
    ]
    numbers = with_errors([(value, error) for *_, value, error in listed])
    rows = [
        (
            (name_span(f"{letter}_{i}" if chain.n > 1 else letter),),
            _where(noun, i, chain.n),
            text if value or error else "none",
            unit_text(unit),
        )
        for (letter, noun, unit, i, value, error), text in zip(listed, numbers, strict=True)
    ]
    return page.table(_WORDS, "chain_table", rows, "lldl")


def _where(noun: str, i: int, n: int) -> str:
    if noun != "spring":
        return f"{noun} of cart {i}" if n > 1 else noun
    if n == 1:
        return "springs, together"
    left, right = ("wall" if i == 1 else str(i - 1)), ("wall" if i == n + 1 else str(i))
    return f"spring {left}–{right}"
