"""The error of a number and the points it earns.

The arithmetic is exact, so that a number exactly at a limit is judged correctly. Only this file
reads the tolerances of a criterion. So `judge.award` can apply another rubric to stored errors,
with the same result as grading again.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, TypeVar

from pipeline.grading import rubric as asked

if TYPE_CHECKING:
    from pipeline.grading.reference import Reference

Number = TypeVar("Number", float, Fraction)

NO_CREDIT = Fraction(10**6)  # percent; the error of a number that is zero or has the wrong sign
# The largest error that rounding may excuse, as a share of the number. It is that of a number with
# two digits, such as 10 for 10.5. One digit says too little about the measurement, and "0e2" says
# nothing.
_MOST_ROUNDING = Fraction(1, 20)


def half_digit(typed: Decimal) -> Fraction:
    """Return half a unit of the last typed digit: 0.005 for 0.10, 0.5 for 29."""
    exponent = typed.as_tuple().exponent
    if not isinstance(exponent, int):
        raise ValueError(f"{typed} is not a finite number")
    return Fraction(10) ** exponent / 2


def as_typed(typed: Decimal) -> str:
    """Return a number as its author typed it; Python would print `0e2` as `0E+2`."""
    return str(typed).replace("E+", "e").replace("E", "e")


def rounding(typed: Decimal) -> Fraction:
    """Return how far rounding may have moved a number: half of its last digit, at most 5 %."""
    return min(half_digit(typed), _MOST_ROUNDING * abs(Fraction(typed)))


def is_vague(typed: Decimal) -> bool:
    """Return whether a number has so few digits that its rounding is not fully excused."""
    return half_digit(typed) > _MOST_ROUNDING * abs(Fraction(typed))


@lru_cache(1024)  # a rubric has few numbers, and a class uses each very often
def exact(value: float) -> Fraction:
    """Return a number of a rubric as its author typed it: 0.1 is exactly a tenth."""
    return Fraction(repr(value))


def percent_off(typed: Decimal, reference: "Reference", *, sigmas: float) -> Fraction:
    """Return the error of a number against its reference, in percent of the smaller of the two.

    So an error of 5 % is a factor of 1.05 either way. Rounding, and `sigmas` standard errors of the
    reference, are subtracted first. Any value between the reference's bounds is right.
    """
    slack = exact(sigmas) * Fraction(reference.std)
    low, high = Fraction(reference.low) - slack, Fraction(reference.high) + slack
    half = rounding(typed)
    nothing, least, most = Fraction(0), Fraction(typed) - half, Fraction(typed) + half
    return _apart(least, most, low, high, nothing=nothing, worst=NO_CREDIT)


@dataclass(frozen=True, kw_only=True)
class Typed:
    """A typed number in floating point, for fast comparison with many references.

    Attributes
    ----------
    excused : the largest error that is excused as rounding.
    hidden : half a unit of the last digit, as a share of the number.
    """

    value: float
    excused: float
    hidden: float
    digits: int

    @classmethod
    def of(cls, typed: Decimal) -> "Typed":
        """Return a typed number as `Typed`."""
        return cls(
            value=float(typed),
            excused=float(rounding(typed)),
            hidden=float(half_digit(typed) / abs(Fraction(typed))) if typed else math.inf,
            digits=len(typed.as_tuple().digits),
        )

    def percent_off(self, reference: "Reference", *, sigmas: float) -> float:
        """Return the same as the function `percent_off`, in floating point.

        The result is not exact enough to judge a number at a limit.
        """
        slack = sigmas * reference.std
        low, high = reference.low - slack, reference.high + slack
        least, most = self.value - self.excused, self.value + self.excused
        return _apart(least, most, low, high, nothing=0.0, worst=float(NO_CREDIT))


def _apart(
    least: Number, most: Number, low: Number, high: Number, *, nothing: Number, worst: Number
) -> Number:
    """Return the gap between two intervals, in percent of the smaller end.

    Parameters
    ----------
    nothing : the result if the intervals overlap.
    worst : the largest result, and the result for an interval that reaches zero.
    """
    if most < low:
        above, below = low, most
    elif least > high:
        above, below = least, high
    else:
        return nothing
    return min(100 * (above / below - 1), worst) if below > 0 else worst


def credit(error: Fraction, *, full: float, none: float) -> Fraction:
    """Return the share of the points that an error earns.

    It is 1 up to `full`, 0 from `none` on, and linear in between. If both are equal, an error of
    exactly this size still earns everything.
    """
    top, bottom = exact(full), exact(none)
    if error <= top:
        return Fraction(1)
    if error >= bottom:
        return Fraction(0)
    return (bottom - error) / (bottom - top)


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
