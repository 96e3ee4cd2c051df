"""Grow a hypothesis: screen the catalogue, refit the suspects, fit the best to whole runs."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from pipeline.gap import limits
from pipeline.gap.data.runs import Run, cut_shots
from pipeline.gap.fit.baseline import SHOT_LENGTH
from pipeline.gap.fit.levenberg_marquardt import Fit, fit_model
from pipeline.gap.fit.restart import restart_runs
from pipeline.gap.fit.structure import Candidate, Model
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge
from pipeline.gap.search.rugged import polish, zoom
from pipeline.gap.search.screen import Suspect, Team, candidates_at, screen
from pipeline.plant.nonlinear.effects.base import Effect

_SHORT_LIST = 9  # suspects refitted on pieces
_FULL_LIST = 5  # of which the best are refitted on whole runs …
_FULL_SCREEN = 3  # … with the best of a screen on whole runs
_OUT_OF_SIGHT = 8.0  # a suspect that leaves this many times the best one's misfit is out
_BESIDE_THE_FLOOR = 1.5  # … where that one leaves no more than noise
_IN_THE_RUNNING = 3.0  # times the best sibling's misfit: what may still win when refined
_TOGETHER = 0.9  # of what a part of it leaves, which a team must leave at most
_NO_LESS = 1.03  # of what a team leaves: a part of it that leaves less does as well alone
_POLISHED = 0.1  # of the chi-square without it: a contact that is there explains more
_NOISE_ALONE = 1.05  # chi-square that no richer law of friction lowers
_HINT = 2.0  # what the criterion must fall by, by the screen's estimate, to be worth a refit
_FRICTION_ROUNDS = 2  # of run-by-run friction, the worst runs started anew before each
_NEARLY_RIGHT = 6.0  # chi-square of the better runs, below which the bad ones are worth a new start
_ZOOM_SHARE = 0.15  # of the first suspect's, below which one start must do
_LEADING = 0.4  # of the first suspect's share, for what is dear to refit


def grow(parent: Hypothesis, study: Study) -> Iterator[Hypothesis]:
    """Yield the children of a hypothesis, fully refitted: an effect more, or a team of them.

    What is dear is done last, and only for those who can still win: contacts are polished, and
    dry friction grows into its richer laws.
    """
    fits: list[tuple[tuple[Candidate, ...], Fit]] = []
    plain: list[Hypothesis] = []
    for candidates, start in _starts(parent, study):
        fits.append((candidates, fit_whole(start, study)))
        if not _is_contact(candidates):
            plain.append(judge(fits[-1][1], study, added=candidates))
            yield plain[-1]
    for candidates, fit in fits[:]:
        for other, start in _lookalikes(candidates, fit, study):
            fits.append(((other,), fit_whole(start, study)))
    lowest = min((fit.cost for _, fit in fits), default=np.inf)
    contacts: set[tuple[str, int]] = set()
    for candidates, fit in sorted(fits, key=lambda pair: pair[1].cost):
        if _is_contact(candidates) and candidates[0].key not in contacts:
            if fit.cost < _IN_THE_RUNNING * lowest and fit.chi < _POLISHED * parent.fit.chi:
                fit = polish(fit, study.training, enough=limits.AT_FLOOR, mapper=study.mapper)
            contacts.add(candidates[0].key)
            yield judge(fit, study, added=candidates)
    closed = any(child.at_floor for child in plain)
    for child in plain:
        equals = [fit.cost for others, fit in fits if closed or len(others) == len(child.added)]
        noise = _NOISE_ALONE * child.fit.n_points
        running = noise < child.fit.cost < _IN_THE_RUNNING * min(equals)
        if not running or any(_tells_better(other, child) for other in plain):
            continue
        for effect in study.catalogue:
            if any(c.effect.key == effect.grows_from for c in child.added):
                yield _grown_friction(effect, child, study)


def _tells_better(other: Hypothesis, child: Hypothesis) -> bool:
    """Do the same laws on more carts explain more, or a part of this team no less?

    Of runs not seen and of those fitted: where the two disagree, neither stands for the other.
    """
    mine, others = {c.key for c in child.added}, {c.key for c in other.added}
    same_laws = {c.effect.key for c in other.added} == {c.effect.key for c in child.added}
    if same_laws and mine < others:
        within = _TOGETHER
    elif others < mine:
        within = _NO_LESS
    else:
        return False
    return other.error < within * child.error and other.fit.cost < within * child.fit.cost


def _lookalikes(
    added: Sequence[Candidate], fit: Fit, study: Study
) -> Iterator[tuple[Candidate, Model]]:
    """Yield what the values of an effect, just added by itself, hint at in its stead."""
    if len(added) > 1:
        return
    index, chain = len(fit.structure.effects) - 1, fit.structure.chain(fit.theta)
    term = fit.terms[index]
    hint = term.effect.lookalike(term.effect.named(term.values), term.place, chain)
    if hint is None or hint.effect not in study.catalogue:
        return
    base = fit.without(index)
    if (hint.effect.key, hint.place) in (c.key for c in base.structure.effects):
        return
    for candidate, usual in candidates_at(
        hint.effect, hint.place, runs=study.training, chain=chain
    ):
        values = hint.effect.named(usual) | hint.values
        if candidate.has_signs_of(tuple(values.values())):
            yield candidate, base.with_effect(candidate, tuple(values.values()))
            return


def _is_contact(candidates: Sequence[Candidate]) -> bool:
    return any(candidate.effect.contact for candidate in candidates)


def _starts(parent: Hypothesis, study: Study) -> list[tuple[tuple[Candidate, ...], Fit]]:
    """Return the suspects worth a full refit, each with a fit to start from.

    Pieces forgive a wrong structure, so most suspects come from them; whole runs show what adds
    up over a run, such as a light hidden mass in resonance.
    """
    look = partial(
        screen,
        whole=study.training,
        springs=study.springs,
        catalogue=study.catalogue,
        mapper=study.mapper,
    )
    pieces = [cut_shots(run, length=SHOT_LENGTH) for run in study.training]
    loose = fit_model(parent.fit, pieces, iterations=4, scatter_free=False, mapper=study.mapper)
    suspects, teams = look(loose, pieces)
    suspects = [s for s in suspects if _promises(s.share, loose)]
    short = [
        _short_refit(loose, s, pieces, study, top=suspects[0].share) for s in _short_list(suspects)
    ]
    short.sort(key=lambda pair: pair[1].cost)
    closed = bool(short) and short[0][1].chi < limits.AT_FLOOR
    within = _BESIDE_THE_FLOOR if closed else _OUT_OF_SIGHT
    within *= short[0][1].cost if short else np.inf
    chosen = [pair for pair in short[:_FULL_LIST] if pair[1].cost < within]
    if closed:
        return chosen
    best = short[0][1].cost if short else np.inf
    for team in teams:
        if _promises(team.share, loose) and not _is_contact(team.candidates):
            pair = _refit_team(loose, team, pieces, study)
            if team.family or pair[1].cost < _TOGETHER * best:
                chosen.append(pair)
                best = min(best, pair[1].cost)
    suspects, _ = look(parent.fit, study.training)
    suspects = [s for s in suspects if _promises(s.share, parent.fit)]
    for suspect in suspects[:_FULL_SCREEN]:
        key, top = suspect.candidate.key, suspects[0].share
        if _needs_starts(suspect.candidate) and suspect.share > _LEADING * top:
            chosen.append(_short_refit(parent.fit, suspect, study.training, study, top=top))
        elif (key,) not in (tuple(c.key for c in candidates) for candidates, _ in chosen):
            pair = next((p for p in short if p[0][0].key == key), None)
            pair = pair or _short_refit(loose, suspect, pieces, study, top=0.0)
            if pair[1].cost < within:
                chosen.append(pair)
    return chosen


def _promises(share: float, fit: Fit) -> bool:
    """Would who explains this share of the gap, as screened, lower the criterion at all?"""
    return -fit.n_points / limits.THINNING * np.log1p(-min(share, 0.999)) > _HINT


def _short_list(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Return who is worth a refit; contacts need fine steps, so only where they lead."""
    top = suspects[0].share if suspects else 0.0
    return [
        suspect
        for suspect in suspects[:_SHORT_LIST]
        if not suspect.candidate.effect.contact or suspect.share > _LEADING * top
    ]


def _needs_starts(candidate: Candidate) -> bool:
    """Would one start not do? The screen cannot scale a trial of a limit to the data either."""
    effect = candidate.effect
    return _is_rugged(effect) or effect.parameters[0].neutral is None


def _is_rugged(effect: Effect) -> bool:
    return effect.rugged or effect.contact


def _short_refit(
    start: Fit, suspect: Suspect, pieces: Sequence[Run], study: Study, *, top: float
) -> tuple[tuple[Candidate, ...], Fit]:
    """Refit a suspect on pieces; where the landscape is rugged, from several starts.

    `top` is the share of the gap the first suspect explains.
    """
    several = _needs_starts(suspect.candidate)
    if _is_rugged(suspect.candidate.effect) and suspect.share > _ZOOM_SHARE * top:
        suspect = zoom(start, pieces, suspect, mapper=study.mapper)
    starts = [start.with_effect(suspect.candidate, values) for values in suspect.starts]
    starts = starts[:3] if several else [_best_start(starts, pieces, study)]
    fits = [
        fit_model(
            one, pieces, iterations=3 if several else 5, scatter_free=False, mapper=study.mapper
        )
        for one in starts
    ]
    best = min(fits, key=lambda fit: fit.cost)
    if several:
        best = fit_model(
            best,
            pieces,
            nuisance=best.nuisance,
            iterations=6,
            scatter_free=False,
            mapper=study.mapper,
        )
    return (suspect.candidate,), best


def _refit_team(
    start: Fit, team: Team, pieces: Sequence[Run], study: Study
) -> tuple[tuple[Candidate, ...], Fit]:
    """Refit the members of a team together on pieces."""
    starts = []
    for values in team.starts:
        grown: Model = start
        for candidate, of_one in zip(team.candidates, values, strict=True):
            grown = grown.with_effect(candidate, of_one)
        starts.append(grown)
    best = _best_start(starts, pieces, study)
    fit = fit_model(best, pieces, iterations=5, scatter_free=False, mapper=study.mapper)
    return team.candidates, fit


def _best_start(starts: Sequence[Model], pieces: Sequence[Run], study: Study) -> Model:
    """Return the start that leaves least: the screen's is a trial's multiple, not simulated."""

    def cost(start: Model) -> float:
        fit = fit_model(start, pieces, iterations=0, mapper=study.mapper)
        return fit.cost

    return min(starts, key=cost)


def fit_whole(start: Model, study: Study) -> Fit:
    """Fit whole runs; friction first with one size for all runs, then run by run."""
    whole = study.training
    structure = start.structure
    fit = fit_model(
        start,
        whole,
        iterations=25 if structure.has_contact else 12,
        scatter_free=False,
        mapper=study.mapper,
    )
    for attempt in range(_FRICTION_ROUNDS):
        if not structure.many_rests or fit.chi < limits.AT_FLOOR:
            break
        if np.quantile(fit.run_chi, 0.25) < _NEARLY_RIGHT:
            fit = restart_runs(fit, whole, mapper=study.mapper)
        elif attempt:
            break
        fit = fit_model(
            fit,
            whole,
            nuisance=fit.nuisance,
            spread=fit.spread,
            iterations=12,
            learn_spread=True,
            mapper=study.mapper,
        )
    return fit


def _grown_friction(effect: Effect, child: Hypothesis, study: Study) -> Hypothesis:
    """Fit a richer friction law in the places of the simpler one, just added, from its fit."""
    added, simple = child.added, child.fit
    structure = simple.structure
    simpler = [c for c in added if c.effect.key == effect.grows_from]
    at = [structure.effects.index(c) for c in simpler]
    known = [effect.grown(t.effect.named(t.values)) for t in (simple.terms[i] for i in at)]
    chain = structure.chain(simple.theta)
    trials = [candidates_at(effect, c.place, runs=study.training, chain=chain) for c in simpler]
    fits = []
    tried = set()
    for trial in zip(*trials, strict=True):
        starts = tuple(
            tuple((effect.named(values) | told).values())
            for told, (_, values) in zip(known, trial, strict=True)
        )
        if starts in tried:
            continue
        tried.add(starts)
        start = simple.without(*at)
        for (candidate, _), values in zip(trial, starts, strict=True):
            start = start.with_effect(candidate, values)
        fits.append(
            fit_model(start, study.training, iterations=4, scatter_free=False, mapper=study.mapper)
        )
    best = min(fits, key=lambda fit: fit.cost)
    fit = fit_whole(best, study)
    return judge(fit, study, added=best.structure.effects[-len(added) :])
