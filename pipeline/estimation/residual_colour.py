"""Residuals that are not white: what their correlation does to standard errors.

A chain fitted to carts with dry friction leaves smooth residuals, and an encoder at rest rounds
the same way for seconds: neighbouring samples then tell the same thing, and counting each as new
would make every standard error too small.

Reference: W. Newey & K. West, Econometrica 55, 1987; the lag window is Parzen's.
"""

import numpy as np

from pipeline.plant.chain import Array

_LAGS_SHARE = 1 / 3  # of the samples; a rest after a step is correlated as long as it lasts


def long_run_variance(residual: Array) -> float:
    """Return the variance (of zero-mean residuals (p, n)) that an average would shrink from.

    The mean square for white residuals, more where neighbours agree; never less.
    """
    n = residual.shape[1]
    correlation = _tapered_correlation(residual)
    total = float(np.mean(np.einsum("jjl->jl", correlation).sum(axis=1))) / n
    return max(total, float(np.mean(residual**2)))


def score_covariance(residual: Array, slopes: Array) -> Array:
    """Return the covariance (n_p, n_p) of sum(slopes * residual) over carts and samples.

    `residual` (p, n) is taken as stationary, its carts as correlated; `slopes` (n_p, p, n).
    """
    n = residual.shape[1]
    correlation = _tapered_correlation(residual)
    n_fft = correlation.shape[-1]
    spectrum = np.fft.rfft(correlation)  # (p, p, n_f)
    J = np.fft.rfft(slopes, n_fft)  # (n_p, p, n_f)
    weight = np.full(J.shape[-1], 2.0)  # each frequency stands for its negative too
    weight[[0, -1]] = 1.0
    coloured = np.einsum("jkf,qkf->qjf", spectrum.conj(), J) * (weight / (n * n_fft))
    n_p = slopes.shape[0]
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
    window = np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * np.clip(1 - x, 0.0, None) ** 3)
    return correlation * window
