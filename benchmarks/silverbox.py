"""The gap workflow on the Silverbox, an electronic mass on a hardening spring, official split.

    python benchmarks/silverbox.py FOLDER     # with SNLS80mV.mat in it

Data: T. Wigren, J. Schoukens, Three free data sets for development and benchmarking in nonlinear
system identification, European Control Conference 2013. The search sees the training part alone;
the test parts are simulated from one second before, and the first 50 samples are not judged.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from pipeline.gap.data.runs import make_run
from pipeline.gap.explain import explain_gap
from pipeline.gap.fit.linearise import fresh_nuisance, simulate_run
from pipeline.gap.fit.structure import Candidate, Model, Structure
from pipeline.gap.types import Gap
from pipeline.plant.nonlinear.effects.base import AugmentedChain
from pipeline.results import Record

INTERVAL = 2**14 / 1e7  # s
TRAIN = (40650, 105712)
TESTS = {"multisine": (105712, 127400), "arrow": (100, 40575), "no extrapolation": (100, 32100)}
WARM_UP, SKIPPED = 600, 50  # samples


def cut(u: np.ndarray, y: np.ndarray, name: str, first: int, end: int) -> Record:
    """Return one stretch of the log as a record."""
    return Record(
        id=name,
        kind="sweep",
        t=np.asarray(np.arange(end - first) * INTERVAL, dtype=np.float64),
        u=u[first:end],
        y=y[None, first:end],
        carts=(1,),
        free=(1,),
        resolution=np.array([0.0]),
        hold="band_limited",
    )


def start_at(model: AugmentedChain, *, springs: tuple[bool, ...]) -> Model:
    """Return a model as the fits have it: its structure and its vector."""
    structure = Structure(springs=springs)
    for term in model.terms:
        signs = tuple(float(np.sign(v) or 1.0) for v in term.values)
        sizes = tuple(abs(v) for v in term.values)
        structure = structure.with_effect(
            Candidate(effect=term.effect, place=term.place, signs=signs, scales=sizes)
        )
    return structure.start(model.chain, [term.values for term in model.terms])


def test_error(gap: Gap, record: Record, *, skipped: int, zero: float) -> float:
    """Return the root-mean-square error (V) of the model on a record it has not seen."""
    run = make_run(record, n=1)
    model = start_at(gap.model, springs=(True, False))
    nuisance = fresh_nuisance(run)
    nuisance.zero[:] = zero
    simulated = simulate_run(model, run, nuisance)[0]
    return float(np.sqrt(np.mean((run.y[0] - simulated)[skipped:] ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description="The gap workflow on the Silverbox.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=20_000, help="of each training piece")
    options = parser.parse_args()
    data = loadmat(options.folder / "SNLS80mV.mat")
    u, y = data["V1"].ravel().astype(float), data["V2"].ravel().astype(float)
    first, end = TRAIN
    starts = np.linspace(first, end - options.samples, 3).astype(int)
    pieces = [cut(u, y, f"train-{s}", s, s + options.samples) for s in starts]
    wall, cpu = time.perf_counter(), time.process_time()
    gap = explain_gap(pieces, springs=(True, False), position_unit="V", tell=print)
    spent = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{gap.verdict} in {spent[0]:.1f} s, {spent[1]:.1f} s of a core")
    for found in gap.effects:
        print(f"  {found.effect.key}: {found.nrmse_before:.2%} -> {found.nrmse_after:.2%}")
        for name, value in found.parameters.items():
            print(f"    {name} {value.value:.4g} ± {value.std or 0:.1g} {value.unit}")
    zero = float(np.mean([trace.zero for trace in gap.traces if not trace.held_out]))
    for name, (a, b) in TESTS.items():
        lead = min(WARM_UP, a)
        record = cut(u, y, name, a - lead, b)
        error = test_error(gap, record, skipped=lead + SKIPPED, zero=zero)
        print(f"{name}: {1e3 * error:.3f} mV")


if __name__ == "__main__":
    main()
