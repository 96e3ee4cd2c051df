"""The joint fit on time records: how fast, how often it finds the chain, how honest its errors.

Records are steps of 1 and 0.6 cm, on and off, 6 to 10 s long at 113 to 500 Hz, read by an encoder
of 0.00227 cm with white noise before its rounding. "inside" is the share of named parameters
within 1.96 standard errors of the truth, "rms z" their error in standard errors.

Run: python -m benchmarks.time_fit
"""

import time

import numpy as np

from pipeline.plant.linear.presets import PRESETS
from pipeline.stages.time_fit import fit_records
from tests.helpers.time_records import random_chain, step_record

N_TIMED = 15
N_SEEDS = 200
N_CHAINS = 400
NOISES = (0.0, 0.0005, 0.00227)  # cm: none (rounding alone), a fifth of a count, a count


def times() -> None:
    print("four records of 677 samples, all springs expected")
    for name, chain in PRESETS.items():
        rng = np.random.default_rng(0)
        spent = []
        for _ in range(N_TIMED):
            records = [step_record(chain, rng=rng, id=f"{i}") for i in range(4)]
            start = time.perf_counter()
            fit_records(records, n=chain.n, springs=(True,) * (chain.n + 1))
            spent.append(time.perf_counter() - start)
        print(f"  {name}: median {1e3 * np.median(spent):.0f} ms, worst {1e3 * max(spent):.0f} ms")


def coverage() -> None:
    print(f"presets, {N_SEEDS} seeds each")
    print("  preset       noise [cm]  converged  inside: mean  worst  rms z  chi²/dof")
    for name, chain in PRESETS.items():
        truth = np.array(list(chain.parameters().values()))
        for noise in NOISES:
            rng = np.random.default_rng(1)
            z, converged, chi_square = [], 0, []
            for _ in range(N_SEEDS):
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
                fit = fit_records(records, n=chain.n, springs=(True,) * (chain.n + 1))
                value = np.array([p.value for p in fit.parameters.values()])
                std = np.array([p.std for p in fit.parameters.values()], dtype=float)
                z.append((value - truth) / std)
                converged += fit.converged
                chi_square.append(fit.chi_square_per_dof)
            inside = np.mean(np.abs(z) < 1.96, axis=0)
            print(
                f"  {name}  {noise:<10} {converged / N_SEEDS:>9.1%}  {np.mean(inside):>12.1%}  "
                f"{np.min(inside):.1%}  {np.sqrt(np.mean(np.square(z))):.2f}  "
                f"{np.mean(chi_square):.2f}"
            )


def convergence() -> None:
    print(f"{N_CHAINS} random chains of 1 to 4 carts, three steps each")
    rng = np.random.default_rng(2)
    found, starts, spent = 0, 0, []
    for i in range(N_CHAINS):
        n = 1 + i % 4
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
        start = time.perf_counter()
        fit = fit_records(records, n=n, springs=springs)
        spent.append(time.perf_counter() - start)
        found += bool(fit.converged and np.max(np.abs(fit.chain.m / chain.m - 1)) < 0.1)
        starts += fit.n_starts
    print(
        f"  found {found / N_CHAINS:.1%}, {starts / N_CHAINS:.2f} starts, "
        f"median {1e3 * np.median(spent):.0f} ms"
    )


if __name__ == "__main__":
    times()
    convergence()
    coverage()
