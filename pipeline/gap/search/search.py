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
from pipeline.gap.fit.levenberg_marquardt import Fit
from pipeline.gap.fit.structure import Candidate, Model
from pipeline.gap.follow.choose import Records, choose_laws, rivals_of
from pipeline.gap.follow.fit import Follow
from pipeline.gap.follow.track import make_track
from pipeline.gap.limits import SURE
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, lowers_error, worth_it
from pipeline.gap.search.translate import as_model, filled, make_candidate
from pipeline.gap.search.whole import finish, fit_on, fit_whole
from pipeline.plant.nonlinear.effects import find_effect

_FEW = 4  # effects tried at a time: least sure means only roughly least missed
_LOOSER = (0.02, 0.01, 0.005, 0.002, 0.0)  # gains


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
        found.append(judge(fit_whole(_as_model(lean, study, records), study), study))
        study.tell(f"{found[-1].size} laws are left: error {found[-1].error:.1%}")
        for rival in rivals_of(lean, records):
            found.append(judge(fit_whole(_as_model(rival, study, records), study), study))
        found[1:] = [h for h in found[1:] if np.isfinite(h.error)]
        # What ends at a bound is often nothing: it goes, and what remains is sound.
        chosen = prune(min(found, key=lambda h: h.bic_of_all), study, found)
        sound = [h for h in found if h.sound and np.isfinite(h.error)]
        if not chosen.sound:
            chosen = prune(min(sound, key=lambda h: h.bic_of_all), study, found)
        usable = chosen.sound and np.isfinite(chosen.error)
        return chosen if usable else baseline, [h for h in found if h.sound]
    found = [h for h in found if np.isfinite(h.error) and h.sound]
    worth = [h for h in found if worth_it(h, baseline, study)]
    return min(worth, key=lambda h: h.bic, default=baseline), found


def _as_model(follow: Follow, study: Study, records: Records) -> Model:
    """Return what a following model says, in effects of the catalogue."""
    if not any(study.springs):
        # On no spring errors add up: what a model lacks misleads a fit that is free at once.
        for gain in _LOOSER:
            follow = records.fit(follow, gain=gain) if gain < follow.gain else follow
    return as_model(follow, springs=study.springs, catalogue=study.catalogue, runs=study.training)


def prune(chosen: Hypothesis, study: Study, found: list[Hypothesis]) -> Hypothesis:
    """Drop effects, and richer laws, that the others have made needless; all tried are `found`.

    And those that are nothing within their error. Of the least sure few, what is missed least
    goes first; what is lost adds up, so each is compared with the best so far.
    """
    best = chosen
    while chosen.key:
        effects = chosen.fit.structure.effects
        sure = sureness(finish(chosen.fit, study))
        order: list[int] = np.argsort(sure, kind="stable").tolist()
        for few in (order[:_FEW], order[_FEW:]):
            needless = []
            for index in few:
                plainer = _plainer(chosen, effects[index], study)
                if plainer is not None:
                    found.append(plainer)
                    needless += [plainer] if plainer.sound and plainer.bic < chosen.bic else []
                without = found[0]
                if len(effects) > 1:
                    without = _without(chosen, effects[index], study)
                    found.append(without)
                nothing = sure[index] < SURE  # it goes, wherever that leads the others
                if nothing or (without.sound and _as_good(without, best, study)):
                    needless.append(without)
            if needless:
                chosen = min(needless, key=lambda h: h.bic)
                best = min(best, chosen, key=lambda h: h.error)
                break
        else:
            break
    return chosen


def without_nothing(chosen: Hypothesis, final: Fit, study: Study) -> Hypothesis | None:
    """Return a hypothesis without its least sure effect, where that may be nothing; or None.

    `final` is its fit with the covariance.
    """
    sure = sureness(final)
    if not sure or min(sure) >= SURE:
        return None
    return _without(chosen, chosen.fit.structure.effects[int(np.argmin(sure))], study)


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


def sureness(fit: Fit) -> list[float]:
    """Return how many standard errors each effect is from nothing, by its least sure parameter."""
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
    """Return the hypothesis without one of its effects, fitted from where it is."""
    index = hypothesis.fit.structure.effects.index(effect)
    return judge(fit_on(hypothesis.fit, hypothesis.fit.without(index), study), study)


def _plainer(hypothesis: Hypothesis, rich: Candidate, study: Study) -> Hypothesis | None:
    """Return the hypothesis with the law that a richer one grew from in its place."""
    if rich.effect.grows_from is None:
        return None
    index = hypothesis.fit.structure.effects.index(rich)
    effect = find_effect(rich.effect.grows_from)
    values = [hypothesis.fit.terms[index].values[rich.effect.names.index(name)]
              for name in effect.names]  # fmt: skip
    chain = hypothesis.fit.structure.chain(hypothesis.fit.theta)
    plain = make_candidate(effect, rich.place, values, runs=study.training, chain=chain)
    model = hypothesis.fit.without(index).with_effect(plain, values)
    return judge(fit_on(hypothesis.fit, model, study), study)


def steps_to(
    chosen: Hypothesis, found: Sequence[Hypothesis], study: Study
) -> tuple[Hypothesis, ...]:
    """Return the linear model, one effect, … chosen: what helps most by itself comes first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        known = {h.key: h for h in found}
        rest = [(steps[0].key - {effect.key}, effect) for effect in effects]
        smaller = [known.get(key) or _without(steps[0], effect, study) for key, effect in rest]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)
