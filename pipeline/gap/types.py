"""The result types of the gap workflow."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import ValidationError

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.json_files import Number, computed, read_json, result, written
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, Effect, effect_name
from pipeline.results import (
    ChainWithUnits,
    Check,
    Finding,
    Intervention,
    Provenance,
    RecordingGroup,
)
from pipeline.setup import Setup, Units
from pipeline.submission.toml import first_refusal, quote

Quantity = Literal["position", "velocity", "input"]
Verdict = Literal["named", "partial", "none", "ambiguous", "unexplained"]
# Advice: its aim, what distinguishes two explanations, what to record, and what is new about it.
Aim = Literal["decide", "sharpen", "check", "explain", "extend"]
DifferIn = Literal["place", "drive", "motion", "quantity"]
RecordingKind = Literal["decay", "step", "ramp", "sweep", "first_input", "held", "ruler"]
Change = Literal["smaller", "larger", "both_signs", "finer", "faster"]
_WHERE = 'place, as {"cart": 1} or {"spring": 2}; empty for an effect on the input'


@result()
class NamedValue:
    """A parameter of an effect, with its standard error."""

    value: float = written()
    std: float | None = written()
    unit: str = written()


@result()
class EffectAt:
    """An effect and its place."""

    effect: Effect = written("name of the effect in the catalogue")
    where: dict[str, int] = written(_WHERE)

    @property
    def name(self) -> str:
        """The name inside a sentence, such as "dry (Coulomb) friction on cart 2"."""
        return effect_name(self.effect, self.where)


@result()
class Alternative(EffectAt):
    """Another effect that could take the place of the found effect, fitted in the same way."""

    nrmse_after: Number = written()
    confidence: Number = written("weight among the models with which it is compared")


@result()
class FoundEffect(EffectAt):
    """One effect, listed in the order of discovery; its errors are those on held-out runs."""

    parameters: dict[str, NamedValue] = written()
    details: dict[str, NamedValue] = written("parameters that only describe a contact")
    confidence: Number = written(
        "weight by the Bayesian information criterion among all fitted models of the same size"
    )
    nrmse_before: Number = written("without this effect")
    nrmse_after: Number = written("with this effect")
    rivals: tuple[Alternative, ...] = written()


@result()
class RecordGap:
    """Relative root-mean-square error of one cart in one run."""

    experiment: str = written()
    cart: int = written()
    held_out: bool = written()
    baseline: Number = written()
    final: Number = written()
    noise_floor: Number = written()


@result()
class GapWindow:
    """A stretch of time in which a run departs most from a model."""

    experiment: str = written()
    cart: int = written()
    start: float = written("s", key="from")
    end: float = written("s", key="to")
    what: str = written()
    share: float = written("share of the cart's squared error in this recording")


@result()
class FreeRun:
    """One simulation of a whole record, started from its first readings."""

    experiment: str = written()
    error: float | None = written("root mean square, position unit; null if the carts diverge")


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """One cart in one run, for figures: measured, linear model and final model (n,).

    `zero` is the encoder's zero in this run, according to the final model.
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
class WindowedResidualForce:
    """The unexplained force on one cart in one run, as a mean over each window.

    Attributes
    ----------
    t, x, v, u : times, positions, velocities and inputs (windows, samples). The input is 0 for
        carts other than 1.
    weight : weight (windows, samples) of each sample in the mean. The weights of a window add up to
        1.
    acceleration, force : means (windows,).
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
        """Return the mean over each window (windows,) of values (windows, samples)."""
        return (self.weight * values).sum(axis=1)


@result()
class FormulaTerm:
    """One term of a formula, with its coefficient."""

    term: str = written("in x, v and u of the cart, for example v|v|")
    coefficient: float = written()
    std: float = written()
    unit: str = written()


@result()
class ForceFormula:
    """The shortest formula for the unexplained force, by regression over a library of terms."""

    @computed()
    def text(self) -> str:
        """The sum of the terms as text, such as "-0.0021 sqrt|v| sign v"."""
        signed = " ".join(
            f"{'-' if one.coefficient < 0 else '+'} {abs(one.coefficient):.3g} {one.term}"
            for one in self.terms
        )
        return f"-{signed[2:]}" if signed[0] == "-" else signed[2:]

    terms: tuple[FormulaTerm, ...] = written()
    explains: float = written("share of the squared force that the formula explains")
    in_catalogue: Literal[False] = written(
        "the formula describes the data; it is not an effect", default=False
    )


@result()
class ForceAgainst:
    """The unexplained force against one quantity, bin by bin."""

    quantity: Quantity = written()
    unit: str = written()
    at: tuple[float, ...] = written("mean of the quantity in each bin")
    force: tuple[float, ...] = written("mean force")
    spread: tuple[float | None, ...] = written(
        "standard deviation between recordings; null if only one recording has data in the bin"
    )
    formula: tuple[float, ...] | None = written("mean force by the formula")


@result()
class Residual:
    """The unexplained force on one cart."""

    cart: int = written()
    unit: str = written("of the force")
    against: tuple[ForceAgainst, ...] = written()
    formula: ForceFormula | None = written("null if no formula is better than none")


@result(eq=False)
class AlternativeModel(AugmentedChain):
    """A model that may be the true one."""

    weight: float = written("weight among the contenders, by the Bayesian criterion")


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """The contenders' predictions of the proposed recording.

    Attributes
    ----------
    pair : indices (from 0) of the two contenders that the recording separates best, weighted by how
        likely they are.
    t, u : time in s, and input (n,).
    positions : positions (contenders, n) of `cart`.
    """

    pair: tuple[int, int]
    cart: int
    t: Array
    u: Array
    positions: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """The recording that best distinguishes the contenders.

    Attributes
    ----------
    limits : the limits of the plan for which the recording was chosen; None if a file lacks them.
    separation : root mean square difference, in units of the noise, that remains between the two
        contenders if one is refitted to the other.
    prediction : the contenders' predictions; None if the proposal was read from a file.
    """

    recording: Recording
    limits: PlanLimits | None
    separation: float
    prediction: Prediction | None = None


@result()
class Advice:
    """What to record next, and why."""

    aim: Aim = written(
        "decide between two explanations, sharpen a parameter, check the effects found, explain "
        "the error that remains, or extend the range in which the linear model was tested"
    )
    between: tuple[tuple[EffectAt, ...], ...] = written(
        "two explanations, each with the effects that the other lacks; or one effect", default=()
    )
    differ_in: DifferIn | None = written(
        "what distinguishes the two: the place of the effect, whether it needs the drive, the kind "
        "of motion that shows it, or the quantity on which it depends",
        default=None,
    )
    parameter: str | None = written("the parameter to sharpen", default=None)
    kind: RecordingKind | None = written(
        "null if no kind of recording would help that is not there yet", default=None
    )
    change: Change | None = written("how it differs from those of this kind", default=None)
    cart: int | None = written("the cart to watch", default=None)
    reach: float | None = written(
        "largest distance of the cart from its rest: below this, or above it", default=None
    )
    there: tuple[str, ...] = written("recordings of this kind that are there", default=())
    repeat: bool = written("whether to make each recording twice as well", default=False)
    difference: float | None = written(
        "largest difference between the two explanations in `next_recording`, position unit",
        default=None,
    )


@result(eq=False)
class GapErrors:
    """Relative root-mean-square errors, pooled over the held-out runs."""

    baseline: Number = written("of the linear model")
    final: Number = written("of the model with all effects found")
    noise_floor: Number = written()


@result()
class GapSubmission:
    """The submission that the gap belongs to."""

    title: str = written()
    carts: int = written()


@result(eq=False)
class Gap:
    """The gap of the linear model. A number that could not be determined is null.

    Attributes
    ----------
    bench : the set-up to which the numbers refer.
    traces : data for the figures, missing in a gap that was read from a file.
    measure_left : computes `left_forces`, which few readers need.
    chain_covariance : covariance (n_p, n_p) of the parameters in `chain_std`. None if it could not
        be computed or the gap was read from a file.
    proposal : the next recording; None if no candidate was evaluated.
    """

    schema: Literal["cartlab-gap/1"] = written(default_factory=lambda: "cartlab-gap/1")
    verdict: Verdict = written()
    complete: bool = written(
        "false if the time limit ended the search; this is then the best answer so far, and "
        "another search may find more",
        default=True,
    )
    causes: tuple[Check, ...] = written(
        "failed checks of the set-up, which may cause the gap, the most serious first; effects "
        "count only once the set-up is right",
        default=(),
    )
    groups: tuple[RecordingGroup, ...] = written(
        "groups of recordings that want different carts, the largest first",
        default=(),
    )
    effects: tuple[FoundEffect, ...] = written(
        "verdict `ambiguous`: the rivals of the last effect explain as much. Verdict `partial`: "
        "each effect lowers the error by a tenth or more, but a gap remains. Verdict "
        "`unexplained`: they are only suspects"
    )
    suspects: tuple[Alternative, ...] = written(
        "if the verdict is `unexplained`, the single effects that help most, the best first",
        default=(),
    )
    baseline: float
    final: float
    noise_floor: float

    @computed(key="gap")
    def errors(self) -> GapErrors:
        """Relative errors, pooled over the held-out runs."""
        return GapErrors(baseline=self.baseline, final=self.final, noise_floor=self.noise_floor)

    repeatability: float | None = written("relative difference of recordings with the same input")
    by_record: tuple[RecordGap, ...] = written()
    free_run: tuple[FreeRun, ...] = written(
        "error of one simulation over each whole recording", default=()
    )
    where: tuple[GapWindow, ...] = written("where the linear model fails most")
    left: tuple[GapWindow, ...] = written(
        "where the final model fails most, if the verdict is `partial` or `unexplained`",
        default=(),
    )
    residual: tuple[Residual, ...] = written(
        "the unexplained force on each cart, if the error is too large for a name",
        default=(),
    )
    advice: Advice | None = written("what to record next", default=None)
    next_experiment: str = written("the advice in words", default_factory=str)

    @computed(default=None)
    def next_recording(self) -> dict[str, Any] | None:
        """The recording that best distinguishes the contenders, as a table of plan.toml."""
        if self.proposal is None:
            return None
        return self.proposal.recording.model_dump(mode="json", exclude_defaults=True)

    @computed(default=None)
    def next_limits(self) -> dict[str, float] | None:
        """The limits of plan.toml for which the recording was chosen."""
        return self.proposal and self.proposal.limits and self.proposal.limits.model_dump()

    @computed(default=None)
    def separation(self) -> float | None:
        """Root mean square difference of the two contenders after refits, in units of the noise."""
        return self.proposal and self.proposal.separation

    training: tuple[str, ...] = written("ids of the recordings")
    held_out: tuple[str, ...] = written("ids of the recordings")
    left_out: tuple[Finding, ...] = written(
        "recordings that the identification did not use; no figure here includes them",
        default=(),
    )
    interventions: tuple[Intervention, ...] = written(
        "times at which a hand moved a cart, excluded from fits and errors", default=()
    )
    spread: dict[int, float] = written(
        "relative spread of the dry friction from recording to recording, by cart",
        key="friction_spread",
        default_factory=dict,
    )

    @computed()
    def units(self) -> Units:
        """The submission's units."""
        return self.bench.units

    @computed(key="linear")
    def linear_chain(self) -> Chain:
        """The linear chain that fits best."""
        return self.linear.chain

    linear: AugmentedChain
    model: AugmentedChain = written("the chain with the effects")
    contenders: tuple[AlternativeModel, ...] = written(
        "models that may be true, the chosen one first, then the likeliest; empty if only noise is "
        "left",
        default=(),
    )
    notes: tuple[str, ...] = written("notes for the reader", default=())

    @computed()
    def submission(self) -> GapSubmission:
        """The submission."""
        return GapSubmission(title=self.title, carts=self.bench.n)

    @computed()
    def springs(self) -> tuple[bool, ...]:
        """Whether each spring exists: wall-1, 1-2, …, n-wall."""
        return self.bench.springs

    @computed()
    def chain(self) -> ChainWithUnits:
        """The chain of the final model."""
        return ChainWithUnits.of(self.model.chain, self.bench.units)

    chain_std: dict[str, Number] = written(
        "standard errors of the chain's m_1, c_1, k_1, …", default_factory=dict
    )
    provenance: Provenance = written(default_factory=lambda: Provenance(files={}))
    title: str = ""
    bench: Setup
    traces: tuple[Trace, ...]
    measure_left: Callable[[], tuple[WindowedResidualForce, ...]] = tuple
    chain_covariance: Array | None = None
    proposal: Proposal | None = None

    @property
    def left_forces(self) -> tuple[WindowedResidualForce, ...]:
        """The force that the model does not explain, by run and cart."""
        return self.measure_left()

    @classmethod
    def from_written(
        cls,
        *,
        springs: tuple[bool, ...],
        units: Units,
        submission: GapSubmission,
        errors: GapErrors,
        linear_chain: Chain,
        **own: Any,
    ) -> "Gap":
        """Return the gap from the content of a file."""
        recording, limits, separation = (
            own.pop(name) for name in ("next_recording", "next_limits", "separation")
        )
        proposal = None
        if recording is not None and separation is not None:
            proposal = Proposal(
                recording=Recording.model_validate(recording),
                limits=PlanLimits.model_validate(limits) if limits else None,
                separation=separation,
            )
        del own["chain"]  # also in the model
        bench = Setup(springs=springs, units=units)
        return cls(
            bench=bench,
            title=submission.title,
            baseline=errors.baseline,
            final=errors.final,
            noise_floor=errors.noise_floor,
            linear=AugmentedChain(chain=linear_chain),
            proposal=proposal,
            traces=(),
            **own,
        )


def read_gap(text: str) -> Gap:
    """Return the gap of a `gap.json`, without its traces.

    Raises
    ------
    ConfigError : the text is not a `gap.json`, or the catalogue lacks effects of its model.
    """
    try:
        return read_json(Gap, text)
    except ValidationError as error:
        raise ConfigError(f"not what cartlab gap writes: {first_refusal(error)}") from None
    except (ValueError, KeyError, TypeError) as error:  # for example null for a number
        raise ConfigError(f"not what cartlab gap writes: {quote(str(error))}") from None
