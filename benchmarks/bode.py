"""The fit of all carts at once, against what people fit resonances with: from dwells, from records.

How the others are used is in `benchmarks/bode_tools.py`.
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
from benchmarks.page import Table, installed, missing, share, spread
from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.linear.simulate import simulate_linear
from pipeline.results import ChainFit, FrequencyResponse, Record
from pipeline.set_up import Bench
from pipeline.stages.time_fit import fit_records

TITLE = "Resonances of one, two and three carts"
WORDS = """
The paper's task: resonances, damping ratios and static gains of the chain. **Over the bound** is
the root-mean-square error of a fit's numbers, each in units of the Cramér–Rao bound of a chain of
carts on springs: 1 is what no unbiased method is below on average, 10 wastes 99 of 100
measurements (of a method at the bound the median is 0.6 to 1, as most seeds are kinder than the
root mean square of all). Methods that do not know that the carts are a chain have more numbers to
find, so that 1 is out of their reach by a little. **Right** is every resonance within 2 % of the
truth; all that need a start have the initial estimates of the paper's tables 1 to 3. What gives no
answer counts as infinitely wrong.
"""
TOOLS = ("control", "scikit-rf", "sdypy-EMA", "sippy_unipi")
OURS = "cartlab"
SEEDS = 24
NOISES = (0.3, 1.0, 3.0)  # times 1 % of the amplitude and half an encoder count
RECORD_NOISES = (0.0007, 0.00227, 0.007)  # cm; an encoder count is 0.00227
RATE, PERIODS = 50.0, 3  # Hz
LARGEST = 1.0  # cm

_MARKS = "oDsv^P"


@dataclass(frozen=True, kw_only=True)
class Try:
    """One fit: errors over the bound (infinite where it failed), whether right, CPU ms."""

    modes: float
    gains: float
    right: bool
    milliseconds: float


Trials = dict[tuple[str, int, float], list[Try]]  # by tool, carts, noise


def judged(find: Callable[[], Modes], *, truth: Modes, least: Modes) -> Try:
    """Run one method and compare it with the truth, in units of the bound."""
    start = time.process_time()
    try:
        found = find()
    except (DataError, RuntimeError, ValueError, ArithmeticError, LookupError):
        found = None  # what methods raise that find no answer
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
    """Return what is compared, of all named parameters."""
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
    """Return a record of a multisine of random phases, from rest; white noise, no rounding."""
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
                    fit = fit_records([record], bench=Bench(springs=(True,) * (chain.n + 1)))
                    return _of_fit(fit, chain)

                tried: list[tuple[str, Callable[[], Modes]]] = [(OURS, ours)]
                for name, tool, find in RECORD_TOOLS:
                    if installed(tool):
                        tried.append((name, lambda find=find, record=record: find(record)))
                for name, find in tried:
                    trials[name, chain.n, noise].append(judged(find, truth=truth, least=least))
    return trials


def rows_of(
    trials: Trials, *, tools: Sequence[tuple[str, str]], noises: Sequence[float]
) -> list[list[str]]:
    """Return a line for each tool and number of carts: error by noise, share right, time."""
    rows = []
    for name, tool in ((OURS, ""), *tools):
        if tool and not installed(tool):
            rows.append(missing(name, columns=len(_HEAD)))
            continue
        for n in (1, 2, 3):
            tries = [trials[name, n, noise] for noise in noises]
            every = [one for some in tries for one in some]
            no_gains = np.isnan([one.gains for one in every]).any()
            rows.append(
                [
                    name,
                    str(n),
                    *(spread(one.modes for one in some) for some in tries),
                    "–" if no_gains else spread(one.gains for one in every),
                    share(sum(one.right for one in every), len(every)),
                    spread(one.milliseconds for one in every),
                ]
            )
    return rows


_HEAD = ("tool", "carts", "ω, ζ over the bound: little noise", "middle", "much")
_HEAD += ("K over the bound", "right", "ms of a core")


def _speed(trials: Trials) -> str:
    """Say how much less time `curve_fit` took, by the medians of one, two and three carts."""
    times = {
        (name, n): np.median(
            [one.milliseconds for noise in NOISES for one in trials[name, n, noise]]
        )
        for name in (OURS, CURVE_FIT)
        for n in (1, 2, 3)
    }
    ratios = [times[OURS, n] / times[CURVE_FIT, n] for n in (1, 2, 3)]
    return f"cartlab took {min(ratios):.0f} to {max(ratios):.0f} times as long as `curve_fit`."


def picture(
    kinds: Sequence[tuple[str, Trials, Sequence[float]]],
) -> Figure:
    """Draw the error over the bound against the noise, by data and carts."""
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


_CEILING = 300.0  # at which what is worse, or gave no answer, is drawn


def tables(*, quick: bool) -> list[Table]:
    """Compare from magnitudes, from magnitudes and phases, from time records."""
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
    return [
        Table(
            title="From the magnitudes of sine dwells, as the paper's students have them",
            head=_HEAD,
            rows=rows_of(magnitudes, tools=blind, noises=NOISES),
            note=f"{seeds} seeds a noise. {_DWELLS} {_FITS} {_MAGNITUDES} "
            f"{_speed(magnitudes)} Vector fitting, modal analysis and "
            "subspaces need phases, so that these data are not for them.",
        ),
        Table(
            title="With phases",
            head=_HEAD,
            rows=rows_of(complex_, tools=[(t[0], t[1]) for t in DWELL_TOOLS], noises=NOISES),
            note=f"{_FITS} {_PHASES} {_speed(complex_)} {_VECTORS}",
        ),
        Table(
            title="From one record of a multisine",
            head=_HEAD,
            rows=rows_of(records, tools=[(t[0], t[1]) for t in RECORD_TOOLS], noises=RECORD_NOISES),
            note=_RECORDS,
            picture=lambda: picture(kinds),
        ),
    ]


_DWELLS = """Dwells: 20, 25 and 30 frequencies, evenly spaced logarithms from 0.3 to 7 Hz; standard
errors of 1 % of the amplitude and half an encoder count together (middle), a third (little) and
three times that (much). A damping ratio below zero, which magnitudes cannot tell from one above, is
taken as positive."""
_FITS = """Nelder–Mead is `fminsearch` with its defaults (tolerances 1e-4, 200 evaluations a
parameter; scipy's are the same), on the paper's parameters of all carts at once and without
weights. `curve_fit` has the same parameters, and each point's true standard error as `sigma`."""
_MAGNITUDES = "Linear: of magnitudes; logarithms: of theirs."
_PHASES = """Linear: of real and imaginary parts; logarithms: of magnitudes', and phases."""
_VECTORS = """Vector fitting: as many complex pole pairs as carts, common to all, started at
logarithmic spacing, strictly proper, responses scaled to one; it takes no weights, and needs no
start, which the others do."""
_RECORDS = """Three periods of 10 s at 50 Hz from rest, all lines up to 25 Hz, largest motion 1 cm,
white noise of 0.0007, 0.0023 and 0.007 cm on the positions. The bound knows that the carts were at
rest. cartlab, N4SID and ERA have the whole record and need no start. N4SID: the true order, signals
scaled to one, horizons of 40 samples (better on other seeds than the 20 by default). ERA: 400
Markov parameters, the true order. sdypy-EMA: responses of the second and third period, the hold
undone, 0.3 to 8 Hz, orders up to 40 for LSCF and 20 for rational fractions (beyond, it stops with
an error), stable poles nearest to the paper's start; it tells poles but no static gains. N4SID
needs nothing but the order, and serves for any linear system; only cartlab's numbers are
those of masses, dampers and springs. In the figure: ω and ζ over the bound, medians; what is worse
than 300 is drawn there."""
