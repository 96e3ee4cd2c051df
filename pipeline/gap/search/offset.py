"""Find a constant force that explains the rest points of runs with different carts held.

On a linear chain, a constant force only shifts the rest position, like a wrong encoder zero. But if
other carts are held, other springs balance the same force.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.linearise import Nuisance
from pipeline.plant.chain import Chain


@dataclass(frozen=True, kw_only=True)
class Offset:
    """A constant force on a cart; its standard error comes from the scatter between runs."""

    cart: int
    force: float
    std: float


def find_offset(
    chain: Chain, runs: Sequence[GapRun], nuisance: Sequence[Nuisance]
) -> Offset | None:
    """Return the constant force that explains the fitted encoder zeros, if any is certain."""
    if not np.any(chain.k > 0):
        return None
    if len({run.free for run in runs}) == 1 and not any(run.at_rest for run in runs):
        return None  # the force would look like a wrong encoder zero
    best: tuple[float, Offset] | None = None
    total, step = 0.0, 0.0
    for run, one in zip(runs, nuisance, strict=True):
        zeros = one.zero[list(run.rows)]
        total += float(zeros @ zeros)
        step = max(step, float((run.sigma * np.sqrt(12.0)).max()))
    count = sum(len(run.rows) for run in runs)
    if np.sqrt(total / count) < limits.OFFSET_STEPS * step:
        return None
    for cart in range(1, chain.n + 1):
        gains = [_compliance(chain, run, cart) for run in runs]
        pairs = [
            (gain, one.zero[list(run.rows)])
            for gain, run, one in zip(gains, runs, nuisance, strict=True)
            if np.any(gain)
        ]
        forces = np.array([gain @ zero / (gain @ gain) for gain, zero in pairs])
        if forces.size < 3:
            continue
        unexplained = total - sum(
            float(zero @ zero - (zero - gain * forces.mean()) @ (zero - gain * forces.mean()))
            for gain, zero in pairs
        )
        smallest = step / np.sqrt(12.0) / max(float(np.abs(g).max()) for g, _ in pairs)
        std = max(float(forces.std(ddof=1)), smallest) / np.sqrt(forces.size)
        sure = abs(float(forces.mean())) > limits.OFFSET_SURE * std
        if (
            sure
            and unexplained < (1.0 - limits.OFFSET_SHARE) * total
            and (best is None or unexplained < best[0])
        ):
            best = (unexplained, Offset(cart=cart, force=float(forces.mean()), std=std))
    return best[1] if best else None


def _compliance(chain: Chain, run: GapRun, cart: int) -> Array:
    """Return the displacement of the measured carts under a unit force on one cart."""
    free = [i for i, moves in enumerate(run.free) if moves]
    if cart - 1 not in free:
        return np.zeros(len(run.rows))
    K = chain.stiffness[np.ix_(free, free)]
    unit = np.array([1.0 if i == cart - 1 else 0.0 for i in free])
    if np.linalg.cond(K) > 1e9:
        return np.zeros(len(run.rows))
    x = np.linalg.solve(K, unit)
    return np.array([x[free.index(row)] for row in run.rows])
