"""Amplitude spectra of a run, computed from all samples and thinned to what a plot can show."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array

MOST_LINES = 400  # lines on a logarithmic axis; finer than a screen can show


def amplitude_spectrum(t: Array, y: Array) -> tuple[Array, Array]:
    """Return frequencies (f,) in rad/s, without zero, and amplitudes (…, f) of signals (…, n).

    The mean is subtracted. A Hann window reduces leakage from the ends; it is scaled so that a sine
    at the frequency of a line has its true amplitude. Samples that are not evenly spaced are
    interpolated.
    """
    even = np.linspace(t[0], t[-1], t.size)
    if np.max(np.abs(even - t)) > 1e-6 * (t[-1] - t[0]):
        flat = y.reshape(-1, t.size)
        y = np.array([np.interp(even, t, row) for row in flat]).reshape(y.shape)
    window = np.hanning(t.size)
    lines = np.fft.rfft((y - y.mean(axis=-1, keepdims=True)) * window)
    step = 2.0 * np.pi / (even[-1] - even[0]) * (t.size - 1) / t.size
    omega = step * np.arange(1, lines.shape[-1])
    return omega, 2.0 / window.sum() * np.abs(lines[..., 1:])


def thin_lines(amplitudes: Sequence[Array]) -> tuple[NDArray[np.intp], list[Array]]:
    """Return the indices (k,) of the lines to keep, and each spectrum's values (k,) at these lines.

    Lines that are close together on the logarithmic axis are merged into one, with their largest
    value, so every peak stays. Its frequency is where the first spectrum is largest.
    """
    count = amplitudes[0].size
    if count <= MOST_LINES:
        return np.arange(count), list(amplitudes)
    edges = np.unique(np.round(np.geomspace(1, count + 1, MOST_LINES + 1)).astype(int)) - 1
    starts = edges[:-1]
    pieces = [slice(a, b) for a, b in pairwise(edges.tolist())]
    kept = starts + np.array([int(np.argmax(amplitudes[0][piece])) for piece in pieces])
    return kept, [np.maximum.reduceat(one, starts) for one in amplitudes]
