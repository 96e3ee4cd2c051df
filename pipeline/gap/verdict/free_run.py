"""The error of one simulation over a whole record, started from its first readings."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.levenberg_marquardt import GapFit
from pipeline.gap.fit.linearise import fresh_nuisance, simulate_run
from pipeline.gap.types import FreeRun


def free_runs(
    fit: GapFit, runs: Sequence[GapRun], zeros: Mapping[str, Array]
) -> tuple[FreeRun, ...]:
    """Return the error of each record, all carts together, ordered by record id.

    Of the values fitted to a record, only its encoder `zeros` (n,) are used. A record interrupted
    by a hand is simulated piece by piece, but counts as one.
    """
    squares: dict[str, list[Array]] = {}
    for run in runs:
        zero = np.where(run.free, zeros[run.id], 0.0)
        fresh = fresh_nuisance(replace(run, zero=zero))
        off = run.y - simulate_run(fit, run, fresh)
        squares.setdefault(run.id, []).append(off.ravel() ** 2)
    found = []
    for experiment, parts in sorted(squares.items()):
        size = float(np.sqrt(np.mean(np.concatenate(parts))))
        found.append(FreeRun(experiment=experiment, error=size if np.isfinite(size) else None))
    return tuple(found)
