"""Propose what a following model finds: before a search, and in its place where nothing is left."""

from collections.abc import Iterable
from contextlib import suppress

import numpy as np

from pipeline.gap.fit.baseline import first_chain
from pipeline.gap.fit.levenberg_marquardt import Fit, fit_model
from pipeline.gap.fit.uncertainty import covariance
from pipeline.gap.follow.choose import choose_laws, rivals_of
from pipeline.gap.follow.fit import Follow
from pipeline.gap.follow.records import Records
from pipeline.gap.follow.track import make_track
from pipeline.gap.limits import SURE
from pipeline.gap.search.beam import choose, prune
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.grow import fit_whole
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge
from pipeline.gap.search.translate import as_model, filled

_IN_THE_RUNNING = 3.0  # times the chosen model's misfit while following: a rival that may still win


def propose(baseline: Hypothesis, study: Study) -> tuple[Hypothesis | None, tuple[Hypothesis, ...]]:
    """Return the hypothesis that leaves nothing to search for, if any, and all that are sound.

    None where the time is over, or where the equations of a following model have no solution.
    """
    judged: list[Hypothesis] = []
    settled = None
    with suppress(OutOfTime, np.linalg.LinAlgError):
        settled = _follow(baseline, study, judged)
    return settled, tuple(best_of_each(h for h in judged if _is_usable(h)))


def _follow(baseline: Hypothesis, study: Study, judged: list[Hypothesis]) -> Hypothesis | None:
    """Fill `judged`; return the hypothesis that leaves nothing to search for, if any."""
    records = Records(
        tracks=tuple(make_track(run) for run in study.training),
        mapper=study.mapper,
        columns=frozenset().union(*(filled(effect) for effect in study.catalogue)),
    )
    chain = baseline.fit.structure.chain(baseline.fit.theta)
    own = first_chain(study.training, springs=study.springs)
    lean = choose_laws(records, springs=study.springs, chains=[chain, own])
    if not lean.laws.groups():
        return None
    judged.append(_judged(lean, study))
    if _settled(baseline, study, judged) is None:
        return None
    for rival in rivals_of(lean, records):
        near = rival.total < _IN_THE_RUNNING * lean.total
        judged.append(_judged(rival, study, finish=near))
    return _settled(baseline, study, judged)


def _judged(follow: Follow, study: Study, *, finish: bool = True) -> Hypothesis:
    """Return what a following model says, fitted to whole runs: to the end, or by a few steps."""
    start = as_model(follow, springs=study.springs, catalogue=study.catalogue, runs=study.training)
    if finish:
        return judge(fit_whole(start, study), study)
    fit = fit_model(start, study.training, iterations=4, scatter_free=False, mapper=study.mapper)
    return judge(fit, study)


def _is_usable(hypothesis: Hypothesis) -> bool:
    return bool(np.isfinite(hypothesis.error)) and hypothesis.sound


def _settled(baseline: Hypothesis, study: Study, judged: list[Hypothesis]) -> Hypothesis | None:
    """Return the best of those judged, pruned, where it leaves nothing to search for."""
    usable = [h for h in judged if _is_usable(h)]
    chosen = prune(choose(usable, baseline, study), study)
    if not chosen.key or not study.is_noise(chosen):
        return None
    if chosen.has_contact and not chosen.at_floor:
        return None  # what is left of a bounce may be another law
    if any(is_nothing(covariance(chosen.fit, study.training, mapper=study.mapper))):
        return None
    judged.append(chosen)
    return chosen


def is_nothing(fit: Fit) -> list[bool]:
    """Return which effects have a parameter that is nothing within its standard errors.

    Without an error, as where the model runs away nearby, none is sure to be something.
    """
    structure = fit.structure
    if fit.covariance is None:
        return [True] * len(structure.effects)
    std = np.sqrt(np.diag(fit.covariance)) * structure.physical_derivative(fit.theta)
    return [
        any(
            not abs(value - p.neutral) >= SURE * error
            for p, value, error in zip(
                term.effect.parameters, term.values, std[structure.span(index)], strict=True
            )
            if p.neutral is not None and p.reported
        )
        for index, term in enumerate(fit.terms)
    ]


def best_of_each(hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return of each set of effects the best fit, in the order of their first."""
    best: dict[frozenset[tuple[str, int]], Hypothesis] = {}
    for h in hypotheses:
        if h.key not in best or h.bic < best[h.key].bic:
            best[h.key] = h
    return list(best.values())
