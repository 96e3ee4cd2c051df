"""Compare the joint fit of all carts with other tools that find resonances.

`benchmarks/bode_tools.py` calls the other tools.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from benchmarks.bode_tools import CURVE_FIT, DWELL_TOOLS, PERIOD, RECORD_TOOLS, Dwells, Modes
from benchmarks.identification import (
    PAPER_STARTS,
    RIGHT,
    bound,
    fit_from,
    least_possible_std,
    measure,
)
from benchmarks.page import Table, installed, missing, share, significant, spread
from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.time_fit import fit_records
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ChainFit, FrequencyResponse, Record
from pipeline.setup import Setup

TITLE = "Resonances of one, two and three carts"
WORDS = """
**How close does each tool come to the best that the data allow?** The task is that of the paper:
find resonances, damping ratios and static gains. An error of 1 is the smallest possible on
average (the Cramér–Rao bound for a chain of carts on springs). At an error of 10, 99 of 100
measurements are wasted.
"""
TOOLS = ("control", "scikit-rf", "sdypy-EMA", "sippy_unipi")
OURS = "cartlab"
SEEDS = 24
NOISES = (0.3, 1.0, 3.0)  # times the usual noise: 1 % of the amplitude and half an encoder count
RECORD_NOISES = (0.0007, 0.00227, 0.007)  # in cm; an encoder count is 0.00227 cm
RATE, PERIODS = 50.0, 3  # Hz
LARGEST = 1.0  # cm
CARTS = (1, 2, 3)

_MARKS = "oDsv^P"


@dataclass(frozen=True, kw_only=True)
class Try:
    """One fit: errors in units of the bound (infinite if it failed), success, CPU time in ms."""

    modes: float
    gains: float
    right: bool
    milliseconds: float


Trials = dict[tuple[str, int, float], list[Try]]  # by tool, carts, noise


def judged(find: Callable[[], Modes], *, truth: Modes, least: Modes) -> Try:
    """Run one method and compare its result with the true values, in units of the bound."""
    start = time.process_time()
    try:
        found = find()
    except (DataError, RuntimeError, ValueError, ArithmeticError, LookupError):
        found = None  # these errors mean that a method finds no answer
    milliseconds = 1e3 * (time.process_time() - start)
    if found is None:
        return Try(modes=np.inf, gains=np.inf, right=False, milliseconds=milliseconds)
    off = [
        (found.omega - truth.omega) / least.omega,
        (found.zeta - truth.zeta) / least.zeta,
    ]
    assert truth.gains is not None
    assert least.gains is not None
    gains = np.nan if found.gains is None else _rms((found.gains - truth.gains) / least.gains)
    return Try(
        modes=_rms(np.concatenate(off)),
        gains=gains,
        right=bool(np.all(np.abs(found.omega / truth.omega - 1) < RIGHT)),
        milliseconds=milliseconds,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def modes_named(chain: Chain, values: Sequence[float]) -> Modes:
    """Return the resonances and gains, which are compared, from the chain's parameter values."""
    named = dict(zip(chain.parameters(), values, strict=True))
    keys = "n" if chain.n == 1 else "abc"[: chain.n]
    zetas = ["zeta"] if chain.n == 1 else [f"zeta_{key}" for key in keys]
    gains = ["K"] if chain.n == 1 else [f"K_{i + 1}" for i in range(chain.n)]
    return Modes(
        omega=np.array([named[f"omega_{key}"] for key in keys]),
        zeta=np.array([named[name] for name in zetas]),
        gains=np.array([named[name] for name in gains]),
    )


def _of_fit(fit: ChainFit, chain: Chain) -> Modes:
    return modes_named(chain, [fit.parameters[name].value for name in chain.parameters()])


def from_dwells(*, seeds: int, phases: bool) -> Trials:
    """Try every tool on the same noisy dwells."""
    trials: Trials = defaultdict(list)
    for chain in PRESETS.values():
        truth = modes_named(chain, list(chain.parameters().values()))
        for noise in NOISES:
            least = modes_named(
                chain, least_possible_std(chain, phases=phases, noise=noise).tolist()
            )
            for seed in range(seeds):
                rng = np.random.default_rng([40, seed])
                responses = measure(chain, rng=rng, phases=phases, noise=noise)

                def ours(
                    responses: Sequence[FrequencyResponse] = responses, chain: Chain = chain
                ) -> Modes:
                    fit = fit_from(responses, start=PAPER_STARTS[chain.n], n=chain.n)
                    return _of_fit(fit, chain)

                tried: list[tuple[str, Callable[[], Modes]]] = [(OURS, ours)]
                dwells = Dwells.of(responses)
                for name, tool, needs_phases, find in DWELL_TOOLS:
                    if installed(tool) and (phases or not needs_phases):
                        tried.append((name, lambda find=find, dwells=dwells: find(dwells)))
                for name, find in tried:
                    trials[name, chain.n, noise].append(judged(find, truth=truth, least=least))
    return trials


def multisine(chain: Chain, *, rng: np.random.Generator, noise: float) -> Record:
    """Return a record of a multisine with random phases, from rest, with white noise."""
    t = np.arange(round(PERIODS * PERIOD * RATE)) / RATE
    lines = np.arange(1, round(PERIOD * RATE / 2)) / PERIOD
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    u = np.cos(2 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
    y = simulate_linear(chain, t, u)
    scale = LARGEST / np.abs(y).max()
    carts = tuple(range(1, chain.n + 1))
    return Record(
        id="multisine",
        kind="sweep",
        t=t,
        u=scale * u,
        y=scale * y + noise * rng.standard_normal(y.shape),
        carts=carts,
        free=carts,
        resolution=np.zeros(chain.n),
        hold="zero_order",
    )


def from_records(*, seeds: int) -> Trials:
    """Try every tool on the same noisy records."""
    trials: Trials = defaultdict(list)
    for chain in PRESETS.values():
        truth = modes_named(chain, list(chain.parameters().values()))
        for noise in RECORD_NOISES:
            for seed in range(seeds):
                record = multisine(chain, rng=np.random.default_rng([41, seed]), noise=noise)
                t, u = record.t, record.u
                assert u is not None
                least = modes_named(
                    chain,
                    bound(
                        chain, lambda of, t=t, u=u, s=noise: simulate_linear(of, t, u) / s
                    ).tolist(),
                )

                def ours(record: Record = record, chain: Chain = chain) -> Modes:
                    fit = fit_records([record], bench=Setup(springs=(True,) * (chain.n + 1)))
                    return _of_fit(fit, chain)

                tried: list[tuple[str, Callable[[], Modes]]] = [(OURS, ours)]
                for name, tool, find in RECORD_TOOLS:
                    if installed(tool):
                        tried.append((name, lambda find=find, record=record: find(record)))
                for name, find in tried:
                    trials[name, chain.n, noise].append(judged(find, truth=truth, least=least))
    return trials


def rows_of(
    data: str, trials: Trials, *, tools: Sequence[tuple[str, str]], middle: float
) -> list[list[str]]:
    """Return each tool's row: errors at `middle` noise by number of carts, successes, times."""
    rows = []
    for name, tool in ((OURS, ""), *tools):
        if tool and not installed(tool):
            rows.append([data, *missing(name, columns=len(_HEAD) - 1)])
            continue
        every = {
            n: [one for (who, carts, _), some in trials.items() if (who, carts) == (name, n)
                for one in some]
            for n in CARTS
        }  # fmt: skip
        gains = [float(np.median([one.gains for one in every[n]])) for n in CARTS]
        times = [float(np.median([one.milliseconds for one in every[n]])) for n in CARTS]
        tried = [one for n in CARTS for one in every[n]]
        rows.append(
            [
                data,
                name,
                *(spread(one.modes for one in trials[name, n, middle]) for n in CARTS),
                "–" if np.isnan(gains).any() else ", ".join(map(significant, gains)),
                share(sum(one.right for one in tried), len(tried)),
                ", ".join(map(significant, times)),
            ]
        )
    return rows


_HEAD = ("data", "tool", "ω, ζ: 1 cart", "2 carts", "3 carts", "K: 1, 2, 3 carts")
_HEAD += ("right", "ms of a core: 1, 2, 3 carts")


def _speed(trials: Trials) -> list[float]:
    """Return cartlab's median time divided by that of `curve_fit`, by number of carts."""
    times = {
        (name, n): np.median(
            [one.milliseconds for noise in NOISES for one in trials[name, n, noise]]
        )
        for name in (OURS, CURVE_FIT)
        for n in CARTS
    }
    return [float(times[OURS, n] / times[CURVE_FIT, n]) for n in CARTS]


def picture(
    kinds: Sequence[tuple[str, Trials, Sequence[float]]],
) -> Figure:
    """Draw the error in units of the bound against the noise, for each kind of data and chain."""
    figure = Figure(figsize=(6.5, 5.2), layout="constrained")
    grid = figure.subplots(len(kinds), 3, sharey=True, squeeze=False)
    shown = list(dict.fromkeys(name for _, trials, _ in kinds for name, _, _ in trials))
    lines = {}
    for row, (words, trials, noises) in zip(grid, kinds, strict=True):
        for n, axes in enumerate(row, start=1):
            for index, name in enumerate(shown):
                medians = [
                    np.median([one.modes for one in trials[name, n, noise]])
                    for noise in noises
                    if (name, n, noise) in trials
                ]
                if medians:
                    (lines[name],) = axes.plot(
                        range(len(medians)),
                        np.minimum(medians, _CEILING),
                        marker=_MARKS[index % len(_MARKS)],
                        color=f"C{index}",
                        linewidth=2.0 if name == OURS else 1.0,
                        markersize=4,
                    )
            axes.axhline(1.0, color="#888888", linewidth=0.8)
            axes.set(yscale="log", ylim=(0.5, 1.5 * _CEILING))
            axes.set_title(f"{words}, {n} cart{'s' * (n > 1)}")
        row[0].set_ylabel("error over bound", labelpad=20)
    for axes in grid[-1]:
        axes.set_xlabel("noise: 0 little, 1 middle, 2 much", labelpad=12)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)
    return figure


_CEILING = 300.0  # larger errors and missing answers are drawn at this value


def tables(*, quick: bool) -> list[Table]:
    """Compare the tools on magnitudes, on magnitudes with phases, and on time records."""
    seeds = 1 if quick else SEEDS
    magnitudes = from_dwells(seeds=seeds, phases=False)
    complex_ = from_dwells(seeds=seeds, phases=True)
    records = from_records(seeds=seeds)
    blind = [(name, tool) for name, tool, needs_phases, _ in DWELL_TOOLS if not needs_phases]
    kinds = (
        ("magnitudes", magnitudes, NOISES),
        ("with phases", complex_, NOISES),
        ("records", records, RECORD_NOISES),
    )
    slower = [*_speed(magnitudes), *_speed(complex_)]
    every = [(tool[0], tool[1]) for tool in DWELL_TOOLS]
    on_records = [(tool[0], tool[1]) for tool in RECORD_TOOLS]
    return [
        Table(
            title="Errors over the least possible",
            head=_HEAD,
            rows=[
                *rows_of("magnitudes", magnitudes, tools=blind, middle=NOISES[1]),
                *rows_of("with phases", complex_, tools=every, middle=NOISES[1]),
                *rows_of("a record", records, tools=on_records, middle=RECORD_NOISES[1]),
            ],
            better=_BETTER.format(least=min(slower), most=max(slower)),
            note=_NOTE.format(seeds=seeds),
            picture=lambda: picture(kinds),
        )
    ]


_BETTER = """
**Others are better** in speed and generality. `curve_fit` is {least:.0f} to {most:.0f} times
as fast as cartlab. N4SID needs only the order and suits any linear system. Vector fitting
needs no initial values.
"""
_NOTE = """
- Each cell of ω, ζ is the median with quartiles over {seeds} seeds at the middle noise. The
  figure shows all noises; errors are cut off at 300. An optimal tool has a median of 0.6 to 1.
  Tools that do not know the chain fit more numbers, so they stay a little above 1.
- Right: every resonance is within 2 % of the truth, at all noises. A tool that fails counts as
  infinitely wrong.
- Dwells: 20, 25 and 30 frequencies from 0.3 to 7 Hz. The middle noise is 1 % of the amplitude and
  half an encoder count; the other noises are a third and three times as large. Fits that need
  initial values have the paper's (tables 1 to 3).
- Nelder–Mead is `fminsearch` with its defaults, without weights, on magnitudes or their
  logarithms; with phases also on real and imaginary parts. `curve_fit` knows the standard error
  of each point. Vector fitting has one pair of poles for each cart and needs phases.
- A record is a multisine from rest: three periods of 10 s at 50 Hz, up to 1 cm. White noise of
  0.0007, 0.0023 or 0.007 cm is added. N4SID and ERA have the true order. N4SID has horizons of 40
  samples (better here than the default 20). ERA has 400 Markov parameters.
- Modal analysis (sdypy-EMA) has the responses of periods two and three from 0.3 to 8 Hz, and
  orders up to 40 (LSCF) or 20 (rational fractions). Of its stable poles, those nearest to the
  paper's initial values count. It returns no static gains.
"""
