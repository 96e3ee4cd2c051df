"""Grow a hypothesis: screen the catalogue, refit the suspects, fit the best to whole runs."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.gap.baseline import SHOT_LENGTH
from pipeline.gap.fit import Fit, fit_model
from pipeline.gap.hypothesis import AT_FLOOR, CONTACT, THINNING, Bench, Hypothesis, judge
from pipeline.gap.restart import restart_runs
from pipeline.gap.rugged import polish, zoom
from pipeline.gap.runs import Run, cut_shots
from pipeline.gap.screen import Suspect, candidates_at, extend, screen
from pipeline.gap.structure import Candidate, Structure
from pipeline.plant.chain import Array
from pipeline.plant.effects.base import Effect

_SHORT_LIST = 9  # suspects refitted on pieces
_FULL_LIST = 5  # of which the best are refitted on whole runs …
_FULL_SCREEN = 3  # … with the best of a screen on whole runs
_OUT_OF_SIGHT = 8.0  # a suspect that leaves this many times the best one's misfit is out
_BESIDE_THE_FLOOR = 1.5  # … where that one leaves no more than noise
_IN_THE_RUNNING = 3.0  # times the best sibling's misfit: what may still win when refined
_POLISHED = 0.1  # of the chi-square without it: a contact that is there explains more
_NOISE_ALONE = 1.05  # chi-square that no richer law of friction lowers
_HINT = 2.0  # what the criterion must fall by, by the screen's estimate, to be worth a refit
_FRICTION_ROUNDS = 2  # of run-by-run friction, the worst runs started anew before each
_NEARLY_RIGHT = 6.0  # chi-square of the better runs, below which the bad ones are worth a new start
_RUGGED = ("extra_mode", "slack_spring", *CONTACT)
_ZOOM_SHARE = 0.15  # of the first suspect's, below which one start must do
_LEADING = 0.4  # of the first suspect's share, for what is dear to refit


def grow(parent: Hypothesis, bench: Bench) -> Iterator[Hypothesis]:
    """Yield the children of a hypothesis: one further effect each, fully refitted.

    What is dear is done last, and only for those who can still win: contacts are polished, and
    dry friction grows into its richer laws.
    """
    fits: list[tuple[Candidate, Fit]] = []
    for candidate, start in _starts(parent, bench):
        fits.append((candidate, fit_whole(start.structure, start.theta, bench)))
        if candidate.effect.key not in CONTACT:
            yield judge(fits[-1][1], bench, added=candidate)
    lowest = min((fit.cost for _, fit in fits), default=np.inf)
    contacts: dict[tuple[str, int], Fit] = {}
    for candidate, fit in sorted(fits, key=lambda pair: pair[1].cost):
        if candidate.effect.key in CONTACT and candidate.key not in contacts:
            if fit.cost < _IN_THE_RUNNING * lowest and fit.chi < _POLISHED * parent.fit.chi:
                fit = polish(fit, bench.training, enough=AT_FLOOR, mapper=bench.mapper)
            contacts[candidate.key] = fit
            yield judge(fit, bench, added=candidate)
    for candidate, fit in fits:
        running = _NOISE_ALONE * fit.n_points < fit.cost < _IN_THE_RUNNING * lowest
        for effect in bench.catalogue if running else ():
            if effect.grows_from == candidate.effect.key:
                yield _grown_friction(effect, fit, bench)


def _starts(parent: Hypothesis, bench: Bench) -> list[tuple[Candidate, Fit]]:
    """Return the suspects worth a full refit, each with a fit to start from.

    Pieces forgive a wrong structure, so most suspects come from them; whole runs show what adds
    up over a run, such as a light hidden mass in resonance.
    """
    look = partial(
        screen,
        whole=bench.training,
        springs=bench.springs,
        catalogue=bench.catalogue,
        mapper=bench.mapper,
    )
    pieces = [cut_shots(run, length=SHOT_LENGTH) for run in bench.training]
    loose = fit_model(
        parent.fit.structure,
        parent.fit.theta,
        pieces,
        iterations=4,
        scatter_free=False,
        mapper=bench.mapper,
    )
    suspects = [s for s in look(loose, pieces) if _promises(s, loose)]
    short = [
        _short_refit(loose, s, pieces, bench, top=suspects[0].share) for s in _short_list(suspects)
    ]
    short.sort(key=lambda pair: pair[1].cost)
    closed = bool(short) and short[0][1].chi < AT_FLOOR
    within = _BESIDE_THE_FLOOR if closed else _OUT_OF_SIGHT
    within *= short[0][1].cost if short else np.inf
    chosen = [pair for pair in short[:_FULL_LIST] if pair[1].cost < within]
    if closed:
        return chosen
    suspects = [s for s in look(parent.fit, bench.training) if _promises(s, parent.fit)]
    for suspect in suspects[:_FULL_SCREEN]:
        key, top = suspect.candidate.key, suspects[0].share
        if _needs_starts(suspect.candidate) and suspect.share > _LEADING * top:
            chosen.append(_short_refit(parent.fit, suspect, bench.training, bench, top=top))
        elif key not in (candidate.key for candidate, _ in chosen):
            pair = next((p for p in short if p[0].key == key), None)
            pair = pair or _short_refit(loose, suspect, pieces, bench, top=0.0)
            if pair[1].cost < within:
                chosen.append(pair)
    return chosen


def _promises(suspect: Suspect, fit: Fit) -> bool:
    """Would the suspect, as screened, lower the criterion at all?"""
    return -fit.n_points / THINNING * np.log1p(-min(suspect.share, 0.999)) > _HINT


def _short_list(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Return who is worth a refit; contacts need fine steps, so only where they lead."""
    top = suspects[0].share if suspects else 0.0
    return [
        suspect
        for suspect in suspects[:_SHORT_LIST]
        if suspect.candidate.effect.key not in CONTACT or suspect.share > _LEADING * top
    ]


def _needs_starts(candidate: Candidate) -> bool:
    """Would one start not do? The screen cannot scale a trial of a limit to the data either."""
    effect = candidate.effect
    return effect.key in _RUGGED or effect.parameters[0].neutral is None


def _short_refit(
    start: Fit, suspect: Suspect, pieces: Sequence[Run], bench: Bench, *, top: float
) -> tuple[Candidate, Fit]:
    """Refit a suspect on pieces; where the landscape is rugged, from several starts.

    `top` is the share of the gap the first suspect explains.
    """
    several = _needs_starts(suspect.candidate)
    if suspect.candidate.effect.key in _RUGGED and suspect.share > _ZOOM_SHARE * top:
        suspect = zoom(start, pieces, suspect, mapper=bench.mapper)
    fits = []
    for values in suspect.starts[: 3 if several else 1]:
        structure, theta = extend(start, suspect.candidate, values)
        fits.append(
            fit_model(
                structure,
                theta,
                pieces,
                iterations=3 if several else 5,
                scatter_free=False,
                mapper=bench.mapper,
            )
        )
    best = min(fits, key=lambda fit: fit.cost)
    if several:
        best = fit_model(
            best.structure,
            best.theta,
            pieces,
            locals_=best.locals_,
            iterations=6,
            scatter_free=False,
            mapper=bench.mapper,
        )
    return suspect.candidate, best


def fit_whole(structure: Structure, theta: Array, bench: Bench) -> Fit:
    """Fit whole runs; friction first with one size for all runs, then run by run."""
    whole = bench.training
    dry = any(structure.dry)
    contact = any(c.effect.key in CONTACT for c in structure.effects)
    fit = fit_model(
        structure,
        theta,
        whole,
        iterations=25 if contact else 12,
        scatter_free=False,
        mapper=bench.mapper,
    )
    for attempt in range(_FRICTION_ROUNDS):
        if not dry or fit.chi < AT_FLOOR:
            break
        if np.quantile(fit.run_chi, 0.25) < _NEARLY_RIGHT:
            fit = restart_runs(fit, whole, mapper=bench.mapper)
        elif attempt:
            break
        fit = fit_model(
            structure,
            fit.theta,
            whole,
            locals_=fit.locals_,
            spread=fit.spread,
            iterations=12,
            learn_spread=True,
            mapper=bench.mapper,
        )
    return fit


def _grown_friction(effect: Effect, simple: Fit, bench: Bench) -> Hypothesis:
    """Fit a richer friction law from the simpler one's fit."""
    structure = simple.structure
    index = len(structure.effects) - 1
    place = structure.effects[index].place
    force = structure.model(simple.theta).terms[index].values[0]
    base = simple.theta[: structure.span(index).start]
    trials = candidates_at(effect, place, runs=bench.training, chain=structure.chain(simple.theta))
    without = structure.without(index)
    fits = []
    tried = set()
    for candidate, values in trials:
        start = _friction_start(effect, force, values)
        if start in tried:
            continue
        tried.add(start)
        grown = without.with_effect(candidate)
        theta = extend(replace(simple, structure=without, theta=base), candidate, start)[1]
        fits.append(
            fit_model(
                grown,
                theta,
                bench.training,
                iterations=4,
                scatter_free=False,
                mapper=bench.mapper,
            )
        )
    best = min(fits, key=lambda fit: fit.cost)
    fit = fit_whole(best.structure, best.theta, bench)
    return judge(fit, bench, added=best.structure.effects[-1])


def _friction_start(effect: Effect, force: float, values: tuple[float, ...]) -> tuple[float, ...]:
    """Return start values: the simpler law's force, and trial values for what is new."""
    start = []
    for parameter, value in zip(effect.parameters, values, strict=True):
        if parameter.name == "force":
            start.append(force)
        elif parameter.name == "static_force":
            start.append(1.5 * force)
        else:
            start.append(value)
    return tuple(start)
