"""How many lines a run of time stamps lacks, and the true period behind them.

Stamps are whole milliseconds. Near 1 kHz a clock of 1.0024 ms skips a stamp every 417 ms although
no line is lost, so a difference of two tells nothing by itself. But the clock's own skips are
evenly spaced, like the teeth of a comb, and losses are not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.bench.thresholds import (
    ALIKE,
    BY_CHANCE,
    CLOSEST_TEETH,
    FEWEST_EVEN,
    MOST_ABSENT,
    OTHER_PERIOD,
    PIECE,
    SLOW,
    STRIP,
    TOOTH_SLACK,
)

Stamps = NDArray[np.int64]

_FIRST_TEETH, _SECOND_TEETH = 60, 120  # missing stamps tried as the comb's first two teeth
_RECENT = 16  # teeth the spacing is told from, for a clock that drifts


@dataclass(frozen=True, kw_only=True)
class StampFit:
    """The clock of a run.

    Attributes
    ----------
    period : ms from line to line.
    missing : lines that the clock ticked and that are not there.
    """

    period: float
    missing: int


def fit_stamps(stamps: Stamps, *, period: float, stated: bool = False) -> StampFit:
    """Return the clock behind stamps (n,) in ms, never falling; `period` (ms) is what is expected.

    The expectation counts only where the stamps do not tell: a short run with losses, a clock
    within some 1e-5 of 1 ms, or one that ticks twice within a millisecond. Where the bench itself
    `stated` it, it counts as well where more lines are missing than a comb can be told from.
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
    if stated and missing > MOST_ABSENT * span / period:
        return StampFit(period=period, missing=missing)
    usual = float(np.median(steps))
    if usual >= SLOW:
        measured = float(steps[steps < usual + SLOW].mean())  # rounding makes two usual steps
        lost = int((np.round(steps / measured) - 1).clip(min=0).sum())
        return StampFit(period=span / (n - 1 + lost), missing=lost)
    if span + 1 - np.unique(stamps).size > MOST_ABSENT * span:  # or the clock has leapt
        if stated or period >= 1 / (1 - MOST_ABSENT):
            return StampFit(period=period, missing=missing)
        return StampFit(period=span / (n - 1), missing=0)  # not the bench that is expected
    if not 1.0 <= period < 1.0 + 1.0 / CLOSEST_TEETH:
        return StampFit(period=period, missing=missing)
    seen = np.zeros(span + 1, dtype=np.bool_)
    seen[stamps - stamps[0]] = True
    absent = np.flatnonzero(~seen).tolist()
    teeth = _comb(absent)
    chance = (1 + 2 * TOOTH_SLACK) * len(absent) / span  # that a tooth is there though it is none
    if teeth and _FIRST_TEETH * _SECOND_TEETH * chance ** (len(teeth) - 2) < BY_CHANCE:
        spacing = (teeth[-1] - teeth[0]) / (len(teeth) - 1)
        return StampFit(period=spacing / (spacing - 1), missing=len(absent) - len(teeth))
    skips = round(span * (1 - 1 / period))
    return StampFit(period=period, missing=max(0, len(absent) - skips))


def even_period(stamps: Stamps) -> float | None:
    """Return the period of stamps that one even clock explains without a loss, else None."""
    i = np.arange(stamps.size) - (stamps.size - 1) / 2
    slope = float(i @ stamps / (i @ i))
    return slope if slope > 0 and np.ptp(stamps - slope * i) < STRIP else None


def _other_period(stamps: Stamps, stated: float) -> StampFit | None:
    """Return the clock of those pieces that are even, where it is another than the stated one.

    Lines that a bench loses leave no long piece even, unless they are few.
    """
    pieces = [stamps[i : i + PIECE + 1] for i in range(0, stamps.size - PIECE, PIECE)]
    even = [period for piece in pieces if (period := even_period(piece)) is not None]
    if len(even) < max(FEWEST_EVEN * len(pieces), 1):
        return None
    measured = float(np.median(even))
    if abs(measured / stated - 1) <= OTHER_PERIOD or max(even) - min(even) > ALIKE * measured:
        return None
    span = int(stamps[-1] - stamps[0])
    missing = sum(
        max(0, round(int(piece[-1] - piece[0]) / measured) - PIECE)
        for piece in pieces
        if even_period(piece) is None
    )
    return StampFit(period=span / (stamps.size - 1 + missing), missing=missing)


def _comb(absent: Sequence[int]) -> list[int]:
    """Return the absent stamps (ascending) that are the clock's own skips: the longest comb.

    Every tooth of it must be there, from the first absent stamps to the last.
    """
    there = frozenset(absent)
    best: list[int] = []
    for i, first in enumerate(absent[:_FIRST_TEETH]):
        for second in absent[i + 1 : i + 1 + _SECOND_TEETH]:
            # Closer teeth are the rarer find: a comb may miss none, so the most teeth win.
            teeth = _follow(first, second, there=there, last=absent[-1])
            best = max(best, teeth, key=len)
    return best


def _follow(first: int, second: int, *, there: frozenset[int], last: int) -> list[int]:
    """Return the teeth from the first two on; [] where one is missing before the end."""
    if second - first < CLOSEST_TEETH:
        return []
    teeth = [first, second]
    while True:
        back = teeth[-_RECENT:]
        # Two teeth tell their spacing to a millisecond, many to a fraction of it.
        expected = back[-1] + (back[-1] - back[0]) / (len(back) - 1)
        slack = TOOTH_SLACK + 1.0 / (len(back) - 1)
        low, high = int(np.ceil(expected - slack)), int(np.floor(expected + slack))
        if high > last:
            return teeth
        near = [stamp for stamp in range(low, high + 1) if stamp in there]
        if not near:
            return []
        teeth.append(min(near, key=lambda stamp: abs(stamp - expected)))
