"""Sample times: checked, and straightened where the file had rounded them."""

from dataclasses import dataclass

import numpy as np

from pipeline.plant.chain import Array

SLOW = 0.5  # s between samples; no bench records so slowly, a file in ms or in samples looks so
_FINEST_DECIMAL = 9  # a file that prints time beyond the nanosecond has not rounded it
_ON_STEP = 0.02  # of a step; a value farther off is no multiple
_WORTH_STRAIGHTENING = 2e-3  # rounding below this share of the sample interval does no harm
_ROUNDING_BAND = 0.65  # of the rounding step: half of it, and what the fit of a short piece errs
_ROUNDING_REACH, _IN_BAND = 1.5, 0.99  # a rare stamp may be a step off: a late tick, a beat
_SHORTEST_PIECE = 32  # samples; a fit of fewer leaves the band by chance
_MOSTLY = 0.8  # share of samples on straight pieces below which the clock itself is uneven
_GAP = 4.0  # a gap is an interval of so many usual ones


@dataclass(frozen=True, kw_only=True, eq=False)
class Clock:
    """The times of a record.

    Attributes
    ----------
    t : (n,) s; straightened where `pieces` is not 0.
    rounding : s; the decimal step all stamps are multiples of, 0 where there is none.
    pieces : how many straight lines replaced the rounded stamps; 0: the stamps as they are.
    stopped : sample (from 0) where time does not advance, or None.
    gaps : samples (from 0) before which time is missing.
    """

    t: Array
    rounding: float
    pieces: int
    stopped: int | None
    gaps: tuple[int, ...]

    @property
    def interval(self) -> float:
        """The usual sample interval, s."""
        return float(np.median(np.diff(self.t))) if self.pieces == 0 else self.mean_interval

    @property
    def mean_interval(self) -> float:
        """The mean sample interval, s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))

    @property
    def jitter(self) -> float:
        """Root-mean-square deviation of the intervals (gaps aside) from their median, s."""
        steps = np.diff(self.t)
        usual = np.median(steps)
        return float(np.sqrt(np.mean((steps[steps < _GAP * usual] - usual) ** 2)))


def read_clock(stamps: Array) -> Clock:
    """Check time stamps and undo their rounding where a straight clock explains them.

    Stamps rounded to a step that matters against the sample interval are replaced by straight
    lines (one where the clock is even; more where it drifts or missed a beat) that stay within
    the rounding. A clock that no such lines explain is uneven in truth: its stamps are kept.
    """
    rounding = decimal_step(stamps)
    t, pieces = stamps, 0
    mean = (stamps[-1] - stamps[0]) / (stamps.size - 1)
    steps = np.diff(stamps)
    uneven = np.ptp(steps) > 1e-6 * abs(mean)
    backwards = bool((steps < 0).any())
    if uneven and not backwards and 0 < mean and rounding > _WORTH_STRAIGHTENING * mean:
        t, pieces = _straighten(stamps, rounding)
    steps = np.diff(t)
    stopped = int(np.argmax(steps <= 0)) + 1 if (steps <= 0).any() else None
    usual = np.median(steps)
    gaps = np.flatnonzero(steps > _GAP * usual + 1.5 * rounding) + 1 if usual > 0 else ()
    return Clock(
        t=t,
        rounding=rounding,
        pieces=pieces,
        stopped=stopped,
        gaps=tuple(int(i) for i in gaps),
    )


def decimal_step(values: Array) -> float:
    """Return the largest power of ten (1 s at most) that all values are multiples of, or 0."""
    for digits in range(_FINEST_DECIMAL + 1):
        step = 10.0**-digits
        multiples = values / step
        # A double near 1e5 s in steps of 1e-9 s is itself only good to a hundredth of the step.
        rounding = 1e-6 + 4 * np.finfo(np.float64).eps * np.abs(multiples).max()
        if np.abs(multiples - np.round(multiples)).max() < min(rounding, _ON_STEP):
            return step
    return 0.0


def _straighten(stamps: Array, rounding: float) -> tuple[Array, int]:
    """Return straight times and the number of lines, or the stamps and 0."""
    t, on_lines, pieces = stamps.copy(), 0, 0
    waiting = [(0, stamps.size)]
    while waiting:
        start, end = waiting.pop()
        line = _line(stamps[start:end])
        off = np.abs(line - stamps[start:end]) / rounding
        if off.max() <= _ROUNDING_REACH and np.mean(off <= _ROUNDING_BAND) >= _IN_BAND:
            t[start:end] = line
            on_lines, pieces = on_lines + end - start, pieces + 1
        elif end - start >= 2 * _SHORTEST_PIECE:
            middle = (start + end) // 2
            waiting += [(start, middle), (middle, end)]
    if on_lines < _MOSTLY * stamps.size or (np.diff(t) <= 0).any():
        return stamps, 0
    return t, pieces


def _line(stamps: Array) -> Array:
    """Return the least-squares straight line through the stamps, at each sample."""
    i = np.arange(stamps.size) - (stamps.size - 1) / 2
    return stamps.mean() + i * (i @ stamps) / (i @ i)
