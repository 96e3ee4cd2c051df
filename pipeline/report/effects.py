"""The catalogue of effects as a page: law, picture and deciding recording of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.plant.augmented import rest_positions, simulate_augmented
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.effect import AugmentedChain, Effect, EffectTerm
from pipeline.report.builder import PageBuilder, Part
from pipeline.report.document import Block, Code, Document, Picture, bullet_list, paragraph
from pipeline.report.effect_texts import INPUT, POSITION, parameter_text
from pipeline.report.equations.model import formula
from pipeline.report.figures import MODEL, QUIET, SECOND, SECOND_LINE
from pipeline.report.figures.style import legend_above, log_scale, panels, position_label
from pipeline.report.files import write_document
from pipeline.simulated.hidden import usual_term
from pipeline.words.numbers import significant, subscript
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import Span, spans

_WORDS = phrases("effects")
BENCH = "throne-2dof"  # the smallest preset with a spring between two carts
# Hz; fast enough to compute velocities and accelerations as differences of positions
_RATE = 1000.0
_DURATION = 4.0  # s
_STEP = (0.1, 2.1)  # s; times at which the input is switched on and off


def render_effects(effects: Sequence[Effect], out: Path, *, progress: Progress = silent) -> None:
    """Write `effects.html` and `figures/*.svg` into `out`; repeated calls write the same bytes."""
    write_document(build_gallery(effects, progress=progress), out, name="effects", pdf=False)


def build_gallery(effects: Sequence[Effect], *, progress: Progress = silent) -> Document:
    """Return the catalogue with a picture of each effect on a simulated bench."""
    parts: list[Part] = [("summary", "Catalogue", lambda page: _overview(page, effects))]
    parts += [(e.key, e.title, lambda page, e=e: _entry(page, e)) for e in effects]
    return Document(
        title="Effects beyond the linear chain",
        subtitle="The catalogue of effects",
        authors=(),
        sections=PageBuilder().sections(parts, doing="effects", progress=progress),
    )


def _overview(page: PageBuilder, effects: Sequence[Effect]) -> list[Block]:
    rows = [
        (
            spans(Span(effect.key, "code", url=f"#{effect.key}")),
            effect.place,
            ", ".join(parameter_text(p) for p in effect.parameters if p.reported),
            effect.sentence,
        )
        for effect in effects
    ]
    return [paragraph(_WORDS.text("effects")), page.table(_WORDS, "effects_table", rows, "llll")]


def _entry(page: PageBuilder, effect: Effect) -> list[Block]:
    chain = PRESETS[BENCH]
    term = usual_term(effect, chain)
    facts = {
        "fingerprint": effect.fingerprint,
        "deciding": effect.deciding_run,
        "equivalent": effect.equivalent,
        "read": f"{effect.reference}.",
    }
    return [
        paragraph(effect.sentence),
        formula(effect.formula),
        effect_picture(page, term, chain, bench=BENCH),
        bullet_list(_WORDS.spans(f"effect_{key}", text=t) for key, t in facts.items() if t),
        # What simulates the bench of the picture.
        Code(f"cartlab simulate --preset {BENCH} {hiding_option(term)} --out bench"),
    ]


def effect_picture(page: PageBuilder, term: EffectTerm, chain: Chain, *, bench: str) -> Picture:
    """Return a picture of an effect: its fingerprint, and a run with and without it."""
    effect = term.effect
    sizes = (
        f"{p.symbol} = {significant(value, digits=3)} "
        f"{p.unit_text(position=POSITION, input=INPUT)}".strip()
        for p, value in zip(effect.parameters, term.values, strict=True)
        if p.reported
    )
    values = {
        "title": effect.title,
        "place": f" on {effect.place} {term.place}" if term.place else "",
        "bench": bench,
        "sizes": ", ".join(sizes),
        "seen": _WORDS.text("seen_reading" if scales_readings(effect) else f"seen_{effect.axis}"),
        "axis": effect.axis,
        "fingerprint": effect.fingerprint,
    }
    return page.picture(effect.key, effect_figure(term, chain), _WORDS, "effect", **values)


def hiding_option(term: EffectTerm) -> str:
    """Return the option `--hide` of `cartlab simulate` for this effect."""
    place = [f"{term.effect.place}={term.place}"] if term.place else []
    pairs = zip(term.effect.parameters, term.values, strict=True)
    sizes = [f"{p.name}={value:.3g}" for p, value in pairs if p.reported]
    return f"--hide {term.effect.key}:{','.join(place + sizes)}"


# -------------------------------------------------------------------------------------- pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class _Run:
    """One run of the bench, simulated with and without an effect.

    Attributes
    ----------
    without, with_it : readings (n_carts, n) without and with the effect.
    """

    name: str
    t: Array
    u: Array
    free: tuple[int, ...]
    without: Array
    with_it: Array

    def rate(self) -> Array:
        """Return the carts' velocities (n_carts, n) with the effect."""
        return np.gradient(self.with_it, self.t, axis=1)

    def residual_force(self, chain: Chain) -> Array:
        """Return the forces (n_carts, n) that masses, dampings and springs do not explain."""
        v = self.rate()
        a = np.gradient(v, self.t, axis=1)
        force = chain.m[:, None] * a + chain.c[:, None] * v + chain.stiffness @ self.with_it
        force[0] -= self.u
        return force


def effect_figure(term: EffectTerm, chain: Chain) -> Figure:
    """Return a figure of an effect's fingerprint, and of the run in which the effect shows best."""
    # The effect's own cart, the cart right of its spring, or cart 1.
    cart = min(max(term.place, 1), chain.n)
    runs = _runs(term, chain, cart=cart)
    shown = max(runs, key=lambda run: _difference(run, cart))
    figure, (left, right) = panels(1.75, columns=2, share_x=False)
    _fingerprint(left, term, chain, shown, cart=cart)
    seen = _window(shown, cart)
    t = shown.t[seen]
    right.plot(t, shown.without[cart - 1, seen], label="without", **SECOND_LINE)
    right.plot(t, shown.with_it[cart - 1, seen], color=MODEL, lw=1.1, label="with it")
    right.set_ylabel(position_label(cart, POSITION))
    right.yaxis.set_label_coords(-0.2, 0.5)
    right.set_xlabel(f"{shown.name}: time [s]")
    legend_above(right)
    return figure


def scales_readings(effect: Effect) -> bool:
    """Return whether an effect changes the sensor's readings, not the motion."""
    return any(p.neutral == 1.0 for p in effect.parameters)


def _window(run: _Run, cart: int) -> slice:
    """Return the samples to show: all, or one second around the largest difference."""
    if _difference(run, cart) > 0.1:
        return slice(None)
    largest = int(np.argmax(np.abs(run.with_it[cart - 1] - run.without[cart - 1])))
    half = round(0.5 * _RATE)
    first = min(max(largest - half, 0), run.t.size - 2 * half)
    return slice(first, first + 2 * half)


def _difference(run: _Run, cart: int) -> float:
    apart = run.with_it[cart - 1] - run.without[cart - 1]
    return float(np.std(apart) / np.std(run.without[cart - 1]))


def _runs(term: EffectTerm, chain: Chain, *, cart: int) -> list[_Run]:
    """Return a run in which the input is switched on and off, and a decay of one cart.

    The decay is left out for an effect on the input.
    """
    t = np.arange(0.0, _DURATION, 1 / _RATE)
    # Slightly less than the input that holds a cart at the end of its travel.
    size = 0.95 / float(np.max(np.abs(chain.static_gains())))
    everyone = tuple(range(1, chain.n + 1))
    # If the effect acts in one direction only, the step goes in that direction.
    side = next(
        (np.sign(v) for p, v in zip(term.effect.parameters, term.values, strict=True) if p.side),
        1.0,
    )
    on = (t >= _STEP[0]) & (t < _STEP[1])
    model = AugmentedChain(chain=chain, terms=(term,))
    runs = [_run("step", model, t, np.where(on, side * size, 0.0), free=everyone)]
    if term.effect.place != "input":
        start = np.zeros(chain.n)
        start[cart - 1] = 1.4  # multiple of the travel
        runs.append(_run("decay", model, t, np.zeros_like(t), free=(cart,), x0=start))
    return runs


def _run(
    name: str,
    model: AugmentedChain,
    t: Array,
    u: Array,
    *,
    free: tuple[int, ...],
    x0: Array | None = None,
) -> _Run:
    at_rest = rest_positions(model, free=free) if x0 is None else x0
    return _Run(
        name=name,
        t=t,
        u=u,
        free=free,
        without=simulate_augmented(AugmentedChain(chain=model.chain), t, u, free=free, x0=x0),
        with_it=simulate_augmented(model, t, u, free=free, x0=at_rest),
    )


# ------------------------------------------------------------------ the fingerprint


def _fingerprint(ax: Axes, term: EffectTerm, chain: Chain, run: _Run, *, cart: int) -> None:
    draw: dict[str, Callable[..., None]] = {
        "velocity": _against_motion,
        "position": _against_motion,
        "stretch": _against_motion,
        "input": _against_input,
        "time": _about_an_edge,
        "frequency": _over_frequency,
    }
    if scales_readings(term.effect):
        _against_truth(ax, run, cart=cart)
    else:
        draw[term.effect.axis](ax, term, chain, run, cart=cart)


def _against_motion(ax: Axes, term: EffectTerm, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the unexplained force (vertical axis) against the motion that causes it."""
    motion = run.rate() if term.effect.axis == "velocity" else run.with_it
    force, seen, word = run.residual_force(chain)[cart - 1], motion[cart - 1], f"of cart {cart}"
    if term.effect.place == "spring":
        walls = np.zeros((1, run.t.size))
        stretch = np.diff(np.concatenate([walls, motion, walls]), axis=0)
        # A stretched spring pulls its right cart back and its left cart forward.
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


def _against_input(ax: Axes, term: EffectTerm, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the force on cart 1 over the input, which changes slowly enough to show the law."""
    size = float(np.max(np.abs(run.u)))
    u = size * np.sin(2 * np.pi * run.t / _DURATION)
    slow = _run("ramp", AugmentedChain(chain=chain, terms=(term,)), run.t, u, free=run.free)
    ax.plot([-size, size], [-size, size], **SECOND_LINE)
    _cloud(ax, u[3:-3], (slow.residual_force(chain)[0] + u)[3:-3])
    ax.set_xlabel(f"input [{INPUT}]")
    ax.set_ylabel(f"force that arrives [{INPUT}]")


def _about_an_edge(ax: Axes, term: EffectTerm, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the force on cart 1 around a jump of the input."""
    near = (run.t > _STEP[1] - 0.02) & (run.t < _STEP[1] + 0.08)
    milliseconds = 1e3 * (run.t[near] - _STEP[1])
    arriving = run.residual_force(chain)[0] + run.u
    ax.plot(milliseconds, run.u[near], drawstyle="steps-post", **SECOND_LINE)
    ax.plot(milliseconds, arriving[near], color=MODEL, lw=1.1)
    ax.set_xlabel("time from the end of the step [ms]")
    ax.set_ylabel(f"force on cart 1 [{INPUT}]")


def _over_frequency(ax: Axes, term: EffectTerm, chain: Chain, run: _Run, *, cart: int) -> None:
    """Plot the cart's frequency response, computed from its response to a short pulse."""
    t = np.arange(0.0, 12.0, 1 / _RATE)  # s; by then the response to the pulse has ended
    padded = 2 * t.size
    u = np.zeros(t.size)
    u[20:40] = 1.0  # short compared with every period of oscillation
    model = AugmentedChain(chain=chain, terms=(term,))
    pulse = _run("pulse", model, t, u, free=tuple(range(1, chain.n + 1)))
    hertz, omega = np.fft.rfftfreq(padded, 1 / _RATE), np.abs(chain.poles) / (2 * np.pi)
    band = (hertz > 0.3 * omega.min()) & (hertz < 2.5 * omega.max())
    for y, colour, style in ((pulse.without, SECOND, "--"), (pulse.with_it, MODEL, "-")):
        gain = np.fft.rfft(y[cart - 1], padded)[band] / np.fft.rfft(u, padded)[band]
        ax.plot(hertz[band], np.abs(gain), color=colour, ls=style, lw=1.1)
    log_scale(ax, "x", "y")
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel(f"x{subscript(cart)}/u [{POSITION}/{INPUT}]")


def _against_truth(ax: Axes, run: _Run, *, cart: int) -> None:
    """Plot the sensor's reading over the true position."""
    reach = np.array([run.without[cart - 1].min(), run.without[cart - 1].max()])
    ax.plot(reach, reach, **SECOND_LINE)
    _cloud(ax, run.without[cart - 1], run.with_it[cart - 1])
    ax.set_xlabel(f"position of cart {cart} [{POSITION}]")
    ax.set_ylabel(f"reading [{POSITION}]")


def _cloud(ax: Axes, x: Array, y: Array) -> None:
    """Plot points; the axes leave out spikes from numerical differentiation at a jump."""
    shown = np.linspace(0, x.size - 1, min(x.size, 500)).astype(int)
    ax.plot(x[shown], y[shown], ".", color=MODEL, ms=2.6, mew=0)
    low, high = np.quantile(y, [0.002, 0.998])
    low, high = min(low, 0.0), max(high, 0.0)
    middle, half = (low + high) / 2, 1.08 * (high - low) / 2
    if half > 0:
        ax.set_ylim(middle - half, middle + half)
