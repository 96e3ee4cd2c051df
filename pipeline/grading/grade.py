"""The grade of a submission: `grade.json`; and the grades of a class as a table."""

from collections.abc import Iterable
from math import nan
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from pipeline.json_files import json_text
from pipeline.setup import Units

if TYPE_CHECKING:
    import pandas as pd

    from pipeline.grading.rubric import Rubric

Outcome = Literal["pass", "partial", "fail", "skip"]
Code = Literal[
    "hz_for_rad_s",
    "peak_count",
    "peak_for_steady_state",
    "peak_to_peak",
    "transient_used",
    "carts_swapped",
    "counts_for_length",
    "log10_for_ln",
    "factor_of_ten",
    "no_fit_done",
    "final_off",
    "initial_off",
    "initial_final_disagree",
    "physically_impossible",
    "wrong_state_space",
    "wrong_gains",
    "wrong_prefilter",
    "missing",
    "shared_data",
    "data_problem",
]
CODES: tuple[Code, ...] = get_args(Code)
Values = dict[str, Any]  # numbers, texts, or lists of numbers or texts


class GradeTable(BaseModel):
    """A table in `grade.json`; unknown keys are allowed, because later versions may add keys."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Criterion(GradeTable):
    """The result of one criterion.

    The outcome is `skip` if the criterion depends on another one that failed, or if nothing could
    be judged.
    """

    id: str
    title: str
    outcome: Outcome
    points: float
    out_of: float
    message: str
    expected: Annotated[Values, Field(description="expected values, by name")]
    found: Annotated[Values, Field(description="values in the submission, by name")]


class Flag(GradeTable):
    """A mistake that the grader names, with its place and evidence."""

    code: Code
    parameters: Annotated[
        tuple[str, ...],
        Field(
            description="numbers that the mistake explains, missing items, or recordings concerned"
        ),
    ]
    message: str
    evidence: Values


class GradeOverride(GradeTable):
    """Points given by hand; the points of the criterion already include them."""

    criterion: str
    points: float
    why: str


class Adjustment(GradeTable):
    """A change of the total by a person; `points` of the grade already include it."""

    points: Annotated[float, Field(description="points added; negative for a deduction")]
    why: str


class Grade(GradeTable):
    """The grade of one submission."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)

    schema_: Annotated[Literal["cartlab-grade/1"], Field(alias="schema")] = "cartlab-grade/1"
    submission: str
    authors: Annotated[tuple[str, ...], Field(description="empty if names are left out")]
    status: Literal["graded", "failed"]
    points: float
    out_of: float
    days_late: float = 0.0
    deducted: Annotated[
        float, Field(description="deduction for lateness, already subtracted from `points`")
    ] = 0.0
    reason: Annotated[
        str,
        Field(description="why the submission could not be graded, one line per reason, or empty"),
    ] = ""
    unsettled: Annotated[
        bool,
        Field(
            description="whether a limit, a crash or this computer ended the grading; the next run "
            "grades the submission again"
        ),
    ] = False
    criteria: tuple[Criterion, ...] = ()
    flags: tuple[Flag, ...] = ()
    notes: tuple[str, ...] = ()
    repaired: Annotated[
        str, Field(description="who repaired submission.toml before grading, and why; or empty")
    ] = ""
    units: Annotated[
        Units | None,
        Field(description="units of the numbers in the criteria; null if nothing was judged"),
    ] = None
    springs: Annotated[
        tuple[str, ...],
        Field(description="springs that the recordings need and the rubric lacks"),
    ] = ()
    overrides: tuple[GradeOverride, ...] = ()
    adjustments: Annotated[
        tuple[Adjustment, ...],
        Field(description="changes of the total by hand; the total never falls below 0"),
    ] = ()
    open: Annotated[
        tuple[str, ...],
        Field(description="criteria that a person has not graded yet; if any, points may rise"),
    ] = ()

    def criterion(self, id_: str) -> Criterion | None:
        """Return the result of a criterion; None if it was not judged."""
        return next((own for own in self.criteria if own.id == id_), None)

    @property
    def judged(self) -> dict[str, Criterion]:
        """The results of the criteria, by id, without those that a person has yet to grade."""
        return {own.id: own for own in self.criteria if own.id not in self.open}

    @property
    def codes(self) -> tuple[Code, ...]:
        """The codes of the flags, each once."""
        return tuple(dict.fromkeys(flag.code for flag in self.flags))

    @property
    def by_hand(self) -> tuple[str, ...]:
        """The ids of the criteria with points given by hand, and `total` if that was adjusted."""
        total = ("total",) if self.adjustments else ()
        return (*(given.criterion for given in self.overrides), *total)

    @property
    def in_doubt(self) -> bool:
        """Whether a person should look: there is a flag, or something is not graded."""
        return bool(self.flags or self.open or self.unsettled) or self.status == "failed"

    @property
    def lost(self) -> frozenset[str]:
        """The judged criteria without full points; an open criterion has lost nothing yet."""
        lost = (criterion.id for criterion in self.criteria if criterion.points < criterion.out_of)
        return frozenset(lost).difference(self.open)

    @classmethod
    def failed(
        cls,
        submission: str,
        reason: str,
        *,
        out_of: float,
        authors: tuple[str, ...],
        days_late: float,
        unsettled: bool = False,
    ) -> "Grade":
        """Return the grade of a submission that could not be graded."""
        return cls(
            submission=submission,
            authors=authors,
            status="failed",
            points=0.0,
            out_of=out_of,
            days_late=days_late,
            reason=reason,
            unsettled=unsettled,
        )

    @property
    def awaits_grading(self) -> bool:
        """Whether the next run grades the submission again and nobody gave points by hand."""
        return self.unsettled and not self.by_hand

    def with_flags(self, *flags: Flag) -> "Grade":
        """Return the grade with further flags; all flags are sorted in the order of `Code`."""
        together = sorted((*self.flags, *flags), key=lambda flag: CODES.index(flag.code))
        return self.model_copy(update={"flags": tuple(together)})


def grade_text(grade: Grade) -> str:
    """Return `grade.json` as text; the same grade gives the same bytes."""
    return json_text(grade)


def read_grade(text: str) -> Grade:
    """Return the grade that a `grade.json` contains.

    Raises
    ------
    ValueError : the text is not a grade.
    """
    return Grade.model_validate_json(text)


_COLUMNS = (
    "submission", "authors", "status", "days_late", "total", "total_out_of", "remarks",
    "criterion", "outcome", "points", "out_of", "by_hand",
)  # fmt: skip


def class_frame(grades: Iterable[Grade], *, rubric: "Rubric") -> "pd.DataFrame":
    """Return the class as a table with one row per submission and criterion.

    Columns about the submission: `submission`, `authors`, `status`, `days_late`, `total` (after the
    deduction for lateness), `total_out_of`, `remarks` (codes of flags). Spaces separate the items
    of a list, as in `grades.csv`.

    Columns about the criterion: `criterion`, `outcome`, `points`, `out_of`, `by_hand`. A criterion
    that was never judged has an empty outcome, and its points are NaN.
    """
    import pandas as pd  # imported late: it takes 0.2 s, and grading does not need it

    rows = []
    for grade in grades:
        whole = (
            grade.submission,
            " ".join(grade.authors),
            grade.status,
            grade.days_late,
            grade.points,
            grade.out_of,
            " ".join(grade.codes),
        )
        judged, by_hand = grade.judged, grade.by_hand
        for asked in rubric.criteria:
            own = judged.get(asked.id)
            came_to = (own.outcome, own.points) if own else ("", nan)
            rows.append((*whole, asked.id, *came_to, asked.points, asked.id in by_hand))
    return pd.DataFrame(rows, columns=[*_COLUMNS])
