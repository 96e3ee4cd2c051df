"""Modulating functions: an equation of motion averaged over windows, the data never differentiated.

The equation is multiplied by a bump that vanishes at both ends of a window with its first three
derivatives, and integrated by parts: the derivatives move from the data to the bump, which is
known. What remains is linear in masses, dampings and springs.

Reference: M. Shinbrot, Trans. ASME 79 (1957), 579-588.
"""

import numpy as np

from pipeline.arrays import Array


def bump(s: Array, *, span: Array | float) -> tuple[Array, Array, Array]:
    """Return (s (1 - s))⁴ for s from 0 to 1 over `span` s, and two derivatives by time."""
    b, slope = s * (1 - s), 1 - 2 * s
    return b**4, 4 * b**3 * slope / span, (12 * b**2 * slope**2 - 8 * b**3) / span**2


def bump_integral(s: Array) -> Array:
    """Return the integral of the bump from 0 to s, for an input that is held between samples."""
    return s**5 * np.polyval([1 / 9, -1 / 2, 6 / 7, -2 / 3, 1 / 5], s)
