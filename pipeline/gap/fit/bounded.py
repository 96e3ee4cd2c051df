"""One step of a fit, within bounds."""

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
    """Return a step of the parameters `at` (size,) within their bounds and step limits.

    `bounds` are the lower bounds, the upper bounds, and the largest step of each parameter. `solve`
    returns the step of the `active` parameters, given by index. A parameter at a bound that would
    step outward is fixed, and the others are solved again, at most `rounds` times.
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
    # Each step is clipped separately, so that a long step does not shorten the others.
    return np.clip(at + np.clip(delta, -reach, reach), low, high) - at
