"""The effect of correlated residuals on standard errors.

A chain fitted to carts with dry friction leaves smooth residuals, and an encoder at rest rounds the
same way for seconds. Neighbouring samples then carry the same information. If each sample counted
as independent, every standard error would be too small. This module computes the middle factor of
the sandwich estimator, which corrects for this.

Reference: W. Newey & K. West, Econometrica 55, 1987; the lag window is Parzen's.
"""

from functools import cache

import numpy as np

from pipeline.arrays import Array

# Lags to use, as a share of the samples. At a rest after a step, residuals stay correlated.
_LAGS_SHARE = 1 / 3


def _parzen(x: Array) -> Array:
    """Return Parzen's window at lags x; the last lag is 1."""
    return np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * np.clip(1 - x, 0.0, None) ** 3)


def colour(residual: Array, *, angle: float) -> float:
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
    return max(1.0, float(1 + 2 * np.sum(_window(lags) * correlation * wave)))


@cache
def _window(lags: int) -> Array:
    """Return Parzen's window at the lags 1 to `lags`."""
    return _parzen(np.arange(1, lags) / lags)


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
    x = np.minimum(lags, n_fft - lags) / max(_LAGS_SHARE * n, 1.0)
    return correlation * _parzen(x)
