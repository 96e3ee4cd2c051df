"""Measures of a step response: overshoot and settling time."""

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.limits import SETTLING_BAND


def overshoot_percent(y: Array, *, before: Array | float, level: Array | float) -> Array:
    """Return how far `y` (..., n) exceeds the final level, in percent of the change in level."""
    change = np.asarray(level, dtype=np.float64) - before
    past = (y - np.asarray(level)[..., None]) * np.sign(change)[..., None]
    return 100 * np.maximum(past.max(-1), 0.0) / np.abs(change)


def settling_time(
    t: Array, y: Array, *, before: Array | float, level: Array | float, noise: float = 0.0
) -> Array:
    """Return when `y` (..., n) enters the 2 % band for good, in s after t[0]; NaN if never.

    `noise` widens the band if a measured signal scatters by more than 2 %.
    """
    change = np.asarray(level, dtype=np.float64) - before
    band = np.maximum(SETTLING_BAND * np.abs(change), noise)
    outside = np.abs(y - np.asarray(level)[..., None]) > band[..., None]
    n_last = np.where(outside.any(-1), t.size - np.argmax(outside[..., ::-1], axis=-1), 0)
    return np.where(n_last < t.size, t[np.minimum(n_last, t.size - 1)] - t[0], np.nan)
