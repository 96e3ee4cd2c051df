"""The rubric: required items, criteria with points and tolerances, late policy."""

from decimal import Decimal
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, create_model

from pipeline.grading.grade import CODES, Code
from pipeline.names import parameter_names
from pipeline.results import Kind
from pipeline.submission import Design, Students, System
from pipeline.submission.models import TomlTable

Points = Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)]
Percent = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
Sigmas = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=1000)]
Step = Annotated[float, Field(ge=0.01, le=1000, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class RequiredRuns(TomlTable):
    """A minimum number of experiments of a kind; `carts` are the free carts, default: all."""

    kind: Kind
    carts: tuple[int, ...] = ()
    at_least: Count = 1


class Required(TomlTable):
    """The required items: runs, parameters (`K_*` is a pattern) and further tables."""

    experiments: tuple[RequiredRuns, ...] = ()
    initial: tuple[str, ...] = ()
    final: tuple[str, ...] = ()
    state_space: bool = False
    feedback: tuple[Literal["gains", "prefilter", "overshoot_percent", "settling_time"], ...] = ()


class Late(TomlTable):
    """Deduction for late work: `percent_per_day` of the points earned, after the days of grace.

    `due` is the deadline, used if the platform gives submission times.
    """

    due: AwareDatetime | None = None
    percent_per_day: Percent = 0.0
    grace_days: Annotated[float, Field(ge=0, le=365, allow_inf_nan=False)] = 0.0
    most_percent: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 100.0


class FlagCosts(
    create_model(
        "_Costs",
        __base__=TomlTable,
        **dict[str, Any](
            (code, (Share, 0.5 if code == "wrong_state_space" else 0.0))
            for code in CODES
            if code != "shared_data"
        ),
    )
):
    """By code, the least share of its criterion's points that a remark costs.

    The tolerances already weigh each wrong number. But a single wrong entry of A or B makes the
    whole model wrong, which its share of the entries does not reflect. Only a person decides
    whether `shared_data` is a copy, and sets those points by hand.
    """

    def of(self, code: Code) -> float:
        """Return what the remark of a code costs."""
        return getattr(self, code, 0.0)


class _Criterion(TomlTable):
    """The fields of every criterion; `requires` lists criteria that must not have failed."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}$")]
    points: Points
    title: str = ""
    requires: tuple[str, ...] = ()
    message: str = ""  # shown if points were lost


class _Graded(_Criterion):
    """Full credit up to an error of `full_percent`, none from `none_percent`, linear in between.

    Half a unit of the last typed digit and `sigmas` standard errors of the reference are first
    subtracted from the error. Dampings have their own limits.
    """

    full_percent: Percent = 5.0
    none_percent: Percent = 20.0
    damping_full_percent: Percent = 40.0
    damping_none_percent: Percent = 150.0


class RequiredPieces(_Criterion):
    """Is everything in `[required]` present? Credit is the share that is."""

    check: Literal["required"]


class DataQuality(_Criterion):
    """Are the recordings sound? Credit is the share of good runs."""

    check: Literal["data"]


class Parameters(_Graded):
    """Reported parameters against those recomputed from the student's own recordings."""

    check: Literal["initial", "final"]
    parameters: tuple[str, ...] = ("*",)
    sigmas: Sigmas = 3.0


class InitialFinal(_Graded):
    """The student's initial estimates against the final ones; guesses are not judged."""

    check: Literal["initial_final"]
    parameters: tuple[str, ...] = ("*",)
    full_percent: Percent = 15.0
    none_percent: Percent = 50.0
    damping_full_percent: Percent = 100.0
    damping_none_percent: Percent = 400.0


class Laws(_Criterion):
    """Redundancies and inequalities that the final table of a real chain obeys.

    A law holds if some table within half a unit of the last typed digits obeys it. Otherwise the
    worst law counts: a quarter of the points is lost if it only holds within these percentages,
    half within twice as much, and all from four times as much.
    """

    check: Literal["laws"]
    frequency_percent: Percent = 3.0
    damping_percent: Percent = 30.0


class StateModel(_Graded):
    """A and B against the student's own final table, or the reference: entry by entry."""

    check: Literal["state_space"]


class Gains(_Criterion):
    """The gains on the carts: stable, and overshoot and settling time within the goal.

    Overshoot counts in percentage points above the goal, settling time in percent above it.
    """

    check: Literal["gains"]
    overshoot_full: Percent = 5.0
    overshoot_none: Percent = 40.0
    settling_full_percent: Percent = 20.0
    settling_none_percent: Percent = 150.0


class Claims(_Criterion):
    """Reported overshoot (percentage points) and settling time (percent) against simulation."""

    check: Literal["claims"]
    overshoot_full: Percent = 5.0
    overshoot_none: Percent = 25.0
    settling_full_percent: Percent = 20.0
    settling_none_percent: Percent = 100.0


class Prefilter(_Criterion):
    """The prefilter against the reciprocal of the loop's static gain."""

    check: Literal["prefilter"]
    full_percent: Percent = 5.0
    none_percent: Percent = 25.0


class Hardware(_Criterion):
    """A closed-loop run with a stated controller: its difference from the model (NRMSE, percent).

    If the run did not use the reported gains, the message says so.
    """

    check: Literal["hardware"]
    full_percent: Percent = 30.0
    none_percent: Percent = 90.0


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
    | Hardware,
    Field(discriminator="check"),
]


class Rubric(TomlTable):
    """A validated rubric.

    Attributes
    ----------
    system, design : replace the submission's own; without `design` the submission's is used.
    step : points are rounded to it.
    anonymous : names are left out of all files unless requested.
    examples : submission folders given out with the assignment, relative to the rubric's folder;
        any submission may contain their recordings.
    students : what students see at the desk of a lab server whose user list names the rubric.
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
    def names(self) -> list[str]:
        """The parameters of the system, in the order of the paper's tables."""
        return parameter_names(self.system.carts, rigid=self.system.bench.rigid)

    @property
    def out_of(self) -> float:
        """The sum of all points."""
        return float(sum(Decimal(str(criterion.points)) for criterion in self.criteria))


def matching(patterns: tuple[str, ...], names: list[str]) -> list[str]:
    """Return the names that match one of the patterns, in their order."""
    return [n for n in names if any(fnmatchcase(n, pattern) for pattern in patterns)]
