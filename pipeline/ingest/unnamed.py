"""Find the roles of columns without names from their signals.

Time rises evenly. Positions never jump. An input jumps between levels, or it moves the other
columns: their accelerations follow a linear law only if the law includes the input.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.force_balance import Windows, motion_period
from pipeline.ingest.channels import encoder_step, is_stepped, mirrors
from pipeline.ingest.clock import SLOW, read_clock
from pipeline.ingest.table import FileTable
from pipeline.submission.models import MOST_CARTS

# Change between two samples, as a share of the column's range; no cart moves so fast.
_JUMP = 0.2
_FASTEST = 1e-5  # s between samples; no bench records faster
_CLEARER = 0.5  # ratio of the unexplained shares of acceleration, best input to next best
_FEWEST, _MOST_WINDOWS = 9, 4000


@dataclass(frozen=True, kw_only=True)
class Roles:
    """Column numbers (from 1) by role; `doubts` say why a person should check them."""

    columns: Mapping[str, int] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()


def find_roles(table: FileTable) -> Roles:
    """Return the roles of the columns of a table without names; empty if they cannot be found."""
    with np.errstate(all="ignore"):  # undefined shares compare as false
        return _find_roles(table)


def _find_roles(table: FileTable) -> Roles:
    values = table.values
    clocks = [i for i, column in enumerate(values) if _is_clock(column)]
    if not clocks:
        return Roles(doubts=_other_clock(values))
    time = clocks[0]
    interval = float(values[time, -1] - values[time, 0]) / (values.shape[1] - 1)
    doubts = []
    if len(clocks) > 1:
        numbers = " and ".join(str(i + 1) for i in clocks)
        doubts.append(f"the columns {numbers} both rise evenly: which is the time?")
    signals = [
        i for i, column in enumerate(values)
        if i not in clocks and np.ptp(column) > 0 and not _rises_evenly(column)
    ]  # fmt: skip
    signals = _without_copies(table, signals)
    signals = _without_rates(values, signals, interval=interval)
    drive, reference, doubt = _find_input(table, signals)
    doubts += [doubt] if doubt else []
    positions = [i for i in signals if i not in (drive, reference)]
    if not 0 < len(positions) <= MOST_CARTS:
        return Roles()
    # A position and its reference may be equal to 5 %.
    doubts += [
        f"the columns {i + 1} and {j + 1} are nearly equal: is one of them the reference?"
        for i, j in combinations(signals, 2)
        if np.std(values[i] - values[j]) < 0.05 * np.std(values[i])
    ][:1]
    roles = {"time": time, "input": drive, "reference": reference}
    roles |= {f"x{cart}": i for cart, i in enumerate(positions, start=1)}
    columns = {role: i + 1 for role, i in roles.items() if i is not None}
    return Roles(columns=columns, doubts=tuple(doubts))


# ---------------------------------------------------------------------------------- times


def _is_clock(values: Array) -> bool:
    steps = np.diff(values)
    # A clock may have rounded stamps, so time need not advance at every sample.
    if values.size < 3 or (steps < 0).any() or np.count_nonzero(steps) < 0.2 * steps.size:
        return False
    clock = read_clock(values)
    regular = bool(clock.jitter < clock.mean_interval)
    return clock.stopped is None and _FASTEST < clock.mean_interval < SLOW and regular


def _rises_evenly(values: Array) -> bool:
    """Return whether values may be sample numbers, or a time in small units."""
    steps = np.diff(values)
    return bool(steps.size > 0 and steps.min() > 0 and np.ptp(steps) < 0.5 * np.median(steps))


def _other_clock(values: Array) -> tuple[str, ...]:
    """Return a note on a column that may be a time in milliseconds or microseconds."""
    for i, column in enumerate(values):
        if column.size < 3 or (np.diff(column) <= 0).any():
            continue
        step = float(column[-1] - column[0]) / (column.size - 1)
        for unit, factor in (("milliseconds", 1e-3), ("microseconds", 1e-6)):
            if _rises_evenly(column) and step != 1 and _FASTEST < factor * step < SLOW:
                rate = f"{1 / (factor * step):.5g}"
                return (f"column {i + 1} rises by {step:.5g} a sample: if those are {unit}, "
                        f"sample_rate = {rate}",)  # fmt: skip
    return ()


# -------------------------------------------------------------------- redundant columns


def _without_copies(table: FileTable, signals: Sequence[int]) -> list[int]:
    """Return the columns except commanded positions that only repeat a later encoder column."""
    values, whole = table.values, table.whole
    return [
        i for i in signals
        if not (whole[i] and any(whole[j] and mirrors(*values[[i, j]]) for j in signals if j > i))
    ]  # fmt: skip


def _without_rates(values: Array, signals: Sequence[int], *, interval: float) -> list[int]:
    """Return the columns, leaving out those that are the velocity of another column."""
    parts = _averages(values, signals)
    if parts is None:
        return list(signals)
    mean, slope, _ = parts

    def is_rate(i: int, j: int) -> bool:
        rate, own = slope[j] / interval, mean[i] - mean[i].mean()
        size = float(own @ own)
        if not size or np.corrcoef(rate, own)[0, 1] < 0.99:
            return False
        return abs(float((rate - rate.mean()) @ own) / size - 1.0) < 0.05

    pairs = range(len(signals))
    return [
        column for i, column in enumerate(signals)
        if not any(is_rate(i, j) for j in pairs if j != i)
    ]  # fmt: skip


# ---------------------------------------------------------------------------------- the input


def _find_input(table: FileTable, signals: Sequence[int]) -> tuple[int | None, int | None, str]:
    """Return the columns of input and reference, each None if not found, and a note on doubts."""
    if len(signals) < 2:
        return None, None, ""
    values = table.values
    left = _left_unexplained(values, signals)
    stepped = [
        i for i in signals
        if (np.abs(np.diff(values[i])) > _JUMP * np.ptp(values[i])).any() and is_stepped(values[i])
    ]  # fmt: skip
    found = _by_jumps(values, signals, stepped, left) if stepped else _by_law(values, signals, left)
    if found is not None:
        drive, reference = found
        return drive, reference, ""
    guess = _as_exported(table, signals)
    return guess, None, "which column is the input is not clear from the signals"


def _by_jumps(
    values: Array, signals: Sequence[int], stepped: Sequence[int], left: Mapping[int | None, float]
) -> tuple[int, int | None] | None:
    """Return input and reference if one column has steps; None if that is not clear.

    A position responds to a step without a jump. The output of a controller jumps with its
    reference, or it explains the motion better.
    """
    first, *copies = stepped
    if any(not _is_alike(values, first, i) for i in copies):
        drive, reference = sorted(stepped, key=lambda i: left.get(i, 0.0))[:2]
        clear = len(stepped) == 2 and left and left[drive] < _CLEARER * left[reference]
        return (drive, reference) if clear else None
    jumps = np.abs(np.diff(values, axis=1)) > _JUMP * np.ptp(values, axis=1, keepdims=True)
    edges = np.flatnonzero(jumps[first])
    near = np.unique(np.clip([edges - 1, edges, edges + 1], 0, jumps.shape[1] - 1))
    others = [i for i in signals if i not in stepped]
    jumping = [i for i in others if jumps[i, near].any()]
    if not others or len(jumping) > 1 or (jumping and copies):
        return None
    if jumping:
        return jumping[0], first
    if jumps[others].any() or (left and left[first] > min(left[i] for i in others)):
        return None
    return (copies[-1], first) if copies else (first, None)


def _by_law(
    values: Array, signals: Sequence[int], left: Mapping[int | None, float]
) -> tuple[int | None, None] | None:
    """Return the column that clearly explains the motion of the others, and None as reference.

    The column is None if the motion dies away without an input. The result is None if the input is
    not clear.
    """
    if not left:
        return None
    # In free motion, less than a tenth of the acceleration is unexplained.
    if left[None] < 0.1:  # no input is needed, or all columns are sines
        if _dies_away(values[list(signals)]):
            return None, None
        pure = _purest(values, signals)
        return None if pure is None else (pure, None)
    best, second = sorted(signals, key=lambda i: left[i])[:2]
    # Of columns that an input moves, less than half of the acceleration is unexplained.
    clear = left[best] < min(0.5, _CLEARER * left[second], _CLEARER * left[None])
    step = encoder_step(values[best])
    steps = [encoder_step(values[i]) for i in signals if i != best]
    same = any(step > 0 and abs(other - step) < 0.01 * step for other in steps)
    return (best, None) if clear and not same else None  # a cart moved by hand moves others too


def _is_alike(values: Array, i: int, j: int) -> bool:
    # This is the correlation of one signal in two units.
    return bool(abs(np.corrcoef(values[i], values[j])[0, 1]) > 0.999)


def _averages(values: Array, signals: Sequence[int]) -> Array | None:
    """Return mean, slope and curvature (3, signals, windows); None if the record is short."""
    n = values.shape[1]
    if not signals:
        return None
    period = min(motion_period(values[i]) for i in signals)
    # A window has 0.4 of the fastest period.
    width = max(round(0.4 * period), _FEWEST)
    if n < 8 * width:
        width = max(n // 8, _FEWEST)
    if n < 4 * width:
        return None
    hop = max(1, (n - width) // _MOST_WINDOWS)
    windows = Windows(np.arange(float(n)), first=slice(None, None, hop), width=width)
    return windows.means(values[list(signals)])


def _left_unexplained(values: Array, signals: Sequence[int]) -> dict[int | None, float]:
    """Return, for each trial input, the share of accelerations that no linear law explains.

    The key None stands for no input. The law is linear in all columns, and in the slopes of those
    that are not the trial input. The share is the mean over the latter columns.
    """
    parts = _averages(values, signals)
    if parts is None:
        return {}
    mean, slope, curvature = parts
    left: dict[int | None, float] = {}
    for drive in (None, *range(len(signals))):
        moved = [i for i in range(len(signals)) if i != drive]
        known = np.vstack([mean, slope[moved], np.ones(mean.shape[1])]).T
        known = known / np.maximum(np.abs(known).max(axis=0), 1e-300)
        wanted = curvature[moved].T
        law, *_ = np.linalg.lstsq(known, wanted, rcond=1e-9)
        rest = ((wanted - known @ law) ** 2).sum(0) / np.maximum((wanted**2).sum(0), 1e-300)
        left[None if drive is None else signals[drive]] = float(rest.mean())
    return left


def _purest(values: Array, signals: Sequence[int]) -> int | None:
    """Return the column that is a much purer sine than all others: a computed one; else None."""
    parts = _averages(values, signals)
    if parts is None:
        return None
    mean, _, curvature = parts
    left = {}
    for i, own, wanted in zip(signals, mean, curvature, strict=True):
        known = np.array([own, np.ones(own.size)]).T
        law, *_ = np.linalg.lstsq(known, wanted, rcond=None)
        left[i] = float(((wanted - known @ law) ** 2).sum() / (wanted**2).sum())
    best, second = sorted(left, key=lambda i: left[i])[:2]
    # What is not a sine must be a tenth of that of the next column.
    return best if left[best] < 0.1 * left[second] else None


def _dies_away(rows: Array) -> bool:
    """Return whether every column moves less than half as much at the end as at the start."""
    parts = np.array_split(rows, 3, axis=1)
    first, last = (
        np.sqrt(((part - part.mean(1, keepdims=True)) ** 2).mean(1))
        for part in (parts[0], parts[-1])
    )
    return bool((last < 0.5 * first).all())


def _as_exported(table: FileTable, signals: Sequence[int]) -> int:
    """Return the only column with fractions, otherwise the last one, as in ECP exports."""
    fractions = [i for i in signals if not table.whole[i]]
    return fractions[0] if len(fractions) == 1 else signals[-1]
