"""Find the turning points of a signal, and stretches of constant input."""

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.noise import difference_noise


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
