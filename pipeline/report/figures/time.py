"""Figures of recordings over time: decays, steps, dwells (paper: 12-14), closed loops (15-17)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.report.figures import (
    CARTS,
    MEASURED,
    MODEL,
    QUIET,
    SECOND_LINE,
    SHADE,
    THIRD,
    Look,
)
from pipeline.report.figures.style import (
    keep_in_sight,
    legend_above,
    name_panels,
    panels,
    plot_line,
    plot_measured,
    plot_model,
    plot_points,
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
_POINTS = 120  # measured points of a cart in a small panel; more would hide the model's line
_MODELS: tuple[Look, ...] = ({"color": MODEL, "lw": 1.0}, SECOND_LINE)
_SET_POINT: Look = {"color": THIRD, "lw": 0.9, "ls": "-."}


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


# ------------------------------------------------------------ steps and sweeps

Motion = Mapping[int, Array]  # by cart: the model's positions (n,) in a recording


def step_figure(
    steps: Sequence[Sequence[StepGain]],
    *,
    records: Sequence[Record],
    position_unit: str,
    models: Mapping[str, Motion] | None = None,
) -> Figure:
    """Return step recordings in small panels.

    Each entry of `steps` has the gains of all carts in one recording.

    Parameters
    ----------
    models : by recording, the motion of the model that was fitted to it.
    """
    motions = [(models or {}).get(record.id, {}) for record in records]
    carts = [
        sorted({gain.cart for gain in gains} | set(motion))
        for gains, motion in zip(steps, motions, strict=True)
    ]
    swings = [
        max(float(np.ptp(record.position(cart))) for cart in shown)
        for shown, record in zip(carts, records, strict=True)
    ]
    figure, axes = small_multiples(
        [record.id for record in records], height=_SMALL, share_y=_alike(swings)
    )
    for ax, gains, record, motion in zip(axes, steps, records, motions, strict=True):
        plot_step(ax, gains, record=record, model=motion)
    label_outer(axes, x="time [s]", y=f"position [{position_unit}]")
    legend_above(axes[0], columns=5)
    return figure


def plot_step(
    ax: Axes, gains: Sequence[StepGain], *, record: Record, model: Motion | None = None
) -> None:
    """Plot the positions of all carts in a step recording, and the levels between which they move.

    The model's lines lie over the measured points. A dashed line shows each level over the window
    in which it was measured.
    """
    for gain in gains:
        for edge in gain.edges:
            for window, level in (
                (edge.window_before, edge.level_before),
                (edge.window_after, edge.level_after),
            ):
                ax.plot(window, (level, level), color=MEASURED, ls="--", lw=0.8, zorder=1.5)
    if model:
        plot_fitted(ax, record, model)
    else:
        for gain in gains:
            _plot_cart_points(ax, record.t, record.position(gain.cart), cart=gain.cart)
    if gains:
        ax.plot([], [], color=MEASURED, ls="--", lw=0.8, label="level")
    for t in sorted({edge.t for gain in gains for edge in gain.edges}):
        ax.axvline(t, color=QUIET, lw=0.8, ls=":")


def plot_fitted(ax: Axes, record: Record, model: Motion) -> None:
    """Plot the measured points of carts, and over them the lines of the model fitted to them."""
    for cart in sorted(model):
        plot_points(ax, record.t, record.position(cart), most=_POINTS)
        _plot_cart(ax, record.t, model[cart], cart=cart)
    ax.plot([], [], ".", color=MEASURED, ms=3 * 2.2, mew=0, label="measured")


def sweep_figure(record: Record, *, model: Motion, position_unit: str) -> Figure:
    """Return a sweep with the model that was fitted to it, and a row of panels for each cart.

    On the left is the whole sweep, with what the model leaves of the motion. On the right are the
    cycles around the largest swing, with the measured points and the model's line.
    """
    carts = sorted(model)
    figure, axes = panels(*[0.95] * len(carts), columns=2, share_x="column")
    cut = _largest_swing(record, model)
    for whole, near, cart in zip(axes[::2], axes[1::2], carts, strict=True):
        y, t = record.position(cart), record.t
        plot_line(whole, t, y - np.median(y), {"color": QUIET, "lw": 0.7}, label="motion")
        plot_line(whole, t, y - model[cart], {"color": MODEL, "lw": 0.8}, label="residual")
        whole.axvspan(float(t[cut][0]), float(t[cut][-1]), color=SHADE, lw=0)
        plot_measured(near, t[cut], y[cut])
        plot_model(near, t[cut], model[cart][cut])
        whole.set_ylabel(position_label(cart, position_unit))
    for ax in axes[:2]:
        legend_above(ax)
    for ax in axes[-2:]:
        ax.set_xlabel("time [s]")
    return figure


def _largest_swing(record: Record, model: Motion) -> slice:
    """Return the samples of about ten cycles of cart motion, around the largest swing."""
    centred = np.array([y - np.median(y) for y in model.values()])
    size = np.abs(centred) / np.maximum(np.ptp(centred, axis=1, keepdims=True), 1e-300)
    cart, middle = np.unravel_index(int(size.argmax()), size.shape)
    crossings = np.flatnonzero(np.diff(np.signbit(centred[cart])))
    at = int(np.searchsorted(crossings, middle))
    before, after = crossings[:at][-_CYCLES_SHOWN:], crossings[at:][:_CYCLES_SHOWN]
    first = int(before[0]) if before.size == _CYCLES_SHOWN else 0
    last = int(after[-1]) if after.size == _CYCLES_SHOWN else record.t.size - 1
    return slice(first, last + 1)


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


@dataclass(frozen=True, kw_only=True)
class HardwareRun:
    """One run of model against measurement.

    Attributes
    ----------
    checks : comparison with one or two models, for each cart.
    record : the recording with the input; None leaves the input out.
    """

    name: str
    checks: Sequence[HardwareCheck]
    record: Record | None = None

    @property
    def has_input(self) -> bool:
        """Whether the input was logged."""
        return self.record is not None and self.record.u is not None

    @property
    def worst(self) -> HardwareCheck:
        """The comparison with the largest difference."""
        return max(self.checks, key=lambda check: check.nrmse)


def hardware_figure(runs: Sequence[HardwareRun], *, units: Units) -> Figure:
    """Return runs side by side: each cart with its set point, the residuals, and the input."""
    carts = sorted({check.cart for run in runs for check in run.checks})
    loops = sorted({check.loop for run in runs for check in run.checks})
    driven = any(run.has_input for run in runs)
    heights = [*[0.9, 0.62] * len(carts), *([0.6] if driven else [])]
    several = len(runs) > 1
    figure, axes = panels(*heights, columns=len(runs), share_x="column", titled=several)
    for column, run in enumerate(runs):
        own = axes[column :: len(runs)]
        for above, below, cart in zip(own[::2], own[1::2], carts, strict=False):
            checks = [check for check in run.checks if check.cart == cart]
            if checks:
                plot_hardware(above, checks, loops=loops)
                _plot_hardware_residuals(below, checks, loops=loops)
            if not column:
                above.set_ylabel(position_label(cart, units.position))
                below.set_ylabel(f"residual [{units.position}]")
        if run.has_input:
            assert run.record is not None
            plot_effort(own[-1], run.record, model=run.checks[0].effort)
        own[-1].set_xlabel("time [s]")
    if driven:
        axes[-len(runs)].set_ylabel(f"u [{units.input}]")
    if several:
        name_panels(axes[: len(runs)], [run.name for run in runs], columns=len(runs))
    every = {check.loop for check in runs[0].checks}
    for k, loop in enumerate(loops):
        if loop not in every:
            axes[0].plot([], [], label=_LOOPS[loop], **_MODELS[k])
    if any(check.set_point is not None for run in runs for check in run.checks):
        axes[0].plot([], [], label="set point", **_SET_POINT)
    legend_above(axes[0])
    return figure


def plot_hardware(ax: Axes, checks: Sequence[HardwareCheck], *, loops: Sequence[str]) -> None:
    """Plot a cart's set point and motion, and one or two models with which it is compared.

    Parameters
    ----------
    loops : all models of the figure, so that a model looks the same in each panel.
    """
    first = checks[0]
    if first.set_point is not None:
        ax.step(first.t, first.set_point, where="post", **_SET_POINT)
    plot_measured(ax, first.t, first.measured)
    for check in checks:
        look = _MODELS[loops.index(check.loop)]
        plot_line(ax, check.t, check.model, look, label=_LOOPS[check.loop])
    keep_in_sight(ax, first.measured)


def _plot_hardware_residuals(
    ax: Axes, checks: Sequence[HardwareCheck], *, loops: Sequence[str]
) -> None:
    ax.axhline(0.0, color=QUIET, lw=0.6)
    for check in checks:
        look = _MODELS[loops.index(check.loop)] | {"lw": 0.8}
        plot_line(ax, check.t, check.measured - check.model, look)
    keep_in_sight(ax, checks[0].measured - np.median(checks[0].measured))


def plot_effort(ax: Axes, record: Record, *, model: Array | None) -> None:
    """Plot the logged input, and the input that the modelled loop would need."""
    assert record.u is not None
    plot_points(ax, record.t, record.u)
    if model is not None:
        plot_line(ax, record.t, model, {"color": MODEL, "lw": 1.0})
        keep_in_sight(ax, record.u)


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
