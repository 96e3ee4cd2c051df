"""What grading one submission ends in: criteria with points, flags with evidence, `grade.json`."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

from pipeline.results_json import plain_json
from pipeline.schemas.grade import Code, Outcome

SCHEMA = "cartlab-grade/1"

CODES: tuple[Code, ...] = get_args(Code)


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """One line of the grade.

    Attributes
    ----------
    outcome : `skip` where a criterion it builds on failed, or no reference could be had.
    message : one sentence for the student.
    expected, found : by parameter or entry, for the table in the feedback.
    """

    id: str
    title: str
    outcome: Outcome
    points: float
    out_of: float
    message: str
    expected: dict[str, Any]
    found: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Flag:
    """What a TA would write in the margin: a named mistake, where, and the evidence for it.

    Attributes
    ----------
    parameters : the reported numbers it explains, or what is missing, or the runs concerned.
    message : one kind sentence of help.
    evidence : the telling number as reported, as recomputed, and what the mistake makes of it.
    """

    code: Code
    parameters: tuple[str, ...]
    message: str
    evidence: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Grade:
    """The grade of one submission; `failed` where it could not be graded, for the `reason` given.

    Attributes
    ----------
    deducted : points taken off for lateness, already out of `points`.
    notes : what the reader must know about how it was graded.
    springs : that the recordings ask for and the rubric does not have.
    """

    submission: str
    authors: tuple[str, ...]
    status: Literal["graded", "failed"]
    points: float
    out_of: float
    days_late: float = 0
    deducted: float = 0.0
    reason: str = ""
    criteria: tuple[Criterion, ...] = ()
    flags: tuple[Flag, ...] = ()
    notes: tuple[str, ...] = ()
    springs: tuple[str, ...] = ()

    def with_flags(self, *flags: Flag) -> "Grade":
        """Return the grade with further flags, in the order of the codes."""
        together = sorted((*self.flags, *flags), key=lambda flag: CODES.index(flag.code))
        return replace(self, flags=tuple(together))


def grade_dict(grade: Grade) -> dict[str, Any]:
    """Return the grade as plain data, in the order of `grade.json`."""
    return {"schema": SCHEMA, **asdict(grade)}


def grade_text(grade: Grade) -> str:
    """Return `grade.json` as text; same grade, same bytes."""
    plain = plain_json(grade_dict(grade))
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
