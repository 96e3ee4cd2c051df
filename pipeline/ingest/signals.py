"""What the signals themselves tell: the encoder's step and the sign of the input."""

import numpy as np

from pipeline.plant.chain import Array

_MOST_LEVELS = 20_000  # an encoder on a lab cart has a few thousand counts over its travel
_ON_GRID = 0.15  # of a step, rms: farther off, the values are not multiples of one step
_LEAST_SHARE = 0.02  # of the work to and fro: less net work has no sure sign
_MIRRORED = 0.8  # of the samples in motion
_BLOCKS = 12  # a record is cut into so many to look for rest; a lab step settles within a few
_STILL = 0.02  # of the travel: the cart rests in a block that scatters less
_RESTS, _SURE = 5, 0.9  # so many rests correlate with the input so well (squared) by chance in
# one of a hundred records


def encoder_step(x: Array) -> float:
    """Return the step all values are multiples of, 0 where none is seen.

    The smallest distances between levels are one step; the step is refined by a line through all
    levels, which must lie on it.
    """
    levels = np.unique(x)
    span = levels[-1] - levels[0]
    if levels.size < 3:
        return 0.0
    distances = np.diff(levels)
    distances = distances[distances > span / _MOST_LEVELS / 2]
    if distances.size < 2:
        return 0.0
    smallest = distances.min()
    step = float(np.median(distances[distances < 1.5 * smallest]))
    counts = np.cumsum(np.round(distances / step))
    at = np.cumsum(distances)
    if counts[-1] > _MOST_LEVELS:
        return 0.0
    step = float(counts @ at / (counts @ counts))
    off_grid = distances / step - np.round(distances / step)
    return step if np.sqrt(np.mean(off_grid**2)) < _ON_GRID else 0.0


def mirrors(reference: Array, x1: Array) -> bool:
    """Tell a commanded position that only repeats encoder 1, as an ECP logs it in open loop.

    Both in counts. The copy is read a little later than the sample before and a little earlier
    than the sample itself, so it lies between the two; a true reference leads or waits.
    """
    moving = np.flatnonzero(np.diff(x1)) + 1
    if moving.size < 3 or np.ptp(reference) == 0.0:
        return False
    before, now, copy = x1[moving - 1], x1[moving], reference[moving]
    between = (copy >= np.minimum(before, now) - 1.0) & (copy <= np.maximum(before, now) + 1.0)
    return bool(np.mean(between) > _MIRRORED)


def input_sign(u: Array, x1: Array, *, closed_loop: bool, tied: bool = True) -> int:
    """Return the sign of the input that a passive plant allows, 0 where unsure.

    Where the cart comes to rest under different inputs, a larger input must hold it farther out,
    if springs tie it to a wall or a held cart: on none it may rest anywhere. Else the motor's
    work ∫ u dx_1, from rest and on springs and dampers, must be positive: the sum over held inputs
    is exact, it has to stand out from the work to and fro, and a log that is early or late by a
    sample must not change its sign (a feedback law is never early).
    """
    if np.ptp(u) == 0.0 or np.ptp(x1) == 0.0 or u.size < 2 * _BLOCKS:
        return 0
    at_rest = _sign_at_rest(u, x1) if tied else 0
    return at_rest or _sign_of_work(u, x1, closed_loop=closed_loop)


def _sign_at_rest(u: Array, x1: Array) -> int:
    length = u.size // _BLOCKS
    u_blocks, x_blocks = (a[: _BLOCKS * length].reshape(_BLOCKS, length) for a in (u, x1))
    resting = x_blocks.std(axis=1) < _STILL * np.ptp(x1)
    levels, positions = u_blocks.mean(axis=1)[resting], x_blocks.mean(axis=1)[resting]
    if levels.size < _RESTS or np.ptp(levels) < _STILL * np.ptp(u) or np.ptp(positions) == 0.0:
        return 0
    correlation = np.corrcoef(levels, positions)[0, 1]
    return int(np.sign(correlation)) if correlation**2 > _SURE else 0


def _sign_of_work(u: Array, x1: Array, *, closed_loop: bool) -> int:
    moves = np.diff(x1)
    works = [u[:-1] @ moves, u[:-2] @ moves[1:]]
    if not closed_loop:
        works.append(u[1:] @ moves)
    least = max(_LEAST_SHARE, 1 / np.sqrt(moves.size)) * float(np.abs(u[:-1] * moves).sum())
    signs = {int(np.sign(work)) if abs(work) > least else 0 for work in works}
    return signs.pop() if len(signs) == 1 else 0
