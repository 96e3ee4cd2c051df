"""Search the catalogue: screen, refit the suspects, keep a few hypotheses, grow them, prune."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipeline.gap.baseline import SHOT_LENGTH, fit_locals
from pipeline.gap.fit import Fit, Mapper, fit_model, restart_runs, simulate_run
from pipeline.gap.rugged import polish, zoom
from pipeline.gap.runs import Run, cut_shots
from pipeline.gap.screen import Suspect, candidates_at, extend, screen
from pipeline.gap.structure import Candidate, Structure
from pipeline.plant.chain import Array
from pipeline.plant.effects.base import Effect

AT_FLOOR = 1.15  # chi-square per point below this is noise
AS_REPEATS = 1.1  # an error below this many times what repeats differ by is theirs
_SHORT_LIST = 9  # suspects refitted on pieces
_FULL_LIST = 5  # of which the best are refitted on whole runs …
_FULL_SCREEN = 3  # … with the best of a screen on whole runs
_OUT_OF_SIGHT = 8.0  # a suspect that leaves this many times the best one's misfit is out
_BEAM = (3, 1, 1)  # hypotheses kept after one, two, three effects
_HOPELESS = 30.0  # a hypothesis with this many times the best one's chi-square is not grown
_DEPTH = len(_BEAM)
_BIC_DROP = 20.0
_HINT = 2.0  # what the criterion must fall by, by the screen's estimate, to be worth a refit
THINNING = 10.0  # neighbouring residuals are not independent: N / 10 count
_FRICTION_ROUNDS = 2  # of run-by-run friction, the worst runs started anew before each
_NEARLY_RIGHT = 6.0  # chi-square of the better runs, below which the bad ones are worth a new start
_HELD_OUT_GAIN = 0.95  # an effect must lower the held-out error by this factor …
_CONTACT_GAIN = 0.5  # what a contact leaves is its contact law: no effect to mop it up
_RUN_GAIN, _RUN_SHARE = 0.97, 0.6  # … and by 3 % in 60 % of the runs
_RUGGED = ("extra_mode", "end_stop", "backlash", "slack_spring")
_ZOOM_SHARE = 0.15  # of the first suspect's, below which one start must do
CONTACT = ("end_stop", "backlash")
_LEADING = 0.4  # of the first suspect's share, for what is dear to refit
_BOUND_MARGIN = 0.01  # in logarithms, or in scales


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A model with its fit on training runs and what it leaves on held-out ones.

    `at_floor`: nothing is left but noise, on training and on held-out runs, or no more than
    repeats differ by among themselves. `added` is the effect added last; `parent` the hypothesis
    it was added to.
    """

    fit: Fit
    held: Fit
    error: float
    bic: float
    at_floor: bool
    added: Candidate | None = None
    parent: "Hypothesis | None" = None

    @property
    def key(self) -> frozenset[tuple[str, int]]:
        """Which effects act where."""
        return frozenset(c.key for c in self.fit.structure.effects)

    @property
    def sound(self) -> bool:
        """Is every effect what its name says, and no estimate at a bound of the search?"""
        structure, theta = self.fit.structure, self.fit.theta
        low, high = structure.bounds()
        at_bound = (theta <= low + _BOUND_MARGIN) | (theta >= high - _BOUND_MARGIN)
        for index, term in enumerate(structure.model(theta).terms):
            reported = np.array([p.reported for p in term.effect.parameters])
            values = dict(zip(term.effect.names, term.values, strict=True))
            if np.any(at_bound[structure.span(index)] & reported):
                return False
            if not term.effect.genuine(values):
                return False
        return True


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """What every step of the search needs: runs, springs, catalogue, and who maps over runs.

    `repeatability` is the relative error between runs with the same input, 0 without any.
    """

    training: tuple[Run, ...]
    held_out: tuple[Run, ...]
    springs: tuple[bool, ...]
    catalogue: tuple[Effect, ...]
    repeatability: float
    mapper: Mapper
    tell: Callable[[str], None]


def judge(
    fit: Fit, bench: Bench, *, added: Candidate | None = None, parent: Hypothesis | None = None
) -> Hypothesis:
    """Return the hypothesis a fit stands for."""
    held = fit_locals(fit, bench.held_out, mapper=bench.mapper)
    errors, sizes = [], []
    for run, own in zip(bench.held_out, held.locals_, strict=True):
        model = simulate_run(fit.structure, fit.theta[None], run, own)[0]
        errors.append(float(((run.y - model) ** 2).sum()))
        sizes.append(float((run.swing**2).sum() * run.t.size))
    effective = fit.n_points / THINNING
    bic = effective * np.log(fit.cost / fit.n_points) + fit.theta.size * np.log(effective)
    error = float(np.sqrt(sum(errors) / sum(sizes)))
    only_noise = fit.chi < AT_FLOOR and held.chi < AT_FLOOR
    return Hypothesis(
        fit=fit,
        held=held,
        error=error,
        bic=float(bic),
        at_floor=only_noise or error < AS_REPEATS * bench.repeatability,
        added=added,
        parent=parent,
    )


def search(baseline: Hypothesis, bench: Bench, *, depth: int = _DEPTH) -> list[Hypothesis]:
    """Return every hypothesis judged, the baseline first."""
    seen: dict[frozenset[tuple[str, int]], Hypothesis] = {baseline.key: baseline}
    beam = [baseline]
    for level in range(depth):
        children: list[Hypothesis] = []
        best = min(beam, key=lambda h: h.bic)
        for parent in beam:
            if parent.at_floor or parent.fit.chi > _HOPELESS * best.fit.chi:
                continue
            for child in grow(parent, bench):
                if not child.sound:
                    continue
                if child.key not in seen or child.bic < seen[child.key].bic:
                    seen[child.key] = child
                    if child.bic < parent.bic - _BIC_DROP:
                        children.append(child)
        if not children:
            break
        unique = {child.key: child for child in sorted(children, key=lambda h: -h.bic)}
        worthy = [child for child in unique.values() if not _needlessly_rich(child, unique)]
        beam = sorted(worthy, key=lambda h: h.bic)[: _BEAM[level]]
        bench.tell(f"{level + 1} effect{'s' * (level > 0)}: " + _names(beam[0]))
        if beam[0].at_floor:
            break
    return list(seen.values())


def _needlessly_rich(
    child: Hypothesis, others: Mapping[frozenset[tuple[str, int]], Hypothesis]
) -> bool:
    """Does a simpler law in the place of the effect added last explain no less?"""
    added = child.added
    if added is None or added.effect.grows_from is None:
        return False
    simpler = others.get(child.key - {added.key} | {(added.effect.grows_from, added.place)})
    return simpler is not None and simpler.bic < child.bic


def _names(hypothesis: Hypothesis) -> str:
    return " + ".join(c.label for c in hypothesis.fit.structure.effects)


def grow(parent: Hypothesis, bench: Bench) -> list[Hypothesis]:
    """Return the children of a hypothesis: one further effect each, fully refitted."""
    children = []
    for candidate, fit in _starts(parent, bench):
        child = _full_refit(candidate, fit, parent, bench)
        children.append(child)
        if candidate.effect.family == "dry friction":
            for effect in bench.catalogue:
                if effect.grows_from == candidate.effect.key:
                    children.append(_grown_friction(effect, child, parent, bench))
    return children


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
    within = _OUT_OF_SIGHT * short[0][1].cost if short else np.inf
    chosen = [pair for pair in short[:_FULL_LIST] if pair[1].cost < within]
    if short and short[0][1].chi < AT_FLOOR:
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


def _full_refit(candidate: Candidate, start: Fit, parent: Hypothesis, bench: Bench) -> Hypothesis:
    fit = fit_whole(start.structure, start.theta, bench)
    if candidate.effect.key in CONTACT:
        fit = polish(fit, bench.training, enough=AT_FLOOR, mapper=bench.mapper)
    return judge(fit, bench, added=candidate, parent=parent)


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


def _grown_friction(
    effect: Effect, simple: Hypothesis, parent: Hypothesis, bench: Bench
) -> Hypothesis:
    """Fit a richer friction law from the simpler one's fit."""
    structure = simple.fit.structure
    index = len(structure.effects) - 1
    place = structure.effects[index].place
    force = simple.fit.structure.model(simple.fit.theta).terms[index].values[0]
    base = simple.fit.theta[: structure.span(index).start]
    trials = candidates_at(
        effect, place, runs=bench.training, chain=structure.chain(simple.fit.theta)
    )
    without = structure.without(index)
    fits = []
    tried = set()
    for candidate, values in trials:
        start = _friction_start(effect, force, values)
        if start in tried:
            continue
        tried.add(start)
        grown = without.with_effect(candidate)
        theta = extend(replace(simple.fit, structure=without, theta=base), candidate, start)[1]
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
    return judge(fit, bench, added=best.structure.effects[-1], parent=parent)


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


# ----------------------------------------------------------------------- choosing


def worth_it(child: Hypothesis, parent: Hypothesis) -> bool:
    """Does a further effect help on runs the model has not seen?"""
    contact = any(effect in CONTACT for effect, _ in parent.key)
    gain = _CONTACT_GAIN if contact else _HELD_OUT_GAIN
    if child.bic > parent.bic - _BIC_DROP or child.held.chi > gain**2 * parent.held.chi:
        return False
    better = child.held.run_chi < _RUN_GAIN**2 * parent.held.run_chi
    # A run with nothing but noise left cannot become better.
    open_runs = parent.held.run_chi > AT_FLOOR
    return bool(np.mean(better[open_runs] if open_runs.any() else better) >= _RUN_SHARE)


def choose(found: Sequence[Hypothesis], baseline: Hypothesis) -> Hypothesis:
    """Return the best hypothesis whose every effect is worth it, the smaller where in doubt."""
    best = baseline
    for size in range(1, _DEPTH + 1):
        level = [h for h in found if len(h.key) == size]
        level = [h for h in level if worth_it(h, best)]
        if level:
            best = min(level, key=lambda h: h.bic)
    return best


def prune(chosen: Hypothesis, bench: Bench) -> Hypothesis:
    """Drop effects the others have made needless; reduce rich friction to Coulomb's."""
    while len(chosen.key) > 1:
        trials = []
        for index in range(len(chosen.fit.structure.effects)):
            structure = chosen.fit.structure.without(index)
            theta = np.delete(chosen.fit.theta, np.r_[chosen.fit.structure.span(index)])
            fit = fit_whole(structure, theta, bench)
            trials.append(judge(fit, bench, added=structure.effects[-1], parent=chosen.parent))
        smaller = min(trials, key=lambda h: h.bic)
        if worth_it(chosen, smaller):
            return chosen
        chosen = smaller
    return chosen
