"""Check sample times, and straighten them if the file has rounded them.

Near 1 kHz, stamps in whole milliseconds hardly show the clock's true period: a short record looks
perfectly even. The records of a session share one clock, so together they reveal its period.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import Column, conversion
from pipeline.ingest.table import FileTable

SLOW = 0.5  # s between samples; no bench records more slowly
FEWEST_SAMPLES = 8  # fewest samples for any estimate
_GAP = 4.0  # time is missing if an interval is this many times the usual one
# Largest distance of a stamp from its line, in rounding steps: half a step, plus the fit's error.
_ROUNDING_BAND = 0.65
# Widths of a strip around a line, in rounding steps: 1 if stamps are only rounded, more if some
# ticks of the clock are late.
_BANDS = (1.0, 1.02, 1.05, 1.1, 1.2, 2 * _ROUNDING_BAND)
_REPEATS = 0.05  # share of stamps that repeat if a sample is shorter than their rounding
# Ranges of clocks in s: 32 or 16 bits of µs or ms, or of the file's unit; a day; half a day.
_RANGES = (2**32 * 1e-6, 2**32 * 1e-3, 2**16 * 1e-3, 2**16 * 1e-6, 2**32, 2**16, 86_400, 43_200)
_HAIR = 1e-6  # numerical error of doubles, in rounding steps
# A smaller range of slopes does not show the period; it comes from stamps that flicker.
_NO_ROOM = 10 * _HAIR


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """The times of a record.

    Attributes
    ----------
    t : (n,) times in s, straightened unless `pieces` is 0.
    rounding : decimal step in s of which all stamps are multiples; zero if there is no such step.
    pieces : number of straight lines that replaced the rounded stamps; zero if they are unchanged.
    period : interval of these lines in s if it is common to the session; otherwise None.
    stopped : index (from 0) of the first sample at which time does not advance; None if it always
        does.
    gaps : indices (from 0) of the samples before which time is missing.
    """

    t: Array
    rounding: float
    pieces: int
    period: float | None
    stopped: int | None
    gaps: tuple[int, ...]

    @property
    def interval(self) -> float:
        """The usual sample interval in s."""
        return float(np.median(np.diff(self.t))) if self.pieces == 0 else self.mean_interval

    @property
    def mean_interval(self) -> float:
        """The mean sample interval in s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))

    @property
    def jitter(self) -> float:
        """Root-mean-square deviation of the intervals (except gaps) from their median, in s."""
        steps = np.diff(self.t)
        usual = np.median(steps)
        return float(np.sqrt(np.mean((steps[steps < _GAP * usual] - usual) ** 2)))


def time_stamps(table: FileTable, column: Column | None, *, sample_rate: float | None) -> Array:
    """Return the sample times (n,) in s as written in the file, or from the stated rate.

    Raises
    ------
    SubmissionError : there are too few samples, the time column has no unit of time, or there is
        neither a time column nor a rate (in Hz).
    """
    n = table.values.shape[1]
    if n < FEWEST_SAMPLES:
        raise SubmissionError(
            f"{table.source}: expected at least {FEWEST_SAMPLES} samples, found {n}"
        )
    if column is None:
        if sample_rate is None:
            raise SubmissionError(
                f"{table.source}: no time column; it has {table.headings()}; name the time "
                f"column in `columns`, or state `sample_rate` in Hz"
            )
        return np.arange(n) / sample_rate
    factor = conversion(column.unit, "s")
    if factor is None:
        raise SubmissionError(
            f"{table.source}: {column.name!r} is in {column.unit}, which is not a unit of time"
        )
    return unroll(table.values[column.index] * factor)


def clock_notes(
    table: FileTable, column: Column, clock: Clock, *, sample_rate: float | None
) -> list[str]:
    """Return notes on the clock that wrote a time column.

    Raises
    ------
    SubmissionError : time stands still or goes back; the message names the line.
    """
    if clock.stopped is not None:
        i = clock.stopped
        before, after = clock.t[i - 1], clock.t[i]
        what = "stands still" if after == before else "goes back"
        hint = "; were two recordings pasted together?" if after < before else ""
        raise SubmissionError(
            f"{table.source} {table.place(i)}: time {what}, from {before:g} s to {after:g} s{hint}"
        )
    notes = []
    if clock.mean_interval > SLOW:
        notes.append(
            f"samples are {clock.mean_interval:.4g} s apart: is {column.name!r} in other units?"
        )
    if clock.pieces:
        even = "" if clock.pieces == 1 else f", in {clock.pieces} pieces"
        notes.append(
            f"time stamps rounded to {clock.rounding:g} s were replaced by even ones: "
            f"one sample every {1e3 * (clock.period or clock.mean_interval):.6g} ms{even}"
        )
    for i in clock.gaps[:3]:
        notes.append(
            f"there is a gap in time between {clock.t[i - 1]:.4g} s and {clock.t[i]:.4g} s"
        )
    if len(clock.gaps) > 3:
        notes.append(f"and {len(clock.gaps) - 3} more gaps in time")
    # A stated rate may differ by 1 % from the time column.
    if sample_rate is not None and abs(sample_rate * clock.mean_interval - 1) > 0.01:
        notes.append(
            f"sample_rate = {sample_rate:g} Hz is not used: the time column says "
            f"{1 / clock.mean_interval:.5g} Hz"
        )
    return notes


def read_clock(stamps: Array) -> Clock:
    """Check the time stamps (n,) of one record and undo their rounding."""
    return read_clocks([stamps])[0]


def read_clocks(session: Sequence[Array]) -> list[Clock]:
    """Check the time stamps of every record of a session and undo their rounding.

    Stamps are straightened if their rounding step matters compared with the sample interval. They
    are replaced by straight lines that differ from them by no more than the rounding: one line if
    the clock is even, several if it drifts or missed a tick. If a single period explains all lines,
    they share it. If no such lines explain a clock, it is really uneven, and its stamps are kept.
    """
    rounded = [_rounded(stamps) for stamps in session]
    clocks: list[Clock] = []
    for record, period in zip(rounded, _periods(rounded), strict=True):
        t, pieces = record.straight(period)
        if (np.diff(t) <= 0).any():
            t, pieces = _steady(record.stamps, record.rounding)
        clocks.append(_checked(t, record.rounding, pieces=pieces, period=period))
    return clocks


def _checked(t: Array, rounding: float, *, pieces: int, period: float | None) -> Clock:
    steps = np.diff(t)
    stopped = int(np.argmax(steps <= 0)) + 1 if (steps <= 0).any() else None
    usual = np.median(steps)
    gaps = np.flatnonzero(steps > _GAP * usual + 1.5 * rounding) + 1 if usual > 0 else ()
    return Clock(
        t=t,
        rounding=rounding,
        pieces=pieces,
        period=period if pieces else None,
        stopped=stopped,
        gaps=tuple(int(i) for i in gaps),
    )


def decimal_step(values: Array) -> float:
    """Return the largest power of ten (1 s at most) of which all values are multiples, or 0."""
    # A time with more digits than nanoseconds has not been rounded.
    for digits in range(10):
        step = 10.0**-digits
        multiples = values / step
        # A double near 1e5 s, in steps of 1e-9 s, is itself accurate only to a hundredth of the
        # step.
        rounding = 1e-6 + 4 * np.finfo(np.float64).eps * np.abs(multiples).max()
        # In steps; a value that deviates more is not a multiple.
        if np.abs(multiples - np.round(multiples)).max() < min(rounding, 0.02):
            return step
    return 0.0


# ------------------------------------------------------------------- one record


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rounded:
    """The stamps of a record, and its stretches (start, end) that are straight but for rounding.

    `even` means that the stamps already are on a line. They are then straightened only if other
    records give a better period.
    """

    stamps: Array
    rounding: float
    stretches: tuple[tuple[int, int], ...]
    even: bool

    def straight(self, period: float | None) -> tuple[Array, int]:
        """Return the times and the number of straight lines.

        Without `period`, each line has its own slope.
        """
        if self.even and period is None:
            return self.stamps, 0
        t = self.stamps.copy()
        for start, end in self.stretches:
            t[start:end] = _line(self.stamps[start:end], slope=period)
        return t, len(self.stretches)

    def slopes(self, band: float) -> tuple[float, float]:
        """Return the least and greatest period that fit all stretches; (inf, 0) if no period fits.

        The usual stamps must be within a strip of `band` rounding steps around one line.
        """
        least, greatest = 0.0, np.inf
        for start, end in self.stretches:
            stamps = self.stamps[start:end]
            usual = _usual(stamps, self.rounding)
            low, high = _slopes(stamps, usual, width=band * self.rounding)
            if (high - low) * stamps.size < _NO_ROOM * self.rounding:
                return np.inf, 0.0
            least, greatest = max(least, low), min(greatest, high)
        return least, greatest


def _rounded(stamps: Array) -> _Rounded:
    rounding = decimal_step(stamps)
    record = _Rounded(stamps=stamps, rounding=rounding, stretches=(), even=False)
    mean = (stamps[-1] - stamps[0]) / (stamps.size - 1)
    steps = np.diff(stamps)
    # A rounding step of up to 0.2 % of the interval does no harm.
    if (steps < 0).any() or mean <= 0 or rounding <= 2e-3 * mean:
        return record
    if np.ptp(steps) <= 1e-6 * mean:
        return replace(record, stretches=((0, stamps.size),), even=True)
    return replace(record, stretches=_stretches(stamps, rounding))


def _stretches(stamps: Array, rounding: float) -> tuple[tuple[int, int], ...]:
    """Return the stretches that straight lines explain; () if they cover too little."""
    found = []
    waiting = [(0, stamps.size)]
    while waiting:
        start, end = waiting.pop()
        if _usual(stamps[start:end], rounding).any():
            found.append((start, end))
        # Pieces of fewer than 32 samples would fit a line by chance.
        elif end - start >= 2 * 32:
            pauses = _pauses(stamps[start:end], rounding)
            middle = start + int(pauses[0]) if pauses.size else (start + end) // 2
            waiting += [(start, middle), (middle, end)]
    explained = sum(end - start for start, end in found)
    # If straight pieces cover less than 80 %, the clock itself is uneven.
    return tuple(sorted(found)) if explained >= 0.8 * stamps.size else ()


def _pauses(stamps: Array, rounding: float) -> NDArray[np.intp]:
    """Return the samples before which time is missing."""
    mean = (stamps[-1] - stamps[0]) / (stamps.size - 1)
    steps = np.diff(stamps)
    usual = min(float(np.median(steps)) or mean, mean) + rounding
    return np.flatnonzero(steps > _GAP * usual + 1.5 * rounding) + 1


def _steady(stamps: Array, rounding: float) -> tuple[Array, int]:
    """Return even times for stamps that repeat because they are rounded to a sample or more.

    Between pauses, a straight line replaces them; they may scatter about it by a few samples. Other
    stamps are kept, with 0 lines: a clock that stands still by itself is no rounded one.
    """
    bounds = [0, *_pauses(stamps, rounding).tolist(), stamps.size]
    pieces = [stamps[a:b] for a, b in pairwise(bounds)]
    repeats = np.mean(np.diff(stamps) == 0) if (np.diff(stamps) >= 0).all() else 0.0
    if repeats < _REPEATS or min(piece.size for piece in pieces) < FEWEST_SAMPLES:
        return stamps, 0
    slope = _common_slope(pieces)
    t = np.concatenate([_line(piece, slope=slope) for piece in pieces])
    scatter = float(np.sqrt(np.mean((t - stamps) ** 2)))
    if rounding < 0.4 * slope or scatter > 2 * (rounding + slope) or (np.diff(t) <= 0).any():
        return stamps, 0
    return t, len(pieces)


def _common_slope(pieces: Sequence[Array]) -> float:
    """Return the least-squares slope that all pieces share."""
    moments = [(np.arange(p.size) - (p.size - 1) / 2, p) for p in pieces]
    return float(sum(i @ p for i, p in moments) / sum(i @ i for i, _ in moments))


def unroll(stamps: Array) -> Array:
    """Return stamps (n,) in s without the overflow of a counter, and across midnight.

    Time goes back by a counter's range, of which all but one usual interval is missing.
    """
    steps = np.diff(stamps)
    if not (back := np.flatnonzero(steps < 0)).size:
        return stamps
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if forward.size else 0.0
    for range_ in _RANGES:
        missing = steps[back] + range_
        if (missing >= 0).all() and (missing <= _GAP * usual + 1e-9 * range_).all():
            wraps = np.zeros(stamps.size)
            wraps[back + 1] = range_
            return stamps + np.cumsum(wraps)
    return stamps


def _usual(stamps: Array, rounding: float) -> NDArray[np.bool_]:
    """Return which stamps (n,) are within the rounding of one line.

    Usually these are all stamps except for a few late ones. If more are off the line, no stamp
    counts.
    """
    off = np.abs(_line(stamps) - stamps) / rounding
    near = off <= _ROUNDING_BAND
    # Very few stamps may be one step off, because a tick was late or missing.
    if off.max() <= 1.5 and near.mean() >= 0.99:
        return near
    # If a few stamps jump, a least-squares line tilts, but a strip of the rounding's width does
    # not.
    every = np.ones(stamps.size, dtype=np.bool_)
    low, high = _slopes(stamps, every, width=_BANDS[-1] * rounding)
    # A stamp further from the line than this (in steps) did not advance.
    return every & (low <= high and off.max() < 0.9)


def _line(stamps: Array, *, slope: float | None = None) -> Array:
    """Return the least-squares straight line through the stamps, at each sample."""
    i = np.arange(stamps.size) - (stamps.size - 1) / 2
    return stamps.mean() + i * ((i @ stamps) / (i @ i) if slope is None else slope)


# ------------------------------------------------------------------- the session


def _periods(records: Sequence[_Rounded]) -> list[float | None]:
    """Return the period of each record's clock; records that allow the same period share it.

    Each record confines the period to an interval, which is wider for a shorter record. Records
    with narrow intervals come first. Each joins the first group whose period it allows, or starts a
    new group. None means that the stamps are kept or no single period explains the record.
    """
    groups: list[tuple[float, float, list[int]]] = []
    told = {
        i: [record.slopes(band) for band in _BANDS]
        for i, record in enumerate(records)
        if record.stretches
    }
    for i, bounds in sorted(told.items(), key=lambda item: item[1][-1][1] - item[1][-1][0]):
        for j, (least, greatest, members) in enumerate(groups):
            shared = [(max(least, low), min(greatest, high)) for low, high in bounds]
            allowed = [(low, high) for low, high in shared if low <= high]
            if allowed and records[members[0]].rounding == records[i].rounding:
                groups[j] = (*allowed[0], [*members, i])
                break
        else:
            groups += [(low, high, [i]) for low, high in bounds if low <= high][:1]
    periods: list[float | None] = [None] * len(records)
    for least, greatest, members in groups:
        if not all(records[i].even for i in members):
            for i in members:
                periods[i] = (least + greatest) / 2
    return periods


def _slopes(stamps: Array, usual: NDArray[np.bool_], *, width: float) -> tuple[float, float]:
    """Return the least and greatest slope of a strip of this width that holds the usual stamps."""
    index = np.flatnonzero(usual).astype(np.float64)
    low, high = (_extreme_slope(index, stamps[usual], width=width, side=side) for side in (-1, 1))
    return low, high


def _extreme_slope(index: Array, stamps: Array, *, width: float, side: int) -> float:
    """Return the least (side -1) or greatest (1) slope of a strip of this width.

    The strip must hold all stamps. The width that they need is a convex, piecewise linear function
    of the slope, so Newton's method from outside reaches the bound exactly. If there is no such
    strip, the least slope is inf and the greatest is -inf.
    """
    slope = (stamps[-1] - stamps[0] + side * 2 * width) / (index[-1] - index[0])
    hair = _HAIR * width + 8 * np.finfo(np.float64).eps * np.abs(stamps).max()
    while True:
        off = stamps - slope * index
        top, bottom = int(np.argmax(off)), int(np.argmin(off))
        excess = off[top] - off[bottom] - width
        run = index[bottom] - index[top]
        if excess <= hair:
            return slope
        if run * side <= 0:
            return -side * np.inf
        slope -= excess / run
