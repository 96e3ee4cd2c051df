"""The rubric: required items, criteria with points and tolerances, late policy."""

import re
from collections.abc import Container, Mapping
from datetime import datetime
from decimal import Decimal
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AwareDatetime,
    BeforeValidator,
    Field,
    create_model,
    model_serializer,
    model_validator,
)

from pipeline.grading.grade import CODES, Code, Flag, Grade
from pipeline.names import parameter_names
from pipeline.results import ExperimentKind
from pipeline.submission import Design, Students, System
from pipeline.submission.models import TomlTable
from pipeline.submission.toml import quote

Points = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
Percent = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
Sigmas = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=1000)]
Step = Annotated[float, Field(ge=0.01, le=1000, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class RequiredRuns(TomlTable):
    """A minimum number of experiments of one kind.

    Attributes
    ----------
    carts : the carts that are free to move; default: all.
    """

    kind: ExperimentKind
    carts: tuple[int, ...] = ()
    at_least: Count = 1


class Required(TomlTable):
    """The items that a submission must have: recordings, parameters and further tables.

    Names of parameters may be patterns such as `K_*`.
    """

    experiments: tuple[RequiredRuns, ...] = ()
    initial: tuple[str, ...] = ()
    final: tuple[str, ...] = ()
    state_space: bool = False
    feedback: tuple[Literal["gains", "prefilter", "overshoot_percent", "settling_time"], ...] = ()


def _read_due(typed: object) -> object:
    """Return a deadline as a datetime, also if its date and offset are in quotation marks."""
    found = str(typed)
    if isinstance(typed, str):
        # Python before 3.14 reads no space before the offset.
        text = re.sub(r"\s+(?=[+-]\d\d:?\d\d$|Z$)", "", typed.strip())
        try:
            typed = datetime.fromisoformat(text) if "T" in text or " " in text else None
        except ValueError:
            typed = None
    if isinstance(typed, datetime) and typed.tzinfo is not None:
        return typed
    raise ValueError(
        "expected date, time and offset from UTC, such as 2026-11-29T23:59:00+01:00, "
        f"found {quote(found)}"
    )


class Late(TomlTable):
    """The deduction for late work.

    Attributes
    ----------
    due : the deadline, with its offset from UTC; it applies if the platform gives submission times.
    percent_per_day : the deduction for each day begun after the days of grace, in percent of the
        earned points.
    most_percent : the largest deduction, in percent of the earned points.
    """

    due: Annotated[AwareDatetime, BeforeValidator(_read_due)] | None = None
    percent_per_day: Percent = 0.0
    grace_days: Annotated[float, Field(ge=0, le=365, allow_inf_nan=False)] = 0.0
    most_percent: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 100.0


class FlagCost(TomlTable):
    """The least and the most that a mistake costs: shares of the criterion where it is charged.

    In a rubric, a plain number is the least.
    """

    least: Share = 0.0
    most: Share = 1.0

    @model_validator(mode="before")
    @classmethod
    def _from_number(cls, typed: Any) -> Any:
        is_number = isinstance(typed, int | float) and not isinstance(typed, bool)
        return {"least": float(typed)} if is_number else typed

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.least > self.most:
            raise ValueError("least is more than most")
        return self

    @model_serializer
    def _as_typed(self) -> float | dict[str, float]:
        return self.least if self.most == 1 else {"least": self.least, "most": self.most}


class FlagCosts(
    create_model(
        "_Costs",
        __base__=TomlTable,
        **dict[str, Any](
            (code, (FlagCost, FlagCost(least=0.5 if code == "wrong_state_space" else 0.0)))
            for code in CODES
            if code != "shared_data"
        ),
    )
):
    """The cost of each flag.

    By default most flags cost nothing, because the tolerances already judge each wrong number. But
    one wrong entry of A or B makes the whole model wrong, although it is a small share of the
    entries.

    `shared_data` has no cost, because a person must decide whether a recording was copied, and set
    the points by hand.
    """

    def of(self, code: Code) -> FlagCost:
        """Return the cost of the flag with a code."""
        return getattr(self, code, FlagCost())


class _Criterion(TomlTable):
    """The keys of every criterion.

    Attributes
    ----------
    requires : ids of criteria that must have been passed, at least partly.
    """

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}$")]
    points: Points
    title: str = ""
    requires: tuple[str, ...] = ()
    message: str = ""  # shown if points are lost


class _Graded(_Criterion):
    """A criterion with full points up to `full_percent` of error and none from `none_percent` on.

    In between, points fall linearly. Half a unit of the last typed digit, and `sigmas` standard
    errors of the reference, are subtracted from the error first. Dampings have limits of their own.
    """

    full_percent: Percent = 5.0
    none_percent: Percent = 20.0
    damping_full_percent: Percent = 40.0
    damping_none_percent: Percent = 150.0


From = Literal["own", "recordings", "either"]


class _FromModel(
    create_model("_ModelSource", __base__=_Criterion, **dict[str, Any]({"from": (From, "either")}))
):
    """A criterion of numbers that follow from a model of the carts.

    `from` says which model counts: the one of the student's own final table, the one of the
    recordings, or the better of the two.
    """


class _FromTable(
    create_model(
        "_TableSource",
        __base__=_Graded,
        **dict[str, Any]({"from": (Literal["own", "recordings"], "recordings")}),
    )
):
    """A criterion of numbers of a table.

    With `from = "own"`, they are compared with what the other numbers of the same table give.
    """


def source_of(criterion: "Criterion") -> From:
    """Return what the numbers of a criterion are judged by."""
    return getattr(criterion, "from", "recordings")


class RequiredPieces(_Criterion):
    """Check how many of the items in `[required]` are present; points are in proportion.

    Recordings and typed numbers count half each. If something is missing, at least one step of the
    points is lost.

    Attributes
    ----------
    experiments : the kinds of recording to judge; default: every item that no other criterion
        names.
    """

    check: Literal["required"]
    experiments: tuple[ExperimentKind, ...] = ()


class DataQuality(_Criterion):
    """Check the recordings; points are in proportion to those that are required and sound."""

    check: Literal["data"]


class Parameters(_FromTable):
    """Compare reported parameters with those of the recordings, or of the rest of the table."""

    check: Literal["initial", "final"]
    parameters: tuple[str, ...] = ("*",)
    sigmas: Sigmas = 3.0


class InitialFinal(_Graded):
    """Compare the student's initial estimates with the final ones; guesses are not judged."""

    check: Literal["initial_final"]
    parameters: tuple[str, ...] = ("*",)
    full_percent: Percent = 15.0
    none_percent: Percent = 50.0
    damping_full_percent: Percent = 100.0
    damping_none_percent: Percent = 400.0


class Laws(_Criterion):
    """Check the redundancies and inequalities that the final table of real carts satisfies.

    A law holds if some table within the rounding of the typed one satisfies it. If laws fail, the
    worst one counts. A quarter of the points is lost if the numbers must change by
    `frequency_percent` and `damping_percent` for it to hold, half if they must change by twice as
    much, and all if by four times as much.
    """

    check: Literal["laws"]
    frequency_percent: Percent = 3.0
    damping_percent: Percent = 30.0


class StateModel(_FromModel, _Graded):
    """Compare each entry of A and B with the student's own final table, or with the reference.

    Attributes
    ----------
    states : the order of the states that the lab asks for; default: x1, v1, x2, v2, … Another order
        costs nothing, but gets a remark.
    """

    check: Literal["state_space"]
    states: tuple[str, ...] = ()


class Gains(_FromModel):
    """Simulate the gains on the carts: they must be stable and meet the design goal.

    The errors are the overshoot above the goal, in percentage points, and the settling time above
    the goal, in percent.
    """

    check: Literal["gains"]
    overshoot_full: Percent = 5.0
    overshoot_none: Percent = 40.0
    settling_full_percent: Percent = 20.0
    settling_none_percent: Percent = 150.0


class Claims(_FromModel):
    """Compare the reported overshoot and settling time with a simulation of the reported gains."""

    check: Literal["claims"]
    overshoot_full: Percent = 5.0
    overshoot_none: Percent = 25.0
    settling_full_percent: Percent = 20.0
    settling_none_percent: Percent = 100.0


class Prefilter(_FromModel):
    """Compare the prefilter with the reciprocal of the loop's static gain."""

    check: Literal["prefilter"]
    full_percent: Percent = 5.0
    none_percent: Percent = 25.0


class Hardware(_Criterion):
    """Compare a closed-loop run with a simulation of its stated controller (NRMSE, in percent).

    If the run did not use the reported gains, the message says so.
    """

    check: Literal["hardware"]
    full_percent: Percent = 30.0
    none_percent: Percent = 90.0


class Effects(_Criterion):
    """Compare the effects that the students named with those of their bench in the answer key.

    The name, the place and each parameter of every effect count equally. An effect that the bench
    does not have counts as one wrong number.
    """

    check: Literal["effects"]
    full_percent: Percent = 10.0
    none_percent: Percent = 50.0


class Manual(_Criterion):
    """A criterion that a person grades, such as the discussion; the message says what is asked."""

    check: Literal["manual"]


Criterion = Annotated[
    RequiredPieces
    | DataQuality
    | Parameters
    | InitialFinal
    | Laws
    | StateModel
    | Gains
    | Claims
    | Prefilter
    | Hardware
    | Effects
    | Manual,
    Field(discriminator="check"),
]


class Rubric(TomlTable):
    """A validated rubric.

    Attributes
    ----------
    system : the bench; it replaces the submission's own.
    design : the design goal; if given, it replaces the submission's own.
    step : step to which points are rounded.
    anonymous : whether names are left out of all files unless requested.
    examples : submission folders given out with the assignment, relative to the rubric's folder;
        any submission may contain their recordings.
    students : what students see on the desk of a lab server, if its list of users names this
        rubric.
    """

    version: Literal[1]
    title: str = ""
    system: System
    design: Design | None = None
    required: Required = Required()
    late: Late = Late()
    step: Step = 0.01
    flags: FlagCosts = FlagCosts()
    anonymous: bool = False
    examples: tuple[str, ...] = ()
    students: Students = Students()
    criteria: tuple[Criterion, ...]

    @property
    def titles(self) -> dict[str, str]:
        """The titles of the criteria, by id; a criterion without a title is called by its id."""
        return {asked.id: asked.title or asked.id for asked in self.criteria}

    def without(self, held: Container[str]) -> "Rubric":
        """Return the rubric without some criteria."""
        criteria = tuple(asked for asked in self.criteria if asked.id not in held)
        return self.model_copy(update={"criteria": criteria})

    def criterion(self, id_: str) -> Criterion | None:
        """Return the criterion with this id, or None."""
        return next((asked for asked in self.criteria if asked.id == id_), None)

    @property
    def names(self) -> list[str]:
        """The parameter names of the system, in the order of the tables in Throne's paper."""
        return parameter_names(self.system.carts, rigid=self.system.bench.rigid)

    @property
    def out_of(self) -> float:
        """The sum of all points."""
        return float(sum(Decimal(str(criterion.points)) for criterion in self.criteria))


def matching(patterns: tuple[str, ...], names: list[str]) -> list[str]:
    """Return the names that match at least one pattern, in the order of `names`."""
    return [n for n in names if any(fnmatchcase(n, pattern) for pattern in patterns)]


# ------------------------------------- which flags concern what a criterion judges

# The check that each flag concerns. Other flags concern the parameter table that their evidence
# names.
_ABOUT: Mapping[Code, str] = {
    "initial_final_disagree": "initial_final",
    "wrong_state_space": "state_space",
    "wrong_gains": "gains",
    "wrong_prefilter": "prefilter",
    "missing": "required",
    "data_problem": "data",
}


def concerns(flag: Flag, criterion: Criterion, *, names: list[str]) -> bool:
    """Return whether a flag concerns what a criterion judges."""
    if flag.code == "missing" and "criteria" in flag.evidence:
        return criterion.id in flag.evidence["criteria"]
    if flag.code in _ABOUT:
        return _ABOUT[flag.code] == criterion.check
    tables = {flag.evidence.get("table"), flag.evidence.get("also_in")} - {None}
    if not tables:
        return criterion.check == "data"  # a table that the students reduced themselves
    if not isinstance(criterion, Parameters) or criterion.check not in tables:
        return False
    return not set(flag.parameters).isdisjoint(matching(criterion.parameters, names))


def find_remarks(grade: Grade, criterion: Criterion, rubric: Rubric) -> list[Flag]:
    """Return the flags of a grade that concern a criterion."""
    return [flag for flag in grade.flags if is_about(flag, criterion, rubric)]


def is_about(flag: Flag, criterion: Criterion, rubric: Rubric) -> bool:
    """Return whether a flag concerns a criterion; the flag for shared recordings concerns none."""
    return flag.code != "shared_data" and concerns(flag, criterion, names=rubric.names)
