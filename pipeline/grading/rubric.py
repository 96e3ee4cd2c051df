"""The rubric: what a lab asks, the criteria with their points and tolerances, the late policy."""

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
    """So many experiments of a kind; `carts` are the carts free in it, default: all."""

    kind: Kind
    carts: tuple[int, ...] = ()
    at_least: Count = 1


class Required(TomlTable):
    """What must be handed in: runs, parameters (`K_*` is a pattern), the further tables."""

    experiments: tuple[RequiredRuns, ...] = ()
    initial: tuple[str, ...] = ()
    final: tuple[str, ...] = ()
    state_space: bool = False
    feedback: tuple[Literal["gains", "prefilter", "overshoot_percent", "settling_time"], ...] = ()


class Late(TomlTable):
    """Points lost to lateness: `percent_per_day` of those earned, after the days of grace.

    `due` is the deadline, where the platform says when something was handed in.
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

    The tolerances already weigh each wrong number. But one wrong entry among the many of A and B
    makes another model of the carts, and its share of the entries does not say so. Whether
    `shared_data` is a copy is for a person to say, who gives the points by hand.
    """

    def of(self, code: Code) -> float:
        """Return what the remark of a code costs."""
        return getattr(self, code, 0.0)


class _Criterion(TomlTable):
    """What every criterion has; `requires` are criteria that must not have failed before it."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}$")]
    points: Points
    title: str = ""
    requires: tuple[str, ...] = ()
    message: str = ""  # said where not all points were earned


class _Graded(_Criterion):
    """Full credit up to `full_percent` of error, none from `none_percent`, in between a line.

    Half a unit of the last digit typed and `sigmas` standard errors of the reference come off the
    error first; dampings have limits of their own.
    """

    full_percent: Percent = 5.0
    none_percent: Percent = 20.0
    damping_full_percent: Percent = 40.0
    damping_none_percent: Percent = 150.0


class RequiredPieces(_Criterion):
    """Is all there that `[required]` asks for? Credit is the share that is."""

    check: Literal["required"]


class DataQuality(_Criterion):
    """Do the recordings hold what they should? Credit is the share of good runs."""

    check: Literal["data"]


class Parameters(_Graded):
    """Reported parameters against those recomputed from the student's own recordings."""

    check: Literal["initial", "final"]
    parameters: tuple[str, ...] = ("*",)
    sigmas: Sigmas = 3.0


class InitialFinal(_Graded):
    """The student's initial against the student's final estimates; guesses are not judged."""

    check: Literal["initial_final"]
    parameters: tuple[str, ...] = ("*",)
    full_percent: Percent = 15.0
    none_percent: Percent = 50.0
    damping_full_percent: Percent = 100.0
    damping_none_percent: Percent = 400.0


class Laws(_Criterion):
    """Redundancies and inequalities that the final table of a real chain obeys.

    A law holds where it does for some table within half the last digits typed. Else the worst law
    counts: a quarter of the points is lost where it only holds within these percentages, half
    within twice them, all from four times on.
    """

    check: Literal["laws"]
    frequency_percent: Percent = 3.0
    damping_percent: Percent = 30.0


class StateModel(_Graded):
    """A and B against the student's own final table, or the reference: entry by entry."""

    check: Literal["state_space"]


class Gains(_Criterion):
    """What the gains do on the carts: stable, overshoot and settling time within the goal.

    Overshoot in percentage points above the goal, settling time in percent above it.
    """

    check: Literal["gains"]
    overshoot_full: Percent = 5.0
    overshoot_none: Percent = 40.0
    settling_full_percent: Percent = 20.0
    settling_none_percent: Percent = 150.0


class Claims(_Criterion):
    """Reported overshoot (percentage points) and settling time (percent) against what gains do."""

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
    """A closed-loop run whose controller is stated; how far the model is from it (NRMSE, percent).

    Where gains other than the reported ones ran, that is said.
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
    system, design : win over the submission's own; without `design` the submission's is used.
    step : points are rounded to it.
    anonymous : names stay out of what is written unless asked for.
    examples : submission folders handed out with the task, from the rubric's own folder: their
        recordings may stand in anybody's submission.
    students : what they see at the desk of a lab server, where its list of users names the rubric.
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
        """All points there are."""
        return float(sum(Decimal(str(criterion.points)) for criterion in self.criteria))


def matching(patterns: tuple[str, ...], names: list[str]) -> list[str]:
    """Return the names that fit one of the patterns, in their own order."""
    return [n for n in names if any(fnmatchcase(n, pattern) for pattern in patterns)]
