"""The points of a criterion: its tolerances applied to the errors of its numbers.

Only this file reads tolerances. So `recompute.py` can apply another rubric to stored errors, with
the same result as grading again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from pipeline.grading import rubric as asked
from pipeline.grading.references.tolerance import credit

ALL, NONE = Fraction(1), Fraction(0)  # shares of the points
Tolerance = Literal["number", "exact", "damping", "overshoot", "settling"]
# For each tolerance, two keys of a criterion: the largest error with full points, and the smallest
# error without points.
TOLERANCES: Mapping[Tolerance, tuple[str, str]] = {
    "number": ("full_percent", "none_percent"),
    "exact": ("full_percent", "none_percent"),
    "damping": ("damping_full_percent", "damping_none_percent"),
    "overshoot": ("overshoot_full", "overshoot_none"),
    "settling": ("settling_full_percent", "settling_none_percent"),
}


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """The error of a number, and the tolerance that judges it.

    Attributes
    ----------
    error : the error in percent, or in percentage points for an overshoot.
    by : name of the tolerance. `exact` is for an entry of a state model that must be 0 or 1. A
        right 0 or 1 is ignored, because it is no achievement.
    """

    error: Fraction
    by: Tolerance = "number"


def points_for_one(criterion: asked.Criterion, deviation: Deviation) -> Fraction:
    """Return the share of the criterion's points that one number earns."""
    full, none = (getattr(criterion, key) for key in TOLERANCES[deviation.by])
    return credit(deviation.error, full=full, none=none)


def points_for(criterion: asked.Criterion, deviations: Sequence[Deviation]) -> Fraction:
    """Return the share of the criterion's points that one or more numbers earn together.

    Gains must meet the whole goal, so the worst number counts. In other criteria, all numbers count
    equally.
    """
    shares = [points_for_one(criterion, deviation) for deviation in deviations]
    if isinstance(criterion, asked.Gains):
        return min(shares)
    return mean_share(
        [
            share
            for share, deviation in zip(shares, deviations, strict=True)
            if deviation.by != "exact" or share < 1
        ]
    )


def mean_share(shares: Sequence[Fraction]) -> Fraction:
    """Return the mean of shares; needs at least one."""
    return sum(shares, NONE) / len(shares)
