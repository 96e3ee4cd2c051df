"""Records in time: decays, steps, sine dwells (Figures 12-14), closed loops (Figures 15-17)."""

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.report.figures import (
    CART_COLOURS,
    CART_LINES,
    MEASURED,
    MODEL,
    QUIET,
    SECOND,
    SHADE,
    legend_above,
    panels,
    plot_measured,
    plot_model,
    thin,
)
from pipeline.report.words import clean
from pipeline.results import (
    FeedbackDesign,
    HardwareCheck,
    LogDecrement,
    Record,
    SinePoint,
    StepGain,
)

_CYCLES_SHOWN = 10  # of the steady part: single cycles can still be seen
_SINE_POINTS = 300
_SETTLED_BAND = 0.02  # the 2 % of the settling time
_ROOM = 1.12  # above the largest value
_LONGEST_TITLE = 28  # characters above a panel of half the width


# --------------------------------------------------------------------- decays


def decay_figure(
    decays: Sequence[LogDecrement], *, records: Sequence[Record], position_unit: str
) -> Figure:
    """Return the decays of one cart as small multiples, repeats side by side."""
    figure, axes = _small_multiples([decay.experiment for decay in decays])
    for ax, decay, record in zip(axes, decays, records, strict=True):
        plot_decay(ax, decay, record=record)
    _label_outer(axes, y=f"x{decays[0].cart} [{position_unit}]")
    return figure


def plot_decay(ax: Axes, decay: LogDecrement, *, record: Record) -> None:
    """Plot one decay: record, fit, envelope, and the extrema used."""
    plot_measured(ax, record.t, record.position(decay.cart))
    for envelope in (decay.envelope_upper, decay.envelope_lower):
        ax.plot(*thin(decay.fit_t, envelope), color=SECOND, lw=0.9, ls="--")
    plot_model(ax, decay.fit_t, decay.fit_y, label="fit")
    ax.plot(decay.peak_t, decay.peak_y, "D", ms=3.0, mfc="none", mec=MEASURED, mew=0.8)
    if decay.release > record.t[0]:
        ax.axvspan(float(record.t[0]), decay.release, color=SHADE, lw=0)


def damping_figure(decays: Sequence[LogDecrement], *, position_unit: str) -> Figure:
    """Return damping ratio against amplitude, a panel for each cart, a marker for each record."""
    carts = sorted({decay.cart for decay in decays})
    figure, axes = panels(1.35, columns=len(carts), share_x=False)
    for ax, cart in zip(axes, carts, strict=True):
        own = [decay for decay in decays if decay.cart == cart]
        for decay, marker in zip(own, cycle("Dosv^P"), strict=False):
            plot_damping(ax, decay, marker=marker)
        ax.set_title(f"cart {cart}", loc="left", y=1.0)
        ax.set_xlabel(f"amplitude [{position_unit}]")
        most = np.max([decay.zeta_at_amplitude.max(axis=1) for decay in own], axis=0)
        ax.set_xlim(0.0, _ROOM * most[0])
        ax.set_ylim(0.0, _ROOM * most[1])
    axes[0].set_ylabel("ζ")
    return figure


def plot_damping(ax: Axes, decay: LogDecrement, *, marker: str) -> None:
    """Plot the local damping ratio against the amplitude it was seen at."""
    amplitude, zeta = decay.zeta_at_amplitude
    ax.plot(amplitude, zeta, marker, ms=3.2, mfc="white", mec=MEASURED, mew=0.8, ls="-", lw=0.6,
            color=QUIET)  # fmt: skip


# ---------------------------------------------------------------------- steps


def step_figure(
    steps: Sequence[Sequence[StepGain]], *, records: Sequence[Record], position_unit: str
) -> Figure:
    """Return step records as small multiples; each entry of `steps` is one record's carts."""
    figure, axes = _small_multiples([record.id for record in records])
    for ax, gains, record in zip(axes, steps, records, strict=True):
        plot_step(ax, gains, record=record)
    _label_outer(axes, y=f"position [{position_unit}]")
    return figure


def plot_step(ax: Axes, gains: Sequence[StepGain], *, record: Record) -> None:
    """Plot the positions of all carts of a step record, with the levels that were read off."""
    for gain in gains:
        y = record.position(gain.cart)
        style = (gain.cart - 1) % len(CART_LINES)
        ax.plot(*thin(record.t, y), color=CART_COLOURS[style], ls=CART_LINES[style], lw=1.0)
        for edge in gain.edges:
            for window, level in (
                (edge.window_before, edge.level_before),
                (edge.window_after, edge.level_after),
            ):
                ax.plot(window, (level, level), color=MEASURED, lw=2.2, solid_capstyle="butt")
    for t in sorted({edge.t for gain in gains for edge in gain.edges}):
        ax.axvline(t, color=QUIET, lw=0.8, ls=":")


# ---------------------------------------------------------------------- sines


def sine_figure(points: Sequence[SinePoint], *, record: Record, position_unit: str) -> Figure:
    """Return one dwell, a panel for each cart, the transient shaded."""
    figure, axes = panels(*[1.0] * len(points))
    for ax, point in zip(axes, points, strict=True):
        plot_sine(ax, point, record=record)
        ax.set_ylabel(f"x{point.cart} [{position_unit}]")
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    end = max(p.steady_from for p in points) + _CYCLES_SHOWN * 2 * np.pi / points[0].omega
    axes[0].set_xlim(float(record.t[0]), min(float(record.t[-1]), end))
    return figure


def plot_sine(ax: Axes, point: SinePoint, *, record: Record) -> None:
    """Plot one cart's motion, transient shaded, the steady amplitude as a band."""
    end = point.steady_from + _CYCLES_SHOWN * 2 * np.pi / point.omega
    shown = record.t <= end
    t, y = record.t[shown], record.position(point.cart)[shown]
    steady = t >= point.steady_from
    ax.plot(*thin(t, y), color=QUIET, lw=0.7)
    plot_measured(ax, t, y, most=_SINE_POINTS)
    ax.axvspan(float(t[0]), point.steady_from, color=SHADE, lw=0, label="transient")
    # The middle of the steady swing: mean over samples, near enough for ten cycles.
    middle = float(np.mean(y[steady])) if np.any(steady) else float(np.mean(y))
    for k, level in enumerate((middle - point.amplitude, middle + point.amplitude)):
        ax.plot((point.steady_from, float(t[-1])), (level, level), color=MODEL, lw=1.1,
                label="" if k else "steady amplitude")  # fmt: skip


# ------------------------------------------------------------------- feedback


def hardware_figure(checks: Sequence[Sequence[HardwareCheck]], *, position_unit: str) -> Figure:
    """Return one run, a panel for each cart; an entry holds the one or two models of a cart."""
    figure, axes = panels(*[1.05] * len(checks))
    for ax, group in zip(axes, checks, strict=True):
        plot_hardware(ax, group)
        ax.set_ylabel(f"x{group[0].cart} [{position_unit}]")
    legend_above(axes[0])
    axes[-1].set_xlabel("time [s]")
    return figure


def plot_hardware(ax: Axes, checks: Sequence[HardwareCheck]) -> None:
    """Plot measured points against the simulated loop, and the model under the measured input."""
    measured = checks[0].measured
    plot_measured(ax, checks[0].t, measured)
    for check in checks:
        if check.loop == "closed":
            plot_model(ax, check.t, check.model, label="model of the loop")
        else:
            ax.plot(*thin(check.t, check.model), color=SECOND, ls="--", lw=1.1,
                    label="model with the measured input")  # fmt: skip
    # An unstable model may leave any axis: it is shown to one span beyond what was measured.
    low, high = float(np.min(measured)), float(np.max(measured))
    span = high - low or 1.0
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(low - span, bottom), min(high + span, top))


def design_figure(design: FeedbackDesign, *, position_unit: str, input_unit: str) -> Figure:
    """Return the simulated step of the designed loop: positions above, input below."""
    figure, (above, below) = panels(1.5, 0.8)
    plot_design(above, design)
    above.set_ylabel(f"position [{position_unit}]")
    legend_above(above, columns=5)
    below.step(*thin(design.t, design.u), where="post", color=MODEL, lw=1.0)
    below.set_ylabel(f"u [{input_unit}]")
    below.set_xlabel("time [s]")
    return figure


def plot_design(ax: Axes, design: FeedbackDesign) -> None:
    """Plot all carts' positions, the chosen cart's goal and its 2 % band."""
    r = design.reference
    ax.axhspan(r - _SETTLED_BAND * abs(r), r + _SETTLED_BAND * abs(r), color=SHADE, lw=0)
    ax.axhline(r, color=QUIET, lw=0.8)
    for cart, y in enumerate(design.y, start=1):
        style = (cart - 1) % len(CART_LINES)
        ax.plot(*thin(design.t, y), color=CART_COLOURS[style], ls=CART_LINES[style],
                lw=1.8 if cart == design.cart else 1.0, label=f"x{cart}")  # fmt: skip
    if design.settling_time is not None:
        ax.axvline(design.settling_time, color=QUIET, lw=0.8, ls=":")


# -------------------------------------------------------------------- helpers


def _small_multiples(titles: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Return one panel for each title; more than one stand in two columns."""
    n = len(titles)
    columns = 1 if n == 1 else 2
    rows = -(-n // columns)
    figure, axes = panels(*[1.3] * rows, columns=columns, share_x=False)
    for spare in axes[n:]:
        figure.delaxes(spare)
    for ax, title in zip(axes, map(clean, titles), strict=False):
        short = title if len(title) <= _LONGEST_TITLE else f"{title[: _LONGEST_TITLE - 1]}…"
        ax.set_title(short, loc="left", y=1.0)
    return figure, axes[:n]


def _label_outer(axes: Sequence[Axes], *, y: str) -> None:
    """Title the axes at the left and at the lower end of each column."""
    columns = 1 if len(axes) == 1 else 2
    for i, ax in enumerate(axes):
        if i % columns == 0:
            ax.set_ylabel(y)
        if i + columns >= len(axes):
            ax.set_xlabel("time [s]")
