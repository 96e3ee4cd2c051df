"""How far one simulation of a whole record strays, started from its first readings."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.gap.data.runs import Run
from pipeline.gap.fit.levenberg_marquardt import Fit
from pipeline.gap.fit.linearise import Nuisance, fresh_nuisance, simulate_run
from pipeline.gap.types import FreeRun


def free_runs(fit: Fit, runs: Sequence[Run], nuisance: Sequence[Nuisance]) -> tuple[FreeRun, ...]:
    """Return the error of each run, all carts together, in the order of their ids.

    Of what was fitted to the run itself only the encoders' zeros are used.
    """
    found = []
    for run, own in zip(runs, nuisance, strict=True):
        zero = np.where(run.free, own.zero, 0.0)
        fresh = fresh_nuisance(replace(run, zero=zero))
        size = float(np.sqrt(np.mean((run.y - simulate_run(fit, run, fresh)) ** 2)))
        found.append(FreeRun(experiment=run.id, error=size if np.isfinite(size) else None))
    return tuple(sorted(found, key=lambda one: one.experiment))
