"""A hypothesis: effects at places, fitted, and judged on runs the fit has not seen."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.data.independent import independent
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.baseline import fit_nuisance
from pipeline.gap.fit.levenberg_marquardt import Fitting, GapFit, Mapper, fit_model
from pipeline.gap.fit.linearise import simulate_run
from pipeline.gap.fit.structure import GapModel
from pipeline.plant.nonlinear.effects.base import Effect
from pipeline.words.progress import Progress, silent

_BOUND_MARGIN = 0.01  # in logarithms, or in scales


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A model with its fit on training runs and what it leaves on held-out ones.

    `at_floor`: nothing is left but noise, on training and on held-out runs. `news` and
    `held_news` are how many of the residuals are independent.
    """

    fit: GapFit
    held: GapFit
    error: float
    bic: float
    news: float
    held_news: float
    at_floor: bool

    @property
    def bic_of_all(self) -> float:
        """The criterion with the likelihood of the held-out runs, to which nothing is fitted."""
        points = self.held.n_points / limits.THINNING
        return self.bic + points * float(np.log(max(self.held.chi, 1e-300)))

    @property
    def key(self) -> frozenset[tuple[str, int]]:
        """Which effects act where."""
        return frozenset(c.key for c in self.fit.structure.effects)

    @property
    def has_contact(self) -> bool:
        """Whether bodies meet."""
        return self.fit.structure.has_contact

    @property
    def size(self) -> int:
        """How many laws act: one of dry friction counts once, on however many carts it acts."""
        effects = self.fit.structure.effects
        return len({c.effect.key if c.effect.family else c.key for c in effects})

    @property
    def sound(self) -> bool:
        """Is every effect what its name says, and no estimate at a bound of the search?"""
        structure, theta = self.fit.structure, self.fit.theta
        low, high = structure.bounds()
        at_bound = (theta <= low + _BOUND_MARGIN) | (theta >= high - _BOUND_MARGIN)
        for index, term in enumerate(structure.model(theta).terms):
            reported = np.array([p.reported for p in term.effect.parameters])
            values = term.effect.named(term.values)
            if np.any(at_bound[structure.span(index)] & reported):
                return False
            if not term.effect.genuine(values):
                return False
        return True


@dataclass(frozen=True, kw_only=True, eq=False)
class Study:
    """What every step of the search needs: runs, springs, catalogue, and how fits go.

    `repeatability` is the relative error between runs with the same input, 0 without any. `whole`
    are the training runs with the end of the one whose end is held out, where what adds up over a
    whole run must show in the numbers: on no spring.
    """

    training: tuple[GapRun, ...]
    held_out: tuple[GapRun, ...]
    springs: tuple[bool, ...]
    catalogue: tuple[Effect, ...]
    repeatability: float = 0.0
    fitting: Fitting = field(default_factory=Fitting)
    progress: Progress = silent
    whole: tuple[GapRun, ...] = ()

    @property
    def mapper(self) -> Mapper:
        """Who maps over runs."""
        return self.fitting.mapper

    def fit(self, start: GapModel, **how: Any) -> GapFit:
        """Fit a model to the training runs, as `Fitting` says but for the changes in `how`."""
        return fit_model(start, self.training, replace(self.fitting, **how))

    def with_noise(self, training: Sequence[GapRun]) -> "Study":
        """Return the study with these training runs, and their noise in all others."""
        sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
        held_out = tuple(run.with_noise(sigma) for run in self.held_out)
        whole = tuple(run.with_noise(sigma) for run in self.whole)
        return replace(self, training=tuple(training), held_out=held_out, whole=whole)

    @property
    def floor(self) -> float:
        """Relative error that the noise of the encoders alone makes on the held-out runs."""
        noise = sum(float((run.sigma**2).sum()) * run.t.size for run in self.held_out)
        motion = sum(float((run.swing**2).sum()) * run.t.size for run in self.held_out)
        return float(np.sqrt(noise / motion))

    def explains(self, hypothesis: Hypothesis) -> bool:
        """Tell whether so little is left that the gap has its name."""
        enough = max(limits.ENOUGH_NOISE * self.floor, limits.ENOUGH_REPEATS * self.repeatability)
        return hypothesis.error <= enough

    def may_be_half(self, hypothesis: Hypothesis) -> bool:
        """Tell whether more is left than a contact's own law, or what repeats do, explains."""
        enough = max(limits.FURTHER * self.floor, limits.ENOUGH_REPEATS * self.repeatability)
        return hypothesis.error > enough and not hypothesis.has_contact

    def is_noise(self, hypothesis: Hypothesis) -> bool:
        """Tell whether nothing is left: of any run, or on held-out ones beyond what repeats do."""
        quiet = hypothesis.error < limits.NOTHING * self.floor
        quiet = quiet and hypothesis.fit.chi < limits.AT_FLOOR
        as_repeats = hypothesis.error < limits.AS_REPEATS * self.repeatability
        return hypothesis.at_floor or quiet or as_repeats


def judge(fit: GapFit, study: Study) -> Hypothesis:
    """Return the hypothesis a fit stands for."""
    held = fit_nuisance(fit, study.held_out, study.mapper)
    errors, sizes = [], []
    for run, left in zip(study.held_out, _residuals(held, study.held_out), strict=True):
        errors.append(float((left**2).sum()))
        sizes.append(float((run.swing**2).sum() * run.t.size))
    size = float(np.log(fit.n_points / limits.THINNING)) * fit.theta.size
    return Hypothesis(
        fit=fit,
        held=held,
        error=float(np.sqrt(sum(errors) / sum(sizes))),
        bic=fit.n_points / limits.THINNING * float(np.log(fit.cost / fit.n_points)) + size,
        news=_news(fit, study.training),
        held_news=_news(held, study.held_out),
        at_floor=fit.chi < limits.AT_FLOOR and held.chi < limits.AT_FLOOR,
    )


def _residuals(fit: GapFit, runs: Sequence[GapRun]) -> list[Array]:
    """Return measured minus simulated positions (rows, samples) of each run."""
    return [
        run.y - simulate_run(fit, run, nuisance)
        for run, nuisance in zip(runs, fit.nuisance, strict=True)
    ]


def _news(fit: GapFit, runs: Sequence[GapRun]) -> float:
    """Return how many residuals tell as much as independent ones.

    What a model leaves that is not noise swings with the carts: few of its points are news.
    """
    most = fit.n_points / limits.THINNING
    # Without springs errors add up to a drift; a model that ran away has no residuals.
    if not any(fit.structure.springs) or not np.isfinite(fit.cost):
        return most
    alone = sum(independent(row) for left in _residuals(fit, runs) for row in left)
    return min(alone, most)


def evidence(fuller: Hypothesis, other: Hypothesis) -> float:
    """Return by how much a hypothesis is the likelier, in units of the criterion.

    Only what the fuller one leaves counts as chance; runs held out, to which neither is fitted,
    count alike.
    """
    share = fuller.news / (fuller.fit.n_points / limits.THINNING)
    taught = (other.bic - fuller.bic) * share
    return taught + fuller.held_news * float(np.log(other.held.chi / fuller.held.chi))


def lowers_error(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Is the held-out error lower, and by a tenth where too much for a name is left?"""
    gain = 1.0 if study.explains(child) else limits.PARTIAL_GAIN
    return child.error < gain * parent.error


def worth_it(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Do further effects help, on runs the model has not seen too?"""
    drop = limits.BIC_DROP * (child.size - parent.size) or limits.SAME_LAW
    return lowers_error(child, parent, study) and evidence(child, parent) > drop
