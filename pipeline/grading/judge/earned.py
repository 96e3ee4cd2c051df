"""What a criterion earns: its tolerances, applied to how far each of its numbers is off.

Nothing else reads a tolerance. So what was found once is weighed again under another rubric with
the same result as grading again, see `reweigh.py`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from pipeline.grading import rubric as asked
from pipeline.grading.references.tolerance import credit

ALL, NONE = Fraction(1), Fraction(0)  # shares of the points
Tolerance = Literal["number", "exact", "damping", "overshoot", "settling"]
# The keys of a criterion: up to the first all is earned, from the second on nothing.
TOLERANCES: Mapping[Tolerance, tuple[str, str]] = {
    "number": ("full_percent", "none_percent"),
    "exact": ("full_percent", "none_percent"),
    "damping": ("damping_full_percent", "damping_none_percent"),
    "overshoot": ("overshoot_full", "overshoot_none"),
    "settling": ("settling_full_percent", "settling_none_percent"),
}


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """How far a number is off, and which tolerance judges it.

    Attributes
    ----------
    error : in the unit of the tolerance (percent, or percentage points).
    by : `exact` is a zero or a one of a state model. It is given away where it is right, and
        counts like any other number where it is wrong.
    """

    error: Fraction
    by: Tolerance = "number"


def earned_by(criterion: asked.Criterion, deviation: Deviation) -> Fraction:
    """Return the share of its points that one number earns."""
    full, none = (getattr(criterion, key) for key in TOLERANCES[deviation.by])
    return credit(deviation.error, full=full, none=none)


def earned(criterion: asked.Criterion, deviations: Sequence[Deviation]) -> Fraction:
    """Return the share that numbers earn together; at least one.

    Gains must meet all of the goal, so the worst counts. Elsewhere numbers share the points evenly.
    """
    shares = [earned_by(criterion, deviation) for deviation in deviations]
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
    """Return the mean of some shares; at least one."""
    return sum(shares, NONE) / len(shares)
