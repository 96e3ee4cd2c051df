"""What lateness takes off."""

import math
from fractions import Fraction

from pipeline.grading.rubric import Late
from pipeline.grading.tolerance import exact

_CENTS = 100  # points are taken to the hundredth


def late_deduction(earned: Fraction, *, late: Late, days_late: float) -> Fraction:
    """Return the points off those earned: so much for every day begun after the grace."""
    days = max(0, math.ceil(days_late - late.grace_days))
    share = min(exact(late.percent_per_day) * days, exact(late.most_percent)) / 100
    return Fraction(math.floor(earned * share * _CENTS + Fraction(1, 2)), _CENTS)
