"""Properties of single channels: an encoder's step, a mirror, a stuck encoder, a clipped input."""

import numpy as np

from pipeline.arrays import Array

_MOST_LEVELS = 20_000  # an encoder on a lab cart has a few thousand counts over its travel


def encoder_step(x: Array) -> float:
    """Return the step of which all values are multiples, 0 without such a step.

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
    # Of a step, rms: farther off, the values are not multiples of one step.
    return step if np.sqrt(np.mean(off_grid**2)) < 0.15 else 0.0


def mirrors(reference: Array, x1: Array) -> bool:
    """Return whether a commanded position only repeats encoder 1, as an ECP logs it in open loop.

    Both in counts. The copy is read a little later than the sample before and a little earlier than
    the sample itself, so it lies between the two; a true reference leads or lags.
    """
    moving = np.flatnonzero(np.diff(x1)) + 1
    if moving.size < 3 or np.ptp(reference) == 0.0:
        return False
    before, now, copy = x1[moving - 1], x1[moving], reference[moving]
    between = (copy >= np.minimum(before, now) - 1.0) & (copy <= np.maximum(before, now) + 1.0)
    # Of the samples in motion.
    return bool(np.mean(between) > 0.8)


def stuck_spans(x: Array) -> list[tuple[int, int]]:
    """Return (first, last) sample of every stretch in which a moving encoder stood still.

    The reading freezes at speed and, if it comes back, comes back with a jump; a cart that stops
    slows down first. A coarse encoder does not show speed: there only the jump counts, if it is far
    larger than any other move.
    """
    moves = np.abs(np.diff(x))
    # At rest for this long at a turning point a cart moves less than one step.
    still = [run for run in _runs(moves == 0.0, least=10) if run[0] > 0]
    moving = moves[moves > 0]
    if not still or moving.size < 3:
        return []
    # Encoder steps a sample: no cart stops from that speed between two samples.
    abrupt = 5.0 * (encoder_step(x) or float(np.median(moving)))
    after = [last for _, last in still if last < moves.size]
    # Times the fastest other move between two samples: no cart starts so from rest.
    jump = max(abrupt, 1.5 * float(np.delete(moves, after).max(initial=0.0)))

    def is_stuck(first: int, last: int) -> bool:
        on = moves[last : last + 2]  # it may move on between two samples
        back = bool(on.max(initial=np.inf if last == moves.size else 0.0) >= abrupt)
        return (moves[first - 1] >= abrupt and back) or bool(on[:1].max(initial=0.0) >= jump)

    return [(first, last) for first, last in still if is_stuck(first, last)]


def _runs(still: np.ndarray, *, least: int) -> list[list[int]]:
    """Return [first, last] of each run of `least` equal samples or more.

    still[i]: x[i] = x[i + 1].
    """
    runs = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])))).reshape(-1, 2)
    return runs[runs[:, 1] - runs[:, 0] + 1 >= least].tolist()


def saturation(u: Array) -> float | None:
    """Return the limit at which a varied input was clipped, or None.

    A clipped input enters its extreme with a jump, holds it, leaves with a jump, and takes it far
    more often than the next value. The crest of a sine, even if rounded to a few digits, does not,
    nor does a controller that creeps up to its last value.
    """
    levels, counts = np.unique(u, return_counts=True)
    # A stepped input with few levels is at its extremes by design.
    if levels.size <= 20:
        return None
    for top, following in ((-1, -2), (0, 1)):
        limit, gap = levels[top], abs(levels[top] - levels[following])
        # This many times as often as the next level; the rounded crest of a sine takes it 1.4
        # times.
        if limit == 0.0 or counts[top] < 5 * counts[following]:
            continue
        at_limit = u == limit
        for first, last in _runs(at_limit[:-1] & at_limit[1:], least=3):
            entry = abs(limit - u[first - 1]) if first > 0 else np.inf
            leave = abs(limit - u[last + 1]) if last + 1 < u.size else np.inf
            m = last - first + 1
            # m samples of a crest, a parabola, are within one level if it falls by this many to the
            # next; rounding adds one.
            if min(entry, leave) > max(3, 4 * m / (m - 1) ** 2 + 1) * gap:
                return abs(float(limit))
    return None


def never_changes(name: str) -> str:
    """Return a sentence if a position stands still while another or the input changes."""
    return f"{name!r} never changes: a held cart, or an encoder that is stuck"


def channel_problems(t: Array, u: Array | None, positions: dict[str, Array]) -> list[str]:
    """Return the faults of the input and the positions (heading to values), in words."""
    problems = []
    moving = any(np.ptp(x) > 0 for x in positions.values())
    for name, x in positions.items():
        if np.ptp(x) == 0.0 and (moving or (u is not None and np.ptp(u) > 0)):
            problems.append(never_changes(name))
        problems += [
            f"{name!r} stands still while the cart moves fast, from {t[first]:.4g} s to "
            f"{t[last]:.4g} s: "
            "the encoder stuck"
            for first, last in stuck_spans(x)[:3]
        ]
    if u is not None and (limit := saturation(u)) is not None:
        problems.append(f"the input is clipped at {limit:g}")
    return problems
