"""One step of a fit, inside bounds."""

from collections.abc import Callable

import numpy as np

from pipeline.arrays import Array


def bounded_step(
    at: Array,
    bounds: tuple[Array, Array, Array],
    active: np.ndarray,
    *,
    solve: Callable[[np.ndarray], Array],
    rounds: int,
) -> Array:
    """Return a step of the parameters `at` (size,), inside their bounds and their reach.

    `bounds` are lower, upper, and how far each may go at once. `solve` gives the step of those that
    are `active`, by index. One at a bound, with the step pointing outward, stays, and the others
    are solved for again, for as many `rounds`.
    """
    low, high, reach = bounds
    delta = np.zeros(at.size)
    for _ in range(rounds):
        if not active.size:
            break
        step = solve(active)
        here = at[active]
        out = (here + step <= low[active]) & (here <= low[active])
        out |= (here + step >= high[active]) & (here >= high[active])
        if not out.any():
            delta[active] = step
            break
        active = active[~out]
    # One long step must not carry the others with it: each is clipped by itself.
    return np.clip(at + np.clip(delta, -reach, reach), low, high) - at
