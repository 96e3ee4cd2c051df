"""The frequency response of one cart, measured and fitted (the paper's Figures 4, 6, 7, 9-11)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from pipeline.arrays import Array
from pipeline.names import mode_suffixes
from pipeline.plant.chain import Chain
from pipeline.report.figures import CARTS, MEASURED, MODEL, QUIET
from pipeline.report.figures.style import (
    DigitTicks,
    legend_above,
    log_frequency_axis,
    panels,
    plot_line,
)
from pipeline.results import FrequencyResponse
from pipeline.setup import Units
from pipeline.words.numbers import subscript

_DB_PER_NEPER = 20 / np.log(10)
_NOISE = "within the noise"
# Limit of the residual axis in medians. On sound data, points on a sharp peak reach up to 22.
_MOST_RESIDUAL = 30.0
_LEAST_LIMIT = 0.1  # percent; residuals below it are never outside
_MARGIN = 1.15  # room for the marks


def bode_figure(response: FrequencyResponse, *, chain: Chain | None, units: Units) -> Figure:
    """Return magnitude, phase (if measured) and residual of the fit, one below the other.

    Zero magnitudes are left out, because a logarithm cannot show them.
    """
    figure = bode_panels(response, chain=chain, units=units)
    legend_above(figure.axes[0])
    return figure


def bode_panels(response: FrequencyResponse, *, chain: Chain | None, units: Units) -> Figure:
    """Return the figure without a legend, so that callers can draw more into it."""
    response = _positive(response)
    has_phase = response.phase is not None
    heights = [1.3, *([0.8] if has_phase else []), *([0.5] if chain else [])]
    figure, axes = panels(*heights)
    log_frequency_axis(axes[0], response.omega)
    for lower in axes[1:]:
        lower.add_artist(DigitTicks(lower, "x"))
    plot_magnitude(axes[0], response, chain=chain, units=units)
    if has_phase:
        plot_phase(axes[1], response, chain=chain)
    if chain:
        plot_residual(axes[-1], response, chain=chain)
    axes[-1].set_xlabel("ω [rad/s]")
    return figure


def overview_figure(
    responses: Sequence[FrequencyResponse],
    *,
    chain: Chain | None,
    units: Units,
) -> Figure:
    """Return one panel with the magnitudes of all carts: points are measured, lines are the fit."""
    responses = [_positive(response) for response in responses]
    figure, (ax,) = panels(1.75)
    every = np.concatenate([response.omega for response in responses])
    log_frequency_axis(ax, every)
    for response in responses:
        name = f"cart {response.cart}"
        colour, ls, *_ = CARTS[(response.cart - 1) % len(CARTS)]
        clear, decibel = response.has_signal, _decibel(response.magnitude)
        for shown, edge in ((clear, colour), (~clear, QUIET)):
            if shown.any():
                x, y = response.omega[shown], decibel[shown]
                ax.plot(x, y, "D", ms=3.2, mew=0.8, mfc="white", mec=edge)
        if chain:
            omega, line = _fitted(response, chain)
            plot_line(ax, omega, line, {"color": colour, "ls": ls})
        ax.plot([], [], "D", ls=ls if chain else "", ms=3.2, mfc="white", color=colour, label=name)
    if chain:
        _mark_modes(ax, every, chain)
    ax.set_ylabel(f"|X/U| [dB re 1 {units.gain}]")
    ax.set_xlabel("ω [rad/s]")
    legend_above(ax)
    return figure


def plot_magnitude(
    ax: Axes,
    response: FrequencyResponse,
    *,
    chain: Chain | None,
    units: Units,
) -> None:
    """Plot the magnitude in dB: diamonds with error bars, and the fit as a line."""
    # An error bar in decibels cannot extend down to zero.
    relative = np.clip(response.magnitude_std / response.magnitude, 0.0, 0.9)
    error = np.vstack([-_DB_PER_NEPER * np.log1p(-relative), _DB_PER_NEPER * np.log1p(relative)])
    _points(ax, response, _decibel(response.magnitude), error, in_legend=True)
    if chain:
        ax.plot(*_fitted(response, chain), color=MODEL, label="fit")
        _mark_modes(ax, response.omega, chain)
    ax.set_ylabel(f"|X{subscript(response.cart)}/U| [dB re 1 {units.gain}]")


def plot_phase(ax: Axes, response: FrequencyResponse, *, chain: Chain | None) -> None:
    """Plot the phase in degrees, with measured values shifted by full turns towards the fit.

    Without a fit, points above the noise are unwrapped, and the others are shifted towards them.
    """
    assert response.phase is not None
    clear = response.has_signal if response.has_signal.any() else np.full(response.omega.size, True)
    near = np.interp(response.omega, response.omega[clear], np.unwrap(response.phase[clear]))
    if chain:
        omega = _dense(response.omega, chain)
        line = np.unwrap(np.angle(chain.frequency_response(omega)[response.cart - 1]))
        line -= 2 * np.pi * np.round(line[0] / (2 * np.pi))
        ax.plot(omega, np.degrees(line), color=MODEL)
        near = np.interp(response.omega, omega, line)
    phase = near + (response.phase - near + np.pi) % (2 * np.pi) - np.pi
    error = (
        None if response.phase_std is None else np.degrees(np.clip(response.phase_std, 0, np.pi))
    )
    _points(ax, response, np.degrees(phase), error)
    low, high = ax.dataLim.intervaly
    margin = 0.08 * max(high - low, 90.0)
    bottom, top = ax.set_ylim(low - margin, high + margin)
    # Ticks are at multiples of 45°, 90° or half turns; with more than five, labels would touch.
    half_turns = 180.0 * max(1, np.ceil((top - bottom) / 900.0))
    labels = top // 90.0 + -bottom // 90.0 + 1
    ax.yaxis.set_major_locator(
        MultipleLocator(45.0 if high - low <= 90.0 else 90.0 if labels <= 5 else half_turns)
    )
    ax.set_ylabel("phase [°]")


def plot_residual(ax: Axes, response: FrequencyResponse, *, chain: Chain) -> None:
    """Plot the difference of measured and fitted magnitude in percent.

    The axis shows 30 times the median residual of the points with a signal. A triangle at the edge
    marks each point outside.
    """
    fitted = np.abs(chain.frequency_response(response.omega)[response.cart - 1])
    residual, clear = 100 * (response.magnitude / fitted - 1), response.has_signal
    ax.axhline(0.0, color=MODEL)
    _points(ax, response, residual, 100 * response.magnitude_std / fitted)
    ax.set_ylabel("residual [%]")
    size = np.abs(residual)
    if not clear.any():
        clear = np.full_like(clear, True)
    middle = float(np.quantile(size[clear], 0.5, method="lower"))
    limit = max(_MOST_RESIDUAL * middle, _LEAST_LIMIT)
    outside = size > limit
    if not outside.any():
        return
    ax.set_ylim(-_MARGIN * limit, _MARGIN * limit)
    for above, mark in ((True, "^"), (False, "v")):
        for shown, color in ((outside & clear, MEASURED), (outside & ~clear, QUIET)):
            if (at := shown & ((residual > 0) == above)).any():
                edge = np.full(int(at.sum()), limit if above else -limit)
                ax.plot(response.omega[at], edge, mark, ms=4.0, mew=0, color=color)


def _positive(response: FrequencyResponse) -> FrequencyResponse:
    return response.only((response.magnitude > 0) & (response.omega > 0))


def _points(
    ax: Axes, response: FrequencyResponse, y: Array, error: Array | None, *, in_legend: bool = False
) -> None:
    """Plot diamonds with error bars; all bars are drawn as one path.

    Points without a signal are grey and have no bars, because a bar would fill the panel.

    Parameters
    ----------
    y : (n_w,) values at the frequencies of the response.
    error : (n_w,), or (2, n_w) for the parts below and above the point; None draws no bars.
    """
    for clear, color, name in ((True, MEASURED, "measured"), (False, QUIET, _NOISE)):
        if not (shown := response.has_signal == clear).any():
            continue
        x, at = response.omega[shown], y[shown]
        label = name if in_legend else None
        look = {"ms": 3.2, "mew": 0.8, "mfc": "white", "color": color, "zorder": 3}
        ax.plot(x, at, "D", label=label, **look)
        if error is not None and clear:
            below, above = np.broadcast_to(error, (2, y.size))[:, shown]
            ends = np.column_stack([at - below, at + above, np.full(x.size, np.nan)])
            ax.plot(x.repeat(3), ends.ravel(), color=color, lw=0.7, zorder=2.9)


def _fitted(response: FrequencyResponse, chain: Chain) -> tuple[Array, Array]:
    """Return frequencies, and the magnitude of the fitted chain at each of them in decibels."""
    omega = _dense(response.omega, chain)
    magnitude = np.abs(chain.frequency_response(omega)[response.cart - 1])
    highest = 100.0 * float(response.magnitude.max())  # without damping, a peak would be infinite
    return omega, _decibel(np.minimum(magnitude, highest))


def _dense(omega: Array, chain: Chain) -> Array:
    """Return a fine grid that includes every resonance, so that no sharp peak is cut off."""
    low, high = 0.9 * float(omega.min()), 1.1 * float(omega.max())
    modes = np.abs(chain.poles)
    grid = np.geomspace(low, high, 300)
    return np.unique(np.concatenate([grid, modes[(modes > low) & (modes < high)]]))


def _mark_modes(ax: Axes, omega: Array, chain: Chain) -> None:
    """Mark the resonances by dotted lines with their letters; of one cart, with its symbol."""
    modes = np.unique(np.round(np.abs(chain.poles[chain.poles.imag > 0]), 9))
    letters = mode_suffixes(chain.n) if chain.n > 1 else ["ωₙ"]
    for letter, mode in zip(letters, modes, strict=False):
        if omega.min() < mode < omega.max():
            ax.axvline(mode, color=QUIET, lw=0.8, ls=":")
            ax.annotate(
                letter, (mode, 0.0), xycoords=("data", "axes fraction"), xytext=(2, 2),
                textcoords="offset points", color="#555555", fontsize=7.5,
            )  # fmt: skip


def _decibel(magnitude: Array) -> Array:
    return _DB_PER_NEPER * np.log(magnitude)
