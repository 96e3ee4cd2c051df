"""The map: every type that passes between the stages, in the order of the pipeline.

Units throughout: the submission's own position unit (say cm) and input unit (say V), seconds,
radians. Time is the last axis. Carts and springs count from 1. A standard error ("std") is one
sigma; `None` means it could not be had.

It begins in `results_of_runs.py`, with a recording and what is read off it alone. It goes on
where a package has types of its own: `Ingested` (`ingest/read.py`, what was read),
`Identified` and `Fitted` (`identify/`, what the stages make of the records, up to the fit),
`Repeats` (`identify/soundness/repeated_numbers.py`), `Gap` (`gap/types.py`, what the linear carts
leave out and what explains it), `Grade` (`schemas/grade.py`, what a submission earned and why) and
`Grading` (`grading/gradings.py`, what becomes of it in a class). `results_json.py` writes it all.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Literal

import numpy as np

from pipeline.arrays import Array, ComplexArray, freeze
from pipeline.plant.linear.chain import Chain
from pipeline.plant.loop.margins import Margins
from pipeline.plant.loop.sampled_loop import StateFeedback
from pipeline.results_of_runs import LogDecrement, Record, SinePoint, StepGain

CheckOutcome = Literal["pass", "fail", "skip"]


# χ² per degree of freedom up to which model and noise explain the data: by chance it is under 1.5
# with 30 points and more; errors stated 40 % too small give 2.
EXPLAINED = 2.0


# ----------------------------------------------------- frequency-domain stages


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyResponse:
    """X_cart/U at omega: (n_w,) arrays, ascending; carries its own grid, never interpolated.

    `phase` (rad) and its error are None for a table of amplitude ratios. `source`: sine dwells,
    a table the students reduced, or transforms of step and sweep records; `experiments` are those.
    """

    cart: int
    omega: Array
    magnitude: Array
    magnitude_std: Array
    phase: Array | None
    phase_std: Array | None
    source: Literal["dwells", "table", "records"]
    experiments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "omega", "magnitude", "magnitude_std", "phase", "phase_std")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its standard error and where it comes from ("step", "log_decrement", …).

    `at_bound`: a fit ended at the bound of what is possible (a damping of zero), so `value` is
    that bound and no measurement, `std` is None, and nothing may be concluded from either.
    `experiments` are the recordings it rests on; of a fit's, see `ChainFit.experiments`.
    """

    value: float
    std: float | None
    source: str
    at_bound: bool = False
    experiments: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainFit:
    """One chain fitted to the measurements of all carts at once.

    Attributes
    ----------
    method : "bode_fit" (frequency response) or "time_fit" (time records).
    chain : the fitted plant.
    names : physical parameters that have a standard error ("m_1", "c_1", "k_2", …).
    covariance : (n_p, n_p) of those.
    at_bound : physical parameters that the fit's own data leave open down to their bound, zero:
        held there, or taken from the decays where those tell.
    parameters : the named parameters of the chain with standard errors, in table order. One that
        ended at its bound says so (`Estimate.at_bound`) and is in no table.
    staged : the named parameters the stage-by-stage fit (last cart first) found, for the report.
    chi_square_per_dof : near 1 where model and stated noise explain the data; see `explains_data`.
    misfit : of a "bode_fit" by how much of their magnitude points lie off it, beyond their errors.
    standardised : per cart (n_w,) or per record (n,): residual over its standard error.
    experiments : the recordings that it was fitted to.
    """

    method: Literal["bode_fit", "time_fit"]
    chain: Chain
    names: tuple[str, ...]
    covariance: Array
    at_bound: tuple[str, ...] = ()
    parameters: dict[str, Estimate]
    staged: dict[str, float] = field(default_factory=dict)
    chi_square_per_dof: float
    dof: int
    n_points: int
    n_starts: int
    converged: bool
    message: str
    misfit: float = 0.0
    standardised: dict[str, Array] = field(default_factory=dict)
    experiments: tuple[str, ...] = ()

    @property
    def std(self) -> dict[str, float]:
        """The standard errors of the physical parameters that have one."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def explains_data(self) -> bool:
        """Whether model and stated noise explain the data."""
        return self.chi_square_per_dof <= EXPLAINED


# ------------------------------------------------------------------- comparing


@dataclass(frozen=True, kw_only=True)
class ParameterRow:
    """A line of the paper's Tables 1-3.

    `consistent` is None where there is nothing to compare, or errors too wide to tell;
    `independent` tells whether the two share no recording, None where there are not two.
    """

    name: str
    unit: str
    initial: Estimate | None
    final: Estimate | None
    change_percent: float | None
    change_sigmas: float | None
    consistent: bool | None
    independent: bool | None = None
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One consistency check, in a sentence for a student; outcome against `limit`."""

    id: str
    outcome: CheckOutcome
    value: float | None
    limit: float | None
    message: str

    @property
    def kind(self) -> str:
        """What is asked, whatever it is asked of: "decay" of "decay.run-1.cart_1"."""
        return self.id.partition(".")[0]

    @property
    def about(self) -> str:
        """Of what it is asked, "" where there is one thing only: "run-1.cart_1"."""
        return self.id.partition(".")[2]

    @classmethod
    def of(
        cls,
        id: str,
        good: bool,
        message: str,
        *,
        value: float | None = None,
        limit: float | None = None,
    ) -> "Check":
        """Return a check that passed, or failed."""
        outcome: CheckOutcome = "pass" if good else "fail"
        return cls(id=id, outcome=outcome, value=value, limit=limit, message=message)


SIGN = "input.sign"  # of the check that fails where the data contradict the sign stated


# --------------------------------------------------------------------- control


@dataclass(frozen=True, kw_only=True, eq=False)
class FeedbackDesign:
    """State feedback u = prefilter r - gains [x1, v1, x2, v2, …] and what it should do.

    Attributes
    ----------
    gains : (2n,); prefilter = 1 / DC gain of the loop for the chosen cart.
    poles : closed-loop poles as continuous equivalents (log z / sample_time), rad/s.
    requested_poles : what pole placement was asked for; None with LQR.
    Q (2n, 2n), R : the weights of LQR's cost, the sum of x'Q x + R u²; None with pole placement.
    sample_time : s; the one-sample delay is part of the model the gains are made for.
    overshoot_percent, settling_time (s, 2 %), peak_input : of the simulated step.
    t, y (n_carts, n), u : that step.
    reachable : False where the goal cannot be met; `message` says what is reachable.
    margins : of the loop with its observer and delay, cut at the motor; None where not looked at.
    """

    cart: int
    method: Literal["poles", "lqr"]
    reference: float
    gains: Array
    prefilter: float
    poles: ComplexArray
    requested_poles: ComplexArray | None
    Q: Array | None = None
    R: float | None = None
    sample_time: float
    overshoot_percent: float
    settling_time: float | None
    peak_input: float
    t: Array
    y: Array
    u: Array
    reachable: bool
    message: str
    margins: Margins | None = None

    def controller(self, chain: Chain) -> StateFeedback:
        """Return what runs: its observer knows the carts it was designed for."""
        return StateFeedback(gains=self.gains, prefilter=self.prefilter, model=chain)


@dataclass(frozen=True, kw_only=True, eq=False)
class HardwareCheck:
    """Model against measurement for one cart of one run, as Figures 15-17.

    Attributes
    ----------
    loop : "closed" (the controller that ran, simulated) or "open" (measured input applied).
    nrmse : root-mean-square of measured minus model over that of the measured position.
    overshoot in percent of the change in level; settling_time s; steady_state position units.
    input_scale : the factor on the logged input that explains the motion best (1 = as logged),
        its sign included; None where it was not looked for.
    t, measured, model : (n,).
    effort : (n,) input that the modelled loop asks for; None with the measured input.
    set_point : (n,) where the loop is told to bring this cart; None where it is another that is.
    contradicted : what was logged or stated of the run cannot be so; the note says how.
    """

    experiment: str
    cart: int
    loop: Literal["closed", "open"]
    nrmse: float
    overshoot_model: float | None
    overshoot_measured: float | None
    settling_model: float | None
    settling_measured: float | None
    steady_state_model: float | None
    steady_state_measured: float | None
    input_scale: float | None
    t: Array
    measured: Array
    model: Array
    note: str = ""
    contradicted: bool = False
    effort: Array | None = None
    set_point: Array | None = None


# -------------------------------------------------------------------- together


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """A stage that could not run, and why.

    `missing` is what would let it run, in words. Where recordings are there and do not serve,
    the reason says why, and nothing is missing.
    """

    stage: str
    reason: str
    missing: str = ""


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A recording that was not used, and why, in words that follow its name.

    `is_wrong` : it does not hold what happened, and the reason says how; else it only stands off
    its repeats.
    """

    experiment: str
    reason: str
    is_wrong: bool


@dataclass(frozen=True, kw_only=True)
class Assumption:
    """Something about the bench that every number rests on, and how the data support it.

    Attributes
    ----------
    key : of submission.toml ("system.springs"); `about` says which ("wall-1"), "" the only one.
    value : what was taken.
    origin : "stated" in submission.toml, found from the "data", or a "default".
    support : "open" where the data do not tell.
    found, found_std : the number that the data give for it, if it is one.
    experiments : the recordings that it is about, or that tell it.
    reason : how the data support or contradict it, or why they do not tell.
    """

    key: str
    about: str = ""
    value: bool | str | float | tuple[int, ...]
    origin: Literal["stated", "data", "default"]
    support: Literal["supported", "contradicted", "open"]
    found: float | None = None
    found_std: float | None = None
    experiments: tuple[str, ...] = ()
    reason: str


@dataclass(frozen=True, kw_only=True)
class LateChannel:
    """A cart whose channel is read later than another's, in the experiments of one kind.

    `delay` : s, negative where it is read earlier, against `limit`; `than` is the other cart.
    """

    cart: int
    than: int
    kind: str
    delay: float
    limit: float
    experiments: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """All results of one submission, in pipeline order.

    `files` maps each data file to its SHA-256, `unreadable` each experiment that could not be read
    to its reason, `unexplained` each driven recording in which the carts move to the share of its
    motion's power that the fitted carts leave. `rows` are the table; `chain` is None where no fit
    was possible (then `skipped` says why). `tables` are the students' own reduced tables, also
    where dwells stand in their place; `reported` their numbers, initial and final, as typed;
    `assumptions` what all of it rests on.
    """

    title: str
    section: str
    authors: tuple[tuple[str, str], ...]  # (id, name)
    carts: int
    springs: tuple[bool, ...]
    position_unit: str
    input_unit: str
    records: tuple[Record, ...]
    log_decrements: tuple[LogDecrement, ...]
    step_gains: tuple[StepGain, ...]
    sine_points: tuple[SinePoint, ...]
    frequency_responses: tuple[FrequencyResponse, ...]
    tables: tuple[FrequencyResponse, ...] = ()
    fit: ChainFit | None
    rows: tuple[ParameterRow, ...]
    checks: tuple[Check, ...]
    feedback: FeedbackDesign | None
    hardware: tuple[HardwareCheck, ...]
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...]
    files: dict[str, str]
    unreadable: dict[str, str] = field(default_factory=dict)
    unexplained: dict[str, float] = field(default_factory=dict)
    discussion: str | None  # notes.md, without its comments
    left_out: tuple[LeftOut, ...] = ()
    late_channels: tuple[LateChannel, ...] = ()
    reported: Mapping[str, Mapping[str, Decimal]] = field(default_factory=dict)
    assumptions: tuple[Assumption, ...] = ()

    @property
    def chain(self) -> Chain | None:
        """The identified plant."""
        return self.fit.chain if self.fit else None

    @property
    def steps(self) -> frozenset[str]:
        """The steps: what rings after one was not let go."""
        return frozenset(record.id for record in self.records if record.kind == "step")

    @property
    def failed_checks(self) -> tuple[Check, ...]:
        """The checks that were not passed: each is a reason to doubt the numbers."""
        return tuple(check for check in self.checks if check.outcome == "fail")
