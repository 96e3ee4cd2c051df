"""What the gap workflow finds."""

from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.arrays import Array
from pipeline.plant.nonlinear.effects.base import AugmentedChain, Effect
from pipeline.results import LeftOut
from pipeline.results_of_runs import Intervention

Verdict = Literal["named", "partial", "none", "ambiguous", "unexplained"]


@dataclass(frozen=True, kw_only=True)
class NamedValue:
    """A parameter of an effect with its standard error (None where it could not be had)."""

    value: float
    std: float | None
    unit: str


@dataclass(frozen=True, kw_only=True)
class Rival:
    """Another effect in the same role, fitted as fully; `where` as in `gap.json`.

    `confidence` is its weight among the models it is listed with.
    """

    effect: Effect
    where: dict[str, int]
    nrmse_after: float
    confidence: float


@dataclass(frozen=True, kw_only=True)
class FoundEffect:
    """One effect in the order found; errors are on held-out runs, before and after adding it.

    `confidence` is its weight by the Bayesian information criterion among all fitted models of
    the same size. Parameters that only describe a contact are in `details`.
    """

    effect: Effect
    where: dict[str, int]
    parameters: dict[str, NamedValue]
    details: dict[str, NamedValue]
    confidence: float
    nrmse_before: float
    nrmse_after: float
    rivals: tuple[Rival, ...]


@dataclass(frozen=True, kw_only=True)
class RecordGap:
    """Relative root-mean-square error of one cart in one run."""

    experiment: str
    cart: int
    held_out: bool
    baseline: float
    final: float
    noise_floor: float


@dataclass(frozen=True, kw_only=True)
class GapWindow:
    """Where a run departs from a model most: the window, what happens, its share."""

    experiment: str
    cart: int
    start: float
    end: float
    what: str
    share: float


@dataclass(frozen=True, kw_only=True)
class FreeRun:
    """Root-mean-square error (position unit) of one simulation of a whole record.

    None where the carts run away.
    """

    experiment: str
    error: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """One cart in one run, for figures: measured, the linear model, the final model (n,).

    `zero` is the encoder's zero in that run, as the final model has it.
    """

    experiment: str
    cart: int
    held_out: bool
    t: Array
    u: Array
    measured: Array
    baseline: Array
    final: Array
    zero: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftForce:
    """The force that the model does not explain, on one cart in one run: a mean over each window.

    Attributes
    ----------
    t, x, v, u (windows, samples) : times, position, velocity, input (0 on other carts than 1).
    weight (windows, samples) : of each sample in the mean; they add up to one.
    acceleration, force (windows,) : means.
    """

    experiment: str
    cart: int
    weight: Array
    t: Array
    x: Array
    v: Array
    u: Array
    acceleration: Array
    force: Array

    def mean(self, values: Array) -> Array:
        """Return the mean of (windows, samples) values over each window, (windows,)."""
        return (self.weight * values).sum(axis=1)


@dataclass(frozen=True, kw_only=True)
class FormulaTerm:
    """One term of a formula, "v|v|" say, with its coefficient."""

    term: str
    coefficient: float
    std: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class ForceFormula:
    """The shortest formula for the force left; `explains` is the share that it takes of it."""

    terms: tuple[FormulaTerm, ...]
    explains: float

    @property
    def text(self) -> str:
        """The sum of the terms in words, "-0.0021 sqrt|v| sign v"."""
        signed = " ".join(
            f"{'-' if one.coefficient < 0 else '+'} {abs(one.coefficient):.3g} {one.term}"
            for one in self.terms
        )
        return f"-{signed[2:]}" if signed[0] == "-" else signed[2:]


@dataclass(frozen=True, kw_only=True)
class ForceAgainst:
    """The force left against one quantity, bin by bin.

    Attributes
    ----------
    quantity : "position", "velocity" or "input", with its `unit`.
    at, force : means of each bin; `formula` the mean of what the formula says there.
    spread : standard deviation between runs of a bin's mean, None where one run alone has it.
    """

    quantity: str
    unit: str
    at: tuple[float, ...]
    force: tuple[float, ...]
    spread: tuple[float | None, ...]
    formula: tuple[float, ...] | None


@dataclass(frozen=True, kw_only=True)
class Residual:
    """What is left on one cart: the force (in `unit`), and a formula where one fits."""

    cart: int
    unit: str
    against: tuple[ForceAgainst, ...]
    formula: ForceFormula | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Contender:
    """A model that may be the true one; `weight` is its share by the Bayesian criterion."""

    model: AugmentedChain
    weight: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """The recording that would tell the contenders apart best.

    Attributes
    ----------
    recording : a table of plan.toml.
    limits : the plan's in which it was chosen, by name.
    pair : the two contenders, from 0, that decided: by their weights it tells them apart best.
    separation : root mean square of the difference between those two that no refit of the other
        takes up, in noises.
    t, u : (n,) s and the input; `predicted` (contenders, n) positions of `cart`.
    """

    recording: dict[str, Any]
    limits: dict[str, float]
    pair: tuple[int, int]
    separation: float
    cart: int
    t: Array
    u: Array
    predicted: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Gap:
    """Where simulation and measurement disagree, why, and what is left.

    Attributes
    ----------
    effects : in the order found. Under `ambiguous` the last one's rivals explain as much; under
        `partial` each lowers the error by a tenth or more, and more is left; under `unexplained`
        they are suspects only.
    baseline, final, noise_floor : relative errors pooled over the held-out runs.
    repeatability : the same between runs with the same input, or None without repeats.
    suspects : under `unexplained`, the single effects that help most, the best first.
    left_forces : the force that the model does not explain, run by run; residual : what it is on
        each cart, where more is left than a name may leave.
    free_run : of each run, the error of one simulation from its first readings to its end.
    where, left : where the linear model departs most; and the final one, unless it is enough.
    complete : False where the time allowed ended the search: the best answer so far.
    linear, model : the linear chain that fits best, and the chain with the effects.
    chain_std : standard errors of the latter's "m_1", "c_1", "k_1", …; `chain_covariance` (n_p,
        n_p) of the same, None where it could not be had or was read from a file.
    training, held_out : ids of the runs.
    left_out : recordings that the identification did not use, and why: no part of any figure here.
    interventions : where a force that was not measured acts: no part of any fit or error.
    spread : learnt run-to-run spread of the dry friction, per cart, where the runs show any.
    notes : what a reader must know.
    contenders : unless one leaves no more than noise: the models that may be true, the chosen
        first, then the likeliest.
    proposal : what to record next, as a plan has it; None where nothing was weighed.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    baseline: float
    final: float
    noise_floor: float
    repeatability: float | None
    by_record: tuple[RecordGap, ...]
    where: tuple[GapWindow, ...]
    next_experiment: str
    linear: AugmentedChain
    model: AugmentedChain
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    traces: tuple[Trace, ...]
    chain_std: dict[str, float] = field(default_factory=dict)
    chain_covariance: Array | None = None
    spread: dict[int, float] = field(default_factory=dict)
    suspects: tuple[Rival, ...] = ()
    left: tuple[GapWindow, ...] = ()
    free_run: tuple[FreeRun, ...] = ()
    residual: tuple[Residual, ...] = ()
    left_forces: tuple[LeftForce, ...] = ()
    complete: bool = True
    notes: tuple[str, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    interventions: tuple[Intervention, ...] = ()
    contenders: tuple[Contender, ...] = ()
    proposal: Proposal | None = None
