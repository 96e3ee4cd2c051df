"""What sensors do to channels: steps, copies, a stuck encoder, clipping; and repairs of jumps.

No cart moves in one sample much farther than in the samples on each side, because that needs an
enormous force twice. So such a step is the sensor's doing: a counter that wrapped, a new zero, a
wrong reading, or a reading that was repeated until the next one came.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.ingest.columns import unit_symbol
from pipeline.ingest.table import FEW_NAMED
from pipeline.words.numbers import first_few

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
    still = [run for run in _runs(moves == 0.0, least=10) if run[0] > 0]
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
        back = bool(on.max(initial=np.inf if last == moves.size else 0.0) >= abrupt)
        return (moves[first - 1] >= abrupt and back) or bool(on[:1].max(initial=0.0) >= jump)

    return [(first, last) for first, last in still if is_stuck(first, last)]


def _runs(still: np.ndarray, *, least: int) -> list[list[int]]:
    """Return [first, last] of each stretch of at least `least` equal samples.

    still[i] means x[i] = x[i + 1].
    """
    runs = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])))).reshape(-1, 2)
    return runs[runs[:, 1] - runs[:, 0] + 1 >= least].tolist()


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
        at_limit = u == limit
        for first, last in _runs(at_limit[:-1] & at_limit[1:], least=3):
            entry = abs(limit - u[first - 1]) if first > 0 else np.inf
            leave = abs(limit - u[last + 1]) if last + 1 < u.size else np.inf
            m = last - first + 1
            # Limit of the jump at both ends, in levels. The crest of a sine is a parabola: its m
            # samples can share one level only if the next sample is within this many levels.
            # Rounding adds one.
            if min(entry, leave) > max(3, 4 * m / (m - 1) ** 2 + 1) * gap:
                return abs(float(limit))
    return None


def is_stepped(u: Array) -> bool:
    """Return whether the input is constant between a few edges."""
    # A change by 20 % of the input's range is an edge.
    edges = np.flatnonzero(np.abs(np.diff(u)) > 0.2 * np.ptp(u)) + 1
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


def never_changes(name: str) -> str:
    """Return the sentence for a position that stays constant while another signal changes."""
    return f"{name!r} never changes: a held cart, or an encoder that is stuck"


def channel_problems(t: Array, u: Array | None, positions: dict[str, Array]) -> list[str]:
    """Return the faults of the input and of the positions in words.

    The positions are given by heading.
    """
    problems = []
    moving = any(np.ptp(x) > 0 for x in positions.values())
    for name, x in positions.items():
        if np.ptp(x) == 0.0 and (moving or (u is not None and np.ptp(u) > 0)):
            problems.append(never_changes(name))
        problems += [
            f"{name!r} stands still while the cart moves fast, from {t[first]:.4g} s to "
            f"{t[last]:.4g} s: "
            "the encoder was stuck"
            for first, last in stuck_spans(x)[:3]
        ]
    if u is not None and (limit := saturation(u)) is not None:
        problems.append(f"the input is clipped at {limit:g}")
    return problems


# ----------------------------------------------------------------------------- repairs of positions

_SIDE = 8  # samples on each side of a step
_FARTHER = 4.0  # times as far as any step beside it
_STEPS = 12.0  # encoder steps, or times the noise; a smaller jump does no harm
_LEAST = 0.02  # share of the range
_MOST_BAD = 12  # readings in a row that a spike lasts
_MOST_SHARE = 0.05  # share of readings that may be wrong
_BITS = (8, 10, 12, 14, 16, 20, 24, 32)
_FEWEST_CHANGES = 20


@dataclass(frozen=True, kw_only=True)
class Repair:
    """One repair of a position.

    Attributes
    ----------
    key : "unwrap", "jumps", "spikes" or "repeats", as in `repair = { … }`.
    x : the repaired positions (n,).
    keep : the samples (n,) that remain.
    at : the samples concerned.
    message : what was done, without the samples.
    """

    key: str
    x: Array
    keep: NDArray[np.bool_]
    at: NDArray[np.intp]
    message: str


def repair_positions(
    t: Array,
    y: Mapping[str, Array],
    u: Array | None,
    *,
    unit: str,
    scales: Mapping[str, float],
    wanted: Mapping[str, bool],
) -> tuple[dict[str, Array], NDArray[np.bool_], list[str]]:
    """Return the positions by heading, which samples remain, and notes.

    Parameters
    ----------
    y : positions (n,) in `unit`, by heading.
    u : the input (n,), in any unit.
    scales : position units per number in the file, by heading.
    wanted : for each key of a repair, whether it is made; True if it is missing.
    """
    done: dict[str, Array] = {}
    keep = np.ones(t.size, dtype=np.bool_)
    notes = []
    for name, x in y.items():
        for repair in _repairs(x, u, unit=unit, scale=scales[name], wanted=wanted):
            x = repair.x
            keep &= repair.keep
            where = first_few([f"{t[i]:.4g} s" for i in repair.at], FEW_NAMED)
            notes.append(
                f"{name!r}: {repair.message} ({where}); to undo: "
                f"repair = {{ {repair.key} = false }}"
            )
        done[name] = x
    return done, keep, notes


def _repairs(
    x: Array, u: Array | None, *, unit: str, scale: float, wanted: Mapping[str, bool]
) -> Iterator[Repair]:
    every = np.ones(x.size, dtype=np.bool_)
    held = _held(x) if wanted.get("repeats", True) else None
    rows = np.flatnonzero(held) if held is not None else np.arange(x.size)
    own = x if held is None else x[rows]
    may_jump = own.size > 4 * _SIDE and not _is_even(own)
    if may_jump and wanted.get("unwrap", True):
        jumps, period = _wraps(own, unit=unit, scale=scale)
        if period:
            own = np.unwrap(own, period=period)
            message = f"the counter wrapped {jumps.size} times; {period:.6g} was added back"
            yield Repair(
                key="unwrap", x=_spread(x, rows, own), keep=every, at=rows[jumps], message=message
            )
            x = _spread(x, rows, own)
    if may_jump and wanted.get("spikes", True) and (bad := _wrong(own)).any():
        n = int(bad.sum())
        keep = every.copy()
        keep[rows[bad]] = False
        message = f"{n} samples cannot be right (spikes or dropouts) and were left out"
        yield Repair(key="spikes", x=x, keep=keep, at=rows[bad], message=message)
        rows, own = rows[~bad], own[~bad]
    if may_jump and wanted.get("jumps", True):
        jumps = _jumps(own)
        if jumps.size and u is not None:  # a jump with the input is no new zero
            moved = np.flatnonzero(np.abs(np.diff(u)) > 0.2 * np.ptp(u)) + 1
            jumps = jumps[~np.isin(rows[jumps], [moved - 1, moved, moved + 1])]
        if 0 < jumps.size <= 5:
            shift = np.zeros(own.size)
            for i in jumps:
                beside = 0.5 * (own[i - 1] - own[i - 2] + own[min(i + 1, own.size - 1)] - own[i])
                shift[i:] += own[i] - own[i - 1] - beside
            step = encoder_step(own - shift) if scale == 1.0 else scale
            own = own - (np.round(shift / step) * step if step else shift)
            x = _spread(x, rows, own)
            message = f"the reading jumped {jumps.size} times (a new zero); the jumps were removed"
            yield Repair(key="jumps", x=x, keep=every, at=rows[jumps], message=message)
    if held is not None and not held.all():
        n = round(x.size / held.sum())
        message = f"each reading is repeated {n} times, so only the first of each is used"
        yield Repair(key="repeats", x=x, keep=held, at=rows[:1], message=message)


def _is_even(x: Array) -> bool:
    """Return whether no step is far above the median, or above half of the range."""
    moves = np.abs(np.diff(x))
    most = float(moves.max())
    few = 2 * np.count_nonzero(_STEPS * moves >= most) > moves.size
    return bool(few and most <= 0.5 * np.ptp(x))


def _spread(x: Array, rows: NDArray[np.intp], own: Array) -> Array:
    """Return all samples, given those of some rows; the others repeat the one before."""
    return own[np.maximum(np.searchsorted(rows, np.arange(x.size), side="right") - 1, 0)]


def _jumps(x: Array, *, spare: int = 0) -> NDArray[np.intp]:
    """Return the samples before which the position jumps farther than physics allows.

    `spare` is how many of the steps on each side may be jumps, too.
    """
    moves = np.abs(np.diff(x))
    least = max(_LEAST * float(np.ptp(x)), _STEPS * float(np.median(moves)))
    rows = np.flatnonzero(moves > least)
    if not rows.size:
        return rows
    beside = rows[:, None] + np.arange(_SIDE)
    padded = np.full(moves.size + 2 * _SIDE, -1.0)
    padded[_SIDE:-_SIDE] = moves
    before, after = (
        np.sort(padded[beside + shift], axis=1)[:, -1 - spare] for shift in (0, _SIDE + 1)
    )
    is_far = (moves[rows] > _FARTHER * np.maximum(before, after)) & (np.minimum(before, after) >= 0)
    far = dict(zip(rows[is_far].tolist(), after[is_far].tolist(), strict=True))
    if not far:
        return np.array([], dtype=np.intp)
    step = encoder_step(x)
    # Behind a stuck encoder, the reading jumps back to a cart that moves.
    back = {last for _, last in stuck_spans(x) if far.get(last, 0.0) > 2 * step}
    found = [i + 1 for i in far if moves[i] > _STEPS * step and i not in back]
    return np.array(found, dtype=np.intp)


def _wraps(x: Array, *, unit: str, scale: float) -> tuple[NDArray[np.intp], float]:
    """Return the samples at which a counter or an angle wraps, and its range; 0 if it does not."""
    moves, span = np.abs(np.diff(x)), float(np.ptp(x))
    jumps = np.flatnonzero(moves > 0.5 * span) + 1
    if not jumps.size:
        return jumps, 0.0
    rest = float(np.delete(moves, jumps - 1).max(initial=0.0))
    periods = [factor * 2.0**bits for bits in _BITS for factor in {1.0, scale}]
    angles = {"rad": 2 * np.pi, "deg": 360.0, "rev": 1.0}
    periods += [angles[symbol]] if (symbol := unit_symbol(unit)) in angles else []
    for period in periods:
        # The cart moves while the counter wraps, as far as in other samples.
        fits = np.abs(moves[jumps - 1] - period) <= 1.5 * rest + 2 * encoder_step(x)
        if fits.all() and rest < 0.2 * period and span <= 1.001 * period:
            return jumps, period
    return jumps, 0.0


def _wrong(x: Array) -> NDArray[np.bool_]:
    """Return which samples cannot be right: the position jumps to them and soon back again."""
    jumps = _jumps(x, spare=2).tolist()
    wrong = np.zeros(x.size, dtype=np.bool_)
    for start, end in pairwise(jumps):
        there, back = x[start] - x[start - 1], x[end] - x[end - 1]
        if end - start <= _MOST_BAD and abs(there + back) < 0.5 * min(abs(there), abs(back)):
            wrong[start:end] = not wrong[start - 1]
    return wrong if wrong.mean() <= _MOST_SHARE else np.zeros_like(wrong)


def _held(x: Array) -> NDArray[np.bool_] | None:
    """Return which samples are new readings, if a slow sensor repeats each; None otherwise."""
    starts = np.flatnonzero(np.diff(x) != 0) + 1
    if starts.size < _FEWEST_CHANGES:
        return None
    lengths = np.diff(starts)
    if lengths.sum() < 2 * lengths.size:  # less than half of them are 3
        return None
    n = float(np.median(lengths))
    if n < 3:
        return None
    times = np.maximum(np.round(lengths / n), 1)
    single = times == 1
    regular = np.abs(lengths - times * n) <= 1 + 0.05 * lengths
    if regular.mean() < 0.95 or single.mean() < 0.6 or np.mean(lengths[single] == n) < 0.5:
        return None
    # A slow cart, too, changes an encoder's count every few samples, but by one step.
    if np.median(np.abs(np.diff(x)[starts - 1])) < 1.5 * encoder_step(x):
        return None
    keep = np.zeros(x.size, dtype=np.bool_)
    keep[np.arange(starts[0], -1, -round(n))] = True
    for start, length, count in zip(starts, lengths, times, strict=False):
        keep[start + np.round(np.arange(count) * length / count).astype(int)] = True
    keep[np.arange(starts[-1], x.size, round(n))] = True
    return keep
