"""The clock of a recording: its stamps are a rounded, sometimes interrupted view of even times."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import Column, conversion
from pipeline.ingest.table import FileTable, Note

SLOW = 0.5  # s between samples; no bench records more slowly
FEWEST_SAMPLES = 8  # fewest samples for any estimate
_GAP = 4.0  # time is missing if an interval is this many times the usual one
# Largest distance of a stamp from its line, in rounding steps: half a step, plus the fit's error.
_ROUNDING_BAND = 0.65
# Ranges of clocks in s: 32 or 16 bits of µs or ms, or of the file's unit; a day; half a day.
_RANGES = (2**32 * 1e-6, 2**32 * 1e-3, 2**16 * 1e-3, 2**16 * 1e-6, 2**32, 2**16, 86_400, 43_200)


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """The times of a record.

    Attributes
    ----------
    t : (n,) times in s, straightened unless `pieces` is 0.
    rounding : decimal step in s of which all stamps are multiples; zero if there is no such step.
    pieces : number of straight lines that replaced the rounded stamps; zero if they are unchanged.
    """

    t: Array
    rounding: float
    pieces: int

    @property
    def mean_interval(self) -> float:
        """The mean sample interval in s."""
        return _mean_step(self.t)

    @property
    def jitter(self) -> float:
        """Root-mean-square deviation of the intervals (except gaps) from their median, in s."""
        steps = np.diff(self.t)
        usual = np.median(steps)
        return float(np.sqrt(np.mean((steps[steps < _GAP * usual] - usual) ** 2)))

    @property
    def stopped(self) -> int | None:
        """Index (from 0) of the first sample at which time does not advance; None if it does."""
        return next(iter((np.flatnonzero(np.diff(self.t) <= 0) + 1).tolist()), None)

    @property
    def gaps(self) -> tuple[int, ...]:
        """Indices (from 0) of the samples before which time is missing."""
        usual = float(np.median(np.diff(self.t)))
        return tuple(_late(self.t, usual, self.rounding).tolist()) if usual > 0 else ()


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
) -> list[Note]:
    """Return notes on the clock that wrote a time column.

    Raises
    ------
    SubmissionError : time stands still or goes back; the message names the line.
    """
    if (i := clock.stopped) is not None:
        before, after = clock.t[i - 1], clock.t[i]
        what = "stands still" if after == before else "goes back"
        hint = "; were two recordings pasted together?" if after < before else ""
        raise SubmissionError(
            f"{table.source} {table.place(i)}: time {what}, from {before:g} s to {after:g} s{hint}"
        )
    notes, interval, gaps = list[Note](), clock.mean_interval, clock.gaps
    if interval > SLOW:
        said = f"samples are {interval:.4g} s apart: is {column.name!r} in other units?"
        notes.append(Note(said, "slow", about=column.name))
    if clock.pieces:
        even = "" if clock.pieces == 1 else f", in {clock.pieces} pieces"
        said = (
            f"time stamps rounded to {clock.rounding:g} s were replaced by even ones: "
            f"one sample every {1e3 * interval:.4g} ms{even}"
        )
        notes.append(Note(said, "rounded", about=column.name))
    notes += [
        Note(
            f"there is a gap in time between {clock.t[i - 1]:.4g} s and {clock.t[i]:.4g} s",
            "gap",
            at=[i],
        )
        for i in gaps[:3]
    ]
    if len(gaps) > 3:
        notes.append(Note(f"and {len(gaps) - 3} more gaps in time", "gap", at=gaps[3:]))
    # A stated rate may differ by 1 % from the time column.
    if sample_rate is not None and abs(sample_rate * interval - 1) > 0.01:
        said = (
            f"sample_rate = {sample_rate:g} Hz is not used: the time column says "
            f"{1 / interval:.5g} Hz"
        )
        notes.append(Note(said, "rate_unused", about=column.name))
    return notes


def unroll(stamps: Array) -> Array:
    """Return stamps (n,) in s without the overflow of a counter, and across midnight.

    Time goes back by a counter's range, of which all but one usual interval is missing.
    """
    steps = np.diff(stamps)
    back, forward = steps < 0, steps[steps > 0]
    usual = float(np.median(forward)) if forward.size else 0.0
    for range_ in _RANGES if back.any() else ():
        missing = steps[back] + range_
        if missing.min() >= 0 and missing.max() <= _GAP * usual + 1e-9 * range_:
            return stamps + range_ * np.cumsum(np.append(False, back))
    return stamps


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


# -------------------------------------------------------------------- even times behind the stamps


def read_clock(stamps: Array) -> Clock:
    """Check the time stamps (n,) of a record and undo their rounding.

    Stamps are straightened if their rounding step matters compared with the sample interval. They
    are replaced by straight lines that differ from them by no more than the rounding: one line if
    the clock is even, several if it drifts or missed a tick. If no such lines explain a clock, it
    is really uneven, and its stamps are kept.
    """
    t, rounding, steps = stamps, decimal_step(stamps), np.diff(stamps)
    pieces = () if np.ptp(steps) <= 1e-6 * _mean_step(stamps) else _pieces(stamps, rounding)
    if pieces:
        t = stamps.copy()
        for piece in pieces:
            t[piece] = _line(stamps[piece])
    if (np.diff(t) <= 0).any():
        t, count = _steady(stamps, rounding)
        return Clock(t=t, rounding=rounding, pieces=count)
    return Clock(t=t, rounding=rounding, pieces=len(pieces))


def _pieces(stamps: Array, rounding: float) -> tuple[slice, ...]:
    """Return the pieces that straight lines explain; none if they cover too little."""
    found: list[slice] = []
    mean, steps = _mean_step(stamps), np.diff(stamps)
    # A rounding step of up to 0.2 % of the interval does no harm.
    matters = steps.min() >= 0 and mean > 0 and rounding > 2e-3 * mean
    waiting = [(0, stamps.size)] if matters else []
    while waiting:
        start, end = waiting.pop()
        piece = stamps[start:end]
        if _is_straight(piece, rounding):
            found.append(slice(start, end))
        # Pieces of fewer than 32 samples would fit a line by chance.
        elif piece.size >= 2 * 32:
            pauses = _pauses(piece, rounding)
            middle = start + (int(pauses[0]) if pauses.size else piece.size // 2)
            waiting += [(middle, end), (start, middle)]
    # If straight pieces cover less than 80 %, the clock itself is uneven.
    explained = sum(piece.stop - piece.start for piece in found) >= 0.8 * stamps.size
    return tuple(found) if explained else ()


def _steady(stamps: Array, rounding: float) -> tuple[Array, int]:
    """Return even times for stamps that repeat because they are rounded to a sample or more.

    Between pauses, a straight line replaces them; they may scatter about it by a few samples. Other
    stamps are kept, with 0 lines: a clock that stands still by itself is no rounded one.
    """
    bounds = [0, *_pauses(stamps, rounding).tolist(), stamps.size]
    pieces = [stamps[a:b] for a, b in pairwise(bounds)]
    repeats = np.mean(np.diff(stamps) == 0) if (np.diff(stamps) >= 0).all() else 0.0
    # If a sample is shorter than the rounding, at least one stamp in twenty repeats.
    if repeats < 0.05 or min(piece.size for piece in pieces) < FEWEST_SAMPLES:
        return stamps, 0
    moments = [(_centred(piece.size), piece) for piece in pieces]
    slope = float(sum(i @ p for i, p in moments) / sum(i @ i for i, _ in moments))
    t = np.concatenate([_line(piece, slope=slope) for piece in pieces])
    scatter = float(np.sqrt(np.mean((t - stamps) ** 2)))
    if rounding < 0.4 * slope or scatter > 2 * (rounding + slope) or (np.diff(t) <= 0).any():
        return stamps, 0
    return t, len(pieces)


def _mean_step(stamps: Array) -> float:
    return float((stamps[-1] - stamps[0]) / (stamps.size - 1))


def _late(stamps: Array, usual: float, rounding: float) -> NDArray[np.intp]:
    """Return the samples before which time is missing, from the usual interval."""
    return np.flatnonzero(np.diff(stamps) > _GAP * usual + 1.5 * rounding) + 1


def _pauses(stamps: Array, rounding: float) -> NDArray[np.intp]:
    mean = _mean_step(stamps)
    return _late(stamps, min(float(np.median(np.diff(stamps))) or mean, mean) + rounding, rounding)


def _is_straight(stamps: Array, rounding: float) -> bool:
    """Return whether stamps (n,) are within the rounding of one line, but for a few late ones."""
    signed = (_line(stamps) - stamps) / rounding
    off = np.abs(signed)
    # Very few stamps may be one step off, because a tick was late or missing.
    if off.max() <= 1.5 and np.mean(off <= _ROUNDING_BAND) >= 0.99:
        return True
    # A stamp further from the line than 0.9 steps did not advance.
    if off.max() >= 0.9:
        return False
    # Imported late, because this takes a while and is seldom needed.
    from scipy.optimize import minimize_scalar

    # If a few stamps jump, a least-squares line tilts, but a strip of the rounding's width does
    # not.
    tilt = np.linspace(-1.0, 1.0, stamps.size)
    narrowest = minimize_scalar(lambda x: np.ptp(signed - x * tilt), bounds=(-2, 2))
    return bool(narrowest.fun <= 2 * _ROUNDING_BAND)


def _centred(n: int) -> Array:
    return np.arange(n, dtype=np.float64) - (n - 1) / 2


def _line(stamps: Array, *, slope: float | None = None) -> Array:
    """Return the least-squares straight line through the stamps, at each sample."""
    i = _centred(stamps.size)
    slope = float((i @ stamps) / (i @ i)) if slope is None else slope
    return float(stamps.mean()) + slope * i
