"""Figures of recordings over time: decays, steps, dwells (paper: 12-14), closed loops (15-17)."""

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.report.figures import CARTS, MEASURED, MODEL, QUIET, SECOND_LINE, SHADE, THIRD
from pipeline.report.figures.style import (
    keep_in_sight,
    legend_above,
    panels,
    plot_line,
    plot_measured,
    plot_model,
    plot_points,
    plot_residuals,
    plot_second,
    position_label,
    small_multiples,
)
from pipeline.results import (
    FeedbackDesign,
    HardwareCheck,
    LogDecrement,
    Record,
    SinePoint,
    StepGain,
)
from pipeline.setup import Units
from pipeline.words.numbers import subscript

_CYCLES_SHOWN = 10  # cycles shown of the steady part; few enough to tell them apart
_LOOPS = {"closed": "loop model", "open": "model on measured input"}
_SMALL = 1.15  # height in inches of each of many small panels


# --------------------------------------------------------------------- decays


def decay_figure(
    decays: Sequence[LogDecrement], *, records: Sequence[Record], position_unit: str
) -> Figure:
    """Return the decays of one cart in small panels, repeats side by side."""
    swings = [float(np.ptp(decay.peak_y)) for decay in decays]
    figure, axes = small_multiples(
        [decay.name for decay in decays], height=_SMALL, share_y=_alike(swings)
    )
    for ax, decay, record in zip(axes, decays, records, strict=True):
        plot_decay(ax, decay, record=record)
    label_outer(axes, x="time [s]", y=position_label(decays[0].cart, position_unit))
    legend_above(axes[0])
    return figure


def plot_decay(ax: Axes, decay: LogDecrement, *, record: Record) -> None:
    """Plot one decay: recording, fit, envelope, and the extrema used for the estimate."""
    fit_t, zero = decay.fit_t - decay.release, decay.release
    t, length = record.t - zero, fit_t[-1] - fit_t[0]
    shown = (t >= min(fit_t[0], 0.0) - 0.15 * length) & (t <= fit_t[-1] + 0.25 * length)
    t, y = t[shown], record.position(decay.cart)[shown]
    plot_measured(ax, t, y)
    for envelope, label in ((decay.envelope_upper, "envelope"), (decay.envelope_lower, None)):
        plot_line(ax, fit_t, envelope, SECOND_LINE | {"lw": 0.9}, label=label)
    plot_model(ax, fit_t, decay.fit_y, label="fit")
    ax.plot(decay.peak_t - zero, decay.peak_y, "D", ms=3.0, mfc="none", mec=MEASURED, mew=0.8,
            label="extrema used")  # fmt: skip
    if t[0] < 0:
        ax.axvspan(float(t[0]), 0.0, color=SHADE, lw=0)


def damping_figure(decays: Sequence[LogDecrement], *, position_unit: str) -> Figure:
    """Plot damping ratio over amplitude: one panel for each cart, one marker for each recording."""
    carts = sorted({decay.cart for decay in decays})
    figure, axes = panels(1.35, columns=len(carts), share_x=False)
    for ax, cart in zip(axes, carts, strict=True):
        own = [decay for decay in decays if decay.cart == cart]
        for decay, marker in zip(own, cycle("Dosv^P"), strict=False):
            plot_damping(ax, decay, marker=marker)
        ax.set_title(f"cart {cart}", loc="left", y=1.0)
        ax.set_xlabel(f"swing [{position_unit}]")
        most = np.max([decay.zeta_at_amplitude.max(axis=1) for decay in own], axis=0)
        ax.set_xlim(0.0, 1.12 * most[0])
        ax.set_ylim(0.0, 1.12 * most[1])
    axes[0].set_ylabel("ζ")
    return figure


def plot_damping(ax: Axes, decay: LogDecrement, *, marker: str) -> None:
    """Plot the local damping ratio over the amplitude at which it was measured."""
    amplitude, zeta = decay.zeta_at_amplitude
    ax.plot(amplitude, zeta, marker, ms=3.2, mfc="white", mec=MEASURED, mew=0.8, ls="-", lw=0.6,
            color=QUIET)  # fmt: skip


# ---------------------------------------------------------------------- steps


def step_figure(
    steps: Sequence[Sequence[StepGain]], *, records: Sequence[Record], position_unit: str
) -> Figure:
    """Return step recordings in small panels.

    Each entry of `steps` has the gains of all carts in one recording.
    """
    swings = [
        max(float(np.ptp(record.position(gain.cart))) for gain in gains)
        for gains, record in zip(steps, records, strict=True)
    ]
    figure, axes = small_multiples(
        [record.id for record in records], height=_SMALL, share_y=_alike(swings)
    )
    for ax, gains, record in zip(axes, steps, records, strict=True):
        plot_step(ax, gains, record=record)
    label_outer(axes, x="time [s]", y=f"position [{position_unit}]")
    legend_above(axes[0], columns=5)
    return figure


def plot_step(ax: Axes, gains: Sequence[StepGain], *, record: Record) -> None:
    """Plot the positions of all carts in a step recording, and the levels between which they move.

    A dashed line shows each level over the window in which it was measured.
    """
    for gain in gains:
        _plot_cart_points(ax, record.t, record.position(gain.cart), cart=gain.cart)
        for edge in gain.edges:
            for window, level in (
                (edge.window_before, edge.level_before),
                (edge.window_after, edge.level_after),
            ):
                ax.plot(window, (level, level), color=MEASURED, ls="--", lw=0.8, zorder=1.5)
    ax.plot([], [], color=MEASURED, ls="--", lw=0.8, label="level")
    for t in sorted({edge.t for gain in gains for edge in gain.edges}):
        ax.axvline(t, color=QUIET, lw=0.8, ls=":")


def _plot_cart_points(ax: Axes, t: Array, y: Array, *, cart: int) -> None:
    """Plot a cart's measured points in a panel that it shares with other carts.

    A few of them have the cart's marker, to distinguish the carts.
    """
    style, name = (cart - 1) % len(CARTS), f"x{subscript(cart)}"
    colour, _, mark, _ = CARTS[style]
    plot_points(ax, t, y, most=400, color=colour)
    # Each cart has 16 markers at times of its own, so that equal motions do not hide each other.
    at = np.linspace(0, t.size - 1, 16 * len(CARTS)).astype(int)[style :: len(CARTS)]
    ax.plot(t[at], y[at], mark, ms=3.6, mfc="white", mec=colour, mew=0.9, label=name)


def _plot_cart(ax: Axes, t: Array, y: Array, *, cart: int, lw: float = 1.0) -> None:
    """Plot a cart's line, in its own style, in a panel that it shares with other carts."""
    colour, ls, *_ = CARTS[(cart - 1) % len(CARTS)]
    plot_line(ax, t, y, {"color": colour, "ls": ls, "lw": lw}, label=f"x{subscript(cart)}")


# ---------------------------------------------------------------------- sines


def sine_figure(points: Sequence[SinePoint], *, record: Record, position_unit: str) -> Figure:
    """Return one dwell, with a panel for each cart; the transient is shaded."""
    figure, axes = panels(*[1.0] * len(points))
    for ax, point in zip(axes, points, strict=True):
        plot_sine(ax, point, record=record)
        ax.set_ylabel(position_label(point.cart, position_unit))
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    end = max(p.steady_from for p in points) + _CYCLES_SHOWN * 2 * np.pi / points[0].omega
    axes[0].set_xlim(float(record.t[0]), min(float(record.t[-1]), end))
    return figure


def plot_sine(ax: Axes, point: SinePoint, *, record: Record) -> None:
    """Plot the motion of one cart in a dwell.

    The transient is shaded, and two lines show the steady amplitude.
    """
    end = point.steady_from + _CYCLES_SHOWN * 2 * np.pi / point.omega
    shown = record.t <= end
    t, y = record.t[shown], record.position(point.cart)[shown]
    steady = t >= point.steady_from
    plot_line(ax, t, y, {"color": QUIET, "lw": 0.7})
    plot_measured(ax, t, y, most=300)
    ax.axvspan(float(t[0]), point.steady_from, color=SHADE, lw=0, label="transient")
    # Over ten cycles, the mean of the samples is close enough to the middle of the oscillation.
    middle = float(np.mean(y[steady])) if np.any(steady) else float(np.mean(y))
    for k, level in enumerate((middle - point.amplitude, middle + point.amplitude)):
        ax.plot((point.steady_from, float(t[-1])), (level, level), color=MODEL, lw=1.1,
                label="" if k else "steady amplitude")  # fmt: skip


# ------------------------------------------------------------------- feedback


def hardware_figure(
    checks: Sequence[Sequence[HardwareCheck]],
    *,
    record: Record | None,
    units: Units,
) -> Figure:
    """Return a figure of one run: each cart with its set point, the residuals, and the input.

    Parameters
    ----------
    checks : comparison of the measurement with one or two models, for each cart.
    record : the recording with the input; None leaves the input out.
    """
    driven = record if record is not None and record.u is not None else None
    figure, axes = panels(*[0.9, 0.62] * len(checks), *([0.6] if driven else []))
    for above, below, group in zip(axes[::2], axes[1::2], checks, strict=False):
        if (set_point := group[0].set_point) is not None:
            above.step(group[0].t, set_point, where="post", color=THIRD, lw=0.9, ls="-.")
            axes[0].plot([], [], color=THIRD, lw=0.9, ls="-.", label="set point")
        plot_hardware(above, group)
        above.set_ylabel(position_label(group[0].cart, units.position))
        plot_residuals(below, group[0].t, *(check.measured - check.model for check in group))
        keep_in_sight(below, group[0].measured - np.median(group[0].measured))
        below.set_ylabel(f"residual [{units.position}]")
    if driven:
        plot_effort(axes[-1], driven, model=checks[0][0].effort)
        axes[-1].set_ylabel(f"u [{units.input}]")
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure


def plot_effort(ax: Axes, record: Record, *, model: Array | None) -> None:
    """Plot the logged input, and the input that the modelled loop would need."""
    assert record.u is not None
    plot_points(ax, record.t, record.u)
    if model is not None:
        plot_line(ax, record.t, model, {"color": MODEL, "lw": 1.0})
        keep_in_sight(ax, record.u)


def plot_hardware(ax: Axes, checks: Sequence[HardwareCheck]) -> None:
    """Plot the measurement, and one or two models with which it is compared."""
    plot_measured(ax, checks[0].t, checks[0].measured)
    for check, plot in zip(checks, (plot_model, plot_second), strict=False):
        plot(ax, check.t, check.model, label=_LOOPS[check.loop])
    keep_in_sight(ax, checks[0].measured)


def design_figure(design: FeedbackDesign, *, units: Units) -> Figure:
    """Return the simulated step of the designed loop, with the positions above the input."""
    figure, (above, below) = panels(1.5, 0.8)
    plot_design(above, design)
    above.set_ylabel(f"position [{units.position}]")
    legend_above(above, columns=5)
    below.step(design.t, design.u, where="post", color=MODEL, lw=1.0, label="u")
    below.set_ylabel(f"u [{units.input}]")
    below.set_xlabel("time [s]")
    return figure


def plot_design(ax: Axes, design: FeedbackDesign) -> None:
    """Plot the positions of all carts, and the 2 % band around the controlled cart's set point."""
    r = design.reference
    ax.axhspan(r - 0.02 * abs(r), r + 0.02 * abs(r), color=SHADE, lw=0)
    ax.axhline(r, color=QUIET, lw=0.8)
    for cart, y in enumerate(design.y, start=1):
        _plot_cart(ax, design.t, y, cart=cart, lw=1.8 if cart == design.cart else 1.0)
    if design.settling_time is not None:
        ax.axvline(design.settling_time, color=QUIET, lw=0.8, ls=":")


# -------------------------------------------------------------------- helpers


def _alike(swings: Sequence[float]) -> bool:
    """Return whether the motions are similar enough in size to share one scale."""
    return max(swings) < 4.0 * min(swings)


def label_outer(axes: Sequence[Axes], *, x: str, y: str) -> None:
    """Put axis titles only at the left and at the bottom of each column."""
    columns = len({ax.get_position().x0 for ax in axes})
    for i, ax in enumerate(axes):
        if i % columns == 0:
            ax.set_ylabel(y)
        if i + columns >= len(axes):
            ax.set_xlabel(x)
