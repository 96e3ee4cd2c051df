"""Remove needless effects, and order the others with the most helpful first."""

from collections.abc import Sequence

import numpy as np

from pipeline.gap.fit.levenberg_marquardt import GapFit
from pipeline.gap.fit.structure import Candidate
from pipeline.gap.limits import SURE
from pipeline.gap.search.free_run_fit import finish, fit_on
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, lowers_error, worth_it
from pipeline.gap.search.translate import make_candidate
from pipeline.plant.catalogue import find_effect

_FEW = 4  # effects to try at a time; certainty is only a rough guide to which are needed


def prune(chosen: Hypothesis, study: Study, found: list[Hypothesis]) -> Hypothesis:
    """Drop effects that the others make needless; append every hypothesis tried to `found`.

    An effect may also be replaced by a simpler law. An effect within three standard errors of zero
    is dropped too. Of the few least certain effects, the least needed goes first. Losses add up, so
    each hypothesis is compared with the best so far.
    """
    best = chosen
    while chosen.key:
        effects = chosen.fit.structure.effects
        sure = significance(finish(chosen.fit, study))
        order: list[int] = np.argsort(sure, kind="stable").tolist()
        for few in (order[:_FEW], order[_FEW:]):
            needless = []
            for index in few:
                plainer = _plainer(chosen, effects[index], study)
                if plainer is not None:
                    found.append(plainer)
                    needless += (
                        [plainer] if plainer.is_credible and plainer.bic < chosen.bic else []
                    )
                without = found[0]
                if len(effects) > 1:
                    without = _without(chosen, effects[index], study)
                    found.append(without)
                nothing = sure[index] < SURE  # may be zero, so it must go
                if nothing or (without.is_credible and _as_good(without, best, study)):
                    needless.append(without)
            if needless:
                chosen = min(needless, key=lambda h: h.bic)
                best = min(best, chosen, key=lambda h: h.error)
                break
        else:
            break
    return chosen


def without_zero_effect(chosen: Hypothesis, final: GapFit, study: Study) -> Hypothesis | None:
    """Return a hypothesis without the least certain effect, if it may be zero; otherwise None.

    `final` is the fit of `chosen` with its covariance.
    """
    sure = significance(final)
    if not sure or min(sure) >= SURE:
        return None
    return _without(chosen, chosen.fit.structure.effects[int(np.argmin(sure))], study)


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


def _plainer(hypothesis: Hypothesis, rich: Candidate, study: Study) -> Hypothesis | None:
    """Return the hypothesis with a rich law replaced by its simpler form, if that form exists."""
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
    """Return the path from the linear model to the chosen one, the most helpful effect first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        known = {h.key: h for h in found}
        rest = [(steps[0].key - {effect.key}, effect) for effect in effects]
        smaller = [known.get(key) or _without(steps[0], effect, study) for key, effect in rest]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)
