"""Count the independent readings of a residual."""

import numpy as np

from pipeline.arrays import Array


def independent(residual: Array) -> float:
    """Return the number of independent readings in a residual (samples,).

    A mean square of n correlated points is as certain as one of n / (1 + 2 Σ ρ²) independent
    points. This holds for oscillations, not for a drift.

    Reference: M. S. Bartlett, Journal of the Royal Statistical Society 98 (1935), 536-543.
    """
    power = np.abs(np.fft.rfft(residual - residual.mean(), 2 * residual.size)) ** 2
    covariance = np.fft.irfft(power)[: residual.size]
    if covariance[0] <= 0.0:
        return float(residual.size)
    correlation = covariance[1:] / covariance[0]
    return residual.size / (1.0 + 2.0 * float((correlation**2).sum()))
