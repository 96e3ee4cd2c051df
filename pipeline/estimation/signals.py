"""What several time-domain stages ask of a measured signal: its noise, extrema and plateaus."""

from functools import cache

import numpy as np

from pipeline.plant.chain import Array

_NEIGHBOURS = (-3, -2, -1, 1, 2, 3)  # a quintic through these follows any motion we sample
_MEDIAN_TO_SIGMA = 1.4826  # median absolute value to standard deviation, normal noise
_FLAT_INPUT = 0.02  # of the input's range: smaller changes are noise of the logged input
_MIN_LAGS = 8  # lags of the residual's correlation that are always looked at


def local_noise(t: Array, y: Array) -> float:
    """Return the noise's standard deviation (rounding included), from sample to sample.

    Each sample is compared with the quintic through its six neighbours at their own times, so
    neither the motion nor an uneven clock counts as noise. 0 for fewer than seven samples.
    """
    if t.size < 7:
        return 0.0
    nodes = _neighbours(t) - t[3:-3]  # (6, n - 6)
    weights = np.empty_like(nodes)  # Lagrange's, at zero
    for j, node in enumerate(nodes):
        others = nodes[np.arange(len(nodes)) != j]
        weights[j] = np.prod(others / (others - node), axis=0)
    predicted = np.einsum("jn,jn->n", weights, _neighbours(y))
    scaled = (y[3:-3] - predicted) / np.sqrt(1 + np.einsum("jn,jn->n", weights, weights))
    moving = scaled[scaled != 0]  # a cart at rest on one count says nothing about the noise
    return float(_MEDIAN_TO_SIGMA * np.median(np.abs(moving))) if moving.size else 0.0


def _neighbours(x: Array) -> Array:
    """Return the six neighbours (6, n - 6) of every sample that has them."""
    return np.array([x[3 + j : x.size - 3 + j] for j in _NEIGHBOURS])


def grain(t: Array, y: Array, *, step: float) -> float:
    """Return the smallest change that means something: encoder step or noise, if larger.

    Noise counts by the step that would round as coarsely, sqrt(12) sigma. `step` is the encoder
    step, 0 where none is known.
    """
    arithmetic = 1e-6 * float(np.ptp(y))  # a noise-free simulation has neither
    return max(step, float(np.sqrt(12) * local_noise(t, y)), arithmetic)


def rounding_left(sigma: float, *, step: float) -> float:
    """Return which part (0 to 1) of the rounding error averaging leaves, with noise `sigma`.

    Noise before the rounding acts as dither: the first harmonic of the rounding error shrinks
    by exp(-2 pi² sigma²/step²) (Widrow & Kollár, Quantization Noise, 2008, chapter 4).
    """
    return float(np.exp(-2 * (np.pi * sigma / step) ** 2)) if step > 0 else 0.0


def noise_beyond_rounding(rms: float, *, step: float) -> float:
    """Return the noise that a residual's root-mean-square holds on top of the rounding."""
    return float(np.sqrt(max(rms**2 - step**2 / 12, 0.0)))


def colour(residual: Array, *, angle: float) -> float:
    """Return the residual's spectral density at `angle` (rad per sample) over its mean; >= 1.

    The variance of a fitted sinusoid's coefficients is that of white noise times this factor.
    Parzen's lag window; never below one, because the fit itself takes power out at `angle`.
    """
    n = residual.size
    lags = min(max(_MIN_LAGS, int(np.sqrt(n))), n // 2)
    power = float(residual @ residual)
    if power == 0 or lags < 2:
        return 1.0
    correlation = np.array([residual[:-lag] @ residual[lag:] for lag in range(1, lags)]) / power
    wave = np.cos(angle * np.arange(1, lags))
    return max(1.0, float(1 + 2 * np.sum(_parzen(lags) * correlation * wave)))


@cache
def _parzen(lags: int) -> Array:
    """Return Parzen's window at the lags from 1 on."""
    x = np.arange(1, lags) / lags
    return np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)


def extrema(y: Array, *, prominence: float) -> list[int]:
    """Return the indices of the turning points, maxima and minima in turn, ends included.

    A turning point counts once the signal has gone back by `prominence`. On a flat top the
    middle sample is taken.
    """
    found: list[int] = []
    first = last = low = high = 0  # the running extreme is y[first] .. y[last]
    direction = 0
    for i, value in enumerate(y):
        if direction == 0:  # until the first move shows which way it goes
            low = i if value < y[low] else low
            high = i if value > y[high] else high
            if y[high] - y[low] >= prominence:
                direction = 1 if high > low else -1
                found.append(min(low, high))
                first = last = i
            continue
        ahead = (value - y[first]) * direction
        if ahead > 0:
            first = last = i
        elif ahead == 0 and i == last + 1:
            last = i
        elif -ahead >= prominence:
            found.append((first + last) // 2)
            first = last = i
            direction = -direction
    if direction:
        found.append(first)  # a cart that has come to rest: where it got there
    return found


def plateaus(u: Array) -> list[tuple[int, int]]:
    """Return [start, stop) of each stretch of constant input, in order.

    Constant means: within 2 % of the input's range, or within its noise. A sine gives many short
    stretches, a slow edge a few; how long a stretch must be, the caller knows.
    """
    noise = (
        _MEDIAN_TO_SIGMA * float(np.median(np.abs(np.diff(u, n=2)))) / np.sqrt(6)
        if u.size > 2
        else 0.0
    )
    tolerance = max(_FLAT_INPUT * float(np.ptp(u)), 6 * noise)
    found, start = [], 0
    for i, value in enumerate(u):
        if abs(value - u[start]) > tolerance:
            found.append((start, i))
            start = i
    return [*found, (start, u.size)]
