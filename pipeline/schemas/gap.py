"""`gap.json`, schema `cartlab-gap/1`."""

from typing import Annotated, Any, Literal

from pydantic import Field

from pipeline.schemas.base import (
    Chain,
    ChainWithUnits,
    Document,
    Number,
    Numbers,
    Provenance,
    Units,
)

Place = Annotated[
    dict[str, int], Field(description='{"cart": 1} or {"spring": 2}; empty: the input')
]


class Value(Document):
    """A parameter of an effect, with its standard error."""

    value: float
    std: Number
    unit: str


class Rival(Document):
    """Another effect in the same role, fitted as fully."""

    effect: str
    where: Place
    nrmse_after: Number
    confidence: Number


class Effect(Document):
    """One effect, in the order found; errors are on held-out runs."""

    effect: Annotated[str, Field(description="its name in the catalogue")]
    where: Place
    parameters: dict[str, Value]
    details: Annotated[dict[str, Value], Field(description="what only describes a contact")]
    confidence: Annotated[
        Number, Field(description="weight by the Bayesian information criterion among all fitted")
    ]
    nrmse_before: Number
    nrmse_after: Number
    rivals: tuple[Rival, ...]


class Errors(Document):
    """Relative root-mean-square errors, pooled over the held-out runs."""

    baseline: Annotated[Number, Field(description="of the linear model")]
    final: Annotated[Number, Field(description="of the model with all effects found")]
    noise_floor: Number


class RecordErrors(Document):
    """The same for one cart in one run."""

    experiment: str
    cart: int
    held_out: bool
    baseline: Number
    final: Number
    noise_floor: Number


class FreeRun(Document):
    """One simulation of a whole record, started from its first readings."""

    experiment: str
    error: Annotated[
        Number, Field(description="root mean square, position unit; null: the carts run away")
    ]


class ForceAgainst(Document):
    """The force that the model does not explain against one quantity, bin by bin."""

    quantity: Literal["position", "velocity", "input"]
    unit: str
    at: Annotated[Numbers, Field(description="mean of the quantity in each bin")]
    force: Annotated[Numbers, Field(description="mean force")]
    spread: Annotated[
        tuple[Number, ...],
        Field(description="standard deviation between runs; null where one run alone has the bin"),
    ]
    formula: Annotated[Numbers | None, Field(description="mean of what the formula says")]


class FormulaTerm(Document):
    """One term of a formula."""

    term: Annotated[str, Field(description="in x, v and u of the cart, v|v| say")]
    coefficient: float
    std: float
    unit: str


class ForceFormula(Document):
    """The shortest formula for the force that is left, by regression over a library of terms."""

    text: Annotated[str, Field(description="the sum of the terms, for people")]
    terms: tuple[FormulaTerm, ...]
    explains: Annotated[float, Field(description="share of the squared force")]
    in_catalogue: Annotated[
        Literal[False], Field(description="a description of the data, not an effect of it")
    ] = False


class Residual(Document):
    """What is left on one cart."""

    cart: int
    unit: Annotated[str, Field(description="of the force")]
    against: tuple[ForceAgainst, ...]
    formula: Annotated[
        ForceFormula | None, Field(description="null where no term is better than none")
    ]


class Window(Document):
    """Where a run departs from a model most."""

    experiment: str
    cart: int
    from_: Annotated[float, Field(alias="from", description="s")]
    to: Annotated[float, Field(description="s")]
    what: str
    share: Annotated[float, Field(description="of the run's squared error")]


class Term(Document):
    """An effect of the model with its numbers."""

    effect: str
    where: Place
    parameters: dict[str, float]


class Model(Document):
    """The chain and its effects, to be simulated."""

    chain: Chain
    effects: tuple[Term, ...]


class Contender(Model):
    """A model that may be the true one."""

    weight: Annotated[float, Field(description="by the Bayesian criterion among the contenders")]


class LeftOut(Document):
    """A recording that the identification of the carts left out; the gap is not about it."""

    experiment: str
    reason: Annotated[str, Field(description="in words that follow its name")]
    is_wrong: Annotated[
        bool,
        Field(description="it does not hold what happened; else it only stands off its repeats"),
    ] = False


class Intervention(Document):
    """A stretch in which a force that was not measured, such as a hand, acts on a cart."""

    experiment: str
    cart: int
    from_: Annotated[float, Field(alias="from", description="s")]
    to: Annotated[float, Field(description="s")]
    what: str


class GapSubmission(Document):
    """Which submission it is about."""

    title: str
    carts: int


class Gap(Document):
    """What the linear model leaves out. A number that could not be had is null."""

    schema_: Annotated[Literal["cartlab-gap/1"], Field(alias="schema")]
    verdict: Literal["named", "partial", "none", "ambiguous", "unexplained"]
    complete: Annotated[
        bool,
        Field(
            description="false: the time allowed ended the search, and this is the best answer so "
            "far; another run may come further"
        ),
    ] = True
    effects: tuple[Effect, ...]
    suspects: Annotated[
        tuple[Rival, ...],
        Field(description="under `unexplained`, the single effects that help most"),
    ]
    gap: Errors
    repeatability: Annotated[Number, Field(description="between runs of the same input")]
    by_record: tuple[RecordErrors, ...]
    free_run: Annotated[
        tuple[FreeRun, ...], Field(description="of each run, how far one simulation strays")
    ] = ()
    where: Annotated[tuple[Window, ...], Field(description="where the linear model fails most")]
    left: Annotated[
        tuple[Window, ...],
        Field(description="where the final model does, under `partial` and `unexplained`"),
    ] = ()
    residual: Annotated[
        tuple[Residual, ...],
        Field(description="where more is left than a name may leave, the force left by cart"),
    ] = ()
    next_experiment: str
    next_recording: Annotated[
        dict[str, Any] | None,
        Field(description="what tells the contenders apart best, as a table of plan.toml"),
    ] = None
    next_limits: Annotated[
        dict[str, float] | None, Field(description="the limits of plan.toml that it keeps")
    ] = None
    separation: Annotated[
        Number,
        Field(description="of the two that decided, in noises that no refit takes up"),
    ] = None
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    left_out: tuple[LeftOut, ...] = ()
    interventions: Annotated[
        tuple[Intervention, ...], Field(description="no part of any fit or error")
    ] = ()
    friction_spread: Annotated[
        dict[str, float], Field(description="run-to-run spread of the dry friction, by cart")
    ]
    units: Units
    linear: Annotated[Chain, Field(description="the linear chain that fits best")]
    model: Model
    contenders: Annotated[
        tuple[Contender, ...],
        Field(description="unless only noise is left: models that may be true, the chosen first"),
    ] = ()
    notes: tuple[str, ...]
    submission: GapSubmission
    springs: tuple[bool, ...]
    chain: ChainWithUnits
    chain_std: dict[str, Number]
    provenance: Provenance
