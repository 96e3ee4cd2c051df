"""Search the catalogue: laws chosen while the model follows, then fitted to free runs, judged.

Nothing is tried one by one: all laws at all places are fitted together from nothing to a model
that follows the measurement, and those that are nothing are dropped (`gap.follow`). What is left
is fitted to whole runs, each effect must be worth it on runs the fit has not seen, and rivals
come from the same fit with one law exchanged.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from pipeline.gap.fit.baseline import first_chain
from pipeline.gap.fit.levenberg_marquardt import Fit, fit_model
from pipeline.gap.fit.structure import Candidate
from pipeline.gap.follow.choose import Records, choose_laws, rivals_of
from pipeline.gap.follow.fit import Follow
from pipeline.gap.follow.track import make_track
from pipeline.gap.limits import SURE
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, lowers_error, worth_it
from pipeline.gap.search.translate import as_model, filled, make_candidate
from pipeline.gap.search.whole import finish, fit_whole
from pipeline.plant.nonlinear.effects import find_effect

_LOOSER = (0.02, 0.01, 0.005, 0.002, 0.0)  # gains
_IN_THE_RUNNING = 3.0  # times the chosen model's misfit while following: a rival that may still win


def search(baseline: Hypothesis, study: Study) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return the hypothesis chosen and all that were judged, the baseline first.

    Past the time allowed, the best of those so far.
    """
    found = [baseline]
    with suppress(OutOfTime):
        records = Records(
            tracks=tuple(make_track(run) for run in study.training),
            mapper=study.mapper,
            columns=frozenset().union(*(filled(effect) for effect in study.catalogue)),
        )
        chain = baseline.fit.structure.chain(baseline.fit.theta)
        own = first_chain(study.training, springs=study.springs)
        lean = choose_laws(records, springs=study.springs, chains=[chain, own], tell=study.tell)
        if not lean.laws.groups():
            return baseline, found
        found.append(_judged(lean, study, records))
        study.tell(f"{found[-1].size} laws are left: error {found[-1].error:.1%}")
        for rival in rivals_of(lean, records):
            close = rival.total < _IN_THE_RUNNING * lean.total
            found.append(_judged(rival, study, records, finish=close))
        found[1:] = [h for h in found[1:] if np.isfinite(h.error) and h.sound]
        leading = min(found[1:], key=lambda h: h.bic_of_all, default=baseline)
        return prune(leading, study, found), [h for h in found if h.sound]
    worth = [h for h in found if worth_it(h, baseline, study)]
    return min(worth, key=lambda h: h.bic, default=baseline), found


def _judged(follow: Follow, study: Study, records: Records, *, finish: bool = True) -> Hypothesis:
    """Return what a following model says, fitted to whole runs: to the end, or by a few steps."""
    if not any(study.springs):
        # On no spring errors add up: what a model lacks misleads a fit that is free at once.
        for gain in _LOOSER:
            follow = records.fit(follow, gain=gain) if gain < follow.gain else follow
    start = as_model(follow, springs=study.springs, catalogue=study.catalogue, runs=study.training)
    if finish:
        return judge(fit_whole(start, study), study)
    fit = fit_model(start, study.training, iterations=4, scatter_free=False, mapper=study.mapper)
    return judge(fit, study)


def prune(chosen: Hypothesis, study: Study, found: list[Hypothesis]) -> Hypothesis:
    """Drop effects, and richer laws, that the others have made needless; all tried are `found`.

    And those that are nothing within their error.
    """
    while chosen.key:
        effects = chosen.fit.structure.effects
        plainer = [_plainer(chosen, c, study) for c in effects if c.effect.grows_from]
        if len(effects) == 1:
            without = [found[0]]
        else:
            without = [_without(chosen, c, study) for c in effects]
            found += without
        found += plainer
        as_good = [h for h in without if _as_good(h, chosen, study)]
        as_good += [h for h in plainer if h.bic < chosen.bic]
        as_good = [h for h in as_good if h.sound]
        if not as_good:
            nothing = is_nothing(finish(chosen.fit, study))
            as_good = [h for h, none in zip(without, nothing, strict=True) if none and h.sound]
        if not as_good:
            break
        chosen = min(as_good, key=lambda h: h.bic)
    return chosen


def _as_good(without: Hypothesis, chosen: Hypothesis, study: Study) -> bool:
    """Does a hypothesis without one of the effects do about as well?

    Where much is left for another reason, the criterion's drop is small: an effect that lowers the
    error of runs not seen by a tenth is kept there, if the criterion is for it at all.
    """
    if worth_it(chosen, without, study):
        return False
    if study.explains(chosen):
        return True
    return without.bic < chosen.bic or not lowers_error(chosen, without, study)


def is_nothing(fit: Fit) -> list[bool]:
    """Return which effects have a parameter that is nothing within its standard errors."""
    structure = fit.structure
    if fit.covariance is None:
        return [False] * len(structure.effects)
    std = np.sqrt(np.diag(fit.covariance)) * structure.physical_derivative(fit.theta)
    return [
        any(
            abs(value - p.neutral) < SURE * error
            for p, value, error in zip(
                term.effect.parameters, term.values, std[structure.span(index)], strict=True
            )
            if p.neutral is not None and p.reported
        )
        for index, term in enumerate(fit.terms)
    ]


def _without(hypothesis: Hypothesis, effect: Candidate, study: Study) -> Hypothesis:
    index = hypothesis.fit.structure.effects.index(effect)
    fit = fit_whole(hypothesis.fit.without(index), study, near=True)
    return judge(fit, study)


def _plainer(hypothesis: Hypothesis, rich: Candidate, study: Study) -> Hypothesis:
    """Return the hypothesis with the law in place of a richer one that grew from it."""
    index = hypothesis.fit.structure.effects.index(rich)
    effect = find_effect(rich.effect.grows_from or rich.effect.key)
    values = [hypothesis.fit.terms[index].values[rich.effect.names.index(name)]
              for name in effect.names]  # fmt: skip
    chain = hypothesis.fit.structure.chain(hypothesis.fit.theta)
    plain = make_candidate(effect, rich.place, values, runs=study.training, chain=chain)
    fit = fit_whole(hypothesis.fit.without(index).with_effect(plain, values), study)
    return judge(fit, study)


def steps_to(
    chosen: Hypothesis, found: Sequence[Hypothesis], study: Study
) -> tuple[Hypothesis, ...]:
    """Return the linear model, one effect, … chosen: what helps most by itself comes first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        key = steps[0].key
        smaller = [h for h in found if h.key < key and len(h.key) == len(key) - 1]
        smaller = smaller or [_without(steps[0], effects[-1], study)]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)
