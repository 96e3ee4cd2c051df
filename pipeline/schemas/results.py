"""`results.json`, schema `cartlab-results/1`."""

from typing import Annotated, Literal

from pydantic import Field

from pipeline.schemas.base import (
    ChainWithUnits,
    Document,
    Margins,
    Number,
    Numbers,
    Provenance,
    Units,
)


class Submitted(Document):
    """Whose it is, and the bench."""

    title: str
    section: str
    authors: Annotated[tuple[str, ...], Field(description="ids")]
    carts: int
    springs: Annotated[tuple[bool, ...], Field(description="wall-1, 1-2, …, n-wall")]
    units: Units


class Parameter(Document):
    """One parameter of the transfer functions, estimated in up to two ways."""

    name: Annotated[str, Field(description="K_1, omega_a, zeta_1, …")]
    unit: Annotated[str, Field(description="empty for a damping ratio")]
    initial: Number
    initial_std: Number
    initial_from: Annotated[
        str | None, Field(description="step, log_decrement, frequency_response or assumed")
    ]
    final: Number
    final_std: Number
    final_from: Annotated[str | None, Field(description="bode_fit, time_fit or log_decrement")]
    change_percent: Number
    change_sigmas: Annotated[Number, Field(description="in combined standard errors")]
    consistent: Annotated[
        bool | None, Field(description="null: nothing to compare, or too uncertain")
    ]
    independent: Annotated[
        bool | None,
        Field(description="false: both rest on the same recordings; null: there are not two"),
    ] = None
    note: str


class StateSpace(Document):
    """The state model; the state is (x1, v1, x2, v2, …)."""

    A: tuple[Numbers, ...]
    B: tuple[Numbers, ...]
    C: tuple[Numbers, ...]
    D: tuple[Numbers, ...]


class Fit(Document):
    """The joint fit of all carts."""

    method: Literal["bode_fit", "time_fit"]
    chi_square_per_dof: Number
    dof: int
    points: int
    starts: int
    converged: bool
    message: str


class Friction(Document):
    """The F-test for dry friction in a decay."""

    present: bool
    f_statistic: Number
    threshold: Number
    drop: Annotated[Number, Field(description="d = F/k, position units")]
    drop_std: Number
    zeta: Annotated[Number, Field(description="with friction taken out")]
    zeta_std: Number


class LogDecrement(Document):
    """One free decay of one cart."""

    experiment: str
    cart: int
    number: Annotated[
        int | None, Field(description="which of the recording's decays, from 1; null: the only one")
    ] = None
    release: Annotated[float, Field(description="s, where the free decay begins")] = 0.0
    delta: Annotated[Number, Field(description="logarithmic decrement per full cycle")]
    delta_std: Number
    omega_n: Annotated[Number, Field(description="rad/s, of the exponential-sinusoid fit")]
    omega_n_std: Number
    zeta: Number
    zeta_std: Number
    omega_n_peaks: Annotated[Number, Field(description="rad/s, of the extrema")]
    zeta_peaks: Number
    zeta_peaks_std: Number
    friction: Friction | None
    note: str


class StepGain(Document):
    """Static gain of one cart from one step record."""

    experiment: str
    cart: int
    gain: Number
    gain_std: Number
    interval: Annotated[
        tuple[float, float] | None, Field(description="of the gain, where the cart sticks")
    ]
    rest_shift: Annotated[Number, Field(description="how far the rest point moved")]
    note: str


class FrequencyResponse(Document):
    """X_cart/U at each frequency."""

    cart: int
    omega: Annotated[Numbers, Field(description="rad/s, ascending")]
    magnitude: Annotated[Numbers, Field(description="position unit per input unit")]
    magnitude_std: tuple[Number, ...]
    phase: Annotated[tuple[Number, ...] | None, Field(description="rad")]
    phase_std: tuple[Number, ...] | None
    source: Literal["dwells", "table", "records"]


class Check(Document):
    """One consistency check."""

    id: str
    outcome: Literal["pass", "fail", "skip"]
    value: Number
    limit: Number
    message: str


class Feedback(Document):
    """The designed state feedback u = prefilter r - gains [x1, v1, x2, v2, …]."""

    cart: int
    method: Literal["poles", "lqr"]
    reference: float
    gains: Numbers
    prefilter: Number
    poles: Annotated[
        tuple[tuple[Number, Number], ...],
        Field(description="[re, im], continuous equivalents, rad/s"),
    ]
    sample_time: float
    overshoot_percent: Number
    settling_time: Annotated[Number, Field(description="s, to within 2 %")]
    peak_input: Number
    margins: Margins | None = None
    reachable: bool
    message: str


class MeasuredInput(Document):
    """The plant alone, driven by the logged input."""

    nrmse: Number
    input_scale: Annotated[
        Number, Field(description="the factor on the logged input that explains the motion best")
    ]


class Hardware(Document):
    """Model against measurement for one cart of one run."""

    experiment: str
    cart: int
    loop: Literal["closed", "open"]
    nrmse: Annotated[Number, Field(description="of measured minus simulated position")]
    overshoot_model: Annotated[Number, Field(description="percent of the change in level")]
    overshoot_measured: Number
    settling_time_model: Annotated[Number, Field(description="s")]
    settling_time_measured: Number
    steady_state_model: Annotated[Number, Field(description="position units")]
    steady_state_measured: Number
    measured_input: MeasuredInput | None
    note: str


class Skipped(Document):
    """A stage that could not run, and why."""

    stage: str
    reason: str


class Assumption(Document):
    """Something about the bench that every number rests on, and how the data support it."""

    key: Annotated[str, Field(description="of submission.toml: system.springs, …")]
    about: Annotated[str, Field(description="which one, where there are several: wall-1")]
    value: Annotated[
        bool | float | str | tuple[int, ...], Field(description="what was stated or taken")
    ]
    origin: Literal["stated", "data", "default"]
    support: Annotated[
        Literal["supported", "contradicted", "open"],
        Field(description="open: the data do not tell"),
    ]
    found: Annotated[Number, Field(description="what the data give for it, if it is a number")]
    found_std: Number
    experiments: Annotated[
        tuple[str, ...], Field(description="the recordings it is about, or that tell it")
    ]
    reason: str


class Results(Document):
    """All results of one submission. A number that could not be had is null, never 0 or NaN."""

    schema_: Annotated[Literal["cartlab-results/1"], Field(alias="schema")]
    submission: Submitted
    parameters: tuple[Parameter, ...]
    chain: ChainWithUnits | None
    state_space: StateSpace | None
    fit: Fit | None
    log_decrements: tuple[LogDecrement, ...]
    step_gains: tuple[StepGain, ...]
    frequency_response: tuple[FrequencyResponse, ...]
    checks: tuple[Check, ...]
    feedback: Feedback | None
    hardware: tuple[Hardware, ...]
    assumptions: Annotated[
        tuple[Assumption, ...], Field(description="springs, units, scales, sign, free carts")
    ] = ()
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...]
    provenance: Provenance
