"""The data of a class list that pages and tables show."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import nan
from typing import TYPE_CHECKING, Any

from typing_extensions import TypedDict  # pydantic needs this version before Python 3.12

from pipeline.grading.grade import (
    CODES,
    Adjustment,
    Code,
    Flag,
    Grade,
    GradeOverride,
    GradeTable,
    Outcome,
)
from pipeline.grading.gradebook.entry import whole_version
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import WORDS

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS = (
    "submission", "authors", "status", "days_late", "total", "total_out_of", "remarks",
    "criterion", "outcome", "points", "out_of", "by_hand",
)  # fmt: skip


class Judged(TypedDict):
    """The result of a criterion."""

    id: str
    outcome: Outcome
    points: float


class MistakeEvidence(TypedDict, total=False):
    """What the evidence of a flag says about the kind of mistake."""

    slip: str | None
    together_with: list[str]


class Flagged(TypedDict):
    """A mistake that the grader names."""

    code: Code
    evidence: MistakeEvidence


def slip_of(evidence: Mapping[str, Any]) -> str:
    """Return the kind of mistake behind a flag, in words; "-" if it is unknown."""
    others = (WORDS.text(f"title_{code}") for code in evidence.get("together_with", ()))
    return evidence.get("slip") or " and ".join(others) or "-"


class GradeSummary(GradeTable):
    """The parts of one `grade.json` that the pages and tables of a class need.

    Numbers and messages of the criteria are left out, because reading them takes a third of a
    second for 2,000 submissions.
    """

    submission: str
    authors: tuple[str, ...]
    status: str
    points: float
    out_of: float
    days_late: float = 0.0
    deducted: float = 0.0
    reason: str = ""
    unsettled: bool = False
    criteria: tuple[Judged, ...] = ()
    flags: tuple[Flagged, ...] = ()
    springs: tuple[str, ...] = ()
    overrides: tuple[GradeOverride, ...] = ()
    adjustments: tuple[Adjustment, ...] = ()
    open: tuple[str, ...] = ()

    @classmethod
    def of(cls, grade: Grade) -> "GradeSummary":
        """Return the line of a grade."""
        return cls.model_validate(grade.model_dump(include=set(cls.model_fields)))

    def sharing(self) -> "GradeSummary":
        """Return the line with the flag `shared_data`.

        The flag says that other submissions contain the same recordings.
        """
        flags = [*self.flags, Flagged(code="shared_data", evidence={})]
        flags.sort(key=lambda flag: CODES.index(flag["code"]))
        return self.model_copy(update={"flags": tuple(flags)})

    @cached_property
    def judged(self) -> dict[str, Judged]:
        """The results of the criteria, by id, without those that a person has yet to grade."""
        return {own["id"]: own for own in self.criteria if own["id"] not in self.open}

    @property
    def codes(self) -> tuple[Code, ...]:
        """The codes of the flags, each once."""
        return tuple(dict.fromkeys(flag["code"] for flag in self.flags))

    @property
    def slips(self) -> set[tuple[str, str]]:
        """The code of each flag with the kind of mistake."""
        return {(flag["code"], slip_of(flag["evidence"])) for flag in self.flags}

    @property
    def in_doubt(self) -> bool:
        """Whether a person should look: there is a flag, or something is not graded."""
        return bool(self.flags or self.open or self.unsettled) or self.status == "failed"

    @property
    def by_hand(self) -> tuple[str, ...]:
        """The ids of the criteria with points given by hand, and `total` if that was adjusted."""
        total = ("total",) if self.adjustments else ()
        return (*(given.criterion for given in self.overrides), *total)


@dataclass(frozen=True, kw_only=True)
class ClassRow:
    """A line of the class list with its current grade.

    Attributes
    ----------
    line : parts of the grade; on an anonymous page, its `submission` is a pseudonym.
    submission : name of the submission in the gradebook.
    grading : number of the grading in the gradebook.
    reviewed_by : name of the person who marked the grading as reviewed, or "".
    shared : the flag for recordings that other submissions also contain.
    first_key : key of the first version that was submitted under this name.
    made_of : data from which the line was computed; the line is valid until they change.
    """

    line: GradeSummary
    submission: str
    grading: int
    reviewed_by: str
    shared: Flag | None
    first_key: str
    made_of: tuple[Any, ...]

    @property
    def version(self) -> str:
        """Version of all that is known of the submission, as in `Entry.whole_version`."""
        return whole_version(self.grading, self.made_of[2:], is_shared=self.shared is not None)


@dataclass(frozen=True, kw_only=True)
class ClassNow:
    """The class list with current grades."""

    rubric: Rubric
    rows: tuple[ClassRow, ...]


def wrong_springs(graded: Iterable[tuple[str, ...]]) -> str:
    """Return a question for the instructor if recordings need springs missing from the rubric.

    Returns "" if there is nothing to ask.

    Parameters
    ----------
    graded : for each graded submission, the springs missing from the rubric.
    """
    every = list(graded)
    asking = [springs for springs in every if springs]
    if not asking:
        return ""
    names = ", ".join(dict.fromkeys(name for springs in asking for name in springs))
    return (
        f"the recordings of {len(asking)} of {len(every)} submissions need springs that the "
        f"rubric lacks ({names}), and were judged with these springs: does the rubric's [system] "
        "match the benches?"
    )


def class_frame(lines: Iterable[GradeSummary], *, rubric: Rubric) -> "pd.DataFrame":
    """Return the class as a table with one row per submission and criterion.

    Columns about the submission: `submission`, `authors`, `status`, `days_late`, `total` (after the
    deduction for lateness), `total_out_of`, `remarks` (codes of flags). Spaces separate the items
    of a list, as in `grades.csv`.

    Columns about the criterion: `criterion`, `outcome`, `points`, `out_of`, `by_hand`. A criterion
    that was never judged has an empty outcome, and its points are NaN.
    """
    import pandas as pd  # imported late: it takes 0.2 s, and grading does not need it

    rows = []
    for line in lines:
        whole = (
            line.submission,
            " ".join(line.authors),
            line.status,
            line.days_late,
            line.points,
            line.out_of,
            " ".join(line.codes),
        )
        for asked in rubric.criteria:
            own = line.judged.get(asked.id)
            came_to = (own["outcome"], own["points"]) if own else ("", nan)
            rows.append((*whole, asked.id, *came_to, asked.points, asked.id in line.by_hand))
    return pd.DataFrame(rows, columns=[*_COLUMNS])
