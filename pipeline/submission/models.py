"""The tables of `submission.toml`, as validated models.

The desk's form shows the title and the description of each key.
"""

from decimal import Decimal
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from pipeline.setup import Setup, Units

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# A line that any page can show; pages and PDF readers fail with very long texts.
Line = Annotated[str, Field(max_length=200)]
# Units appear in the titles of figures, so they may not contain invisible characters. Not every
# program knows such a pattern, so it is left out of the schema.
Unit = Annotated[
    str,
    Field(
        max_length=40,
        pattern=r"^[^\p{C}\p{Zl}\p{Zp}]*$",
        json_schema_extra=lambda schema: schema.__delitem__("pattern"),
    ),
]
MOST_CARTS = 4
MOST_EXPERIMENTS = 1_000  # limits the time of stages and comparisons
# A number with its digits as typed: 0.10 has two.
TypedNumber = Annotated[Decimal, Field(allow_inf_nan=False)]


class TomlTable(BaseModel):
    """A table of a file that people type, so an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Author(TomlTable):
    """One student."""

    id: Line
    name: Line = ""


class InputScale(TomlTable):
    """The input's unit, sign and scale; if `sign` is None, the sign is found from the data."""

    unit: Unit = Field(default="V", title="Unit of the input", description="V")
    sign: Literal[1, -1] | None = Field(
        default=None,
        title="Sign of the input",
        description="-1 if a positive input drives cart 1 towards negative x; if empty, it is "
        "found from the data",
    )
    per_count: Positive | None = Field(
        default=None,
        title="Size of one duty count",
        description="in the unit of the input; only for logs of duty counts",
    )


class InputOverride(TomlTable):
    """How the input of one record differs from the system's."""

    sign: Literal[1, -1] | None = None
    per_count: Positive | None = None


class PositionScale(TomlTable):
    """The position's unit; `per_count` converts columns that hold encoder counts."""

    unit: Unit = Field(
        default="count",
        title="Unit of positions",
        description="cm, for example; count for files of encoder counts",
    )
    per_count: Positive | None = Field(
        default=None,
        title="Size of one encoder count",
        description="in the unit of positions: 0.00227 cm on an ECP 210; only for files of counts",
    )


class System(TomlTable):
    """The carts and springs on the bench; if `springs` is not stated, all springs exist.

    `columns` maps roles to headings or numbers; it applies to every recording with such columns.
    """

    carts: int = Field(ge=1, le=MOST_CARTS, title="Carts")
    springs: tuple[bool, ...] = Field(
        default=(), title="Springs on the bench", description="in order, from one wall to the other"
    )
    input: InputScale = InputScale()
    position: PositionScale = PositionScale()
    columns: dict[str, str | int] = Field(
        default={},
        title="Columns of all your files",
        description="if their headings are not recognised, one per line: x1 = Encoder 1 Pos, or "
        "x1 = 3 for the third",
    )

    @model_validator(mode="after")
    def _all_springs(self) -> "System":
        """Fill in `springs` if they are missing, and remember that they were not stated."""
        if not self.states_springs:
            object.__setattr__(self, "springs", (True,) * (self.carts + 1))
        return self

    @property
    def states_springs(self) -> bool:
        """Whether the springs were stated; if not, all springs are assumed."""
        return "springs" in self.model_fields_set

    @property
    def bench(self) -> Setup:
        """The bench as stated."""
        units = Units(position=self.position.unit, input=self.input.unit)
        return Setup(springs=self.springs, units=units, sign=self.input.sign)


class Design(TomlTable):
    """The state-feedback task."""

    cart: int = Field(default=1, title="Cart whose position is controlled")
    reference: Finite = Field(
        default=1.0, title="Size of the step", description="in position units"
    )
    overshoot_percent: float = Field(
        default=10.0, ge=0, lt=100, title="Overshoot", description="at most, in percent"
    )
    settling_time: Finite = Field(
        default=1.0, gt=0, le=1000, title="Settling time", description="s, to within 2 %"
    )
    input_limit: Positive | None = Field(
        default=None, title="Largest input", description="in input units; optional"
    )
    sample_time: Annotated[Finite, Field(ge=1e-4, le=1)] | None = Field(
        default=None, title="Sample time of the controller", description="s; optional"
    )
    method: Literal["poles", "lqr"] = Field(default="lqr", title="Method")


class StateFeedbackController(TomlTable):
    """u = prefilter r - gains [x1, v1, x2, v2, …]."""

    type: Literal["state_feedback"] = Field(title="Controller")
    gains: tuple[Finite, ...] = Field(
        default=(), title="Gains", description="of a state feedback: two per cart, position first"
    )
    prefilter: Finite = Field(default=1.0, title="Prefilter")

    @property
    def missing_gains(self) -> str:
        """A sentence that asks for the gains; "" if they are stated."""
        return "" if self.gains else "the controller has no gains: state them"


class PidController(TomlTable):
    """u = scale (kp e + ki ∫e + kd de/dt), e in the file's own counts or units."""

    type: Literal["pid"] = Field(title="Controller")
    kp: Finite = Field(
        default=0.0, title="kp", description="of a PID: u = scale (kp e + ki ∫e + kd de/dt)"
    )
    ki: Finite = Field(default=0.0, title="ki")
    kd: Finite = Field(default=0.0, title="kd")
    scale: Finite = Field(default=1.0, title="scale")
    cart: int = Field(default=1, title="Cart that a PID feeds back")

    @property
    def missing_gains(self) -> str:
        """A sentence that asks for the gains; "" if at least one is not zero."""
        stated = any((self.kp, self.ki, self.kd))
        return "" if stated else "the controller has no gains: state kp, ki or kd"


Controller = Annotated[StateFeedbackController | PidController, Field(discriminator="type")]


class Repair(TomlTable):
    """Which repairs of a position are made; `false` keeps the readings as they are."""

    unwrap: bool = True
    jumps: bool = True
    spikes: bool = True
    repeats: bool = True


class Experiment(TomlTable):
    """One data file and how it was recorded."""

    id: str
    kind: Literal["decay", "step", "sine", "sweep", "closed_loop", "bode"] = Field(title="Kind")
    file: str
    # On loading, a missing value becomes all carts.
    carts: tuple[int, ...] = Field(
        default=(), title="Free carts", description="such as 1, 2; if empty, all"
    )
    frequency: Positive | None = Field(
        default=None,
        title="Frequency",
        description="of the sine, in Hz; if empty, it is found from the data",
    )
    window: tuple[Finite, Finite] | None = Field(
        default=None,
        title="Part to use",
        description="from, to, in s; if empty, all of it",
    )
    note: str = Field(default="", max_length=2_000, title="Note")
    input: InputOverride | None = None
    columns: dict[str, str | int] | None = Field(
        default=None,
        title="Columns",
        description="of this file, one per line: x1 = Encoder 1 Pos (heading) or x1 = 3 (number)",
    )
    sample_rate: Positive | None = Field(
        default=None, title="Sample rate", description="Hz, for a file without a time column"
    )
    run: str | int | None = Field(
        default=None, title="Run", description="of a file that holds several, as `inspect` names it"
    )
    repair: Repair = Repair()
    hold: Literal["zero_order", "band_limited"] = "zero_order"
    controlled_cart: int | None = Field(default=None, title="Controlled cart")
    controller: Controller | None = None
    reference: Finite | None = Field(
        default=None, title="Set point", description="if the file has no column for it"
    )


class ReportedStateSpace(TomlTable):
    """The state matrices as the students wrote them."""

    A: tuple[tuple[TypedNumber, ...], ...] = Field(
        default=(),
        title="A",
        description="one row per line, two for each cart, states x1, v1, x2, v2, …",
    )
    # A flat list; a column [[b1], [b2], …] is accepted too.
    B: tuple[TypedNumber, ...] = Field(default=(), title="B")

    @field_validator("B", mode="before")
    @classmethod
    def _flat(cls, value: object) -> object:
        """Flatten a column to a list."""
        if isinstance(value, list | tuple) and all(
            isinstance(row, list | tuple) and len(row) == 1 for row in value
        ):
            return tuple(row[0] for row in value)
        return value


class ReportedFeedback(TomlTable):
    """The feedback design as the students wrote it."""

    gains: tuple[TypedNumber, ...] = Field(
        default=(),
        title="Gains",
        description="two per cart, position first: u = prefilter·r − gains·[x1, v1, …]",
    )
    prefilter: TypedNumber | None = Field(default=None, title="Prefilter")
    overshoot_percent: TypedNumber | None = Field(
        default=None, title="Overshoot you found", description="percent"
    )
    settling_time: TypedNumber | None = Field(
        default=None, title="Settling time you found", description="s"
    )


class Reported(TomlTable):
    """The students' reported numbers, with the digits as typed.

    Attributes
    ----------
    effects : for each effect that the students found, its `cart` or `spring` and its parameters.
    """

    initial: dict[str, TypedNumber] = {}
    final: dict[str, TypedNumber] = {}
    state_space: ReportedStateSpace | None = None
    feedback: ReportedFeedback | None = None
    effects: dict[str, dict[str, TypedNumber]] | None = None


class Students(TomlTable):
    """The results that students see: the report, or only which of their numbers are wrong."""

    see: Literal["report", "check"] = "report"


class Unread(TomlTable):
    """A part of `[reported]` that cannot be read, so it counts as not reported.

    Attributes
    ----------
    at : keys of the part, such as ("reported", "final", "omega_a"), or of its table.
    message : what is wrong, with the line and what to write instead.
    """

    at: tuple[str, ...]
    message: str


def is_named(name: str, pattern: str) -> bool:
    """Return whether an entry of `leave_out`, an id or a pattern, names an experiment."""
    return name == pattern or fnmatchcase(name, pattern)


class Submission(TomlTable):
    """A validated submission; `folder` is the folder that contains it."""

    version: Literal[1]
    title: Line = Field(
        default="", title="Title of the report", description="Two-cart system, bench 4"
    )
    section: Line = Field(
        default="", title="Lab section", description="as your instructor numbers them"
    )
    authors: tuple[Author, ...] = Field(
        default=(),
        max_length=50,
        title="You",
        description="one line each: id, name (the name is optional)",
    )
    system: System
    design: Design | None = None
    experiments: Annotated[tuple[Experiment, ...], Field(max_length=MOST_EXPERIMENTS)] = ()
    leave_out: tuple[Line, ...] = Field(
        default=(),
        title="Recordings that are not used",
        description="ids of experiments, or patterns such as 14-Feb-*",
    )
    reported: Reported | None = None
    students: Students = Students()
    folder: Path = Field(default=Path(), exclude=True)
    discussion: str | None = Field(default=None, exclude=True)
    unread: tuple[Unread, ...] = Field(default=(), exclude=True)

    @property
    def used(self) -> tuple[Experiment, ...]:
        """The experiments that `leave_out` does not name."""
        return tuple(
            one
            for one in self.experiments
            if not any(is_named(one.id, pattern) for pattern in self.leave_out)
        )

    @property
    def typed(self) -> dict[str, dict[str, Decimal]]:
        """Return the students' own initial and final estimates, with the digits as typed."""
        own = self.reported or Reported()
        return {"initial": own.initial, "final": own.final}
