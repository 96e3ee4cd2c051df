"""Grades and outcomes for tests of the gradebook and of what is written from it."""

from pathlib import Path
from typing import Any

from pipeline.grading.batch import Outcome
from pipeline.grading.grade import Criterion, Flag, Grade, grade_text
from pipeline.grading.load import load_rubric
from pipeline.grading.rubric import Rubric
from pipeline.resources import RUBRICS


def two_cart_rubric() -> Rubric:
    """Return the shipped rubric for two carts: 20 points, 10 % a day."""
    return load_rubric(RUBRICS / "throne-2dof.toml")


def make_grade(name: str, *, share: float = 1.0, days_late: float = 0.0, **changes: Any) -> Grade:
    """Return a grade in which each criterion earned this share of its points."""
    criteria = tuple(
        Criterion(
            id=asked.id,
            title=asked.title,
            outcome="pass" if share == 1 else "fail" if share == 0 else "partial",
            points=round(share * asked.points, 2),
            out_of=asked.points,
            message="As expected." if share == 1 else "omega_1 is off.",
            expected={"omega_1": 19.6},
            found={"omega_1": 3.12},
        )
        for asked in two_cart_rubric().criteria
    )
    fields: dict[str, Any] = {
        "submission": name,
        "authors": (f"s-{name}",),
        "status": "graded",
        "points": round(sum(c.points for c in criteria), 2),
        "out_of": 20.0,
        "days_late": days_late,
        "criteria": criteria,
    }
    return Grade(**{**fields, **changes})


def failed_grade(name: str, reason: str) -> Grade:
    """Return the grade of a submission that could not be graded."""
    return Grade(
        submission=name, authors=(), status="failed", points=0.0, out_of=20.0, reason=reason
    )


def hertz_flag() -> Flag:
    """Return the flag of a frequency in the wrong unit."""
    return Flag(
        code="hz_for_rad_s",
        parameters=("omega_1",),
        message="3.12 is 19.6/2π: this looks like Hz where rad/s is asked.",
        evidence={"reported": 3.12, "recomputed": 19.6, "ratio": 0.159},
    )


def shared_flag(other: str) -> Flag:
    """Return the flag of a recording that stands in another submission too."""
    return Flag(
        code="shared_data",
        parameters=("step-1",),
        message=f"The recording of step-1 stands in {other} too.",
        evidence={"submissions": [other]},
    )


def make_outcome(grade: Grade, *, key: str = "", **changes: Any) -> Outcome:
    """Return the outcome that such a grade comes with."""
    fields: dict[str, Any] = {
        "submission": grade.submission,
        "authors": grade.authors,
        "key": key or f"key of {grade.submission}",
        "status": grade.status,
        "reason": grade.reason,
        "days_late": grade.days_late,
        "grade": grade_text(grade),
        "fingerprints": grade.submission.encode(),
    }
    return Outcome(**{**fields, **changes})


def read_text(path: Path) -> str:
    """Return a file's text as written, line ends included."""
    return path.read_bytes().decode()
