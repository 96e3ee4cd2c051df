"""The joint fit to time records: its speed, success rate and standard errors."""

import time

import numpy as np

from benchmarks.page import Table, share, spread
from pipeline.estimation.time_fit import fit_records
from pipeline.plant.chain import PRESETS
from pipeline.setup import Setup
from tests.helpers.time_records import random_chain, step_record

TITLE = "The fit on time records"
WORDS = """
**Without sine dwells, does the fit of steps find the masses, and are its standard errors correct?**
Other tools are compared in the [benchmarks](README.md).
"""
TOOLS = ()
NOISES = (0.0, 0.0005, 0.00227)  # in cm: only rounding, a fifth of a count, a count
INSIDE = 1.96  # 95 % of the estimates are within this many standard errors, if these are right


def tables(*, quick: bool) -> list[Table]:
    return [convergence(6 if quick else 400), coverage(2 if quick else 60)]


def coverage(seeds: int) -> Table:
    """Return a table of errors in standard errors, for each preset."""
    rows = []
    for name, chain in PRESETS.items():
        truth = np.array(list(chain.parameters().values()))
        for noise in NOISES:
            rng = np.random.default_rng(1)
            z, chi_square = [], []
            for _ in range(seeds):
                records = [
                    step_record(
                        chain,
                        rng=rng,
                        swing=swing,
                        duration=rng.uniform(6, 10),
                        rate=rng.choice([113.0, 226.0, 500.0]),
                        noise=noise,
                        id=f"{swing}",
                    )
                    for swing in (1.0, 0.6)
                ]
                fit = fit_records(records, bench=Setup(springs=(True,) * (chain.n + 1)))
                value = np.array([p.value for p in fit.parameters.values()])
                std = np.array([p.std for p in fit.parameters.values()], dtype=float)
                z.append((value - truth) / std)
                chi_square.append(fit.chi_square_per_dof)
            inside = np.mean(np.abs(z) < INSIDE, axis=0)
            rows.append(
                [
                    name,
                    f"{noise}",
                    f"{np.mean(inside):.1%}",
                    f"{np.min(inside):.1%}",
                    f"{np.sqrt(np.mean(np.square(z))):.2f}",
                    f"{np.mean(chi_square):.2f}",
                ]
            )
    return Table(
        title="Are the standard errors correct?",
        head=["plant", "noise, cm", "inside, all", "worst parameter", "rms z", "χ²/dof"],
        rows=rows,
        note=_COVERAGE.format(seeds=seeds),
    )


def convergence(chains: int) -> Table:
    """Return how often the fit finds the masses of a random chain, by number of carts."""
    rng, rows = np.random.default_rng(2), []
    for n in (1, 2, 3, 4):
        found, starts, spent = 0, 0, []
        for _ in range(max(1, chains // 4)):
            chain, springs = random_chain(n, rng)
            records = [
                step_record(
                    chain,
                    rng=rng,
                    swing=swing,
                    duration=rng.uniform(4, 8),
                    jitter=rng.choice([0.0, 0.2]),
                    noise=0.001,
                    id=f"{swing}",
                )
                for swing in (1.0, 0.6, -1.0)
            ]
            start = time.process_time()
            fit = fit_records(records, bench=Setup(springs=springs))
            spent.append(1e3 * (time.process_time() - start))
            found += bool(fit.converged and np.max(np.abs(fit.chain.m / chain.m - 1)) < 0.1)
            starts += fit.n_starts
        rows.append([str(n), share(found, len(spent)), f"{starts / len(spent):.2f}", spread(spent)])
    return Table(
        title="Does it find the masses?",
        head=["carts", "right", "starts", "ms of a core"],
        rows=rows,
        note=_CONVERGENCE,
    )


_CONVERGENCE = """
Random chains, three steps of 4 to 8 s each. Right: every mass within 10 %.
"""
_COVERAGE = """
Two steps (1 and 0.6 cm, 6 to 10 s, 113 to 500 Hz), {seeds} fits a line, read by an encoder of
0.00227 cm with white noise before its rounding. "Inside": the share of parameters within 1.96
standard errors of the truth; 95 % is correct. "rms z": the error in standard errors.
"""
