"""Find how many lines are missing from a run, and the true period, from its time stamps.

Stamps are whole milliseconds. Near 1 kHz, a clock with a period of 1.0024 ms skips one stamp every
417 ms although no line is lost. So a single gap proves nothing. But the skips of a clock are evenly
spaced, like the teeth of a comb, and lost lines are not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]

OTHER_PERIOD = 0.02  # relative difference from the stated period that shows another period
_SLOW = 1.5  # ms; with this period or a longer one, every gap shows a lost line
_MOST_ABSENT = 0.2  # share of the stamps; if more are missing, the clock is slower than 1 kHz
# Number of stamps between skips of a clock with a period of 1.05 ms; no bench for 1 kHz is slower.
_CLOSEST_TEETH = 20
_TOOTH_SLACK = 1  # ms by which a tooth may be off, because stamps are rounded
_FIRST_TEETH, _SECOND_TEETH = 60, 120  # numbers of stamps tried as first and second tooth


@dataclass(frozen=True, kw_only=True)
class StampFit:
    """The clock of a run.

    Attributes
    ----------
    period : ms from line to line.
    """

    period: float
    missing: int


def fit_stamps(stamps: Stamps, *, period: float, stated: bool = False) -> StampFit:
    """Return the clock that explains the time stamps of a run.

    The expected period is used only if the stamps are not conclusive. This can happen in a short
    run with losses, with a period below 1 ms, or with one within about 1e-5 of 1 ms. A period that
    the bench stated is also used if too many lines are missing.

    Parameters
    ----------
    stamps : (n,) time stamps in ms, never decreasing.
    period : expected period, in ms.
    stated : whether the bench itself stated the period.
    """
    n = stamps.size
    if n < 2 or stamps[-1] == stamps[0]:
        return StampFit(period=period, missing=0)
    if (slope := even_period(stamps)) is not None:
        return StampFit(period=slope, missing=0)
    if stated and (measured := _other_period(stamps, period)) is not None:
        return measured
    steps, span = np.diff(stamps), int(stamps[-1] - stamps[0])
    missing = max(0, round(span / period) + 1 - n)
    if stated and missing > _MOST_ABSENT * span / period:
        return StampFit(period=period, missing=missing)
    usual = float(np.median(steps))
    if usual >= _SLOW:
        # Rounding gives usual gaps of two sizes; average both.
        measured = float(steps[steps < usual + _SLOW].mean())
        lost = int((np.round(steps / measured) - 1).clip(min=0).sum())
        return StampFit(period=span / (n - 1 + lost), missing=lost)
    if span + 1 - np.unique(stamps).size > _MOST_ABSENT * span:  # or the clock has jumped
        if stated or period >= 1 / (1 - _MOST_ABSENT):
            return StampFit(period=period, missing=missing)
        # The period of this bench is not the expected one.
        return StampFit(period=span / (n - 1), missing=0)
    if not 1.0 <= period < 1.0 + 1.0 / _CLOSEST_TEETH:
        return StampFit(period=period, missing=missing)
    seen = np.zeros(span + 1, dtype=np.bool_)
    seen[stamps - stamps[0]] = True
    absent = np.flatnonzero(~seen).tolist()
    teeth = _comb(absent)
    chance = (1 + 2 * _TOOTH_SLACK) * len(absent) / span  # probability of a false tooth
    # Such a comb forms by chance from lost lines in less than one of a hundred runs.
    if teeth and _FIRST_TEETH * _SECOND_TEETH * chance ** (len(teeth) - 2) < 0.01:
        spacing = (teeth[-1] - teeth[0]) / (len(teeth) - 1)
        return StampFit(period=spacing / (spacing - 1), missing=len(absent) - len(teeth))
    skips = round(span * (1 - 1 / period))
    return StampFit(period=period, missing=max(0, len(absent) - skips))


def even_period(stamps: Stamps) -> float | None:
    """Return the period if one regular clock explains all stamps without a lost line, else None."""
    i = np.arange(stamps.size) - (stamps.size - 1) / 2
    slope = float(i @ stamps / (i @ i))
    # Stamps of a regular clock lie within 1 ms of a straight line; with a lost line they spread
    # over 1.5 ms or more.
    return slope if slope > 0 and np.ptp(stamps - slope * i) < 1.25 else None


def _other_period(stamps: Stamps, stated: float) -> StampFit | None:
    """Return the clock measured in parts of the run without a lost line.

    The result is None if there are too few such parts, if their periods differ, or if the stated
    period is right.
    """
    long = 200  # lines in a piece; if one line in a hundred is lost, most pieces lack some
    pieces = [stamps[i : i + long + 1] for i in range(0, stamps.size - long, long)]
    even = [period for piece in pieces if (period := even_period(piece)) is not None]
    if len(even) < max(0.25 * len(pieces), 1):
        return None
    measured = float(np.median(even))
    if abs(measured / stated - 1) <= OTHER_PERIOD or max(even) - min(even) > 0.01 * measured:
        return None
    span = int(stamps[-1] - stamps[0])
    missing = sum(
        max(0, round(int(piece[-1] - piece[0]) / measured) - long)
        for piece in pieces
        if even_period(piece) is None
    )
    return StampFit(period=span / (stamps.size - 1 + missing), missing=missing)


def _comb(absent: Sequence[int]) -> list[int]:
    """Return the skips of the clock: the longest evenly spaced series of missing stamps.

    The series must reach the last missing stamp, or end less than one spacing before it.
    """
    there = frozenset(absent)
    best: list[int] = []
    for i, first in enumerate(absent[:_FIRST_TEETH]):
        for second in absent[i + 1 : i + 1 + _SECOND_TEETH]:
            # Because every tooth must be a missing stamp, a comb with close teeth is rarely found
            # by chance. The comb with most teeth wins.
            teeth = _follow(first, second, there=there, last=absent[-1])
            best = max(best, teeth, key=len)
    return best


def _follow(first: int, second: int, *, there: frozenset[int], last: int) -> list[int]:
    """Return the evenly spaced series that begins with two given stamps; [] if it has a gap."""
    if second - first < _CLOSEST_TEETH:
        return []
    teeth = [first, second]
    while True:
        back = teeth[-16:]  # the last teeth only, because a clock may drift
        # Two teeth determine the spacing to a millisecond, many teeth to a fraction of it.
        expected = back[-1] + (back[-1] - back[0]) / (len(back) - 1)
        slack = _TOOTH_SLACK + 1.0 / (len(back) - 1)
        low, high = int(np.ceil(expected - slack)), int(np.floor(expected + slack))
        if high > last:
            return teeth
        near = [stamp for stamp in range(low, high + 1) if stamp in there]
        if not near:
            return []
        teeth.append(min(near, key=lambda stamp: abs(stamp - expected)))
