"""Judge effects: fit them to whole runs, test them on held-out runs, drop the needless."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.fit import (
    Fitting,
    GapFit,
    Mapper,
    covariance,
    fit_model,
    fit_nuisance,
    restart_runs,
)
from pipeline.gap.limits import AT_FLOOR, SURE
from pipeline.gap.parameters import Candidate, GapModel, Structure, bench_scales, simulate_run
from pipeline.gap.pem.fit import PemFit
from pipeline.gap.pem.model import Column, column_set
from pipeline.gap.runs import GapRun, cut_shots, independent
from pipeline.gap.types import Verdict
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import Chain
from pipeline.plant.effect import Effect
from pipeline.plant.simulator.tables import Cart, Drive, Spring
from pipeline.words.progress import Progress, silent

# ---------------------------------------- a hypothesis, judged on runs that its fit has not seen

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


# ---------------------------------------------------------------------- the fit to whole runs

_LENGTHS = (0.3, 0.6, 1.2, 2.4)  # s; with a contact, pieces grow to whole runs
# Factors on the size and damping of a contact at the start of a fit. The contact in `gap.pem` is
# rigid, but the simulator's contact is slightly soft.
_VARIED = ((1.0, 1.0), (1.2, 1.0), (1.0, 0.65), (1.2, 0.65))
_JUMPS, _IN_VAIN = 40, 15  # most jumps, and most in a row that find no lower cost
_WIDTHS = (0.15, 0.075)  # relative sizes of the jumps, in turn
_FEW_TO_HOP = 2  # most effects of a model that jumps, because each jump costs a fit
_NEAR = 8  # iterations of a fit that starts near its end
# Options without springs: the cost of a whole run has many minima, and small gains add up.
_FINISHED: dict[str, Any] = {"iterations": 60, "tolerance": 1e-6}


def fit_on(fit: GapFit, model: GapModel, study: Study) -> GapFit:
    """Fit a slightly changed model, starting from the nuisance parameters of the original fit."""
    if not any(study.springs):
        return fit_free_run(model, study)
    moved = replace(fit, structure=model.structure, theta=model.theta)
    return study.fit(moved, iterations=_NEAR, scatter_free=fit.scattered)


def fit_free_run(start: GapModel, study: Study) -> GapFit:
    """Fit whole runs; friction is first the same in all runs, then different from run to run."""
    structure = start.structure
    steps = {} if any(study.springs) else _FINISHED
    fit = study.fit(start, scatter_free=False, **steps)
    if fit.chi > AT_FLOOR and structure.has_play:
        fit = min(fit, _fit_contact_on_pieces(start, study), key=lambda one: one.cost)
    # Two rounds in which friction differs between runs. Before each, the worst runs are restarted.
    for attempt in range(2):
        if not structure.many_rests or fit.chi < AT_FLOOR:
            break
        with np.errstate(invalid="ignore"):  # some runs may have diverged
            better = np.quantile(fit.run_chi, 0.25)
        # A restart of the worst runs makes sense only if the better ones are nearly right.
        if better < 6.0:
            fit = restart_runs(fit, study.training, study.mapper)
        elif attempt:
            break
        fit = study.fit(fit, iterations=12, learn_spread=True)
    return fit


def finish(fit: GapFit, study: Study) -> GapFit:
    """Return a fit with its covariance; its parameters come from whole runs."""
    if not study.whole:
        return covariance(fit, study.training, study.mapper)
    how = replace(study.fitting, scatter_free=False, **_FINISHED)
    return covariance(fit_model(fit.without_nuisance, study.whole, how), study.whole, study.mapper)


def _fit_contact_on_pieces(start: GapModel, study: Study) -> GapFit:
    """Fit a contact to pieces that grow to whole runs, from several sizes of the contact."""
    structure = start.structure
    spans = [structure.span(i) for i, c in enumerate(structure.effects) if c.effect.contact]

    def on_pieces(model: GapModel, length: float, iterations: int) -> GapFit:
        pieces = [cut_shots(run, length=length) for run in study.training]
        how = replace(study.fitting, iterations=iterations, scatter_free=False)
        return fit_model(model, pieces, how)

    fits = []
    for size, damping in _VARIED:
        theta: Array = start.theta.copy()
        theta[[span.start for span in spans]] += np.log(size)
        theta[[span.stop - 1 for span in spans]] += np.log(damping)
        fits.append(on_pieces(GapModel(structure=structure, theta=theta), _LENGTHS[0], 6))
    grown = []
    for fit in sorted(fits, key=lambda one: one.cost)[:2]:
        for length in _LENGTHS[1:]:
            fit = on_pieces(fit.without_nuisance, length, 8)
        grown.append(study.fit(fit.without_nuisance, iterations=15, scatter_free=False))
    return min(grown, key=lambda one: one.cost)


def basin_hopping(fit: GapFit, study: Study) -> GapFit:
    """Leave a narrow minimum of the cost with backlash for lower ones, by random jumps.

    The parameters of the contact jump; then all are fitted. A fit without backlash, or with more
    than two effects, is returned as it is.

    Reference: D. J. Wales, J. P. K. Doye, J. Phys. Chem. A 101 (1997), 5111-5116; here without
    temperature.
    """
    structure = fit.structure
    if not structure.has_play or len(structure.effects) > _FEW_TO_HOP:
        return fit
    spans = [structure.span(i) for i, c in enumerate(structure.effects) if c.effect.contact]
    places = np.concatenate([np.arange(span.start, span.stop) for span in spans])
    rng, in_vain = np.random.default_rng(0), 0
    for jump in range(_JUMPS):
        if fit.chi < AT_FLOOR or in_vain == _IN_VAIN:
            break
        theta: Array = fit.theta.copy()
        theta[places] += _WIDTHS[jump % 2] * rng.standard_normal(places.size)
        trial = study.fit(replace(fit, theta=theta), iterations=6, scatter_free=False)
        in_vain = 0 if trial.cost < fit.cost else in_vain + 1
        fit = min(fit, trial, key=lambda one: one.cost)
    return fit


# ---------------------------------- laws of the prediction-error fit as effects of the catalogue

_TABLE = {"cart": Cart, "spring": Spring, "input": Drive}


def filled(effect: Effect) -> frozenset[Column]:
    """Return the columns that an effect fills."""
    return column_set(effect.columns(dict.fromkeys(effect.names, 1.0)))


def values_of(effect: Effect, columns: Mapping[IntEnum, float]) -> tuple[float, ...]:
    """Return the parameter values for given columns: the inverse of `effect.columns`.

    The columns are linear in the parameters. So the inverse follows from the columns at one point,
    and at one unit from it in each parameter.
    """
    order = list(effect.columns(dict.fromkeys(effect.names, 1.0)))
    base = np.arange(1.0, 1.0 + len(effect.names))
    points = [base, *(base + unit for unit in np.eye(base.size))]
    at = [effect.columns(effect.named(point.tolist())) for point in points]
    table = np.array([[one[column] for column in order] for one in at])
    J = (table[1:] - table[0]).T
    wanted = np.array([columns[column] for column in order])
    return tuple(float(v) for v in base + np.linalg.solve(J, wanted - table[0]))


def as_model(
    fit: PemFit, *, springs: Sequence[bool], catalogue: Iterable[Effect], runs: Sequence[GapRun]
) -> GapModel:
    """Return the model whose effects express the found laws; richer effects are tried first."""
    by_size = sorted(catalogue, key=lambda effect: -len(filled(effect)))
    chain = fit.laws.chain(fit.p)
    candidates: list[Candidate] = []
    values: list[tuple[float, ...]] = []
    for (table, row), columns in fit.laws.columns(fit.p).items():
        left = dict(columns)
        for effect in by_size:
            mine = filled(effect)
            if _TABLE[effect.place] is table and mine <= column_set(left):
                place = 0 if table is Drive else row + 1
                value = values_of(effect, left)
                candidates.append(make_candidate(effect, place, value, runs=runs, chain=chain))
                values.append(value)
                left = {c: v for c, v in left.items() if (type(c), int(c)) not in mine}
    structure = Structure(springs=tuple(springs), effects=tuple(candidates))
    return structure.start(chain, values)


def make_candidate(
    effect: Effect, place: int, values: Sequence[float], *, runs: Sequence[GapRun], chain: Chain
) -> Candidate:
    """Return an effect at a place, with the signs of its values and its typical sizes there."""
    scales = bench_scales(runs, chain, effect=effect, place=place)
    return Candidate(
        effect=effect,
        place=place,
        signs=tuple(-1.0 if value < 0.0 else 1.0 for value in values),
        scales=tuple(p.size(scales) for p in effect.parameters),
    )


# ------------------------------------------------------ the smallest model that explains as much
#
# A fit with many laws at once may leave crutches: laws that together imitate a part of another
# law's effect. Once they are there, each of them seems needed. So a model is built again from
# below. Its laws are fitted alone, then together, each time from a new start.

_TRIED = 3  # effects to try beside those already chosen, in the order of their errors alone


def build_up(full: Hypothesis, baseline: Hypothesis, study: Study) -> list[Hypothesis]:
    """Return models with some effects of `full`, each fitted from a new start, the chosen one last.

    The chosen one is the smallest that leaves only noise, or else `full`. A rich law is also tried
    in its simpler form.
    """
    effects = full.fit.structure.effects
    parts = list(zip(effects, full.fit.terms, strict=True))
    options = [(effect, term.values) for effect, term in parts]
    for effect, term in parts:
        if (plain := _simpler(effect, term.values)) is not None:
            options.insert(0, plain)
    chain = full.fit.structure.chain(full.fit.theta)
    chains = [chain, baseline.fit.structure.chain(baseline.fit.theta)]
    made: list[Hypothesis] = []

    def is_enough(one: Hypothesis) -> bool:
        return study.is_noise(one) and one.error < limits.NOTHING * full.error

    def fitted(chosen: Sequence[tuple[Candidate, tuple[float, ...]]]) -> Hypothesis:
        """Fit the chosen effects from new starts, and judge them."""
        candidates = tuple(effect for effect, _ in chosen)
        structure = Structure(springs=study.springs, effects=candidates)
        values = [values for _, values in chosen]
        best: Hypothesis | None = None
        for start in chains:
            one = judge(fit_free_run(structure.start(start, values), study), study)
            best = one if best is None or one.fit.cost < best.fit.cost else best
            if is_enough(best):
                break
        assert best is not None
        made.append(best)
        return best

    def slot(option: tuple[Candidate, Any]) -> tuple[int, str | tuple[str, int]]:
        """Return what only one effect of a model may have: its place, and its family or name."""
        return option[0].place, option[0].effect.family or option[0].key

    alone = sorted(((fitted([option]), option) for option in options), key=lambda one: one[0].error)
    best, first = alone[0]
    chosen = [first]
    ranked = [option for _, option in alone[1:]]
    while not is_enough(best):
        taken = {slot(option) for option in chosen}
        rest = [option for option in ranked if slot(option) not in taken][:_TRIED]
        if len(chosen) + 1 >= len(effects) or not rest:
            return [*made, full]
        trials = [(fitted([*chosen, option]), option) for option in rest]
        best, added = min(trials, key=lambda one: one[0].error)
        chosen = [*chosen, added]
    as_small = [h for h in made if is_enough(h) and h.is_credible and len(h.key) == len(chosen)]
    best = min(as_small, key=lambda h: h.bic_of_all, default=None)
    return [*made, full] if best is None else [*(h for h in made if h is not best), best]


def _simpler(
    rich: Candidate, values: Sequence[float]
) -> tuple[Candidate, tuple[float, ...]] | None:
    """Return the simpler form of a rich law, with its values; None for a plain law."""
    if rich.effect.grows_from is None:
        return None
    effect = find_effect(rich.effect.grows_from)
    at = [rich.effect.names.index(name) for name in effect.names]
    plain = Candidate(
        effect=effect,
        place=rich.place,
        signs=tuple(rich.signs[i] for i in at),
        scales=tuple(rich.scales[i] for i in at),
    )
    return plain, tuple(values[i] for i in at)


# ------------------------------------------------- needless effects, and the order of the others

_FEW = 4  # effects to try at a time; certainty is only a rough guide to which are needed


def prune(chosen: Hypothesis, study: Study, found: list[Hypothesis]) -> Hypothesis:
    """Drop effects that the others make needless; append every hypothesis tried to `found`.

    An effect may also be replaced by a simpler law. An effect within three standard errors of zero
    is dropped too, unless it halves the error. Of the few least certain effects, the least needed
    goes first. Losses add up, so each hypothesis is compared with the best so far, and with the one
    that it is made from.
    """
    best = chosen
    while chosen.key:
        effects = chosen.fit.structure.effects
        sure = significance(finish(chosen.fit, study))
        order: list[int] = np.argsort(sure, kind="stable").tolist()
        for few in (order[:_FEW], order[_FEW:]):
            needless = []
            for index in few:
                if (plain := effects[index].effect.grows_from) is not None:
                    plainer = _replaced(chosen, effects[index], find_effect(plain), study)
                    found.append(plainer)
                    if plainer.is_credible and plainer.bic < chosen.bic:
                        needless.append(plainer)
                without = found[0]
                if len(effects) > 1:
                    without = _without(chosen, effects[index], study)
                    found.append(without)
                as_good = all(_as_good(without, one, study) for one in (chosen, best))
                nothing = _may_be_zero(sure[index], without, chosen)
                if nothing or (without.is_credible and as_good):
                    needless.append(without)
            if needless:
                chosen = min(needless, key=lambda h: h.bic)
                best = min(best, chosen, key=lambda h: h.error)
                break
        else:
            break
    return chosen


def enrich(chosen: Hypothesis, study: Study, found: list[Hypothesis]) -> Hypothesis:
    """Replace plain laws by the richer laws that grow from them, if these are worth it.

    The other effects of the first search may have taken the place of a richer law. Every hypothesis
    tried is appended to `found`.
    """
    for effect in chosen.fit.structure.effects:
        richer = [
            _replaced(chosen, effect, rich, study)
            for rich in study.catalogue
            if rich.grows_from == effect.effect.key
        ]
        found += richer
        better = [h for h in richer if h.is_credible and worth_it(h, chosen, study)]
        chosen = min([chosen, *better], key=lambda h: h.bic_of_all)
    return chosen


def without_zero_effect(chosen: Hypothesis, final: GapFit, study: Study) -> Hypothesis | None:
    """Return a hypothesis without the least certain effect that may be zero, or else None.

    `final` is the fit of `chosen` with its covariance.
    """
    sure, effects = significance(final), chosen.fit.structure.effects
    for index in np.argsort(sure, kind="stable").tolist():
        if sure[index] >= SURE:
            break
        without = _without(chosen, effects[index], study)
        if _may_be_zero(sure[index], without, chosen):
            return without
    return None


def _may_be_zero(sure: float, without: Hypothesis, chosen: Hypothesis) -> bool:
    """Return whether an effect may be zero, given its distance from zero in standard errors.

    The standard error is also large if the recordings show an effect but hardly tell its force in
    the unit of the others. An effect that halves the error is not zero. With backlash, a refit
    without the effect may only be stuck in a narrow minimum, so its error proves nothing.
    """
    halves = bool(np.isfinite(without.error)) and limits.MOSTLY * without.error >= chosen.error
    return sure < SURE and (chosen.fit.structure.has_play or not halves)


def _as_good(without: Hypothesis, chosen: Hypothesis, study: Study) -> bool:
    """Return whether a hypothesis without one of the effects does about as well.

    If a large error remains for another reason, the criterion hardly changes. Then an effect stays
    if it lowers the error of unseen runs by a tenth and the criterion does not oppose it.
    """
    if worth_it(chosen, without, study):
        return False
    if study.explains(chosen):
        return True
    return without.bic < chosen.bic or not lowers_error(chosen, without, study)


def significance(fit: GapFit) -> list[float]:
    """Return how far each effect's least certain parameter is from its neutral value.

    The distance is in standard errors. At its neutral value, a parameter has no effect.
    """
    structure = fit.structure
    if fit.covariance is None:
        return [np.inf] * len(structure.effects)
    std = np.sqrt(np.diag(fit.covariance)) * structure.physical_derivative(fit.theta)
    return [
        min(
            (
                abs(value - p.neutral) / error
                for p, value, error in zip(
                    term.effect.parameters, term.values, std[structure.span(index)], strict=True
                )
                if p.neutral is not None and p.reported
            ),
            default=np.inf,
        )
        for index, term in enumerate(fit.terms)
    ]


def _without(hypothesis: Hypothesis, effect: Candidate, study: Study) -> Hypothesis:
    """Return the hypothesis without one of its effects, refitted from its present values."""
    index = hypothesis.fit.structure.effects.index(effect)
    return judge(fit_on(hypothesis.fit, hypothesis.fit.without(index), study), study)


def _replaced(hypothesis: Hypothesis, old: Candidate, effect: Effect, study: Study) -> Hypothesis:
    """Return the hypothesis with another effect at the place of one of its effects.

    Parameters that both have keep their values; the others start at their typical sizes.
    """
    index = hypothesis.fit.structure.effects.index(old)
    known = old.effect.named(hypothesis.fit.terms[index].values)
    chain = hypothesis.fit.structure.chain(hypothesis.fit.theta)
    scales = bench_scales(study.training, chain, effect=effect, place=old.place)
    values = [known.get(p.name, p.size(scales) * p.typical) for p in effect.parameters]
    new = make_candidate(effect, old.place, values, runs=study.training, chain=chain)
    model = hypothesis.fit.without(index).with_effect(new, values)
    return judge(fit_on(hypothesis.fit, model, study), study)


def steps_to(
    chosen: Hypothesis, found: Sequence[Hypothesis], study: Study
) -> tuple[Hypothesis, ...]:
    """Return the path from the linear model to the chosen one, the most helpful effect first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        known = {h.key: h for h in found}
        rest = [(steps[0].key - {effect.key}, effect) for effect in effects]
        smaller = [known.get(key) or _without(steps[0], effect, study) for key, effect in rest]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)


# ------------------------------------------------------ how much is explained, and how certainly


def reach_verdict(
    steps: tuple[Hypothesis, ...],
    found: Sequence[Hypothesis],
    *,
    study: Study,
    sample_time: float,
    best: Hypothesis | None = None,
) -> tuple[Verdict, tuple[Hypothesis, ...], list[Hypothesis]]:
    """Return the verdict, the accepted steps, and the rivals if the verdict is `ambiguous`.

    `steps` lead from the linear model to the chosen one; `found` are all hypotheses judged. If a
    large error remains, two more rules apply. An effect is dropped if a hypothesis without it does
    about as well as the `best` one, by default the chosen one; losses add up. Otherwise the last
    step is withdrawn if rivals dispute its effect.
    """
    baseline, chosen = steps[0], steps[-1]
    best = best or chosen
    # A sufficient linear model stays, unless the effects lower its error by a tenth.
    sufficient = baseline.error <= limits.ENOUGH_NOISE * study.floor
    if sufficient and chosen.error > limits.PARTIAL_GAIN * baseline.error:
        return "none", steps[:1], []
    if not chosen.key:
        return ("none" if study.is_noise(chosen) else "unexplained"), steps, []
    explained = study.explains(chosen)
    gain = baseline.bic - chosen.bic
    close = [
        rival
        for rival in found
        if len(rival.key) == len(chosen.key)
        and rival.key != chosen.key
        and rival.error < limits.CLOSE_ERROR * chosen.error
        and evidence(chosen, rival) < min(limits.CLOSE_GAIN * gain, limits.CLOSE_BIC)
        and not _same_thing(rival, chosen, sample_time=sample_time)
        and (explained or not _same_kind(rival, chosen))
    ]
    if not explained:
        without = _needless(chosen, [*found, *steps], study, best=best)
        disputed = bool(close) and chosen.error > limits.MOSTLY * baseline.error
        if without is not None or disputed:
            back = steps[:-1] if without is None else steps_to(without, [*found, *steps], study)
            best = None if without is None else min(best, without, key=lambda h: h.error)
            return reach_verdict(back, found, study=study, sample_time=sample_time, best=best)
    if close:
        return "ambiguous", steps, close
    return ("named" if explained else "partial"), steps, []


def _needless(
    chosen: Hypothesis, found: Sequence[Hypothesis], study: Study, *, best: Hypothesis
) -> Hypothesis | None:
    """Return the best hypothesis without one of the effects, if it is about as good as `best`."""
    smaller = [h for h in found if h.key < chosen.key and len(h.key) == len(chosen.key) - 1]
    as_good = [h for h in smaller if not lowers_error(best, h, study)]
    return min(as_good, key=lambda h: h.error, default=None)


def _stand_ins(
    rival: Hypothesis, chosen: Hypothesis
) -> list[tuple[tuple[str, int], tuple[str, int]]]:
    """Return the chosen effects that the rival lacks, each with the rival's substitute."""
    mine, other = (
        sorted(keys, key=lambda key: key[::-1])
        for keys in (chosen.key - rival.key, rival.key - chosen.key)
    )
    return list(zip(mine, other, strict=True))


def _same_kind(rival: Hypothesis, chosen: Hypothesis) -> bool:
    """Return whether the rival differs only by laws of the same families at the same places."""
    return all(
        mine[1] == other[1] and find_effect(mine[0]).family == find_effect(other[0]).family != ""
        for mine, other in _stand_ins(rival, chosen)
    )


def _same_thing(rival: Hypothesis, chosen: Hypothesis, *, sample_time: float) -> bool:
    """Return whether a rival is a richer form of the same laws, or provably indistinguishable."""
    return all(
        _same_law(mine, other, chosen, sample_time=sample_time)
        for mine, other in _stand_ins(rival, chosen)
    )


def _same_law(
    mine: tuple[str, int], other: tuple[str, int], chosen: Hypothesis, *, sample_time: float
) -> bool:
    effect = find_effect(mine[0])
    if find_effect(other[0]).grows_from == mine[0] and other[1] == mine[1]:
        return True
    if effect.same_as != other[0]:
        return False
    places = [candidate.key for candidate in chosen.fit.structure.effects]
    term = chosen.fit.terms[places.index(mine)]
    return abs(term.values[0]) < effect.same_below * sample_time
