"""Figures of the gap: motion, errors of each run, and force against its cause."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.gap.residual import ResidualForce
from pipeline.gap.types import FoundEffect, Prediction, RecordGap, Residual, Trace
from pipeline.report.figures import MEASURED, MODEL, QUIET, SECOND, SECOND_LINE, SHADE
from pipeline.report.figures.style import (
    legend_above,
    log_scale,
    name_rows,
    panels,
    plot_measured,
    plot_model,
    plot_points,
    plot_residuals,
    plot_second,
    position_label,
    shorten,
)
from pipeline.words.numbers import subscript
from pipeline.words.text import clean

# Name of the model that has effects besides masses, dampings and springs.
ADDED = "with the effects"
_RESIDUALS = 1.0  # height of the panel of residuals in inches
_LEFT = 0.76  # inches left of a force; "−0.00005" is wider than most numbers
_SEEN = 3.0  # points; a narrower band is hidden by the lines of the residuals


# ---------------------------------------------------------------------- in time


def before_after_figure(
    trace: Trace,
    *,
    noise: float,
    position_unit: str,
    added: str = ADDED,
    touched: Sequence[tuple[Array, Array]] = (),
) -> Figure:
    """Return a figure of one cart in one run: measurement and models above, residuals below.

    Parameters
    ----------
    added : name of the model with effects; "" if it has no effects.
    touched : times and readings just before or after the run, while the cart was moved by hand.
    """
    models = _models(trace, added)
    figure, (above, below) = panels(1.5, _RESIDUALS)
    plot_measured(above, trace.t, trace.measured)
    for t, y in touched:
        above.axvspan(float(t[0]), float(t[-1]), color=SHADE, lw=0)
        plot_points(above, t, y)
    (name, model), *others = models.items()
    for other, y in others:
        plot_second(above, trace.t, y, label=other)
    plot_model(above, trace.t, model, label=name)
    above.set_ylabel(position_label(trace.cart, position_unit))
    legend_above(above)
    if band_shows(trace, noise=noise, added=added):
        below.axhspan(-2 * noise, 2 * noise, color=SHADE, lw=0)
    plot_residuals(below, trace.t, *(trace.measured - y for y in models.values()))
    below.set_ylabel(f"residual [{position_unit}]")
    below.set_xlabel("time [s]")
    return figure


def band_shows(trace: Trace, *, noise: float, added: str = ADDED) -> bool:
    """Return whether the noise band is wide enough to be seen behind the residuals."""
    largest = max(float(np.ptp(trace.measured - y)) for y in _models(trace, added).values())
    return 4 * noise * 72.0 * _RESIDUALS > _SEEN * max(largest, 4 * noise)


def _models(trace: Trace, added: str) -> dict[str, Array]:
    """Return the models' motions by name; the one with effects, if there is one, comes first."""
    linear = {"linear model": trace.baseline}
    return {added: trace.final} | linear if added else linear


def predicted_figure(
    prediction: Prediction, *, names: tuple[str, str], position_unit: str
) -> Figure:
    """Return a figure of a recording as predicted by two explanations, and of their difference."""
    figure, (above, below) = panels(1.5, 1.0)
    first, second = prediction.positions[list(prediction.pair)]
    one, other = names
    plot_model(above, prediction.t, first, label=one)
    plot_second(above, prediction.t, second, label=other)
    above.set_ylabel(position_label(prediction.cart, position_unit))
    legend_above(above)
    plot_residuals(below, prediction.t, second - first)
    below.set_ylabel(f"difference [{position_unit}]")
    below.set_xlabel("time [s]")
    return figure


# ------------------------------------------------------------------- run by run


def by_record_figure(rows: Sequence[RecordGap], *, added: str = ADDED) -> Figure:
    """Return a figure of each run's and cart's error, without and with effects, and the noise.

    Parameters
    ----------
    added : see `before_after_figure`.
    """
    figure, (ax,) = panels(0.19 * len(rows) + 0.1)
    plot_by_record(ax, rows, added=added)
    legend_above(ax)
    ax.set_xlabel("error, share of the motion [%]")
    return figure


def plot_by_record(ax: Axes, rows: Sequence[RecordGap], *, added: str = ADDED) -> None:
    """Plot, for each run and cart, a bar between the errors without and with effects.

    The noise is plotted as well.
    """
    y = -np.arange(len(rows), dtype=float)
    before, after, noise = (
        100 * np.array([getattr(row, name) for row in rows])
        for name in ("baseline", "final", "noise_floor")
    )
    log_scale(ax, "x")
    if added:
        ax.hlines(y, after, before, color=QUIET, lw=1.4)
        ax.plot(before, y, "o", ms=4.5, mfc="white", mec=SECOND, mew=1.1, label="linear model")
    ax.plot(after, y, "o", ms=4.5, color=MODEL, mec=MODEL, label=added or "linear model")
    ax.plot(noise, y, "|", ms=8.0, color=MEASURED, mew=1.2, label="noise")
    every = np.concatenate([before, after, noise])
    every = every[every > 0]
    ax.set_xlim(every.min() / 1.4, every.max() * 1.4)
    names = [f"{shorten(clean(row.experiment), most=30)}, x{subscript(row.cart)}" for row in rows]
    colours = [MEASURED if row.held_out else QUIET for row in rows]
    name_rows(ax, list(zip(names, colours, strict=True)))


# ------------------------------------------------------------------- the force


def force_figure(
    found: FoundEffect,
    forces: Sequence[ResidualForce],
    *,
    units: tuple[str, str],
    added: str = ADDED,
) -> Figure | None:
    """Return a figure of the unexplained force (vertical axis) against its cause.

    Returns None if no run shows it, because a neighbouring cart was not measured or the effect
    changes only the timing.
    """
    axis = found.effect.axis
    cart, spring = found.where.get("cart", 1), found.where.get("spring")
    position, drive = units
    figure, (ax,) = panels(2.1, left=_LEFT)
    shown: list[tuple[Array, Array, Array]] = []
    if spring is not None:
        own = [f for f in forces if f.cart in (spring, spring - 1)]
        carts = {f.cart for f in own}
        own = [f for f in own if f.cart == max(carts)]
        for f in own:
            # Spring j pulls cart j back and cart j - 1 forward.
            sign, side = (-1.0, 0) if f.cart == spring else (1.0, 1)
            rate = axis == "velocity"
            middle = f.velocity if rate else f.position
            other = (f.neighbours_velocity if rate else f.neighbours)[side]
            stretch = -sign * (middle - other)
            shown.append((stretch, sign * f.measured, sign * f.model))
        what = f"rate of stretch [{position}/s]" if axis == "velocity" else f"stretch [{position}]"
        ax.set_ylabel(f"extra force [{drive}]")
    elif axis == "input":
        own = [f for f in forces if f.cart == 1]
        shown = [(f.u, f.measured + f.shaped_input, f.model + f.shaped_input) for f in own]
        what = f"input u [{drive}]"
        ax.set_ylabel(f"force that arrives [{drive}]")
    else:
        own = [f for f in forces if f.cart == cart]
        shown = [
            (f.velocity if axis == "velocity" else f.position, f.measured, f.model) for f in own
        ]
        what = f"velocity [{position}/s]" if axis == "velocity" else f"position [{position}]"
        ax.set_ylabel(f"unexplained force [{drive}]")
    if not shown:
        return None
    plot_force(ax, shown, added=added)
    if axis == "input":
        reach = np.max(np.abs(np.concatenate([x for x, _, _ in shown])))
        ax.plot([-reach, reach], [-reach, reach], label="linear", **SECOND_LINE)
    ax.set_xlabel(what)
    legend_above(ax)
    return figure


def plot_force(
    ax: Axes, shown: Sequence[tuple[Array, Array, Array]], *, added: str = ADDED
) -> None:
    """Plot the measured points and, with smaller marks, the model's points.

    Parameters
    ----------
    shown : triples of arrays: x, measured, model.
    """
    x, measured, model = (np.concatenate(parts) for parts in zip(*shown, strict=True))
    order = np.linspace(0, x.size - 1, min(x.size, 500)).astype(int)
    ax.axhline(0.0, color=QUIET, lw=0.6)
    ax.plot(x[order], measured[order], "o", ms=3.4, mfc="none", mec=MEASURED, mew=0.5,
            label="measured")  # fmt: skip
    ax.plot(x[order], model[order], ".", color=MODEL, ms=3.0, mew=0)
    ax.plot([], [], ".", color=MODEL, ms=6.0, mew=0, label=added)  # only for the legend
    ax.set_xlim(*(1.06 * np.array([x.min(), x.max()]) if x.min() < 0 < x.max() else (None, None)))


def force_left_figure(residual: Residual) -> Figure:
    """Plot the unexplained force on a cart over each quantity, with the fitted formula."""
    figure, axes = panels(*(1.6 for _ in residual.against), share_x=False, left=_LEFT)
    for ax, shown in zip(axes, residual.against, strict=True):
        bars = [0.0 if spread is None else spread for spread in shown.spread]
        ax.axhline(0.0, color=QUIET, lw=0.6)
        ax.errorbar(shown.at, shown.force, yerr=bars, fmt="o", ms=3.4, mfc="none", mec=MEASURED,
                    mew=0.6, ecolor=QUIET, elinewidth=0.8, label="force left")  # fmt: skip
        if shown.formula is not None:
            ax.plot(shown.at, shown.formula, color=MODEL, lw=1.1, label="formula")
        ax.set_xlabel(f"{shown.quantity} [{shown.unit}]")
        ax.set_ylabel(f"force [{residual.unit}]")
    legend_above(axes[0])
    return figure


def timing_figure(
    forces: Sequence[ResidualForce], *, drive: str, added: str = ADDED
) -> Figure | None:
    """Return a figure of the force on cart 1 around the sharpest jump of the input."""
    own = [f for f in forces if f.cart == 1 and np.ptp(f.u) > 0]
    if not own:
        return None
    steep = [float(np.max(np.abs(np.diff(f.u)) / np.diff(f.t))) for f in own]
    force = own[int(np.argmax(steep))]
    at = float(force.t[int(np.argmax(np.abs(np.diff(force.u))))])
    kept = (force.t > at - 0.15) & (force.t < at + 0.5)
    figure, (ax,) = panels(1.8, left=_LEFT)
    measured = (force.measured + force.shaped_input)[kept]
    ax.plot(force.t[kept], measured, ".", color=MEASURED, ms=4.0, mew=0, label="measured")
    ax.plot(force.t[kept], force.u[kept], color=SECOND, ls="--", lw=1.1, label="logged input")
    ax.plot(force.t[kept], (force.model + force.shaped_input)[kept], color=MODEL, lw=1.1,
            label=added)  # fmt: skip
    ax.set_ylabel(f"force on cart 1 [{drive}]")
    ax.set_xlabel("time [s]")
    legend_above(ax)
    return figure


def spectrum_figure(traces: Sequence[Trace], *, position_unit: str, added: str = ADDED) -> Figure:
    """Return amplitude spectra of the motion and of the models' errors.

    They are root mean squares over the runs, so a sine in each run has a peak of its amplitude.
    """
    longest = max(float(t.t[-1] - t.t[0]) for t in traces)
    dt = max(float(np.median(np.diff(t.t))) for t in traces)
    f = np.fft.rfftfreq(2 * int(longest / dt), dt)
    pooled = np.zeros((3, f.size))
    for trace in traces:
        t = np.arange(trace.t[0], trace.t[-1], dt)
        window = np.hanning(t.size)
        for i, y in enumerate(
            (trace.measured - trace.zero, trace.measured - trace.baseline,
             trace.measured - trace.final)
        ):  # fmt: skip
            even = np.interp(t, trace.t, y)
            spectrum = np.fft.rfft((even - even.mean()) * window, 2 * (f.size - 1))
            pooled[i] += np.abs(2 * spectrum / window.sum()) ** 2 / len(traces)
    motion, before, after = np.sqrt(pooled)
    total = np.cumsum(motion**2)
    # Show frequencies up to 1.5 times the one below which 99.5 % of the motion lies.
    end = 1.5 * f[np.searchsorted(total, 0.995 * total[-1])]
    shown = (f > 0) & (f <= max(end, 8 * f[1]))
    step = max(1, int(np.count_nonzero(shown) / 600))
    index = np.flatnonzero(shown)[::step]
    figure, (ax,) = panels(1.9)
    log_scale(ax, "y")
    ax.plot(f[index], motion[index], color=MEASURED, lw=0.8, ls=":", label="measured motion")
    ax.plot(f[index], before[index], label="residual, linear model", **SECOND_LINE)
    ax.plot(f[index], after[index], color=MODEL, lw=1.0, label=f"residual, {added}")
    ax.set_ylabel(f"amplitude [{position_unit}]")
    ax.set_xlabel("frequency [Hz]")
    legend_above(ax)
    return figure
