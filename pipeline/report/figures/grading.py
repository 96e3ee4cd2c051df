"""Figures of a graded class, and of one submission beside its own recordings."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pipeline.arrays import Array
from pipeline.plant.linear.chain import Chain
from pipeline.report.figures.bode import bode_panels
from pipeline.report.figures.style import (
    LIFT,
    MEASURED,
    MODEL,
    SECOND,
    THIRD,
    legend_above,
    panels,
    plot_line,
)
from pipeline.report.figures.svg import tell
from pipeline.report.figures.time import decay_figure, step_figure
from pipeline.report.words import clean
from pipeline.results import FrequencyResponse, LogDecrement, Record, StepGain

_BINS = 10
_ROW = 0.2  # inches
_LONGEST_NAME = 26  # letters, where the numbers of the axis would stand
_LINE_POINTS = 300
_CURVE_POINTS = 2000
_FASTEST = 10.0  # times the measured frequency: hertz taken for rad/s, and the other way, are seen
_WIDEST = 30.0  # dB that the reported curve may stick out above and below what was measured


def distribution_figure(points: Sequence[float], *, out_of: float) -> Figure:
    """Return how many submissions have how many points: a bar for each tenth of them."""
    counts, edges = np.histogram(points, bins=_BINS, range=(0.0, out_of))
    centres = (edges[:-1] + edges[1:]) / 2
    figure, (ax,) = panels(1.5)
    ax.bar(centres, counts, width=0.94 * np.diff(edges), color=MODEL)
    (tops,) = ax.plot(centres, counts, ls="none", marker="none")  # what a reader points at
    tell(tops, centres, counts.astype(float), name="submissions")
    ax.set_xlim(0.0, out_of)
    ax.set_ylim(0.0, 1.08 * max(1, counts.max()))
    ax.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    ax.set_xlabel(f"points of {out_of:g}")
    ax.set_ylabel("submissions")
    return figure


def difficulty_figure(names: Sequence[str], shares: Array) -> Figure:
    """Return the mean share of the points that each criterion earned, in percent.

    Parameters
    ----------
    shares : (n,), between 0 and 1.
    """
    tall = _ROW * len(names) + 0.1
    figure, (ax,) = panels(tall)
    y = -np.arange(len(names), dtype=float)
    ax.hlines(y, 0.0, 100.0, color="#ececec", lw=6.0)
    ax.hlines(y, 0.0, 100 * shares, color=MODEL, lw=6.0)
    ax.set_xlim(0.0, 100.0)
    ax.set_ylim(y[-1] - 0.7, 0.7)
    ax.yaxis.set_visible(False)
    ax.spines["left"].set_visible(False)
    for at, name in zip(y, map(clean, names), strict=True):
        short = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
        ax.text(-0.02, at, short, transform=ax.get_yaxis_transform(), fontsize=7.5, ha="right",
                va="center", color=MEASURED)  # fmt: skip
    box = ax.get_position()
    ax.set_position((0.36, box.y0, box.x1 - 0.36, box.height))
    ax.set_xlabel("mean share of the points [%]")
    ax.xaxis.set_label_coords(0.5, -0.31 / tall)
    return figure


def reported_bode_figure(
    response: FrequencyResponse,
    *,
    chain: Chain | None,
    reported: tuple[Array, Sequence[Array]] | None,
    units: tuple[str, str],
) -> Figure:
    """Return the measured response of one cart, the fit, and the curve of reported parameters.

    Parameters
    ----------
    reported : what reported parameters stand for, see `transfer_functions`; None draws no curve.
    units : of position and input.
    """
    figure = bode_panels(response, chain=chain, position_unit=units[0], input_unit=units[1])
    ax = figure.axes[0]
    if reported is not None:
        low, high = ax.get_ylim()
        omega = np.geomspace(*ax.get_xlim(), _LINE_POINTS)
        decibel = reported_magnitude(omega, cart=response.cart, reported=reported)
        seen = np.abs(decibel - (low + high) / 2) < (high - low) / 2 + _WIDEST
        if seen.any():
            ax.plot(omega[seen], decibel[seen], color=SECOND, ls="--", label="your numbers")
            ax.set_ylim(min(low, decibel[seen].min()), max(high, decibel[seen].max()))
    legend_above(ax)
    return figure


def reported_step_figure(
    gain: StepGain, *, record: Record, reported: float, title: str, position_unit: str
) -> Figure:
    """Return a step record with the level that a reported gain leads to.

    Parameters
    ----------
    title : the number as it is reported and as the record gives it.
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
    """Return a decay with the one that begins alike and has the reported numbers.

    Parameters
    ----------
    reported : natural frequency (rad/s) and damping ratio; a curve that would swing too fast to be
        seen, or does not swing, is not drawn.
    title : the numbers as they are reported and as the record gives them.
    """
    figure = decay_figure([decay], records=[record], position_unit=position_unit)
    (ax,) = figure.axes
    omega, zeta = reported
    if 0 <= zeta < 1 and 0 < omega < _FASTEST * decay.omega_n:
        t = np.linspace(decay.peak_t[0], decay.fit_t[-1], _CURVE_POINTS)
        rest = (decay.envelope_upper[-1] + decay.envelope_lower[-1]) / 2
        since = omega * (t - t[0])
        swing = np.exp(-zeta * since) * np.cos(np.sqrt(1 - zeta**2) * since)
        y = rest + (decay.peak_y[0] - rest) * swing
        plot_line(ax, t - decay.release, y, name="your numbers", color=THIRD, ls="--", lw=1.0)
    return _titled(figure, ax, title)


def _titled(figure: Figure, ax: Axes, title: str) -> Figure:
    ax.set_title(f"{ax.get_title(loc='left')}: {title}", loc="left")
    legend_above(ax, columns=5, lift=LIFT)
    return figure


def reported_magnitude(
    omega: Array, *, cart: int, reported: tuple[Array, Sequence[Array]]
) -> Array:
    """Return 20 log10 |X_cart/U| in dB, (n,), at `omega` in rad/s; see `Chain.tails`."""
    gains, tails = reported
    s = 1j * omega
    numerator = tails[cart] if cart < len(tails) else np.ones(1)
    with np.errstate(divide="ignore", invalid="ignore"):  # without damping a null has no size
        above, below = np.polyval(numerator, s), np.polyval(tails[0], s)
        relative = (above / numerator[-1]) / (below / tails[0][-1])
        return 20 * np.log10(np.abs(gains[cart - 1] * relative))
