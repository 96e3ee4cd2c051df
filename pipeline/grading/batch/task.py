"""The data sent to and from a grading process; importing this module loads no grading code."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pipeline.grading.grade import Grade, grade_text
from pipeline.grading.gradings import Grading
from pipeline.grading.rubric import Rubric

OUT_OF_MEMORY = "needs more memory than allowed"


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Settings for grading, the same for all submissions of a batch.

    Attributes
    ----------
    scratch : folder for copies of the submissions during grading.
    time_limit : time limit for one submission, in s.
    memory_limit : memory limit for one submission, in bytes, added to what an idle process needs.
    out : folder of the class, with repairs of submissions; None for a class in a database.
    """

    rubric: Rubric
    scratch: Path
    time_limit: float = 120.0
    memory_limit: int = 1_000_000_000
    figures: bool = False
    out: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Task:
    """One submission to grade.

    Attributes
    ----------
    id, owner, days_late : as in `intake.find.HandIn`.
    key : hash of everything that affects the outcome; see `gradings.Member`.
    digest : expected hash of the submitted files; "" to skip this check.
    repairs : see `intake.repairs.read_repairs`.
    """

    id: str
    key: str
    sources: tuple[str, ...]
    digest: str = ""
    owner: str = ""
    days_late: float = 0.0
    repairs: Mapping[str, Mapping[str, str]] = field(default_factory=dict, hash=False)


def failed(
    task: Task,
    reason: str,
    *,
    out_of: float,
    authors: Sequence[str] = (),
    settled: bool = True,
    detail: str = "",
) -> Grading:
    """Return the outcome of a submission that could not be graded.

    Parameters
    ----------
    reason : why the submission could not be graded, one cause per line.
    settled : whether the outcome is final; if not, the next run grades the submission again.
    """
    lines = (" ".join(line.split()) for line in reason.split("\n"))
    reason = "".join(c if c.isprintable() or c == "\n" else "�" for c in "\n".join(lines))
    people = tuple(authors)
    grade = Grade.failed(
        task.id,
        reason,
        out_of=out_of,
        authors=people,
        days_late=task.days_late,
        unsettled=not settled,
    )
    return Grading(
        submission=task.id,
        authors=people,
        key=task.key,
        status="failed",
        reason=reason,
        settled=settled,
        days_late=task.days_late,
        grade=grade_text(grade),
        owner=task.owner,
        detail=detail,
    )


def plain_grading(outcome: Grading) -> dict[str, Any]:
    """Return an outcome as a dictionary that JSON can store."""
    return asdict(outcome) | {"fingerprints": base64.b64encode(outcome.fingerprints).decode()}


def read_grading(plain: Mapping[str, Any]) -> Grading:
    """Return the outcome that `plain_grading` turned into a dictionary."""
    return Grading(
        **{
            **plain,
            "fingerprints": base64.b64decode(plain["fingerprints"]),
            "authors": tuple(plain["authors"]),
            "figures": tuple((name, svg) for name, svg in plain["figures"]),
        }
    )
