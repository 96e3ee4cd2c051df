"""A hypothesis: effects at places, fitted, and judged on runs that the fit has not seen."""

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
from pipeline.plant.effect import Effect
from pipeline.words.progress import Progress, silent

_BOUND_MARGIN = 0.01  # in logarithms, or in multiples of the scale


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A model with its fit to the training runs and its error on the held-out runs.

    `at_floor` is true if only noise remains, on training and held-out runs. `n_independent` and
    `n_held_independent` are the numbers of independent residuals on training and held-out runs.
    """

    fit: GapFit
    held: GapFit
    error: float
    bic: float
    n_independent: float
    n_held_independent: float
    at_floor: bool

    @property
    def bic_of_all(self) -> float:
        """The criterion with the likelihood of the held-out runs, which the fit did not use."""
        points = self.held.n_points / limits.THINNING
        return self.bic + points * float(np.log(max(self.held.chi, 1e-300)))

    @property
    def key(self) -> frozenset[tuple[str, int]]:
        """The effects and their places."""
        return frozenset(c.key for c in self.fit.structure.effects)

    @property
    def has_contact(self) -> bool:
        """Whether some effect has a contact."""
        return self.fit.structure.has_contact

    @property
    def size(self) -> int:
        """The number of laws; dry friction counts once, even on several carts."""
        effects = self.fit.structure.effects
        return len({c.effect.key if c.effect.family else c.key for c in effects})

    @property
    def is_credible(self) -> bool:
        """Whether every effect deserves its name, and no estimate is at a bound."""
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
    """The context of the search: runs, springs, catalogue, and options of fits.

    `repeatability` is the relative difference of runs with the same input, 0 without repeats.
    `whole` is filled for benches without springs. It holds the training runs. A run that was cut
    in two is included at full length, so that slowly growing errors show.
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
        """The function that maps work over runs."""
        return self.fitting.mapper

    def fit(self, start: GapModel, **how: Any) -> GapFit:
        """Fit a model to the training runs, with the study's options changed by `how`."""
        return fit_model(start, self.training, replace(self.fitting, **how))

    def with_noise(self, training: Sequence[GapRun]) -> "Study":
        """Return the study with these training runs; the other runs get the same noise."""
        sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
        held_out = tuple(run.with_noise(sigma) for run in self.held_out)
        whole = tuple(run.with_noise(sigma) for run in self.whole)
        return replace(self, training=tuple(training), held_out=held_out, whole=whole)

    @property
    def floor(self) -> float:
        """The relative error on the held-out runs that encoder noise alone causes."""
        noise = sum(float((run.sigma**2).sum()) * run.t.size for run in self.held_out)
        motion = sum(float((run.swing**2).sum()) * run.t.size for run in self.held_out)
        return float(np.sqrt(noise / motion))

    def explains(self, hypothesis: Hypothesis) -> bool:
        """Return whether the remaining error is small enough for the verdict `named`."""
        enough = max(limits.ENOUGH_NOISE * self.floor, limits.ENOUGH_REPEATS * self.repeatability)
        return hypothesis.error <= enough

    def may_be_half(self, hypothesis: Hypothesis) -> bool:
        """Return whether the error is so large that half of the true effects may be missing.

        The error must exceed what repeats explain, and the model must have no contact, because the
        law of a contact is only approximate.
        """
        enough = max(limits.FURTHER * self.floor, limits.ENOUGH_REPEATS * self.repeatability)
        return hypothesis.error > enough and not hypothesis.has_contact

    def is_noise(self, hypothesis: Hypothesis) -> bool:
        """Return whether the remaining error is only noise or the difference between repeats."""
        quiet = hypothesis.error < limits.NOTHING * self.floor
        quiet = quiet and hypothesis.fit.chi < limits.AT_FLOOR
        as_repeats = hypothesis.error < limits.AS_REPEATS * self.repeatability
        return hypothesis.at_floor or quiet or as_repeats


def judge(fit: GapFit, study: Study) -> Hypothesis:
    """Return a fit as a hypothesis, with its criterion and its error on the held-out runs."""
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
        n_independent=_count_independent(fit, study.training),
        n_held_independent=_count_independent(held, study.held_out),
        at_floor=fit.chi < limits.AT_FLOOR and held.chi < limits.AT_FLOOR,
    )


def _residuals(fit: GapFit, runs: Sequence[GapRun]) -> list[Array]:
    """Return measured minus simulated positions (rows, samples) of each run."""
    return [
        run.y - simulate_run(fit, run, nuisance)
        for run, nuisance in zip(runs, fit.nuisance, strict=True)
    ]


def _count_independent(fit: GapFit, runs: Sequence[GapRun]) -> float:
    """Return the number of independent residuals.

    A residual beyond the noise swings with the carts, so few of its points are independent.
    """
    most = fit.n_points / limits.THINNING
    # Without springs, errors add up to a drift. If the model diverged, there are no residuals.
    if not any(fit.structure.springs) or not np.isfinite(fit.cost):
        return most
    alone = sum(independent(row) for left in _residuals(fit, runs) for row in left)
    return min(alone, most)


def evidence(fuller: Hypothesis, other: Hypothesis) -> float:
    """Return by how much the fuller of two hypotheses is more likely, in units of the criterion.

    The number of independent readings comes from the residual of the fuller hypothesis, because
    only this one is due to chance. Training and held-out runs count equally.
    """
    share = fuller.n_independent / (fuller.fit.n_points / limits.THINNING)
    taught = (other.bic - fuller.bic) * share
    return taught + fuller.n_held_independent * float(np.log(other.held.chi / fuller.held.chi))


def lowers_error(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Return whether the held-out error falls enough.

    It must fall by a tenth if the remaining error is too large for the verdict `named`.
    """
    gain = 1.0 if study.explains(child) else limits.PARTIAL_GAIN
    return child.error < gain * parent.error


def worth_it(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Return whether the child's further effects help, also on runs that the fit has not seen."""
    drop = limits.BIC_DROP * (child.size - parent.size) or limits.SAME_LAW
    return lowers_error(child, parent, study) and evidence(child, parent) > drop
