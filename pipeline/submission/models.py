"""The tables of `submission.toml`, as validated models."""

from decimal import Decimal
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# A line on any page; pages and PDF readers fail at texts of a hundred thousand letters.
Line = Annotated[str, Field(max_length=200)]
# Units stand in the titles of figures, which scripts read.
Unit = Annotated[str, Field(max_length=40, pattern=r"^[^\p{C}\p{Zl}\p{Zp}]*$")]
MOST_AUTHORS = 50
MOST_CARTS = 4
MOST_EXPERIMENTS = 1_000  # every stage and every comparison goes through them
Typed = Annotated[Decimal, Field(allow_inf_nan=False)]  # keeps the digits as typed: 0.10 has two


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Author(_Model):
    """One student."""

    id: Line
    name: Line = ""


class Input(_Model):
    """The input's unit, sign and scale; `sign` None: found from the data."""

    unit: Unit = "V"
    sign: Literal[1, -1] | None = None
    per_count: Positive | None = None


class InputOverride(_Model):
    """Where one record's input differs from the system's."""

    sign: Literal[1, -1] | None = None
    per_count: Positive | None = None


class Position(_Model):
    """The position's unit; `per_count` converts columns that hold encoder counts."""

    unit: Unit = "count"
    per_count: Positive | None = None


class System(_Model):
    """The carts and springs on the bench; springs not stated are all there.

    `columns` (role to heading or number) are those of every recording that has them.
    """

    carts: Annotated[int, Field(ge=1, le=MOST_CARTS)]
    springs: tuple[bool, ...] = ()
    input: Input = Input()
    position: Position = Position()
    columns: dict[str, str | int] = {}

    @model_validator(mode="after")
    def _all_springs(self) -> "System":
        """Fill in `springs` where they are left out; that nobody stated them stays known."""
        if not self.states_springs:
            object.__setattr__(self, "springs", (True,) * (self.carts + 1))
        return self

    @property
    def states_springs(self) -> bool:
        """Whether the springs were stated: else all were taken to be there."""
        return "springs" in self.model_fields_set

    @property
    def rigid(self) -> bool:
        """Whether there is one cart without a spring: a mass and a damping, no gain."""
        return self.carts == 1 and not any(self.springs)

    @property
    def tied(self) -> bool:
        """Whether a spring ties the carts to a wall: else no constant input has a rest position."""
        return self.springs[0] or self.springs[-1]


class Design(_Model):
    """The state-feedback task."""

    cart: int = 1
    reference: Finite = 1.0
    overshoot_percent: Annotated[float, Field(ge=0, lt=100)] = 10.0
    settling_time: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 1.0  # s
    input_limit: Positive | None = None
    sample_time: Annotated[float, Field(ge=1e-4, le=1, allow_inf_nan=False)] | None = None  # s
    method: Literal["poles", "lqr"] = "lqr"


class StateFeedback(_Model):
    """u = prefilter r - gains [x1, v1, x2, v2, …]."""

    type: Literal["state_feedback"]
    gains: tuple[Finite, ...] = ()
    prefilter: Finite = 1.0


class Pid(_Model):
    """u = scale (kp e + ki ∫e + kd de/dt), e in the file's own counts or units."""

    type: Literal["pid"]
    kp: Finite = 0.0
    ki: Finite = 0.0
    kd: Finite = 0.0
    scale: Finite = 1.0
    cart: int = 1


Controller = Annotated[StateFeedback | Pid, Field(discriminator="type")]


class Experiment(_Model):
    """One data file and what was done to record it."""

    id: str
    kind: Literal["decay", "step", "sine", "sweep", "closed_loop", "bode"]
    file: str
    carts: tuple[int, ...] = ()  # the free carts; filled in with all of them on loading
    frequency: Positive | None = None  # Hz
    window: tuple[Finite, Finite] | None = None  # s
    note: Annotated[str, Field(max_length=2_000)] = ""
    input: InputOverride | None = None
    columns: dict[str, str | int] | None = None
    sample_rate: Positive | None = None  # Hz
    hold: Literal["zero_order", "band_limited"] = "zero_order"
    controlled_cart: int | None = None
    controller: Controller | None = None
    reference: Finite | None = None


class StateSpace(_Model):
    """The state matrices as the students wrote them."""

    A: tuple[tuple[Typed, ...], ...] = ()
    B: tuple[Typed, ...] = ()  # flat; a column [[b1], [b2], …] is accepted

    @field_validator("B", mode="before")
    @classmethod
    def _flat(cls, value: object) -> object:
        """Flatten a column."""
        if isinstance(value, list | tuple) and all(
            isinstance(row, list | tuple) and len(row) == 1 for row in value
        ):
            return tuple(row[0] for row in value)
        return value


class Feedback(_Model):
    """The feedback design as the students wrote it."""

    gains: tuple[Typed, ...] = ()
    prefilter: Typed | None = None
    overshoot_percent: Typed | None = None
    settling_time: Typed | None = None


class Reported(_Model):
    """What the students claim; numbers keep the digits as typed."""

    initial: dict[str, Typed] = {}
    final: dict[str, Typed] = {}
    state_space: StateSpace | None = None
    feedback: Feedback | None = None


class Submission(_Model):
    """A validated submission; `folder` is where it lies."""

    version: Literal[1]
    title: Line = ""
    section: Line = ""
    authors: Annotated[tuple[Author, ...], Field(max_length=MOST_AUTHORS)] = ()
    system: System
    design: Design | None = None
    experiments: Annotated[tuple[Experiment, ...], Field(max_length=MOST_EXPERIMENTS)] = ()
    reported: Reported | None = None
    folder: Path = Field(default=Path(), exclude=True)
    discussion: str | None = Field(default=None, exclude=True)

    @property
    def typed(self) -> dict[str, dict[str, Decimal]]:
        """Return the students' own initial and final estimates, with the digits as typed."""
        own = self.reported or Reported()
        return {"initial": own.initial, "final": own.final}
