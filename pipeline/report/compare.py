"""The page with interactive plots: one file that contains its data and a still picture.

Without scripts, readers see the picture and the table of errors.
"""

import json
from base64 import b64encode
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipeline import __version__
from pipeline.arrays import Array
from pipeline.gap.types import Gap
from pipeline.output import write_file
from pipeline.report.builder import Page
from pipeline.report.compared_runs import ComparedCart, ComparedRun, compare_runs
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
from pipeline.report.gap_verdict import added_name, share
from pipeline.report.html import render_plots
from pipeline.report.make_report import COMPARE
from pipeline.results import Analysis
from pipeline.words.numbers import count, subscript
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress
from pipeline.words.text import clean

_KINDS = ("decay", "step", "sine", "sweep", "closed_loop")
_SHOWS = ("overlay", "residual", "spectrum", "leftover")
_MODELS = ("linear", "effects", "loop")
_WORDS = phrases("plots")

MOST_WHOLE = 4_000  # most samples of a run that is shown completely
# A longer run is divided into this number of stretches; each keeps its ends and extremes.
_STRETCHES = 1_000
_LEVELS = 65_534  # levels of a packed number; the level below them marks a missing number
_SMALLEST = 1e-12  # share of the largest amplitude; smaller amplitudes are drawn at this level

MOST_LINES = 400  # lines on a logarithmic axis; finer than a screen can show


def write_plots(analysis: Analysis, out: Path, *, gap: Gap | None, progress: Progress) -> None:
    """Write the page of plots into a folder."""
    beside = (out / "report.html").is_file()
    write_file(out / COMPARE, make_page(analysis, gap=gap, report=beside, progress=progress))


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
    worst, counted = _find_worst(runs), count(len(runs), "recording")
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


def pack_run(run: ComparedRun) -> dict[str, Any]:
    """Return a run in the form that the page's script reads.

    Positions and residuals are packed separately, so that residuals keep all digits. The script
    computes each model as position minus residual.
    """
    signals = [cart.measured for cart in run.carts]
    signals += [cart.measured - one.y for cart in run.carts for one in cart.models]
    signals += [run.u] if run.u is not None else []
    kept = keep_extremes(signals) if run.t.size > MOST_WHOLE else np.arange(run.t.size)
    omega, spectra = _spectra(run)
    return {
        "id": clean(run.id),
        "kind": run.kind,
        "note": clean(run.note),
        "t": pack_time(run.t[kept]),
        "u": None if run.u is None else pack(run.u[kept]),
        "omega": pack(omega),
        "carts": [
            {
                "cart": cart.cart,
                "y": pack(cart.measured[kept]),
                "spectrum": next(spectra),
                "models": [
                    {
                        "model": one.model,
                        "nrmse": float(f"{one.nrmse:.6g}"),
                        "residual": pack((cart.measured - one.y)[kept]),
                        "spectrum": next(spectra),
                        "residual_spectrum": next(spectra),
                    }
                    for one in cart.models
                ],
            }
            for cart in run.carts
        ],
    }


def keep_extremes(signals: Sequence[Array]) -> NDArray[np.intp]:
    """Return the indices (k,) of the samples at the ends and extremes of every stretch."""
    bounds = np.linspace(0, signals[0].size, _STRETCHES + 1).astype(int)
    kept = [bounds[:-1], bounds[1:] - 1]
    for signal in signals:
        for fill, extreme in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            filled = np.where(np.isnan(signal), fill, signal)
            pieces = pairwise(bounds.tolist())
            kept.append(np.array([a + extreme(filled[a:b]) for a, b in pieces]))
    return np.unique(np.concatenate(kept))


def pack(values: Array) -> list[Any]:
    """Return numbers as [middle, step, base64 of little-endian int16].

    The lowest int16 marks NaN.
    """
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    step = (high - low) / _LEVELS
    middle = low + step * (_LEVELS // 2)
    shown = np.where(np.isfinite(values), values, middle)
    levels = np.round((shown - middle) / step) if step > 0.0 else np.zeros(values.size)
    levels = np.where(np.isfinite(values), np.clip(levels, -32767, 32767), -32768)
    return [middle, step, b64encode(levels.astype("<i2").tobytes()).decode()]


def pack_time(values: Array) -> str:
    """Return times as "first last" if they are evenly spaced, else as base64 of float32."""
    if values.size > 1:
        even = np.linspace(values[0], values[-1], values.size)
        # A sample that deviates by less than this share of the span still looks evenly spaced.
        if np.max(np.abs(values - even)) <= 1e-5 * abs(even[-1] - even[0]):
            return f"{float(values[0]):.9g} {float(values[-1]):.9g}"
    return b64encode(values.astype("<f4").tobytes()).decode()


def _spectra(run: ComparedRun) -> tuple[Array, Any]:
    """Return frequencies (k,), and an iterator over the packed spectra in the page's order.

    Spectra are logarithms to base ten. If the simulation of a model begins later than the run, all
    spectra begin there too.
    """
    signals = [signal for cart in run.carts for signal in _signals_of(cart)]
    first = max((int(np.argmax(np.isfinite(one))) for one in signals), default=0)
    if run.t.size - first < 4 or not signals:
        return np.zeros(0), iter([pack(np.zeros(0))] * len(signals))
    omega, amplitudes = amplitude_spectrum(run.t[first:], np.array([s[first:] for s in signals]))
    kept, shown = thin_lines([amplitudes.max(axis=0), *amplitudes])
    least = _SMALLEST * max(float(amplitudes.max()), 1e-300)
    return omega[kept], iter([pack(np.log10(np.maximum(one, least))) for one in shown[1:]])


def _signals_of(cart: ComparedCart) -> list[Array]:
    """Return the measured signal, then each model's positions and residuals."""
    pairs = [(one.y, cart.measured - one.y) for one in cart.models]
    return [cart.measured, *(signal for pair in pairs for signal in pair)]


def amplitude_spectrum(t: Array, y: Array) -> tuple[Array, Array]:
    """Return frequencies (f,) in rad/s, without zero, and amplitudes (…, f) of signals (…, n).

    The mean is subtracted. A Hann window reduces leakage from the ends; it is scaled so that a sine
    at the frequency of a line has its true amplitude. Samples that are not evenly spaced are
    interpolated.
    """
    even = np.linspace(t[0], t[-1], t.size)
    if np.max(np.abs(even - t)) > 1e-6 * (t[-1] - t[0]):
        flat = y.reshape(-1, t.size)
        y = np.array([np.interp(even, t, row) for row in flat]).reshape(y.shape)
    window = np.hanning(t.size)
    lines = np.fft.rfft((y - y.mean(axis=-1, keepdims=True)) * window)
    step = 2.0 * np.pi / (even[-1] - even[0]) * (t.size - 1) / t.size
    omega = step * np.arange(1, lines.shape[-1])
    return omega, 2.0 / window.sum() * np.abs(lines[..., 1:])


def thin_lines(amplitudes: Sequence[Array]) -> tuple[NDArray[np.intp], list[Array]]:
    """Return the indices (k,) of the lines to keep, and each spectrum's values (k,) at these lines.

    Lines that are close together on the logarithmic axis are merged into one, with their largest
    value, so every peak stays. Its frequency is where the first spectrum is largest.
    """
    count = amplitudes[0].size
    if count <= MOST_LINES:
        return np.arange(count), list(amplitudes)
    edges = np.unique(np.round(np.geomspace(1, count + 1, MOST_LINES + 1)).astype(int)) - 1
    starts = edges[:-1]
    pieces = [slice(a, b) for a, b in pairwise(edges.tolist())]
    kept = starts + np.array([int(np.argmax(amplitudes[0][piece])) for piece in pieces])
    return kept, [np.maximum.reduceat(one, starts) for one in amplitudes]
