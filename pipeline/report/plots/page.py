"""The page with interactive plots: one file that contains its data and a still picture.

Without scripts, readers see the picture and the table of errors.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlencode

from markupsafe import Markup
from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.gap.types import Gap
from pipeline.output import write_file
from pipeline.report.builder import Page
from pipeline.report.document import Picture
from pipeline.report.figures.style import (
    drawing,
    keep_in_sight,
    legend_above,
    panels,
    plot_measured,
    plot_model,
    plot_second,
    position_label,
)
from pipeline.report.gap.verdict import added_name, share
from pipeline.report.plots import NAME
from pipeline.report.plots.pack import MOST_WHOLE, pack_run
from pipeline.report.plots.runs import ComparedRun, compare_runs
from pipeline.report.render.html import render_plots
from pipeline.results import Analysis
from pipeline.words.numbers import count, subscript
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress
from pipeline.words.text import clean

_KINDS = ("decay", "step", "sine", "sweep", "closed_loop")
_SHOWS = ("overlay", "residual", "spectrum", "leftover")
_MODELS = ("linear", "effects", "loop")
_WORDS = phrases("plots")


def write_plots(analysis: Analysis, out: Path, *, gap: Gap | None, progress: Progress) -> None:
    """Write the page of plots into a folder."""
    beside = (out / "report.html").is_file()
    write_file(out / NAME, make_page(analysis, gap=gap, report=beside, progress=progress))


def make_page(analysis: Analysis, *, gap: Gap | None, report: bool, progress: Progress) -> str:
    """Compare all recordings with their models and return the page; see `render_page`."""
    runs = compare_runs(analysis, gap=gap, progress=progress)
    return render_page(analysis, runs, gap=gap, report=report)


def render_page(
    analysis: Analysis, runs: Sequence[ComparedRun], *, gap: Gap | None, report: bool
) -> str:
    """Return the page; the same runs give the same bytes.

    Parameters
    ----------
    gap : the gap analysis whose effects are in the runs.
    report : whether the page links to a report next to it.
    """
    page = Page(analysis)
    added = added_name(gap) if gap else ""
    names = {name: _WORDS.text(name) for name in ("measured", "linear", "loop")}
    names["effects"] = _WORDS.text("effects", added=added)
    made = {one.model for run in runs for cart in run.carts for one in cart.models}
    models = [name for name in _MODELS if name in made]
    carts = sorted({cart.cart for run in runs for cart in run.carts})
    data = {
        "units": {"position": page.position, "input": page.drive},
        "names": names,
        "runs": [pack_run(run) for run in runs],
    }
    return render_plots(
        title=_WORDS.text("title"),
        about=clean(analysis.title).strip() or "cartlab",
        version=__version__,
        report=report,
        address=_write_address,
        shows=[(key, _WORDS.text(f"show_{key}")) for key in _SHOWS],
        result=_tell_result(runs),
        worst=_find_worst(runs),
        kinds=_group_runs(runs),
        carts=carts,
        names={cart: f"x{subscript(cart)}" for cart in carts},
        lines=[(name, names[name]) for name in ("measured", *models)],
        driven=any(run.u is not None for run in runs),
        fit=_WORDS.text("fit"),
        rows=_list_errors(runs, names),
        notes=[(clean(run.id), clean(run.note)) for run in runs if run.note],
        thinned=_WORDS.text("thinned") if any(r.t.size > MOST_WHOLE for r in runs) else "",
        tables=_WORDS.text("tables") if analysis.tables else "",
        still=_draw_still(page, runs, added=names["effects"]),
        # No text in the data can end the script element.
        data=Markup(json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")),
    )


def _write_address(run: str, cart: int, model: str) -> str:
    """Return the part of the address after "#" that makes the page show a model's residual."""
    lines = [("line", "measured"), ("line", model)]
    return urlencode([("run", run), ("cart", cart), *lines, ("show", "residual")])


def _find_worst(runs: Sequence[ComparedRun]) -> tuple[str, int, float] | None:
    """Return the run and cart that the linear model describes worst, and the model's error."""
    found = [
        (clean(run.id), cart.cart, one.nrmse)
        for run in runs
        for cart in run.carts
        for one in cart.models
        if one.model == "linear"
    ]
    return max(found, key=lambda one: one[2], default=None)


def _tell_result(runs: Sequence[ComparedRun]) -> str:
    worst, counted = _find_worst(runs), count(len(runs), "run")
    if worst is None:
        return _WORDS.text("result_alone", runs=counted)
    run, cart, nrmse = worst
    return _WORDS.text("result", runs=counted, run=run, cart=subscript(cart), share=share(nrmse))


def _group_runs(runs: Sequence[ComparedRun]) -> list[tuple[str, list[str]]]:
    """Return the ids of the runs of each kind."""
    groups = [(kind, [clean(run.id) for run in runs if run.kind == kind]) for kind in _KINDS]
    return [(_WORDS.text(f"kind_{kind}"), ids) for kind, ids in groups if ids]


def _list_errors(
    runs: Sequence[ComparedRun], names: dict[str, str]
) -> list[tuple[str, str, str, dict[int, str]]]:
    """Return a row for each run and model, with the error for each cart."""
    rows = []
    for run in runs:
        for model in _MODELS:
            errors = {
                cart.cart: share(one.nrmse)
                for cart in run.carts
                for one in cart.models
                if one.model == model
            }
            if errors:
                rows.append((clean(run.id), model, names[model], errors))
    return rows


def _draw_still(page: Page, runs: Sequence[ComparedRun], *, added: str) -> Picture | None:
    """Return the run that the linear model describes worst, as a picture."""
    worst = _find_worst(runs)
    chosen = [run for run in runs if run.carts and (not worst or clean(run.id) == worst[0])]
    if not chosen:
        return None
    with drawing():
        figure = _still_figure(chosen[0], position_unit=page.position, added=added)
        return page.picture("compare", figure, _WORDS, "still", run=chosen[0].id)


def _still_figure(run: ComparedRun, *, position_unit: str, added: str) -> Figure:
    figure, axes = panels(*[1.05] * len(run.carts))
    for ax, cart in zip(axes, run.carts, strict=True):
        plot_measured(ax, run.t, cart.measured)
        for one in cart.models:
            if one.model == "effects":
                plot_model(ax, run.t, one.y, label=added)
            elif one.model == "linear":
                plot_second(ax, run.t, one.y, label=_WORDS.text("linear"))
        keep_in_sight(ax, cart.measured)
        ax.set_ylabel(position_label(cart.cart, position_unit))
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure
