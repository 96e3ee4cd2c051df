"""The total of a grade: points in steps of the rubric, late deduction, adjustments."""

import math
from collections.abc import Sequence
from fractions import Fraction

from pipeline.grading.grade import Criterion, Grade
from pipeline.grading.rubric import Late, Rubric
from pipeline.grading.tolerance import exact
from pipeline.grading.words import points_text

_MOST_STEPS = 9  # one for each key of a page, from 1 to 9
_QUARTERS = 4


def to_step(points: Fraction, step: float) -> Fraction:
    """Round points to the rubric's step, halves up, with exact arithmetic."""
    return math.floor(points / exact(step) + Fraction(1, 2)) * exact(step)


def with_total(grade: Grade, criteria: Sequence[Criterion], *, rubric: Rubric) -> Grade:
    """Return the grade with these criteria, and the total that follows from them.

    Lateness is deducted from the points earned. Then the adjustments of the grade are added; the
    total never falls below 0.
    """
    earned = sum((exact(criterion.points) for criterion in criteria), Fraction(0))
    deducted = late_deduction(earned, late=rubric.late, step=rubric.step, days_late=grade.days_late)
    adjusted = sum((exact(one.points) for one in grade.adjustments), Fraction(0))
    by_person = {one.id for one in rubric.criteria if one.check == "manual"}
    changed = {
        "criteria": tuple(criteria),
        "points": float(max(earned - deducted + adjusted, Fraction(0))),
        "out_of": rubric.out_of,
        "deducted": float(deducted),
        "open": tuple(c.id for c in criteria if c.id in by_person and c.outcome == "skip"),
    }
    return grade.model_copy(update=changed)


def late_deduction(earned: Fraction, *, late: Late, step: float, days_late: float) -> Fraction:
    """Return the deduction from the points earned, for every day begun after the grace period.

    It is rounded to the rubric's step; a half is rounded down, in the student's favour.
    """
    days = max(0, math.ceil(days_late - late.grace_days))
    share = min(exact(late.percent_per_day) * days, exact(late.most_percent)) / 100
    return -to_step(-earned * share, step)


def point_steps(out_of: float, *, step: float) -> list[float]:
    """Return up to nine choices of points from 0 to `out_of`, one for each key from 1 to 9.

    These are the multiples of the rubric's step. If those are too many, they are the quarters of
    `out_of`, rounded to a step.
    """
    whole = exact(out_of)
    fine = [n * exact(step) for n in range(_MOST_STEPS) if n * exact(step) < whole]
    if (len(fine)) * exact(step) < whole:
        fine = [to_step(whole * n / _QUARTERS, step) for n in range(_QUARTERS)]
    return [float(points) for points in dict.fromkeys([*fine, whole])]


def list_steps(out_of: float, rubric: Rubric) -> list[str]:
    """Return the points of `point_steps` as text."""
    return [points_text(points) for points in point_steps(out_of, step=rubric.step)]
