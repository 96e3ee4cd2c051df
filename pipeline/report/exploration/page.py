"""`exploration.html`: the turns one below the other, errors and explanations over time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pipeline.output import write_file
from pipeline.report.document import Block, bullet_list, cell, spans
from pipeline.report.exploration.turn import Turn
from pipeline.report.figures.style import QUIET, SECOND, legend_above, panels
from pipeline.report.numbers import NOTHING
from pipeline.report.phrases import phrases
from pipeline.report.render.html import render_html
from pipeline.report.sections.page import Page
from pipeline.report.words import capital, clean, name_span, rich, symbol_text
from pipeline.results import Analysis

NAME = "exploration.html"
_WORDS = phrases("exploration")
_LEAST = 0.01  # of a weight that is told as a number


def write_diary(turns: Sequence[Turn], analysis: Analysis, folder: Path, *, wanted: float) -> Path:
    """Write the diary into a submission's folder; `wanted`: the relative error asked for."""
    page = Page.of(analysis)
    sections = page.sections(
        [
            ("turns", _WORDS.text("turns"), lambda page: _turns(turns)),
            ("errors", _WORDS.text("errors"), lambda page: _errors(page, turns, wanted)),
            ("explanations", _WORDS.text("explanations"), lambda page: _gap(page, turns)),
        ],
        doing="diary",
        progress=None,
    )
    document = page.document(sections, about=_WORDS.text("about"))
    write_file(folder / NAME, render_html(document))
    return folder / NAME


def _share(value: float) -> str:
    return f"{100 * value:.2g} %"


def _turns(turns: Sequence[Turn]) -> list[Block]:
    return [
        bullet_list(
            spans(
                ", ".join([f"{turn.seconds:.0f} s", *turn.recorded]) + ": ", rich(clean(turn.said))
            )
            for turn in turns
        )
    ]


def _errors(page: Page, turns: Sequence[Turn], wanted: float) -> list[Block]:
    names = [name for name in turns[-1].errors if turns[-1].errors[name] is not None]
    if not names:
        return []
    rows = [
        [
            cell(name_span(name)),
            *(
                cell(NOTHING if (error := turn.errors.get(name)) is None else _share(error))
                for turn in turns
            ),
        ]
        for name in names
    ]
    head = ["", *(f"{turn.seconds:.0f} s" for turn in turns)]
    return [
        page.picture(
            "shrinking",
            _shrinking(turns, names, wanted),
            caption=_WORDS.text("errors_caption", wanted=_share(wanted)),
            alt=_WORDS.text("errors_alt"),
        ),
        page.table(_WORDS.text("errors_table"), head, rows, "l" + "r" * len(turns)),
    ]


def _shrinking(turns: Sequence[Turn], names: Sequence[str], wanted: float) -> Figure:
    """Draw each parameter's standard error against time at the bench."""
    figure, (ax,) = panels(2.2)
    seconds = [turn.seconds for turn in turns]
    for name in names:
        errors = [turn.errors.get(name) for turn in turns]
        shown = [np.nan if error is None else 100 * error for error in errors]
        ax.plot(seconds, shown, "o-", ms=3, lw=0.9, label=symbol_text(name))
    ax.axhline(100 * wanted, color=QUIET, lw=0.8, ls="--")
    ax.set_yscale("log")
    ax.set_xlabel("time at the bench [s]")
    ax.set_ylabel("standard error [%]")
    # Beside the axes: three carts have a dozen.
    box = ax.get_position()
    ax.set_position((box.x0, box.y0, box.width - 0.09, box.height))
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderpad=0.0, handlelength=1.6)
    return figure


def _explained(turn: Turn) -> list[str]:
    """Return each explanation in dispute with its weight; of one alone there is none to tell."""
    if len(turn.explanations) < 2:
        return [one.name for one in turn.explanations]
    weights = [
        f"{100 * one.weight:.0f} %" if one.weight >= _LEAST else f"under {100 * _LEAST:.0f} %"
        for one in turn.explanations
    ]
    weights[0] = f"in the model, {weights[0]}"
    return [
        f"{one.name} ({weight})" for one, weight in zip(turn.explanations, weights, strict=True)
    ]


def _gap(page: Page, turns: Sequence[Turn]) -> list[Block]:
    """Show what the model leaves, and between which explanations the data were undecided."""
    looked = [turn for turn in turns if turn.left is not None and turn.floor is not None]
    if not looked:
        return []
    figure, (ax,) = panels(1.5)
    seconds = [turn.seconds for turn in looked]
    ax.plot(seconds, [100 * (t.left or 0.0) for t in looked], "o-", label="left by the model")
    ax.plot(
        seconds, [100 * (t.floor or 0.0) for t in looked], "--", color=SECOND, label="noise alone"
    )
    ax.set_yscale("log")
    ax.set_xlabel("time at the bench [s]")
    ax.set_ylabel("of the motion [%]")
    legend_above(ax)
    rows = [
        [
            cell(f"{turn.seconds:.0f} s"),
            cell(turn.verdict),
            cell(capital("; ".join(_explained(turn)))),
        ]
        for turn in looked
    ]
    return [
        page.picture(
            "left", figure, caption=_WORDS.text("left_caption"), alt=_WORDS.text("left_alt")
        ),
        page.table(_WORDS.text("gap_table"), ["", "verdict", "explanations"], rows, "lll"),
    ]
