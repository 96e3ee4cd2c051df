"""Pictures of the effects: the fingerprint of each, and one run with and without it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.augmented import rest_positions, simulate_augmented
from pipeline.plant.nonlinear.effects import AugmentedChain, Effect, Term
from pipeline.report.effects.words import INPUT, POSITION
from pipeline.report.figures.style import MODEL, QUIET, SECOND, legend_above, panels, position_label
from pipeline.report.numbers import subscript

_RATE = 1000.0  # Hz: differences of the positions are then velocities and accelerations
_DURATION = 4.0  # s
_STEP = (0.1, 2.1)  # s, on and off
_RELEASE = 1.4  # of the travel
_HEIGHT = 1.75  # inches
_LABEL = -0.2  # of the right panel's width, where its title has room
_EDGE = (-0.02, 0.08)  # s about an edge of the input
_RING_OUT = 12.0  # s: nothing is left of a pulse
_PULSE = 20  # samples, short against every period
_MOST_POINTS = 500
_HARD_TO_SEE = 0.1  # of the motion: a smaller difference is shown over a shorter time …
_WINDOW = 0.5  # s on each side of where it is largest
_ROOM = 1.08
_SIZE = 0.95  # of the input that holds a cart at its travel


@dataclass(frozen=True, kw_only=True, eq=False)
class _Run:
    """One run: readings (n_carts, n) of the bench without and with the effect."""

    name: str
    t: Array
    u: Array
    free: tuple[int, ...]
    without: Array
    with_it: Array

    def rate(self) -> Array:
        """Velocities (n_carts, n) with the effect."""
        return np.gradient(self.with_it, self.t, axis=1)

    def residual_force(self, chain: Chain) -> Array:
        """Forces (n_carts, n) that masses, dampings and springs leave, with the effect."""
        v = self.rate()
        a = np.gradient(v, self.t, axis=1)
        force = chain.m[:, None] * a + chain.c[:, None] * v + chain.stiffness @ self.with_it
        force[0] -= self.u
        return force


def effect_figure(term: Term, chain: Chain) -> Figure:
    """Return the fingerprint of an effect on a bench, and the run that shows it best in time."""
    cart = _cart(term, chain)
    runs = _runs(term, chain, cart=cart)
    shown = max(runs, key=lambda run: _difference(run, cart))
    figure, (left, right) = panels(_HEIGHT, columns=2, share_x=False)
    _fingerprint(left, term, chain, shown, cart=cart)
    seen = _window(shown, cart)
    t, without, with_it = (
        shown.t[seen],
        shown.without[cart - 1, seen],
        shown.with_it[cart - 1, seen],
    )
    right.plot(t, without, color=SECOND, ls="--", lw=1.0, label="without")
    right.plot(t, with_it, color=MODEL, lw=1.1, label="with it")
    right.set_ylabel(position_label(cart, POSITION))
    right.yaxis.set_label_coords(_LABEL, 0.5)
    right.set_xlabel(f"{shown.name}: time [s]")
    legend_above(right)
    return figure


def fingerprint_words(effect: Effect) -> str:
    """Say what the fingerprint shows."""
    if _scales_readings(effect):
        return "what the sensor reads, against where the cart is (dashed: the same)"
    return {
        "velocity": "the force that the linear chain does not account for, against velocity",
        "position": "the force that the linear chain does not account for, against position",
        "stretch": "the force that the linear chain does not account for, against the stretch",
        "input": "the force that arrives on cart 1, against the input (dashed: all of it)",
        "time": "the force on cart 1 about an edge of the input (dashed)",
        "frequency": "how far the cart moves per input, without (dashed) and with the effect",
    }[effect.axis]


def _scales_readings(effect: Effect) -> bool:
    return any(p.neutral == 1.0 for p in effect.parameters)


def _window(run: _Run, cart: int) -> slice:
    """Return the samples to show: all, or those about the largest of small differences."""
    if _difference(run, cart) > _HARD_TO_SEE:
        return slice(None)
    largest = int(np.argmax(np.abs(run.with_it[cart - 1] - run.without[cart - 1])))
    half = round(_WINDOW * _RATE)
    first = min(max(largest - half, 0), run.t.size - 2 * half)
    return slice(first, first + 2 * half)


def _cart(term: Term, chain: Chain) -> int:
    """Return the cart to look at: that of the effect, the right one of a spring, the driven one."""
    return min(max(term.place, 1), chain.n)


def _difference(run: _Run, cart: int) -> float:
    apart = run.with_it[cart - 1] - run.without[cart - 1]
    return float(np.std(apart) / np.std(run.without[cart - 1]))


def _runs(term: Term, chain: Chain, *, cart: int) -> list[_Run]:
    """Return a step on and off and, for what is not in the drive, a decay of that cart alone."""
    t = np.arange(0.0, _DURATION, 1 / _RATE)
    size = _SIZE / float(np.max(np.abs(chain.static_gains())))
    everyone = tuple(range(1, chain.n + 1))
    # To the side on which the effect acts, where it has one.
    side = next(
        (np.sign(v) for p, v in zip(term.effect.parameters, term.values, strict=True) if p.side),
        1.0,
    )
    on = (t >= _STEP[0]) & (t < _STEP[1])
    runs = [_run("step", term, chain, t, np.where(on, side * size, 0.0), free=everyone)]
    if term.effect.place != "input":
        start = np.zeros(chain.n)
        start[cart - 1] = _RELEASE
        runs.append(_run("decay", term, chain, t, np.zeros_like(t), free=(cart,), x0=start))
    return runs


def _run(
    name: str,
    term: Term,
    chain: Chain,
    t: Array,
    u: Array,
    *,
    free: tuple[int, ...],
    x0: Array | None = None,
) -> _Run:
    model = AugmentedChain(chain=chain, terms=(term,))
    at_rest = rest_positions(model, free=free) if x0 is None else x0
    return _Run(
        name=name,
        t=t,
        u=u,
        free=free,
        without=simulate_augmented(AugmentedChain(chain=chain), t, u, free=free, x0=x0),
        with_it=simulate_augmented(model, t, u, free=free, x0=at_rest),
    )


# ------------------------------------------------------------------ the fingerprint


def _fingerprint(ax: Axes, term: Term, chain: Chain, run: _Run, *, cart: int) -> None:
    draw: dict[str, Callable[..., None]] = {
        "velocity": _against_motion,
        "position": _against_motion,
        "stretch": _against_motion,
        "input": _against_input,
        "time": _about_an_edge,
        "frequency": _over_frequency,
    }
    if _scales_readings(term.effect):
        _against_truth(ax, run, cart=cart)
    else:
        draw[term.effect.axis](ax, term, chain, run, cart=cart)


def _against_motion(ax: Axes, term: Term, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the force that the linear chain leaves against what it depends on."""
    motion = run.rate() if term.effect.axis == "velocity" else run.with_it
    force, seen, word = run.residual_force(chain)[cart - 1], motion[cart - 1], f"of cart {cart}"
    if term.effect.place == "spring":
        walls = np.zeros((1, run.t.size))
        stretch = np.diff(np.concatenate([walls, motion, walls]), axis=0)
        # A stretched spring pulls its right cart back and its left cart on.
        force = -force if cart == term.place else force
        seen, word = stretch[term.place - 1], f"of spring {term.place}"
    inside = slice(3, -3)  # differences at the ends are one-sided
    _cloud(ax, seen[inside], force[inside])
    ax.axhline(0.0, color=QUIET, lw=0.6)
    rate = term.effect.axis == "velocity"
    if term.effect.place == "spring":
        what = "rate of stretch" if rate else "stretch"
    else:
        what = "velocity" if rate else "position"
    ax.set_xlabel(f"{what} {word} [{POSITION}{'/s' if rate else ''}]")
    ax.set_ylabel(f"extra force [{INPUT}]")


def _against_input(ax: Axes, term: Term, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the force that arrives on cart 1 against the input, slow enough to see the law."""
    size = float(np.max(np.abs(run.u)))
    u = size * np.sin(2 * np.pi * run.t / _DURATION)
    slow = _run("ramp", term, chain, run.t, u, free=run.free)
    ax.plot([-size, size], [-size, size], color=SECOND, ls="--", lw=1.0)
    _cloud(ax, u[3:-3], (slow.residual_force(chain)[0] + u)[3:-3])
    ax.set_xlabel(f"input [{INPUT}]")
    ax.set_ylabel(f"force that arrives [{INPUT}]")


def _about_an_edge(ax: Axes, term: Term, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the force that arrives on cart 1 about an edge of the input."""
    near = (run.t > _STEP[1] + _EDGE[0]) & (run.t < _STEP[1] + _EDGE[1])
    milliseconds = 1e3 * (run.t[near] - _STEP[1])
    arriving = run.residual_force(chain)[0] + run.u
    ax.plot(milliseconds, run.u[near], color=SECOND, ls="--", lw=1.0, drawstyle="steps-post")
    ax.plot(milliseconds, arriving[near], color=MODEL, lw=1.1)
    ax.set_xlabel("time about the step off [ms]")
    ax.set_ylabel(f"force on cart 1 [{INPUT}]")


def _over_frequency(ax: Axes, term: Term, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot how much the cart moves per input over frequency, from its answer to a short pulse."""
    t = np.arange(0.0, _RING_OUT, 1 / _RATE)
    padded = 2 * t.size
    samples = np.arange(t.size)
    u = np.where((samples >= _PULSE) & (samples < 2 * _PULSE), 1.0, 0.0)
    pulse = _run("pulse", term, chain, t, u, free=tuple(range(1, chain.n + 1)))
    hertz, omega = np.fft.rfftfreq(padded, 1 / _RATE), np.abs(chain.poles) / (2 * np.pi)
    band = (hertz > 0.3 * omega.min()) & (hertz < 2.5 * omega.max())
    for y, colour, style in ((pulse.without, SECOND, "--"), (pulse.with_it, MODEL, "-")):
        gain = np.fft.rfft(y[cart - 1], padded)[band] / np.fft.rfft(u, padded)[band]
        ax.plot(hertz[band], np.abs(gain), color=colour, ls=style, lw=1.1)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel(f"x{subscript(cart)}/u [{POSITION}/{INPUT}]")


def _against_truth(ax: Axes, run: _Run, *, cart: int) -> None:
    """Plot what the sensor reads against where the cart is."""
    reach = np.array([run.without[cart - 1].min(), run.without[cart - 1].max()])
    ax.plot(reach, reach, color=SECOND, ls="--", lw=1.0)
    _cloud(ax, run.without[cart - 1], run.with_it[cart - 1])
    ax.set_xlabel(f"position of cart {cart} [{POSITION}]")
    ax.set_ylabel(f"reading [{POSITION}]")


def _cloud(ax: Axes, x: Array, y: Array) -> None:
    """Plot points; the limits leave out the spikes that differences make at a jump."""
    shown = np.linspace(0, x.size - 1, min(x.size, _MOST_POINTS)).astype(int)
    ax.plot(x[shown], y[shown], ".", color=MODEL, ms=2.6, mew=0)
    low, high = np.quantile(y, [0.002, 0.998])
    low, high = min(low, 0.0), max(high, 0.0)
    middle, half = (low + high) / 2, _ROOM * (high - low) / 2
    if half > 0:
        ax.set_ylim(middle - half, middle + half)
