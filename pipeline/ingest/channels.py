"""What a single channel shows: an encoder's step, a copy, a stuck encoder, clipping, a sine."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, true_runs
from pipeline.ingest.table import Note

_MOST_LEVELS = 20_000  # an encoder on a lab cart has a few thousand counts over its travel


def encoder_step(x: Array) -> float:
    """Return the step of which all values are multiples, 0 if there is no such step.

    The smallest distances between levels are one step. A straight line through all levels then
    gives the step more precisely; the levels must lie on that line.
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
    # With a larger rms distance (in steps), the values are not multiples of one step.
    return step if np.sqrt(np.mean(off_grid**2)) < 0.15 else 0.0


def little_motion(ranges: Mapping[int, float]) -> tuple[int, ...]:
    """Return the carts that move less than 5 % as far as another cart, from their ranges."""
    return tuple(cart for cart, range_ in ranges.items() if range_ < 0.05 * max(ranges.values()))


def settles_at_input(u: Array, x: Array) -> bool:
    """Return whether a position in counts settles at the number in the input column.

    Under feedback, it does so if the column holds the set point. In open loop, this is chance.
    """
    edges = find_edges(u)
    if not 0 < edges.size <= 20 or not (_are_counts(u) and _are_counts(x)):
        return False
    pieces = np.split(np.arange(u.size), edges)
    rest, moved = pieces[0], max(pieces[1:], key=lambda piece: abs(u[piece[0]] - u[0]) * piece.size)
    step = float(u[moved[0]] - u[0])
    settled = float(np.mean(x[moved[-(moved.size // 4 + 1) :]]) - np.median(x[rest]))
    # A set point in counts is at least 100.
    return abs(step) >= 100 and abs(abs(settled / step) - 1) < 0.03


def _are_counts(x: Array) -> bool:
    return bool(np.all(np.abs(x - np.rint(x)) < 1e-6))  # a scale leaves rounding errors


def mirrors(reference: Array, x1: Array) -> bool:
    """Return whether a commanded position only repeats encoder 1, as in ECP's open-loop logs.

    Both are in counts. The copy is read slightly before the encoder's own sample, so its value lies
    between that sample and the previous one. A real reference leads or lags.
    """
    moving = np.flatnonzero(np.diff(x1)) + 1
    if moving.size < 3 or np.ptp(reference) == 0.0:
        return False
    before, now, copy = x1[moving - 1], x1[moving], reference[moving]
    between = (copy >= np.minimum(before, now) - 1.0) & (copy <= np.maximum(before, now) + 1.0)
    # Most samples in motion must agree.
    return bool(np.mean(between) > 0.8)


def stuck_spans(x: Array) -> list[tuple[int, int]]:
    """Return (first, last) sample of every stretch in which a moving cart's encoder was stuck.

    A stuck reading stops abruptly while the cart moves and continues, if at all, with a jump. A
    cart that really stops slows down first. A coarse encoder does not show the speed; then only the
    jump counts, and it must be far larger than any other change.
    """
    moves = np.abs(np.diff(x))
    # A cart at a turning point may rest for fewer samples than this.
    still = [run for run in true_runs(moves == 0.0) if run[0] > 0 and run[1] - run[0] >= 9]
    moving = moves[moves > 0]
    if not still or moving.size < 3:
        return []
    # No cart stops between two samples from a speed of five encoder steps per sample.
    abrupt = 5.0 * (encoder_step(x) or float(np.median(moving)))
    after = [last for _, last in still if last < moves.size]
    # No cart starts from rest with a change that is 1.5 times the largest other one.
    jump = max(abrupt, 1.5 * float(np.delete(moves, after).max(initial=0.0)))

    def is_stuck(first: int, last: int) -> bool:
        on = moves[last : last + 2]  # the jump may take two samples
        back = last == moves.size or bool(on.max() >= abrupt)
        return (moves[first - 1] >= abrupt and back) or bool(on[:1].max(initial=0.0) >= jump)

    return [(first, last) for first, last in still if is_stuck(first, last)]


def saturation(u: Array) -> float | None:
    """Return the level at which the input was clipped; None if it was not clipped.

    A clipped input jumps to its extreme, stays there and jumps back. Far more samples are at the
    extreme than at the next level. This does not hold for the crest of a sine, even if it is
    rounded to a few digits. Nor does it hold for a controller that slowly approaches its final
    value. An input with few levels, such as a step, is never called clipped.
    """
    levels, counts = np.unique(u, return_counts=True)
    # An input with few levels, such as a step, has its extremes by design.
    if levels.size <= 20:
        return None
    for top, following in ((-1, -2), (0, 1)):
        limit, gap = levels[top], abs(levels[top] - levels[following])
        # The limit must be five times as frequent as the next level; for a rounded sine the factor
        # is 1.4.
        if limit == 0.0 or counts[top] < 5 * counts[following]:
            continue
        for first, stop in true_runs(u == limit):
            m = stop - first
            if m < 3:
                continue
            entry = abs(limit - u[first - 1]) if first > 0 else np.inf
            leave = abs(limit - u[stop]) if stop < u.size else np.inf
            # Limit of the jump at both ends, in levels. The crest of a sine is a parabola: its m
            # samples can share one level only if the next sample is within this many levels.
            # Rounding adds one.
            if min(entry, leave) > max(3, 4 * m / (m - 1) ** 2 + 1) * gap:
                return abs(float(limit))
    return None


def find_edges(u: Array) -> NDArray[np.intp]:
    """Return the samples at which an input changes by more than 20 % of its range."""
    return np.flatnonzero(np.abs(np.diff(u)) > 0.2 * np.ptp(u)) + 1


def is_stepped(u: Array) -> bool:
    """Return whether the input is constant between a few edges."""
    edges = find_edges(u)
    # A sweep has more edges.
    if edges.size > 20:
        return False
    pieces = np.split(u, edges)
    spread = np.sqrt(sum(((piece - np.median(piece)) ** 2).sum() for piece in pieces) / u.size)
    # Between edges the input may vary by 3 % of its range (rms). A constant input may have been
    # switched on at the first sample.
    return bool(spread <= 0.03 * np.ptp(u))


def line_frequency(t: Array, u: Array) -> float | None:
    """Return the frequency (Hz) of an input; None if it is not a single sine."""
    even = np.linspace(t[0], t[-1], t.size)
    signal = np.interp(even, t, u)
    power = np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(t.size))) ** 2
    peak = int(np.argmax(power))
    line = slice(max(peak - 2, 0), peak + 3)
    # A dwell has 90 % of the input's power in one spectral line.
    if power[line].sum() < 0.9 * power.sum():
        return None
    centre = float(np.arange(power.size)[line] @ power[line] / power[line].sum())
    return centre / float(t[-1] - t[0]) * (t.size - 1) / t.size


def never_changes(name: str) -> Note:
    """Return the sentence for a position that stays constant while another signal changes."""
    said = f"{name!r} never changes: a held cart, or an encoder that is stuck"
    return Note(said, "never_changes", about=name)


def channel_problems(t: Array, u: Array | None, positions: dict[str, Array]) -> list[Note]:
    """Return the faults of the input and of the positions in words.

    The positions are given by heading.
    """
    problems = []
    moving = any(np.ptp(x) > 0 for x in positions.values())
    for name, x in positions.items():
        if np.ptp(x) == 0.0 and (moving or (u is not None and np.ptp(u) > 0)):
            problems.append(never_changes(name))
        problems += [
            Note(
                f"{name!r} stands still while the cart moves fast, from {t[first]:.4g} s to "
                f"{t[last]:.4g} s: the encoder was stuck",
                "stuck",
                about=name,
                at=(first, last),
            )
            for first, last in stuck_spans(x)[:3]
        ]
    if u is not None and (limit := saturation(u)) is not None:
        at = np.flatnonzero(np.abs(u) == limit)
        problems.append(Note(f"the input is clipped at {limit:g}", "clipped", at=at))
    return problems
