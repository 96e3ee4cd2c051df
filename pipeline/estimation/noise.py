"""The noise of a signal, its turning points and plateaus, and errors under correlation."""

from functools import lru_cache
from math import comb

import numpy as np

from pipeline.arrays import Array

# --------------------------------------------------------------- noise, and correlated residuals

_NEIGHBOURS = (-3, -2, -1, 1, 2, 3)  # a quintic through these follows any sampled motion
MEDIAN_TO_SIGMA = 1.4826  # standard deviation over median absolute value, for normal noise


def local_noise(t: Array, y: Array) -> float:
    """Return the noise's standard deviation (rounding included), from sample to sample.

    Each sample is compared with the quintic through its six neighbours at their own times, so
    neither the motion nor an uneven clock counts as noise. The result is 0 for fewer than seven
    samples.
    """
    if t.size < 7:
        return 0.0
    weights, size = _weights(t.tobytes())
    predicted = np.einsum("jn,jn->n", weights, _neighbours(y))
    scaled = (y[3:-3] - predicted) / size
    moving = scaled[scaled != 0]  # zeros, at rest on one count, do not show the noise
    return float(MEDIAN_TO_SIGMA * np.median(np.abs(moving))) if moving.size else 0.0


@lru_cache(2)  # the carts of a record have the same times
def _weights(clock: bytes) -> tuple[Array, Array]:
    """Return Lagrange's weights (6, n - 6) of the neighbours, and their gain for white noise."""
    t = np.frombuffer(clock)
    nodes = _neighbours(t) - t[3:-3]
    weights = np.empty_like(nodes)
    for j, node in enumerate(nodes):
        others = nodes[np.arange(len(nodes)) != j]
        weights[j] = np.prod(others / (others - node), axis=0)
    return weights, np.sqrt(1 + np.einsum("jn,jn->n", weights, weights))


def _neighbours(x: Array) -> Array:
    """Return the six neighbours (6, n - 6) of every sample that has them."""
    return np.array([x[3 + j : x.size - 3 + j] for j in _NEIGHBOURS])


def difference_noise(y: Array, *, order: int) -> Array:
    """Return the noise's standard deviation of evenly sampled signals (…, n), from differences.

    The higher the order, the less of a smooth motion remains. The result comes from the median,
    which ignores jumps. It is zero for a cart that rests on one count.
    """
    differences = np.diff(y, n=order, axis=-1)
    return MEDIAN_TO_SIGMA * np.median(np.abs(differences), axis=-1) / difference_gain(order)


def difference_gain(order: int) -> float:
    """Return the standard deviation of a difference of white noise, relative to the noise."""
    return float(np.sqrt(comb(2 * order, order)))


def high_frequency_noise(residual: Array, *, half_width: int = 4) -> float:
    """Return the noise of a residual, as its deviation from a local quadratic fit."""
    width = 2 * half_width + 1
    if residual.size < 2 * width:
        return float(residual.std())
    offsets = np.arange(-half_width, half_width + 1.0)
    basis = np.vander(offsets, 3)
    smoother = np.linalg.pinv(basis)[-1]  # the fitted value in the middle
    rest = residual - np.convolve(residual, smoother[::-1], mode="same")
    rest = rest[half_width:-half_width]
    gain = 1.0 - 2.0 * smoother[half_width] + float(smoother @ smoother)
    return float(np.sqrt(np.mean(rest**2) / gain))


def resolution(t: Array, y: Array, *, step: float) -> float:
    """Return the smallest significant change: the encoder step, or the noise if that is larger.

    To compare the two, noise sigma is converted to sqrt(12) sigma, the step whose rounding error is
    sigma. `step` is the encoder step, 0 if unknown.
    """
    arithmetic = 1e-6 * float(np.ptp(y))  # for a simulation, which has neither noise nor steps
    return max(step, float(np.sqrt(12) * local_noise(t, y)), arithmetic)


def rounding_left(rms: float, *, step: float) -> float:
    """Return the share (0 to 1) of the rounding error that remains after averaging.

    Noise sigma before the rounding, which follows from the residual's `rms`, acts as dither: the
    first harmonic of the rounding error shrinks by exp(-2 pi² sigma²/step²) (Widrow & Kollár,
    Quantization Noise, 2008, chapter 4).
    """
    sigma = noise_beyond_rounding(rms, step=step)
    return float(np.exp(-2 * (np.pi * sigma / step) ** 2)) if step > 0 else 0.0


def noise_beyond_rounding(rms: float, *, step: float) -> float:
    """Return the noise that remains when rounding is subtracted from a residual's rms."""
    return float(np.sqrt(max(rms**2 - step**2 / 12, 0.0)))


def _parzen(x: Array) -> Array:
    """Return Parzen's window at lags x; the last lag is 1."""
    return np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * np.clip(1 - x, 0.0, None) ** 3)


def relative_psd(residual: Array, *, angle: float) -> float:
    """Return the residual's spectral density at `angle` (rad per sample), relative to white noise.

    The factor multiplies the variance that a fitted sinusoid's coefficients have in white noise. It
    is at least 1, because the fit itself removes power at `angle`.
    """
    n = residual.size
    # Use at least eight lags of the residual's correlation.
    lags = min(max(8, int(np.sqrt(n))), n // 2)
    power = float(residual @ residual)
    if power == 0 or lags < 2:
        return 1.0
    correlation = np.array([residual[:-lag] @ residual[lag:] for lag in range(1, lags)]) / power
    wave = np.cos(angle * np.arange(1, lags))
    window = _parzen(np.arange(1, lags) / lags)
    return max(1.0, float(1 + 2 * np.sum(window * correlation * wave)))


def long_run_variance(residual: Array) -> float:
    """Return the variance of residuals (p, n) that governs the standard error of their mean.

    The residuals have mean zero. For white residuals the result is the mean square. If neighbouring
    samples agree it is larger; it is never smaller.
    """
    n = residual.shape[1]
    correlation = _tapered_correlation(residual)
    total = float(np.mean(np.einsum("jjl->jl", correlation).sum(axis=1))) / n
    return max(total, float(np.mean(residual**2)))


def score_covariance(residual: Array, jacobian: Array) -> Array:
    """Return the covariance (n_p, n_p) of sum(jacobian * residual) over carts and samples.

    The `residual` (p, n) is assumed to be stationary, and the carts may be correlated. `jacobian`
    is (n_p, p, n).
    """
    n = residual.shape[1]
    correlation = _tapered_correlation(residual)
    n_fft = correlation.shape[-1]
    spectrum = np.fft.rfft(correlation)  # (p, p, n_f)
    J = np.fft.rfft(jacobian, n_fft)  # (n_p, p, n_f)
    weight = np.full(J.shape[-1], 2.0)  # each frequency also represents its negative
    weight[[0, -1]] = 1.0
    coloured = np.einsum("jkf,qkf->qjf", spectrum.conj(), J) * (weight / (n * n_fft))
    n_p = jacobian.shape[0]
    meat = (J.conj().reshape(n_p, -1) @ coloured.reshape(n_p, -1).T).real
    return (meat + meat.T) / 2


def _tapered_correlation(residual: Array) -> Array:
    """Return sum_t r_j(t) r_k(t + lag) times Parzen's window, (p, p, n_fft), lags as in `fft`."""
    n = residual.shape[1]
    n_fft = 2 ** int(np.ceil(np.log2(2 * n)))
    R = np.fft.rfft(residual, n_fft)
    correlation = np.fft.irfft(R.conj()[:, None] * R, n_fft)
    lags = np.arange(n_fft)
    # At a rest after a step, residuals stay correlated for up to a third of the samples.
    x = np.minimum(lags, n_fft - lags) / max(n / 3, 1.0)
    return correlation * _parzen(x)


# ----------------------------------------------- turning points, and stretches of constant input


PROMINENCE = 6.0  # smallest significant changes by which the signal goes back at a turning point
MIN_SAMPLES = 12  # of a stretch to fit; enough for five unknowns and a residual


def extrema(y: Array, *, prominence: float) -> list[int]:
    """Return the indices of the turning points, ends included; maxima and minima alternate.

    A turning point counts once the signal has gone back by `prominence`. On a flat top, the middle
    sample is taken.
    """
    found: list[int] = []
    first = last = low = high = 0  # the current extreme is y[first] .. y[last]
    direction = 0
    values = y.tolist()  # reading Python floats one by one takes a third of the time
    for i, value in enumerate(values):
        if direction == 0:  # until a first change shows the direction
            low = i if value < values[low] else low
            high = i if value > values[high] else high
            if values[high] - values[low] >= prominence:
                direction = 1 if high > low else -1
                found.append(min(low, high))
                first = last = i
            continue
        ahead = (value - values[first]) * direction
        if ahead > 0:
            first = last = i
        elif ahead == 0 and i == last + 1:
            last = i
        elif -ahead >= prominence:
            found.append((first + last) // 2)
            first = last = i
            direction = -direction
    if direction:
        found.append(first)  # where the cart came to rest, if it did
    return found


def plateaus(u: Array) -> list[tuple[int, int]]:
    """Return [start, stop) of each stretch of constant input, in order.

    Constant means within 2 % of the input's range, or within its noise. A sine gives many short
    stretches, a slow edge a few; the caller decides how long a stretch must be.
    """
    noise = float(difference_noise(u, order=2)) if u.size > 2 else 0.0
    # Changes below 2 % of the range are noise of the logged input.
    tolerance = max(0.02 * float(np.ptp(u)), 6 * noise)
    found, start, held = [], 0, u[0]
    for i, value in enumerate(u.tolist()):
        if abs(value - held) > tolerance:
            found.append((start, i))
            start, held = i, value
    return [*found, (start, u.size)]
