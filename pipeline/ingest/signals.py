"""What the signals themselves tell: the encoder's step, and what only mirrors an encoder."""

import numpy as np

from pipeline.plant.chain import Array

_MOST_LEVELS = 20_000  # an encoder on a lab cart has a few thousand counts over its travel
_ON_GRID = 0.15  # of a step, rms: farther off, the values are not multiples of one step
_MIRRORED = 0.8  # of the samples in motion


def encoder_step(x: Array) -> float:
    """Return the step all values are multiples of, 0 where none is seen.

    The smallest distances between levels are one step; the step is refined by a line through all
    levels, which must lie on it.
    """
    levels = np.unique(x)
    span = levels[-1] - levels[0]
    if levels.size < 3:
        return 0.0
    distances = np.diff(levels)
    distances = distances[distances > span / _MOST_LEVELS / 2]
    if distances.size < 2:
        return 0.0
    smallest = distances.min()
    step = float(np.median(distances[distances < 1.5 * smallest]))
    counts = np.cumsum(np.round(distances / step))
    at = np.cumsum(distances)
    if counts[-1] > _MOST_LEVELS:
        return 0.0
    step = float(counts @ at / (counts @ counts))
    off_grid = distances / step - np.round(distances / step)
    return step if np.sqrt(np.mean(off_grid**2)) < _ON_GRID else 0.0


def mirrors(reference: Array, x1: Array) -> bool:
    """Tell a commanded position that only repeats encoder 1, as an ECP logs it in open loop.

    Both in counts. The copy is read a little later than the sample before and a little earlier
    than the sample itself, so it lies between the two; a true reference leads or waits.
    """
    moving = np.flatnonzero(np.diff(x1)) + 1
    if moving.size < 3 or np.ptp(reference) == 0.0:
        return False
    before, now, copy = x1[moving - 1], x1[moving], reference[moving]
    between = (copy >= np.minimum(before, now) - 1.0) & (copy <= np.maximum(before, now) + 1.0)
    return bool(np.mean(between) > _MIRRORED)
