"""Every type that passes between the stages, in the order of the pipeline.

Units throughout: the submission's own position unit (say cm) and input unit (say V), seconds,
radians. Time is the last axis. Carts and springs count from 1. A standard error ("std") is one
sigma; `None` means it could not be determined.

Fields marked `written` are in the JSON file of their type, in this order (`json_files.py`). The
sections of this file:

- Recordings: `Record`, `Intervention`, `SinePoint`, `DecayLaw`, `LogDecrement`, `StepGain`.
- Carts: `FrequencyResponse`, `Estimate` with its `Coverage`, `ChainFit`.
- Comparisons: `ParameterRow` (initial against final), `Check`, `Finding`.
- Control: `FeedbackDesign`, `HardwareCheck`.
- Remarks: `Skipped`, `RecordingGroup`, `Assumption`.
- Tables that only `results.json` has: `Submitted`, `Provenance`, `ChainWithUnits`, ….
- All together: `Analysis`.

Other packages have further types:

- `Ingested` (`ingest/read.py`). The data read.
- `Identified` and `Fitted` (`identify/`). Results of the stages up to the fit.
- `Repeats` (`identify/repeats.py`). Steps and decays in repeated recordings.
- `Gap` (`gap/types.py`). The gap of the linear carts and its explanation.
- `Grade` (`grading/grade.py`). The points of a submission, with reasons.
- `Grading` (`grading/gradings.py`). The place of a grade in a class.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from enum import StrEnum
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from pipeline import __version__
from pipeline.arrays import Array, freeze
from pipeline.json_files import (
    FiniteNumbers,
    Matrix,
    Number,
    Numbers,
    Poles,
    Sha256,
    computed,
    result,
    written,
)
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.plant.margins import Margins
from pipeline.plant.sampled_loop import StateFeedback
from pipeline.setup import Setup, Units
from pipeline.words.numbers import percent, significant
from pipeline.words.phrases import phrases
from pipeline.words.quantities import Quantity, quantity_html, quantity_lines

ExperimentKind = Literal["decay", "step", "sine", "sweep", "closed_loop", "bode"]
Hold = Literal["zero_order", "band_limited"]
CheckOutcome = Literal["pass", "fail", "skip"]
Exclusion = Literal["no", "odd", "wrong"]


def passed(good: bool) -> CheckOutcome:
    """Return "pass" if `good` is true, else "fail"."""
    return "pass" if good else "fail"


# Limit of χ² per degree of freedom: below it, model and noise explain the data. By chance it stays
# under 1.5 with 30 or more points; standard errors that are 40 % too small give 2.
EXPLAINED = 2.0


_SENTENCES = phrases("findings", "findings")
SIGNAL = 3.0  # standard errors; a smaller magnitude may be noise alone


# --------------------------------------------------------------------------------------- recordings


@dataclass(frozen=True, kw_only=True)
class HeadingUnit:
    """A unit that a heading states.

    `converts` is true if the unit can be converted to the submission's unit; otherwise it was
    ignored.
    """

    role: Literal["position", "input"]
    heading: str
    unit: str
    converts: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """One measured time series, in physical units.

    Attributes
    ----------
    id : the experiment's id, used in every message.
    t : (n,) measured times in s; they increase strictly, but need not be evenly spaced.
    u : (n,) input; None if the file has no input. A positive input pushes cart 1 towards positive
        x.
    y : (len(carts), n) positions. Row j belongs to cart `carts[j]`.
    carts : the carts that were measured.
    free : the carts free to move. The others are held.
    reference : (n,) set point of a closed-loop run, in position units; otherwise None.
    omega : frequency of a sine dwell in rad/s; otherwise None.
    resolution : (len(carts),) encoder step in position units; 0 if no step is visible.
    hold : how the input behaves between samples.
    source : path of the data file inside the submission.
    notes : corrections made while reading.
    sign_reversed : whether the input's sign was reversed, so that it agrees with the other
        recordings.
    position_scale, input_scale : signed factors from the file's own numbers to y and u. A
        controller's gains may be in the file's units.
    heading_units : the units that the headings of the position and input columns state.
    """

    id: str
    kind: ExperimentKind
    t: Array
    u: Array | None
    y: Array
    carts: tuple[int, ...]
    free: tuple[int, ...]
    reference: Array | None = None
    omega: float | None = None
    resolution: Array
    hold: Hold = "zero_order"
    source: str = ""
    notes: tuple[str, ...] = ()
    sign_reversed: bool = False
    position_scale: float = 1.0
    input_scale: float = 1.0
    heading_units: tuple[HeadingUnit, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "t", "u", "y", "reference", "resolution")
        n = self.t.size
        if self.y.shape != (len(self.carts), n) or self.resolution.shape != (len(self.carts),):
            raise ValueError(f"{self.id}: y {self.y.shape} does not match carts and t ({n},)")
        if any(a is not None and a.shape != (n,) for a in (self.u, self.reference)):
            raise ValueError(f"{self.id}: the input or reference does not match t ({n},)")

    @property
    def measured_free(self) -> tuple[int, ...]:
        """The free carts that were measured, in the order of the rows of y."""
        return tuple(cart for cart in self.carts if cart in self.free)

    @property
    def input(self) -> Array:
        """The input (n,), which is zero if the file lacks it."""
        return np.zeros(self.t.size) if self.u is None else self.u

    def part(self, samples: slice) -> "Record":
        """Return the record with only some of its samples."""
        u, reference = (None if a is None else a[samples] for a in (self.u, self.reference))
        return replace(self, t=self.t[samples], u=u, y=self.y[:, samples], reference=reference)

    def position(self, cart: int) -> Array:
        """Return the measured position (n,) of one cart."""
        return self.y[self.carts.index(cart)]

    def encoder_step(self, cart: int) -> float:
        """Return the encoder step of one cart, in position units; 0 if it is not visible."""
        return float(self.resolution[self.carts.index(cart)])

    @property
    def sample_time(self) -> float:
        """The mean sample interval in s."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))


@result()
class Intervention:
    """A stretch of a record in which an unmeasured force moves or holds a cart.

    Most likely a hand moves the cart, or holds it away from its rest position and releases it.
    """

    experiment: str = written()
    cart: int = written()
    start: float = written("s", key="from")
    end: float = written("s", key="to")
    what: str = written(default="held or moved by a force that was not measured")


@result(eq=False)
class SinePoint:
    """Sinusoidal steady state of one cart in one dwell."""

    experiment: str = written()
    cart: int = written()
    omega: float = written("rad/s; fitted where the submission did not state it")

    @computed()
    def gain(self) -> float:
        """Amplitude ratio, position unit per input unit."""
        return self.amplitude / self.input_amplitude

    @computed()
    def gain_std(self) -> float:
        """Standard error of the amplitude ratio, combined from the errors of both amplitudes."""
        relative = (
            (self.amplitude_std / self.amplitude) ** 2
            + (self.input_amplitude_std / self.input_amplitude) ** 2
            if self.amplitude > 0
            else 0.0
        )
        return self.gain * relative**0.5 if self.amplitude > 0 else self.amplitude_std

    phase: float = written("rad, of the position against the input's sine, in (-pi, pi]")
    phase_std: float = written()
    amplitude: float = written("amplitude of the position")
    amplitude_std: float = written()
    input_amplitude: float = written("amplitude of the measured input, fitted in the same way")
    input_amplitude_std: float = written()
    steady_from: float = written("s; the fit uses t >= steady_from, after the transient")
    settled: bool = written("false if the record ends before a steady state")
    note: str = written(
        "what a reader must know (few counts, not settled, off-sine residual), or empty", default=""
    )
    n_points: int


DecayCause = Literal[
    "exponential",
    "dry_friction",
    "quadratic_drag",
    "frequency_shift",
    "second_mode",
    "drift",
    "unknown",
]


# Two periods have a limit of 7. With a larger limit, even strong drag or friction may not show.
_LARGEST_LIMIT = 8.0


@result(eq=False)
class DecayLaw:
    """The law that a free decay follows, and the linear damping and frequency that it implies."""

    name: DecayCause = written(
        "exponential (within the noise), or why the decay is not: the reason that explains what an "
        "exponential leaves, or unknown if no reason does"
    )
    statistic: Number = written("what an exponential leaves, relative to the noise (F-statistic)")
    limit: Number = written("what the statistic reaches by chance in one of 10,000 decays")
    size: Number = written(
        "d = F/k of friction, beta of a drag beta |v| v, relative shift at the largest swing, "
        "second damped frequency in rad/s, or largest drift off a line"
    )
    size_std: Number = written()
    omega_n: Number = written("rad/s, for small oscillations without the cause")
    omega_n_std: Number = written()
    zeta: Number = written("damping ratio, for small oscillations without the cause")
    zeta_std: Number = written()

    @property
    def is_exponential(self) -> bool:
        """Whether an exponential leaves only noise."""
        return self.name == "exponential"

    @property
    def is_untested(self) -> bool:
        """Whether so few swings were tested that even a strong cause would not show."""
        return self.is_exponential and self.limit > _LARGEST_LIMIT

    @property
    def is_friction(self) -> bool:
        """Whether dry friction explains what an exponential leaves."""
        return self.name == "dry_friction"


# Earlier versions tested for dry friction alone.
_LAW_UNTOLD = DecayLaw(
    name="unknown",
    statistic=np.nan,
    limit=np.nan,
    size=np.nan,
    size_std=np.nan,
    omega_n=np.nan,
    omega_n_std=np.nan,
    zeta=np.nan,
    zeta_std=np.nan,
)


@result(eq=False)
class LogDecrement:
    """Free decay of one cart: peaks, envelope, natural frequency and damping ratio.

    Attributes
    ----------
    peak_t, peak_y : (n_peaks,) times and positions of the extrema used. Maxima and minima
        alternate.
    amplitude : (n_peaks - 2,) half the peak-to-peak swing, at peak_t[1:-1]. A moving rest point
        does not affect it.
    fit_t, fit_y : the fitted decay, for the figure.
    envelope_upper, envelope_lower : the envelope at the times fit_t.
    zeta_at_amplitude : (2, n) amplitudes, and the local damping ratio at each amplitude.
    """

    experiment: str = written()
    cart: int = written()
    number: int | None = written(
        "number of this decay in the recording, from 1; null: the only one",
        default=None,
    )
    release: float = written(
        "s, start of the free decay; before it, the cart may be held or moved", default=0.0
    )
    delta: Number = written("logarithmic decrement per full cycle")
    delta_std: Number = written()
    omega_n: Number = written(
        "rad/s, from the fit of the law; of a decaying sinusoid if the law is dry friction, which "
        "makes it wrong, or unknown"
    )
    omega_n_std: Number = written("including what the fit leaves beyond the noise")
    zeta: Number = written("damping ratio from that fit")
    zeta_std: Number = written()
    omega_n_peaks: Number = written("rad/s, from the extrema")
    omega_n_peaks_std: float
    zeta_peaks: Number = written("damping ratio from the logarithmic decrement")
    zeta_peaks_std: Number = written()
    law: DecayLaw = written(default=_LAW_UNTOLD)
    note: str = written("what a reader must know, or empty", default="")
    peak_t: Array
    peak_y: Array
    amplitude: Array
    fit_t: Array
    fit_y: Array
    envelope_upper: Array
    envelope_lower: Array
    zeta_at_amplitude: Array

    @property
    def name(self) -> str:
        """The record's id and, if it has several decays, the number of this one."""
        return f"{self.experiment}, decay {self.number}" if self.number else self.experiment


@dataclass(frozen=True, kw_only=True, eq=False)
class StepEdge:
    """One jump of the input, with the levels of input and position on both sides.

    `gain` is (level_after - level_before) / (u_after - u_before). `t` and the windows are in s.
    """

    t: float
    u_before: float
    u_after: float
    level_before: float
    level_after: float
    window_before: tuple[float, float]
    window_after: tuple[float, float]
    gain: float
    gain_std: float


@result(eq=False)
class StepGain:
    """Static gain of one cart from one step record."""

    experiment: str = written()
    cart: int = written()
    gain: Number = written("weighted mean over the edges")
    gain_std: Number = written("including the spread of the edges")
    interval: tuple[float, float] | None = written("range of the gain if the cart sticks")
    rest_shift: float | None = written(
        "shift of the rest position from the first to the last rest, by friction"
    )
    note: str = written(default="")
    edges: tuple[StepEdge, ...]


# -------------------------------------------------------------------------------------------- carts


@result(eq=False)
class FrequencyResponse:
    """X_cart/U of one cart at the measured frequencies, never interpolated; arrays (n_w,)."""

    cart: int = written()
    omega: FiniteNumbers = written("rad/s, ascending")
    magnitude: FiniteNumbers = written("position unit per input unit")
    magnitude_std: Numbers = written()
    phase: Numbers | None = written("rad; null for a table of amplitude ratios")
    phase_std: Numbers | None = written()
    source: Literal["dwells", "table", "records"] = written(
        "sine dwells, a table made by the students, or transforms of step and sweep records"
    )
    experiments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "omega", "magnitude", "magnitude_std", "phase", "phase_std")

    @property
    def has_signal(self) -> NDArray[np.bool_]:
        """Whether each magnitude (n_w,) is above the noise, by three standard errors.

        A table without standard errors shows no noise.
        """
        return (self.magnitude > 0) & ~(self.magnitude <= SIGNAL * self.magnitude_std)

    def only(self, kept: NDArray[np.bool_]) -> "FrequencyResponse":
        """Return the response with only the points for which `kept` (n_w,) is true."""
        phase, phase_std = self.phase, self.phase_std
        return replace(
            self,
            omega=self.omega[kept],
            magnitude=self.magnitude[kept],
            magnitude_std=self.magnitude_std[kept],
            phase=None if phase is None else phase[kept],
            phase_std=None if phase_std is None else phase_std[kept],
        )


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Where measurements lie around the frequency of a resonance or null, rad/s.

    Attributes
    ----------
    of : the name of the frequency, such as "omega_b".
    half_width : ζω, half the width of its peak.
    below, above : the nearest measured frequency on each side, or None. One within `half_width`
        counts for both sides.
    limit : the largest relative distance at which measurements still determine it.
    """

    of: str
    omega: float
    half_width: float
    below: float | None
    above: float | None
    limit: float

    @property
    def distance(self) -> float:
        """The relative distance to the farther of both neighbours; 1 if one is missing."""
        if self.below is None or self.above is None:
            return 1.0
        return max(abs(self.below - self.omega), abs(self.above - self.omega)) / self.omega

    @property
    def extrapolated(self) -> bool:
        """Whether no measurement is near enough, so that only the model gives the frequency."""
        return self.distance > self.limit


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its standard error and its source ("step", "log_decrement", …).

    `at_bound` is true if a fit ended at the limit of what is possible, such as zero damping. Then
    `value` is that limit and not a measurement, `std` is None, and no conclusion may be drawn from
    either. `experiments` are the recordings behind the number; for a fit see
    `ChainFit.experiments`. `coverage` shows what determines a fitted frequency or damping ratio.
    """

    value: float
    std: float | None
    source: str
    at_bound: bool = False
    experiments: tuple[str, ...] = ()
    coverage: Coverage | None = None

    @property
    def extrapolated(self) -> bool:
        """Whether only the model gives the number, because no measurement is near it."""
        return self.coverage is not None and self.coverage.extrapolated


@result(eq=False)
class ChainFit:
    """One chain fitted to the measurements of all carts at once.

    Attributes
    ----------
    chain : the fitted plant.
    names : physical parameters that have a standard error, such as "m_1", "c_1", "k_2".
    covariance : (n_p, n_p) covariance of these parameters.
    at_bound : physical parameters whose fitted values cannot be distinguished from zero, their
        bound. They are held at zero or, where possible, taken from the decays.
    parameters : the named parameters of the chain with standard errors, in table order. A parameter
        that ended at its bound has a true `Estimate.at_bound`, and no table shows it.
    staged : the named parameters from the stage-by-stage fit (last cart first), for the report.
    misfit : for a "bode_fit", deviation of the magnitude points from the fit beyond their standard
        errors, as a share of the magnitude.
    standardised : residuals divided by their standard errors: one array (n_w,) per cart, or (n,)
        per record.
    experiments : the recordings that the chain was fitted to.
    """

    method: Literal["bode_fit", "time_fit"] = written(
        "fit to the frequency response or to time records"
    )
    chi_square_per_dof: Number = written("near 1 if model and stated noise explain the data")
    dof: int = written()
    n_points: int = written(key="points")
    n_starts: int = written(key="starts")
    converged: bool = written()
    message: str = written()
    chain: Chain
    names: tuple[str, ...]
    covariance: Array
    at_bound: tuple[str, ...] = ()
    parameters: dict[str, Estimate]
    staged: dict[str, float] = field(default_factory=dict)
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


# -------------------------------------------------------------------------------------- comparisons

# What determines a fitted number: points of the response or motion in the fitted recordings at its
# frequency, a decay, other parameters with such measurements, or only the model.
DeterminedBy = Literal["points", "motion", "decay", "parameters", "model"]


@result()
class ParameterRow:
    """One parameter with its initial and final estimate, a row of the paper's Tables 1-3."""

    name: str = written("K_1, omega_a, zeta_1, …")
    unit: str = written("empty for a damping ratio")
    initial: Estimate | None
    final: Estimate | None

    @computed(key="initial")
    def initial_value(self) -> float | None:
        """The estimate from the first stages."""
        return self.initial and self.initial.value

    @computed()
    def initial_std(self) -> float | None:
        """The standard error, in the unit of the parameter."""
        return self.initial and self.initial.std

    @computed()
    def initial_from(self) -> str | None:
        """`step`, `log_decrement`, `frequency_response` or `assumed`."""
        return self.initial and self.initial.source

    @computed(key="final")
    def final_value(self) -> float | None:
        """The estimate from the fit of all carts at once."""
        return self.final and self.final.value

    @computed()
    def final_std(self) -> float | None:
        """The standard error, in the unit of the parameter."""
        return self.final and self.final.std

    @computed()
    def final_from(self) -> str | None:
        """`bode_fit`, `time_fit` or `log_decrement`."""
        return self.final and self.final.source

    determined_by: DeterminedBy | None = written(
        "what determines the final frequency or damping ratio; model: no measurement is near it",
        default=None,
    )
    change_percent: float | None = written("change from the initial to the final estimate")
    change_sigmas: float | None = written("the change divided by the combined standard error")
    consistent: bool | None = written(
        "null: there is nothing to compare, or the errors are too wide"
    )
    independent: bool | None = written(
        "false: both estimates use the same recordings; null: there is only one",
        default=None,
    )
    note: str = written(default="")

    @property
    def extrapolated(self) -> bool:
        """Whether only the model gives the final number, because no measurement is near it."""
        return self.determined_by == "model"


CheckKind = Literal[
    "input",
    "data",
    "record",
    "position_unit",
    "input_unit",
    "position_scale",
    "input_scale",
    "setup",
    "held",
    "dwells",
    "late_channel",
    "fit",
    "physical",
    "vanishing",
    "springs",
    "groups",
    "redundancy",
    "order",
    "repeats",
    "initial_final",
    "covered",
    "step",
    "decay",
    "hardware",
    "feedback",
]


ReportState = Literal["no_model", "checks_failed", "numbers_disagree", "ok"]


@dataclass(frozen=True, kw_only=True)
class ReportStatus:
    """How far the numbers of a report may be used; every page, terminal and exit code shows this.

    Attributes
    ----------
    state : "no_model", or else "checks_failed", or else "numbers_disagree", or else "ok".
    count : number of failed checks, or of the students' numbers that disagree with their data.
    """

    state: ReportState
    count: int = 0

    @property
    def is_fine(self) -> bool:
        """Whether nothing speaks against the numbers."""
        return self.state == "ok"

    @property
    def words(self) -> str:
        """The status in a few words."""
        match self.state:
            case "no_model":
                return "no model"
            case "checks_failed":
                return f"{self.count} check{'s' if self.count != 1 else ''} failed"
            case "numbers_disagree" if self.count == 1:
                return "1 of your numbers disagrees"
            case "numbers_disagree":
                return f"{self.count} of your numbers disagree"
        return "fine"


# Kinds of check of the set-up, the most serious first (see docs/decisions.md). Of the vanishing
# parameters, only springs count.
_CAUSES: tuple[CheckKind, ...] = (
    "input",
    "springs",
    "position_unit",
    "input_unit",
    "position_scale",
    "input_scale",
    "groups",
    "setup",
    "held",
    "vanishing",
)


@result()
class Check:
    """One consistency check, in a sentence for a student; `value` is compared with `limit`.

    Attributes
    ----------
    kind : the question, such as whether a step has one gain.
    run, cart, parameter : what the question is about, if it is about one of these.
    part : distinguishes several questions of one kind. For example, it is "converged" for the fit,
        "in_ab" for the order of a frequency, or the number of a recording's decay.
    code : the code of the finding that fails it, or "".
    """

    @computed()
    def id(self) -> str:
        """The kind of check and what it is about: "decay.run-1.cart_1"."""
        return f"{self.kind}.{self.about}" if self.about else self.kind

    kind: CheckKind
    run: str = ""
    cart: int | None = None
    parameter: str = ""
    part: str = ""
    code: str = ""
    outcome: CheckOutcome = written()
    value: float | None = written(default=None)
    limit: float | None = written(default=None)
    message: str = written()

    @classmethod
    def from_written(cls, *, id: str, **said: Any) -> "Check":
        """Return the check of a file, whose id has the kind and what the check is about."""
        kind, _, about = id.partition(".")
        return cls(kind=cast(CheckKind, kind), parameter=about, **said)

    @property
    def is_cause(self) -> bool:
        """Whether its failure is a mistake in the set-up, which right carts cannot explain."""
        if self.kind == "vanishing":
            return read_name(self.parameter).symbol == "k"
        return self.kind in _CAUSES

    @property
    def excess(self) -> float:
        """The ratio of the value to its limit; 0 if it is unknown."""
        return abs(self.value / self.limit) if self.value is not None and self.limit else 0.0

    @property
    def about(self) -> str:
        """The subject of the check, such as "run-1.cart_1", or ""."""
        cart = "" if self.cart is None else f"cart_{self.cart}" if self.run else f"cart-{self.cart}"
        if self.parameter and self.part:
            return f"{self.parameter}_{self.part}"
        return ".".join(filter(None, (self.run, cart, self.parameter, self.part)))


@result()
class Finding:
    """Something that is wrong with a recording, the set-up or the model.

    Attributes
    ----------
    code : what is wrong, which is also the key of its sentence in
        `templates/words/findings.toml`.
    kind : the consistency check that fails.
    run, cart, parameter, part : what it is about, as in `Check`. Without a cart, it concerns the
        whole recording; without a recording, the set-up or the model.
    details : values for the sentence. A sentence with `runs` names its recordings itself.
    value, limit : the number that shows it, and its largest allowed value. None if there is no such
        number.
    excludes : whether the recording is used: "no" if it is, "odd" if it is left out because it
        differs from others, "wrong" if it is left out because it does not show what happened.
    """

    code: str
    kind: CheckKind = "record"
    run: str = ""
    cart: int | None = None
    parameter: str = ""
    part: str = ""
    details: Mapping[str, object] = field(default_factory=dict)
    value: float | None = None
    limit: float | None = None
    excludes: Exclusion = "no"

    @classmethod
    def from_written(cls, *, experiment: str, reason: str, is_wrong: bool) -> "Finding":
        """Return the finding of a file, which has its sentence instead of its code."""
        excludes = "wrong" if is_wrong else "odd"
        return cls(code="quoted", run=experiment, details={"reason": reason}, excludes=excludes)

    @computed()
    def experiment(self) -> str:
        """The recording that was not used."""
        return self.run

    @computed()
    def reason(self) -> str:
        """What is wrong, in words that follow the recording's name, if it is about one."""
        return _SENTENCES.text(self.code, **{"cart": self.cart, **self.details})

    @computed(default=False)
    def is_wrong(self) -> bool:
        """True: the recording is wrong; false: it only differs from its repeats."""
        return self.excludes == "wrong"

    @property
    def check(self) -> Check:
        """The failed check."""
        named = self.run and "runs" not in self.details
        return Check(
            kind=self.kind,
            run=self.run,
            cart=self.cart,
            parameter=self.parameter,
            part=self.part,
            code=self.code,
            outcome="fail",
            value=self.value,
            limit=self.limit,
            message=f"{self.run}: {self.reason}" if named else self.reason,
        )


@result()
class Subject:
    """The recording, cart and parameter of a finding, or null."""

    experiment: str | None = written(default=None)
    cart: int | None = written(default=None)
    parameter: str | None = written(default=None)

    @classmethod
    def of(cls, one: "Check | Skipped") -> "Subject":
        """Return the subject of a check or of a skipped stage."""
        return cls(experiment=one.run or None, cart=one.cart, parameter=one.parameter or None)


@result()
class ListedFinding:
    """A failed check, a wrong number, a skipped stage or a warning, as files list it.

    Attributes
    ----------
    code : what is wrong. It is "skipped" for a stage, "warning" for a warning, and "number_off" for
        a student's number that disagrees with the recordings.
    excludes : whether the recording is used, as in `Finding`.
    """

    code: str = written()
    about: Subject = written(default=Subject())
    value: float | None = written(default=None)
    limit: float | None = written(default=None)
    message: str = written()
    excludes: Exclusion = written(
        '"odd": differs from others, "wrong": shows something else', default="no"
    )


# ------------------------------------------------------------------------------------------ control


@result(eq=False)
class FeedbackDesign:
    """The designed state feedback u = prefilter r - gains [x1, v1, x2, v2, …].

    Attributes
    ----------
    t, y (n_carts, n), u : the simulated step.
    units : of the table that a notebook shows.
    """

    cart: int = written()
    method: Literal["poles", "lqr"] = written()
    reference: float = written("size of the step, in position units")
    gains: FiniteNumbers = written("(2n)")
    prefilter: Number = written("1 / DC gain of the loop for the chosen cart")
    poles: Poles = written("closed-loop poles as [re, im]: log z / sample_time, in rad/s")
    sample_time: float = written("s; the delay of one sample is part of the model")
    overshoot_percent: Number = written("overshoot of the simulated step")
    settling_time: float | None = written("s, to within 2 %")
    peak_input: Number = written()
    margins: Margins | None = written(
        "margins of the loop with its observer and delay, opened at the motor",
        default=None,
    )
    bench_margins: Margins | None = written(
        "the same on cartlab's bench, whose observer has no model of the carts and assumes "
        "constant velocities; null: that loop is unstable",
        default=None,
    )
    reachable: bool = written("false if the goal cannot be met")
    message: str = written("what is reachable")
    requested_poles: Poles | None = written(
        "poles requested from pole placement as [re, im], rad/s; null with lqr", default=None
    )
    Q: Matrix | None = written(
        "(2n, 2n) weights of the state in the cost, the sum of x'Q x + R u²; null with poles",
        default=None,
    )
    R: float | None = written("weight of the input in that cost", default=None)
    t: Array
    y: Array
    u: Array
    units: Units = Units(position="position unit", input="input unit")

    def quantities(self) -> list[Quantity]:
        """Return gains, prefilter, and the properties of the simulated step."""
        position, drive = self.units.position, self.units.input
        rows = []
        for i, value in enumerate(self.gains):
            of, unit = ("velocity", f"{drive} s") if i % 2 else ("position", drive)
            name = f"gain on the {of} of cart {i // 2 + 1}"
            rows.append((name, significant(value), f"{unit}/{position}"))
        if self.R is not None:
            rows.append(("LQR weight of the input, R", significant(self.R), f"{position}/{drive}"))
        return [
            *rows,
            ("prefilter", significant(self.prefilter), f"{drive}/{position}"),
            ("sample time T", significant(self.sample_time, digits=5), "s"),
            ("delay of the effort", "1", "sample"),
            ("overshoot", percent(self.overshoot_percent), ""),
            ("settling time, 2 %", significant(self.settling_time, digits=3), "s"),
            ("largest input", significant(self.peak_input, digits=3), drive),
        ]

    def controller(self, chain: Chain | None) -> StateFeedback:
        """Return the controller; its observer predicts with the chain or, as the bench, without."""
        return StateFeedback(gains=self.gains, prefilter=self.prefilter, model=chain)

    @property
    def _shown(self) -> tuple[str, list[Quantity]]:
        rows = self.quantities()
        if self.margins is not None:
            gain, phase = self.margins.gain, self.margins.phase_deg
            rows += [
                ("gain margin", significant(gain, digits=3), ""),
                ("phase margin", significant(phase, digits=3), "°"),
                ("modulus margin", significant(self.margins.modulus, digits=3), ""),
            ]
        return f"State feedback for cart {self.cart}", rows

    def __repr__(self) -> str:
        return quantity_lines(*self._shown)

    def _repr_html_(self) -> str:
        return quantity_html(*self._shown)


@result()
class MeasuredInput:
    """Comparison of the plant alone, driven by the logged input, with the measurement."""

    nrmse: Number = written()
    input_scale: float | None = written(
        "the factor on the logged input that explains the motion best"
    )


@result(eq=False)
class HardwareCheck:
    """Model against measurement for one cart of one run, as in Figures 15-17.

    Attributes
    ----------
    input_scale : the factor on the logged input, sign included, that explains the motion best. It
        is 1 if the log is right, and None if it was not estimated.
    t, measured, model : (n,).
    effort : (n,) input of the simulated loop; None in the comparison with the measured input.
    set_point : (n,) desired position of this cart; None if the loop controls another cart.
    contradicted : whether the log or the stated controller must be wrong; the note says why.
    is_scaled : whether the model is driven by the logged input times `input_scale`.
    """

    experiment: str = written()
    cart: int = written()
    loop: Literal["closed", "open"] = written(
        "closed: simulated with the controller that ran; open: with the measured input"
    )
    nrmse: Number = written(
        "rms of measured minus simulated position, divided by the rms of the measured one"
    )
    overshoot_model: float | None = written("percent of the change in level")
    overshoot_measured: float | None = written()
    settling_model: float | None = written("s", key="settling_time_model")
    settling_measured: float | None = written(key="settling_time_measured")
    steady_state_model: float | None = written("position units")
    steady_state_measured: float | None = written()
    measured_input: MeasuredInput | None = written(default=None)
    note: str = written(default="")
    input_scale: float | None
    t: Array
    measured: Array
    model: Array
    contradicted: bool = False
    is_scaled: bool = False
    effort: Array | None = None
    set_point: Array | None = None


# ------------------------------------------------------------------------------------------ remarks


class Stage(StrEnum):
    """A stage that may be skipped, as named in results.json."""

    READING = "reading"
    LOG_DECREMENT = "log decrement"
    STEP_GAIN = "step gain"
    SINE = "sine steady state"
    FREQUENCY_RESPONSE = "frequency response"
    RESONANCES = "resonances"
    BODE_FIT = "Bode fit"
    FINAL_ESTIMATES = "final estimates"
    NAMED_PARAMETERS = "named parameters"
    FINAL_PARAMETER = "final"
    STATE_FEEDBACK = "state feedback"
    MARGINS = "margins"
    HARDWARE_CHECK = "hardware check"


@result()
class Skipped:
    """A stage that could not run, with its recording, cart or parameter, and the reason.

    `missing` names the missing data in words. It is empty if the data exist but cannot be used;
    `reason` then says why.
    """

    @computed(key="stage")
    def name(self) -> str:
        """The stage, with its recording and cart: "step gain, run-1, cart 1", "reading run-1"."""
        if self.stage in (Stage.READING, Stage.FINAL_PARAMETER):
            return f"{self.stage} {self.run}{self.parameter}"
        cart = "" if self.cart is None else f"cart {self.cart}"
        return ", ".join(filter(None, (self.stage, self.run, cart)))

    stage: Stage
    run: str = ""
    cart: int | None = None
    parameter: str = ""
    reason: str = written()
    missing: str = ""


@result()
class RecordingGroup:
    """Recordings that one set of carts explains, and the numbers that other groups contradict."""

    experiments: tuple[str, ...] = written()
    values: dict[str, float] = written("m_1, k_2, omega_1, …")
    std: dict[str, float] = written("standard errors")
    label: str = written("the day or folder that only these recordings share", default="")
    remark: str = written("why they may differ, and what to state then", default="")
    is_rest: bool = written("whether they follow the carts of no group", default=False)


@result()
class Assumption:
    """A statement about the bench that every number depends on, and whether the data support it."""

    key: str = written("key in submission.toml, such as system.springs")
    about: str = written("which one, if there are several, such as wall-1", default="")
    value: bool | float | str | tuple[int, ...] = written("what was stated or taken")
    origin: Literal["stated", "data", "default"] = written()
    support: Literal["supported", "contradicted", "open"] = written("open: the data do not decide")
    found: float | None = written("value from the data, if it is a number", default=None)
    found_std: float | None = written(default=None)
    experiments: tuple[str, ...] = written(
        "the recordings that it is about, or that test it", default=()
    )
    reason: str = written("how the data support or contradict it, or why they cannot")


# --------------------------------------------------------------------------- tables of results.json


@result()
class Submitted:
    """The title, the authors and the bench of a submission."""

    title: str = written()
    section: str = written()
    authors: tuple[str, ...] = written("ids of the authors")
    carts: int = written()
    springs: tuple[bool, ...] = written("wall-1, 1-2, …, n-wall")
    units: Units = written()


@result()
class Provenance:
    """The program version and the data files behind a result file."""

    version: str = written("of cartlab", default_factory=lambda: __version__)
    files: dict[str, Sha256] = written("SHA-256 of every data file")


@result()
class ChainUnits:
    """Units of masses, dampings and stiffnesses."""

    m: str = written()
    c: str = written()
    k: str = written()


@result(eq=False)
class ChainWithUnits(Chain):
    """Carts and springs with their units."""

    units: ChainUnits = written()

    @classmethod
    def of(cls, chain: Chain, units: Units) -> "ChainWithUnits":
        """Return the chain together with its units."""
        own = ChainUnits(m=units.mass, c=units.damping, k=units.stiffness)
        return cls(m=chain.m, c=chain.c, k=chain.k, units=own)

    @property
    def _shown(self) -> tuple[str, list[Quantity]]:
        springs = self.k[:1] if self.n == 1 else self.k  # on one cart, only their sum is known
        rows = [
            (f"{letter}_{i}", significant(float(value)), unit)
            for letter, values, unit in (
                ("m", self.m, self.units.m),
                ("c", self.c, self.units.c),
                ("k", springs, self.units.k),
            )
            for i, value in enumerate(values, start=1)
        ]
        return "Masses m, dampings c, springs k", rows

    def __repr__(self) -> str:
        return quantity_lines(*self._shown)

    def _repr_html_(self) -> str:
        return quantity_html(*self._shown)


@result(eq=False)
class StateSpaceMatrices:
    """The state model; the state is (x1, v1, x2, v2, …)."""

    A: Matrix = written()
    B: Matrix = written()
    C: Matrix = written()
    D: Matrix = written()


# ------------------------------------------------------------------------------------- all together


@result(eq=False)
class Analysis:
    """All results of one submission. A number that could not be determined is null, never 0 or NaN.

    Attributes
    ----------
    authors : (id, name) of each author.
    tables : frequency responses that the students computed, even if dwells replace them.
    rows : the table of parameters.
    fit : the fitted chain; if it is None, `skipped` says why.
    files : the SHA-256 of each data file.
    unreadable : for each experiment that could not be read, the reason.
    unread : the place and the reason for each part of submission.toml that could not be used.
    unexplained : for each driven recording with motion, the share of its power that the fitted
        carts do not explain.
    discussion : `notes.md`, without its comments.
    reported : the students' own numbers, initial and final, with the digits as typed.
    reported_off : the parameters for which one of these disagrees with the data.
    """

    schema: Literal["cartlab-results/1"] = written(default_factory=lambda: "cartlab-results/1")
    title: str
    section: str
    authors: tuple[tuple[str, str], ...]
    bench: Setup

    @computed()
    def submission(self) -> Submitted:
        """The title, the authors and the bench."""
        return Submitted(
            title=self.title,
            section=self.section,
            authors=tuple(id_ for id_, _ in self.authors),
            carts=self.bench.n,
            springs=self.bench.springs,
            units=self.bench.units,
        )

    records: tuple[Record, ...]
    sine_points: tuple[SinePoint, ...]
    tables: tuple[FrequencyResponse, ...] = ()
    rows: tuple[ParameterRow, ...] = written(key="parameters")

    @computed(key="chain")
    def chain_with_units(self) -> ChainWithUnits | None:
        """The fitted carts and springs."""
        return self.chain and ChainWithUnits.of(self.chain, self.bench.units)

    @computed()
    def state_space(self) -> StateSpaceMatrices | None:
        """The state model of the chain."""
        if self.chain is None:
            return None
        A, B, C, D = self.chain.state_space()
        return StateSpaceMatrices(A=A, B=B, C=C, D=D)

    fit: ChainFit | None = written()

    @computed()
    def unexplained_share(self) -> float | None:
        """The share of the fitted motion (rms) that neither the fitted carts nor noise explain."""
        if self.fit is None or not self.fit.converged:
            return None
        shares = [self.unexplained[run] for run in self.fit.experiments if run in self.unexplained]
        if shares:
            return float(np.sqrt(max(np.mean(shares), 0.0)))
        # A table of amplitude ratios has no recordings.
        return self.fit.misfit if self.fit.method == "bode_fit" else None

    log_decrements: tuple[LogDecrement, ...] = written()
    step_gains: tuple[StepGain, ...] = written()
    frequency_responses: tuple[FrequencyResponse, ...] = written(key="frequency_response")
    checks: tuple[Check, ...] = written()
    feedback: FeedbackDesign | None = written()
    hardware: tuple[HardwareCheck, ...]

    @computed(key="hardware")
    def hardware_by_cart(self) -> tuple[HardwareCheck, ...]:
        """One entry per run and cart: the simulated loop, and the plant on the measured input."""
        found: dict[tuple[str, int], HardwareCheck] = {}
        for check in sorted(self.hardware, key=lambda check: check.loop):  # "closed" before "open"
            key = (check.experiment, check.cart)
            found.setdefault(key, check)
            if check.loop == "open":
                own = MeasuredInput(nrmse=check.nrmse, input_scale=check.input_scale)
                found[key] = replace(found[key], measured_input=own)
        return tuple(found[key] for key in sorted(found))

    assumptions: tuple[Assumption, ...] = written(
        "springs, units, scales, sign, free carts", default=()
    )
    skipped: tuple[Skipped, ...] = written()
    warnings: tuple[str, ...] = written()
    files: dict[str, str]
    unreadable: dict[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    unexplained: dict[str, float] = field(default_factory=dict)
    discussion: str | None
    left_out: tuple[Finding, ...] = ()
    late_channels: tuple[Finding, ...] = ()
    groups: tuple[RecordingGroup, ...] = ()
    reported: Mapping[str, Mapping[str, Decimal]] = field(default_factory=dict)
    reported_off: tuple[str, ...] = ()

    @computed()
    def findings(self) -> tuple[ListedFinding, ...]:
        """Everything that is wrong, open or noted, in one list."""
        excludes: dict[tuple[str, str], Exclusion] = {
            (one.run, one.code): one.excludes for one in self.left_out
        }
        checks = [
            ListedFinding(
                code=one.code or one.kind,
                about=Subject.of(one),
                value=one.value,
                limit=one.limit,
                message=one.message,
                excludes=excludes.get((one.run, one.code), "no"),
            )
            for one in self.failed_checks
        ]
        skipped = [
            ListedFinding(
                code="skipped", about=Subject.of(one), message=f"{one.name}: {one.reason}"
            )
            for one in self.skipped
        ]
        warnings = [ListedFinding(code="warning", message=text) for text in self.warnings]
        typed = [
            ListedFinding(
                code="number_off",
                about=Subject(parameter=name),
                message=f"the number reported for {name} disagrees with the recordings",
            )
            for name in self.reported_off
        ]
        return (*checks, *typed, *skipped, *warnings)

    @computed(key="status")
    def state(self) -> ReportState:
        """How far the numbers may be used."""
        return self.status.state

    @property
    def status(self) -> ReportStatus:
        """How far the numbers may be used, in words too."""
        if self.chain is None:
            return ReportStatus(state="no_model")
        if self.failed_checks:
            return ReportStatus(state="checks_failed", count=len(self.failed_checks))
        if self.reported_off:
            return ReportStatus(state="numbers_disagree", count=len(self.reported_off))
        return ReportStatus(state="ok")

    @computed()
    def provenance(self) -> Provenance:
        """The program version and the data files behind these results."""
        return Provenance(files=dict(sorted(self.files.items())))

    @property
    def chain(self) -> Chain | None:
        """The identified plant; None without a fit, or if the fit failed."""
        return self.fit.chain if self.fit and self.fit.converged else None

    @property
    def steps(self) -> frozenset[str]:
        """The ids of the step recordings; ringing after a step is not a free release."""
        return frozenset(record.id for record in self.records if record.kind == "step")

    @property
    def failed_checks(self) -> tuple[Check, ...]:
        """The checks that failed: each is a reason to doubt the numbers."""
        return tuple(check for check in self.checks if check.outcome == "fail")

    @property
    def causes(self) -> tuple[Check, ...]:
        """The failed checks of the set-up, the most serious first.

        If the set-up is wrong, right carts do not explain the recordings. Among checks of one kind,
        the one that exceeds its limit most comes first.
        """
        failed = [check for check in self.failed_checks if check.is_cause]
        return tuple(sorted(failed, key=lambda one: (_CAUSES.index(one.kind), -one.excess)))

    @property
    def lacks_springs(self) -> bool:
        """Whether the recordings show a spring that is stated to be missing."""
        return any(
            not self.bench.springs[(read_name(check.parameter).cart or 1) - 1]
            for check in self.failed_checks
            if check.kind == "springs"
        )
