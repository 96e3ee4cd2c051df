"""A hypothesis: effects at places, fitted, and judged on runs the fit has not seen."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.gap import limits
from pipeline.gap.data.runs import Run
from pipeline.gap.fit.baseline import fit_nuisance
from pipeline.gap.fit.levenberg_marquardt import Fit, Mapper
from pipeline.gap.fit.linearise import simulate_run
from pipeline.plant.nonlinear.effects import find_effect
from pipeline.plant.nonlinear.effects.base import Effect

_BOUND_MARGIN = 0.01  # in logarithms, or in scales


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A model with its fit on training runs and what it leaves on held-out ones.

    `at_floor`: nothing is left but noise, on training and on held-out runs.
    """

    fit: Fit
    held: Fit
    error: float
    bic: float
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
    def leaves_noise(self) -> bool:
        """Whether noise alone is left of training runs, and little more of those held out.

        A contact found to a thousandth bounces otherwise in the end.
        """
        return self.fit.chi < limits.AT_FLOOR and self.held.chi < limits.NEAR_FLOOR**2

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
    """What every step of the search needs: runs, springs, catalogue, and who maps over runs.

    `repeatability` is the relative error between runs with the same input, 0 without any. `whole`
    are the training runs with the end of the one whose end is held out, where what adds up over a
    whole run must show in the numbers: on no spring.
    """

    training: tuple[Run, ...]
    held_out: tuple[Run, ...]
    springs: tuple[bool, ...]
    catalogue: tuple[Effect, ...]
    repeatability: float
    mapper: Mapper
    tell: Callable[[str], None]
    whole: tuple[Run, ...] = ()

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

    def is_noise(self, hypothesis: Hypothesis) -> bool:
        """Tell whether nothing is left: of any run, or on held-out ones beyond what repeats do."""
        quiet = hypothesis.error < limits.NOTHING * self.floor
        quiet = quiet and hypothesis.fit.chi < limits.AT_FLOOR
        as_repeats = hypothesis.error < limits.AS_REPEATS * self.repeatability
        return hypothesis.at_floor or quiet or as_repeats


def judge(fit: Fit, study: Study) -> Hypothesis:
    """Return the hypothesis a fit stands for."""
    held = fit_nuisance(fit, study.held_out, mapper=study.mapper)
    errors, sizes = [], []
    for run, nuisance in zip(study.held_out, held.nuisance, strict=True):
        model = simulate_run(fit, run, nuisance)
        errors.append(float(((run.y - model) ** 2).sum()))
        sizes.append(float((run.swing**2).sum() * run.t.size))
    effective = fit.n_points / limits.THINNING
    bic = effective * np.log(fit.cost / fit.n_points) + fit.theta.size * np.log(effective)
    error = float(np.sqrt(sum(errors) / sum(sizes)))
    return Hypothesis(
        fit=fit,
        held=held,
        error=error,
        bic=float(bic),
        at_floor=fit.chi < limits.AT_FLOOR and held.chi < limits.AT_FLOOR,
    )


def lowers_error(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Is the held-out error lower, and by enough where too much for a name is left?"""
    added = child.key - parent.key
    contact = any(find_effect(key).contact for key, _ in added)
    gain = limits.PARTIAL_CONTACT if contact else limits.PARTIAL_GAIN
    return child.error < (1.0 if study.explains(child) else gain) * parent.error


def worth_it(child: Hypothesis, parent: Hypothesis, study: Study) -> bool:
    """Does a further effect help on runs the model has not seen?"""
    if not lowers_error(child, parent, study):
        return False
    drop = limits.BIC_DROP if child.size != parent.size else limits.SAME_LAW
    if parent.held.chi < limits.AT_FLOOR:
        # Held-out runs in which the effect does not show cannot speak for it; they must not speak
        # against it, and the others tell the more clearly. Beside a contact it may mop up.
        clear = child.bic < parent.bic - limits.ALONE * drop
        return clear and not (child.has_contact and (parent.at_floor or not child.leaves_noise))
    gain = limits.HELD_OUT_GAIN
    if parent.has_contact and not child.leaves_noise:
        if parent.fit.chi < limits.CONTACT_LAW:
            return False
        gain = limits.CONTACT_GAIN
    if child.bic > parent.bic - drop or child.held.chi > gain**2 * parent.held.chi:
        return False
    better = child.held.run_chi < limits.RUN_GAIN**2 * parent.held.run_chi
    # A run with nothing but noise left cannot become better.
    open_runs = parent.held.run_chi > limits.AT_FLOOR
    return bool(np.mean(better[open_runs] if open_runs.any() else better) >= limits.RUN_SHARE)
