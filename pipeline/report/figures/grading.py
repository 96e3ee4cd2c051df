"""Figures for a graded class, and figures of reported numbers next to the recordings."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.arrays import Array
from pipeline.plant.chain import Chain
from pipeline.report.figures import MEASURED, MODEL, SECOND, SECOND_LINE, SHADE, THIRD
from pipeline.report.figures.bode import bode_panels
from pipeline.report.figures.style import legend_above, panels, plot_line, shorten
from pipeline.report.figures.time import decay_figure, step_figure
from pipeline.results import FrequencyResponse, LogDecrement, Record, StepGain
from pipeline.setup import Units
from pipeline.words.text import clean


def distribution_figure(points: Sequence[float], *, out_of: float) -> Figure:
    """Return a histogram of points, with one bar for each tenth of the total."""
    counts, edges = np.histogram(points, bins=10, range=(0.0, out_of))
    centres = (edges[:-1] + edges[1:]) / 2
    figure, (ax,) = panels(1.5)
    ax.bar(centres, counts, width=0.94 * np.diff(edges), color=MODEL)
    ax.set_xlim(0.0, out_of)
    ax.set_ylim(0.0, 1.08 * max(1, counts.max()))
    ax.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    ax.set_xlabel(f"points of {out_of:g}")
    ax.set_ylabel("submissions")
    return figure


def two_distributions_figure(before: Sequence[int], after: Sequence[int]) -> Figure:
    """Return histograms of points under the current rubric and under a changed one.

    Parameters
    ----------
    before, after : number of submissions in each tenth of the points, starting from zero points.
    """
    edges = np.linspace(0.0, 100.0, len(before) + 1)
    width = 0.42 * (edges[1] - edges[0])
    centres = (edges[:-1] + edges[1:]) / 2
    figure, (ax,) = panels(1.7)
    ax.bar(centres - width / 2, before, width=width, color="none", edgecolor=MEASURED, lw=1.0,
           label="now")  # fmt: skip
    ax.bar(centres + width / 2, after, width=width, color=MODEL, label="with this rubric")
    ax.set_xlim(0.0, 100.0)
    ax.set_ylim(0.0, 1.08 * max(1, *before, *after))
    ax.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    ax.set_xlabel("share of the points [%]")
    ax.set_ylabel("submissions")
    legend_above(ax)
    return figure


def difficulty_figure(titles: Sequence[str], shares: Array) -> Figure:
    """Return a bar for each criterion: the mean share of its points that was earned.

    Parameters
    ----------
    shares : (n,), between 0 and 1.
    """
    figure, (ax,) = panels(0.32 * len(titles) + 0.05)
    y = -np.arange(len(titles), dtype=float)
    ax.hlines(y, 0.0, 100.0, color=SHADE, lw=5.0)
    ax.hlines(y, 0.0, 100 * shares, color=MODEL, lw=5.0)
    for level, title, share in zip(y, titles, shares, strict=True):
        for x, ha, text in (
            (0.0, "left", shorten(clean(title), most=66)),
            (100.0, "right", f"{100 * share:.0f}\u00a0%"),
        ):
            ax.annotate(text, (x, level), xytext=(0.0, 4.0), textcoords="offset points",
                        ha=ha, va="bottom", color=MEASURED)  # fmt: skip
    ax.set_xlim(0.0, 100.0)
    ax.set_ylim(y[-1] - 0.3, 0.75)
    ax.yaxis.set_visible(False)
    ax.spines["left"].set_visible(False)
    box = ax.get_position()
    ax.set_position((0.03, box.y0, 0.94, box.height))
    ax.set_xlabel("mean share of the points [%]")
    return figure


def reported_bode_figure(
    response: FrequencyResponse,
    *,
    chain: Chain | None,
    reported: tuple[Array, Sequence[Array]] | None,
    units: Units,
) -> Figure:
    """Return the measured response of one cart, the fit, and the curve of reported parameters.

    Parameters
    ----------
    reported : transfer functions of the reported parameters; None draws no curve.
    """
    figure = bode_panels(response, chain=chain, units=units)
    ax = figure.axes[0]
    if reported is not None:
        low, high = ax.get_ylim()
        omega = np.geomspace(*ax.get_xlim(), 300)
        decibel = reported_magnitude(omega, cart=response.cart, reported=reported)
        # The axis allows the curve to leave the measured range by 30 dB.
        seen = np.abs(decibel - (low + high) / 2) < (high - low) / 2 + 30.0
        if seen.any():
            ax.plot(omega[seen], decibel[seen], color=SECOND, ls="--", label="your numbers")
            ax.set_ylim(min(low, decibel[seen].min()), max(high, decibel[seen].max()))
    legend_above(ax)
    return figure


def reported_step_figure(
    gain: StepGain, *, record: Record, reported: float, title: str, position_unit: str
) -> Figure:
    """Return a step recording with the level that the reported gain predicts.

    Parameters
    ----------
    title : the reported number and the measured one.
    """
    figure = step_figure([[gain]], records=[record], position_unit=position_unit)
    (ax,) = figure.axes
    for number, edge in enumerate(gain.edges):
        level = edge.level_before + reported * (edge.u_after - edge.u_before)
        ax.plot(edge.window_after, (level, level), color=SECOND, ls="--", lw=1.4,
                label="" if number else "your number")  # fmt: skip
    return _titled(figure, ax, title)


def reported_decay_figure(
    decay: LogDecrement,
    *,
    record: Record,
    reported: tuple[float, float],
    title: str,
    position_unit: str,
) -> Figure:
    """Return a decay with the curve that the reported numbers predict for the same start.

    Parameters
    ----------
    reported : natural frequency (rad/s) and damping ratio. The curve is not drawn if it would be
        too fast to be visible or would not oscillate.
    title : the reported numbers and the measured ones.
    """
    figure = decay_figure([decay], records=[record], position_unit=position_unit)
    (ax,) = figure.axes
    omega, zeta = reported
    # Draw the curve even if hertz and rad/s were confused, which is a factor of 6.3.
    if 0 <= zeta < 1 and 0 < omega < 10.0 * decay.omega_n:
        t = np.linspace(decay.peak_t[0], decay.fit_t[-1], 2000)
        rest = (decay.envelope_upper[-1] + decay.envelope_lower[-1]) / 2
        since = omega * (t - t[0])
        swing = np.exp(-zeta * since) * np.cos(np.sqrt(1 - zeta**2) * since)
        y = rest + (decay.peak_y[0] - rest) * swing
        look = SECOND_LINE | {"color": THIRD}
        plot_line(ax, t - decay.release, y, look, label="your numbers")
    return _titled(figure, ax, title)


def _titled(figure: Figure, ax: Axes, title: str) -> Figure:
    ax.set_title(f"{ax.get_title(loc='left')}: {title}", loc="left")
    legend_above(ax, columns=5)
    return figure


def reported_magnitude(
    omega: Array, *, cart: int, reported: tuple[Array, Sequence[Array]]
) -> Array:
    """Return 20 log10 |X_cart/U| in dB, (n,), at `omega` in rad/s.

    Parameters
    ----------
    reported : gains and polynomials; see `Chain.tails`.
    """
    gains, tails = reported
    s = 1j * omega
    numerator = tails[cart] if cart < len(tails) else np.ones(1)
    with np.errstate(divide="ignore", invalid="ignore"):  # without damping, a null is zero
        above, below = np.polyval(numerator, s), np.polyval(tails[0], s)
        relative = (above / numerator[-1]) / (below / tails[0][-1])
        return 20 * np.log10(np.abs(gains[cart - 1] * relative))
