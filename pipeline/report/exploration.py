"""The page `exploration.html`: first what is known, then how it was found, turn by turn."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.experiments.exploration import Turn, deciding_trace, list_explanations
from pipeline.gap.types import Gap
from pipeline.names import read_name
from pipeline.output import write_file
from pipeline.report.builder import Page
from pipeline.report.document import Block, Heading, Tile, Tiles, Tone, paragraph
from pipeline.report.figures import QUIET, SECOND
from pipeline.report.figures.style import legend_above, log_scale, panels
from pipeline.report.gap_report import before_after_picture
from pipeline.report.gap_verdict import error_board, verdict_blocks, verdict_title
from pipeline.report.html import render_html
from pipeline.results import Analysis
from pipeline.words.numbers import NOTHING, count, listing, unit_text, with_error
from pipeline.words.phrases import phrases
from pipeline.words.text import capital, clean, name_span, rich, spans, symbol_text

_WORDS = phrases("exploration")

NAME = "exploration.html"  # in the folder of the submission


def write_diary(turns: Sequence[Turn], analysis: Analysis, folder: Path, *, wanted: float) -> Path:
    """Write the diary into a submission's folder; return its path.

    Parameters
    ----------
    wanted : requested relative standard error of the parameters.
    """
    page = Page(analysis)
    sections = page.sections(
        [
            ("summary", _WORDS.text("answer"), lambda page: _answer(page, turns, wanted)),
            ("turns", _WORDS.text("turns"), lambda page: _story(page, turns)),
            ("errors", _WORDS.text("errors"), lambda page: _errors(page, turns, wanted)),
            ("explanations", _WORDS.text("explanations"), lambda page: _gap(page, turns)),
        ],
        doing="diary",
    )
    document = page.document(sections, about=_WORDS.text("about"))
    write_file(folder / NAME, render_html(document))
    return folder / NAME


def _answer(page: Page, turns: Sequence[Turn], wanted: float) -> list[Block]:
    """Return what is known at the end: verdict, parameters with errors, and what is unexplained."""
    last = turns[-1]
    blocks: list[Block] = [_board(turns, wanted)]
    if last.gap:
        blocks += [*verdict_blocks(last.gap), error_board(last.gap)]
    fit = page.analysis.fit
    assert fit is not None
    rows = [
        [
            name_span(name),
            with_error(estimate.value, estimate.std),
            unit_text(clean(read_name(name).unit(page.units))) or "1",
            _known(last.errors.get(name)),
        ]
        for name, estimate in fit.parameters.items()
    ]
    return [*blocks, page.table(_WORDS, "known_table", rows, "ldlr")]


def _board(turns: Sequence[Turn], wanted: float) -> Tiles:
    last = turns[-1]
    worst = max((error for error in last.errors.values() if error is not None), default=None)
    known = worst is not None and worst <= wanted
    notes = {"wanted": _known(wanted), "turns": count(len(turns), "turn")}
    values: dict[str, tuple[str, Tone]] = {
        "tile_worst": (_known(worst), "good" if known else "bad"),
        "tile_verdict": (verdict_title(last.gap) if last.gap else NOTHING, _tone(last.gap)),
        "tile_time": (f"{last.seconds:.0f}\u00a0s", ""),
    }
    return Tiles(
        tuple(
            Tile(_WORDS.spans(key), spans(value), _WORDS.spans(f"{key}_note", **notes), tone)
            for key, (value, tone) in values.items()
        )
    )


def _tone(gap: Gap | None) -> Tone:
    if gap is None or gap.verdict == "ambiguous":
        return ""
    return "good" if gap.verdict in ("none", "named") else "bad"


def _story(page: Page, turns: Sequence[Turn]) -> list[Block]:
    """Return each turn: time, recordings, decision, and the deciding recording if there is one."""
    blocks: list[Block] = []
    for number, turn in enumerate(turns, start=1):
        recorded = listing(turn.recorded) or _WORDS.text("nothing_new")
        head = {"number": str(number), "seconds": f"{turn.seconds:.0f}", "recorded": recorded}
        blocks.append(Heading(_WORDS.spans("turn", **head)))
        blocks.append(paragraph(rich(clean(turn.summary + "."))))
        trace = deciding_trace(turn.gap, turn.recorded) if turn.gap else None
        if turn.gap and trace:
            blocks.append(before_after_picture(page, turn.gap, trace, number=number))
    return blocks


def _errors(page: Page, turns: Sequence[Turn], wanted: float) -> list[Block]:
    last = turns[-1].errors
    names = [one for one in last if any(turn.errors.get(one) is not None for turn in turns)]
    if not names:
        return []
    rows = [[name_span(name), *(_known(turn.errors.get(name)) for turn in turns)] for name in names]
    head = ["", *(f"{turn.seconds:.0f} s" for turn in turns)]
    table = page.headed_table(_WORDS.text("errors_table"), head, rows, "l" + "r" * len(turns))
    if len(turns) < 2:  # progress can be drawn from the second turn on
        return [table]
    figure = _shrinking(turns, names, wanted)
    return [page.picture("shrinking", figure, _WORDS, "shrinking", wanted=_known(wanted)), table]


def _known(error: float | None) -> str:
    return NOTHING if error is None else f"{100 * error:.2g} %"


def _shrinking(turns: Sequence[Turn], names: Sequence[str], wanted: float) -> Figure:
    """Draw each parameter's standard error over time at the bench."""
    figure, (ax,) = panels(2.2)
    seconds = [turn.seconds for turn in turns]
    for name in names:
        errors = [turn.errors.get(name) for turn in turns]
        shown = [np.nan if error is None else 100 * error for error in errors]
        ax.plot(seconds, shown, "o-", ms=3, lw=0.9, label=symbol_text(name))
    ax.axhline(100 * wanted, color=QUIET, lw=0.8, ls="--")
    every = [100 * e for turn in turns for e in turn.errors.values() if e]
    # Errors above 100 % count as unknown and may leave the axis.
    _whole_axes(ax, turns, [100 * wanted, *(min(e, 100.0) for e in every)])
    ax.set_ylabel("standard error [%]")
    # The legend is beside the axes, because three carts need a dozen lines.
    box = ax.get_position()
    ax.set_position((box.x0, box.y0, box.width - 0.09, box.height))
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderpad=0.0, handlelength=1.6)
    return figure


def _whole_axes(ax: Axes, turns: Sequence[Turn], values: Sequence[float]) -> None:
    """Start time at zero, and let a logarithmic axis extend to whole powers of ten."""
    ax.set_xlim(0.0, 1.04 * turns[-1].seconds)
    ax.set_xlabel("time at the bench [s]")
    exponents = np.log10([value for value in values if value > 0])
    low, high = np.floor(exponents.min()), np.ceil(exponents.max())
    log_scale(ax, "y")
    ax.set_ylim(10.0**low, 10.0 ** max(high, low + 1))


def _explained(gap: Gap) -> list[str]:
    """Return the competing explanations with their weights; a single explanation has no weight."""
    found = list_explanations(gap)
    if len(found) < 2:
        return [name for name, _ in found]
    weights = [f"{100 * weight:.0f} %" if weight >= 0.01 else "under 1 %" for _, weight in found]
    weights[0] = f"in the model, {weights[0]}"
    return [f"{name} ({weight})" for (name, _), weight in zip(found, weights, strict=True)]


def _gap(page: Page, turns: Sequence[Turn]) -> list[Block]:
    """Return a table and a figure of what the model left unexplained after each turn."""
    looked = [(turn.seconds, turn.gap) for turn in turns if turn.gap is not None]
    if not looked:
        return []
    rows = [
        (f"{seconds:.0f} s", gap.verdict, capital("; ".join(_explained(gap))))
        for seconds, gap in looked
    ]
    table = page.table(_WORDS, "gap_table", rows, "lll")
    if len(looked) < 2:
        return [table]
    return [page.picture("left", _left_figure(turns, looked), _WORDS, "left"), table]


def _left_figure(turns: Sequence[Turn], looked: Sequence[tuple[float, Gap]]) -> Figure:
    """Draw the unexplained share of the motion, and the noise floor, over time."""
    figure, (ax,) = panels(1.5)
    seconds = [at for at, _ in looked]
    left = [100 * (gap.final or 0.0) for _, gap in looked]
    floor = [100 * (gap.noise_floor or 0.0) for _, gap in looked]
    ax.plot(seconds, left, "o-", label="linear model and effects")
    ax.plot(seconds, floor, "--", color=SECOND, label="noise alone")
    _whole_axes(ax, turns, [*left, *floor])
    ax.set_ylabel("of the motion [%]")
    legend_above(ax)
    return figure
