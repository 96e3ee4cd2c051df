"""Jumps of a position that physics forbids, and their repairs.

No cart moves in one sample much farther than in the samples on each side, because that needs an
enormous force twice. So such a step is the sensor's doing: a counter that wrapped, a new zero, a
wrong reading, or a reading that was repeated until the next one came.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.ingest.channels import encoder_step, find_edges, stuck_spans
from pipeline.ingest.columns import unit_symbol
from pipeline.ingest.table import FEW_NAMED, Note
from pipeline.words.numbers import first_few

_SIDE = 8  # samples on each side of a step
_STEPS = 12.0  # encoder steps, or times the noise; a smaller jump does no harm
_BITS = (8, 10, 12, 14, 16, 20, 24, 32)
_ANGLES = {"rad": 2 * np.pi, "deg": 360.0, "rev": 1.0}  # one turn

_Rows = NDArray[np.intp]
_Mask = NDArray[np.bool_]


def repair_positions(
    t: Array,
    y: Mapping[str, Array],
    u: Array | None,
    *,
    unit: str,
    scales: Mapping[str, float],
    wanted: Mapping[str, bool],
) -> tuple[dict[str, Array], _Mask, list[Note]]:
    """Return the positions by heading, which samples remain, and a note on each repair.

    The code of a note is the key of its repair in `submission.toml`.

    Parameters
    ----------
    y : positions (n,) in `unit`, by heading.
    u : the input (n,), in any unit.
    scales : position units per number in the file, by heading.
    wanted : for each key of a repair, whether it is made; True if it is missing.
    """
    moved = find_edges(u) if u is not None else np.array([], dtype=np.intp)
    done: dict[str, Array] = {}
    keep = np.ones(t.size, dtype=np.bool_)
    notes = []
    for name, x in y.items():
        done[name], kept, said = _repair(x, moved, unit=unit, scale=scales[name], wanted=wanted)
        keep &= kept
        for key, at, message in said:
            where = first_few([f"{t[i]:.4g} s" for i in at], FEW_NAMED)
            told = f"{name!r}: {message} ({where}); to undo: repair = {{ {key} = false }}"
            notes.append(Note(told, key, about=name, at=at))
    return done, keep, notes


def _repair(
    x: Array, moved: _Rows, *, unit: str, scale: float, wanted: Mapping[str, bool]
) -> tuple[Array, _Mask, list[tuple[str, _Rows, str]]]:
    """Return a repaired position, its good samples, and for each repair its key, samples, message.

    Parameters
    ----------
    moved : the samples at which the input jumps; a jump with the input is no new zero.
    """
    said: list[tuple[str, _Rows, str]] = []
    held = _held(x) if wanted.get("repeats", True) else None
    keep = np.ones(x.size, dtype=np.bool_) if held is None else held.copy()
    rows = np.flatnonzero(keep)  # of the readings that are used
    own = x[rows]
    may_jump = own.size > 4 * _SIDE and not _is_even(own)
    if may_jump and wanted.get("unwrap", True):
        jumps, period = _wraps(own, unit=unit, scale=scale)
        if period:
            own = np.unwrap(own, period=period)
            x = _spread(x.size, rows, own)
            message = f"the counter wrapped {jumps.size} times; {period:.6g} was added back"
            said.append(("unwrap", rows[jumps], message))
    if may_jump and wanted.get("spikes", True) and (bad := _wrong(own)).any():
        keep[rows[bad]] = False
        message = f"{bad.sum()} samples cannot be right (spikes or dropouts) and were left out"
        said.append(("spikes", rows[bad], message))
        rows, own = rows[~bad], own[~bad]
    if may_jump and wanted.get("jumps", True):
        jumps = _jumps(own)
        jumps = jumps[~np.isin(rows[jumps], [moved - 1, moved, moved + 1])]
        if 0 < jumps.size <= 5:
            own = _without(own, jumps, scale=scale)
            x = _spread(x.size, rows, own)
            message = f"the reading jumped {jumps.size} times (a new zero); the jumps were removed"
            said.append(("jumps", rows[jumps], message))
    if held is not None and not held.all():
        n = round(x.size / held.sum())
        message = f"each reading is repeated {n} times, so only the first of each is used"
        said.append(("repeats", rows[:1], message))
    return x, keep, said


def _is_even(x: Array) -> bool:
    """Return whether no step is far above the median, or above half of the range."""
    moves = np.abs(np.diff(x))
    most = float(moves.max())
    few = 2 * np.count_nonzero(_STEPS * moves >= most) > moves.size
    return bool(few and most <= 0.5 * np.ptp(x))


def _spread(n: int, rows: _Rows, own: Array) -> Array:
    """Return all n samples, given those of some rows; the others repeat the one before."""
    return own[np.maximum(np.searchsorted(rows, np.arange(n), side="right") - 1, 0)]


def _without(x: Array, jumps: _Rows, *, scale: float) -> Array:
    """Return the position without jumps; at each, it moves as far as beside it."""
    move = np.append(np.diff(x), 0.0)
    shift = np.zeros(x.size)
    for i in jumps:
        shift[i:] += move[i - 1] - 0.5 * (move[i - 2] + move[i])
    step = encoder_step(x - shift) if scale == 1.0 else scale
    return x - (np.round(shift / step) * step if step else shift)


def _jumps(x: Array, *, spare: int = 0) -> _Rows:
    """Return the samples before which the position jumps farther than physics allows.

    `spare` is how many of the steps on each side may be jumps, too.
    """
    moves = np.abs(np.diff(x))
    # A jump is at least 2 % of the range.
    least = max(0.02 * float(np.ptp(x)), _STEPS * float(np.median(moves)))
    rows = np.flatnonzero(moves > least)
    padded = np.pad(moves, _SIDE, constant_values=-1.0)
    before, after = (
        np.sort(padded[rows[:, None] + np.arange(_SIDE) + shift], axis=1)[:, -1 - spare]
        for shift in (0, _SIDE + 1)
    )
    # A jump is four times as far as any step beside it.
    is_far = (moves[rows] > 4.0 * np.maximum(before, after)) & (np.minimum(before, after) >= 0)
    rows, after = rows[is_far], after[is_far]
    if not rows.size:
        return rows
    step = encoder_step(x)
    # Behind a stuck encoder, the reading jumps back to a cart that moves; a dropout also begins so.
    stuck = [last for first, last in stuck_spans(x) if first - 1 not in rows]
    is_back = np.isin(rows, stuck) & (after > 2 * step)
    return rows[(moves[rows] > _STEPS * step) & ~is_back] + 1


def _wraps(x: Array, *, unit: str, scale: float) -> tuple[_Rows, float]:
    """Return the samples at which a counter or an angle wraps, and its range; 0 if it does not."""
    moves, span = np.abs(np.diff(x)), float(np.ptp(x))
    jumps = np.flatnonzero(moves > 0.5 * span) + 1
    if not jumps.size:
        return jumps, 0.0
    rest = float(np.delete(moves, jumps - 1).max(initial=0.0))
    periods = [factor * 2.0**bits for bits in _BITS for factor in {1.0, scale}]
    periods += [_ANGLES[symbol]] if (symbol := unit_symbol(unit)) in _ANGLES else []
    for period in periods:
        # The cart moves while the counter wraps, as far as in other samples.
        fits = np.abs(moves[jumps - 1] - period) <= 1.5 * rest + 2 * encoder_step(x)
        if fits.all() and rest < 0.2 * period and span <= 1.001 * period:
            return jumps, period
    return jumps, 0.0


def _wrong(x: Array) -> _Mask:
    """Return which samples cannot be right: the position jumps to them and soon back again."""
    jumps = _jumps(x, spare=2).tolist()
    wrong = np.zeros(x.size, dtype=np.bool_)
    for start, end in pairwise(jumps):
        there, back = x[start] - x[start - 1], x[end] - x[end - 1]
        # A spike lasts at most twelve readings.
        if end - start <= 12 and abs(there + back) < 0.5 * min(abs(there), abs(back)):
            wrong[start:end] = not wrong[start - 1]
    # At most one reading in twenty may be wrong.
    return wrong if wrong.mean() <= 0.05 else np.zeros_like(wrong)


def _held(x: Array) -> _Mask | None:
    """Return which samples are new readings, if a slow sensor repeats each; None otherwise."""
    starts = np.flatnonzero(np.diff(x) != 0) + 1
    lengths = np.diff(starts)
    # More than half of the readings last three samples or longer.
    if starts.size < 20 or (n := float(np.median(lengths))) < 3:
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
