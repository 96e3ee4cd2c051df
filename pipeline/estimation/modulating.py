"""Modulating functions: average an equation of motion over windows, without derivatives of data.

The equation is multiplied by a bump, which is zero at both ends of a window, as are its first three
derivatives. Then it is integrated by parts: the derivatives move from the data to the known bump.
The result is linear in masses, dampings and springs.

References: M. Shinbrot, Trans. ASME 79 (1957), 579-588; H. A. Preisig & D. W. T. Rippin, Computers
& Chemical Engineering 17 (1993).
"""

import numpy as np

from pipeline.arrays import Array


def bump(s: Array, *, span: Array | float) -> tuple[Array, Array, Array]:
    """Return (s (1 - s))⁴ for s from 0 to 1 over `span` seconds, and two time derivatives."""
    b, slope = s * (1 - s), 1 - 2 * s
    return b**4, 4 * b**3 * slope / span, (12 * b**2 * slope**2 - 8 * b**3) / span**2


def motion_period(x: Array) -> float:
    """Return the period, in samples, of a sine with the same size and speed as this motion."""
    return float(2 * np.pi * np.std(x) / np.sqrt(np.mean(np.diff(x) ** 2)))


def bump_integral(s: Array) -> Array:
    """Return the integral of the bump from 0 to s; these are the weights for a held input."""
    return s**5 * np.polyval([1 / 9, -1 / 2, 6 / 7, -2 / 3, 1 / 5], s)


def is_even(t: Array) -> bool:
    """Return whether the intervals between times (n,) differ only by rounding."""
    dt = np.diff(t)
    return bool(np.ptp(dt) <= 1e-9 * dt[0])


def window_weights(t: Array) -> tuple[Array, Array, Array]:
    """Return weights (windows, samples) for the mean, the negative mean slope, and the curvature.

    With few samples the bump's derivatives are integrated badly. So the weights are corrected to be
    exact for parabolas.

    Parameters
    ----------
    t : times (windows, samples) of the samples in each window, s.
    """
    span = t[:, -1:] - t[:, :1]
    w, w1, w2 = bump((t - t[:, :1]) / span, span=span)
    dt = np.gradient(t, axis=1)
    size = (w * dt).sum(1, keepdims=True)
    w, w1, w2 = (weight * dt / size for weight in (w, w1, w2))
    tau = t - (w * t).sum(1, keepdims=True)
    spread = (w * tau**2).sum(1, keepdims=True)
    w2 = w2 - w * w2.sum(1, keepdims=True) - w * tau * (w2 * tau).sum(1, keepdims=True) / spread
    w2 = 2 * w2 / (w2 * tau**2).sum(1, keepdims=True)
    w1 = w1 - w * w1.sum(1, keepdims=True)
    w1 = -w1 / (w1 * tau).sum(1, keepdims=True)
    return w, w1, w2
