"""Rank every effect at every place, and effects together, by how much of the gap they explain.

An output-error score test: each effect is simulated at a few trial sizes beside the fitted
model; what the model could absorb (its parameters, every run's nuisance parameters) is projected
off, and the best multiple of what remains is subtracted from the residual.

Reference: T. Söderström, P. Stoica, System Identification, section 11.5 (score tests).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import Run
from pipeline.gap.fit.levenberg_marquardt import Fit, Mapper, project
from pipeline.gap.fit.linearise import Nuisance, simulate_run
from pipeline.gap.fit.structure import Candidate, bench_scales
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects.base import Effect, Parameter

_MOST = 3.0  # a multiple beyond this is no longer what was simulated
_LEAST = 0.1  # … and one below starts a fit where it has no slope
_STARTS = 8
_PARTS = (1.0, 0.5, 0.2)  # of the multiples a team asks for, to start from
_SUMMED = 1e-6  # of their power: what directions must differ by to be told apart


@dataclass(frozen=True, kw_only=True)
class Suspect:
    """A candidate, the share of the gap it would explain, and start values, the best first."""

    candidate: Candidate
    share: float
    starts: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Team:
    """Candidates that act together, the share of the gap they would explain, and start values.

    `starts` (starts, candidates, parameters).
    """

    candidates: tuple[Candidate, ...]
    share: float
    starts: tuple[tuple[tuple[float, ...], ...], ...]

    @property
    def family(self) -> bool:
        """Is it dry friction on several carts?"""
        return all(c.effect.family for c in self.candidates)


def candidates_at(
    effect: Effect, place: int, *, runs: Sequence[Run], chain: Chain
) -> list[tuple[Candidate, tuple[float, ...]]]:
    """Return the trial sizes of an effect at a place, each side on its own."""
    scales = bench_scales(runs, chain, effect=effect, place=place)
    sizes = tuple(p.scale(scales) for p in effect.parameters)
    trials = []
    for multiples in effect.trial_points:
        sided = [(1.0, -1.0) if p.side else (1.0,) for p in effect.parameters]
        for signs in product(*sided):
            values = tuple(m * s * g for m, s, g in zip(multiples, sizes, signs, strict=True))
            candidate = Candidate(effect=effect, place=place, signs=signs, scales=sizes)
            trials.append((candidate, values))
    return trials


def screen(
    fit: Fit,
    runs: Sequence[Run],
    *,
    whole: Sequence[Run],
    springs: Sequence[bool],
    catalogue: Sequence[Effect],
    mapper: Mapper = map,
) -> tuple[list[Suspect], list[Team]]:
    """Return all suspects, one for each effect and place, and the best teams of them.

    The most telling come first. `runs` are what `fit` was fitted to (pieces or whole); `whole`
    give the typical sizes.
    """
    taken = {c.key for c in fit.structure.effects}
    families = {(c.effect.family, c.place) for c in fit.structure.effects if c.effect.family}
    chain = fit.structure.chain(fit.theta)
    trials: list[tuple[Candidate, tuple[float, ...]]] = []
    for effect in catalogue:
        if effect.grows_from or effect.only_rest:
            continue  # what grows from a simpler effect starts from that one's fit
        for place in shown_places(effect, springs, whole):
            if (effect.key, place) in taken or (effect.family, place) in families:
                continue
            trials += candidates_at(effect, place, runs=whole, chain=chain)
    signals = added_signals(fit, runs, trials, mapper=mapper)
    directions, residual = project(fit, runs, signals, mapper=mapper)
    total = float(residual @ residual)
    # A direction the model absorbs almost whole says nothing; keep rounding out of it.
    power = np.einsum("ij,ij->j", directions, directions)
    overlap = directions.T @ residual
    found: dict[tuple[str, int], list[tuple[float, int, tuple[float, ...]]]] = {}
    for at, ((candidate, values), square, dot) in enumerate(
        zip(trials, power, overlap, strict=True)
    ):
        if not np.isfinite(square) or square <= 0.0:
            continue
        first = candidate.effect.parameters[0]
        multiple = float(np.clip(dot / square, -_MOST if first.signed else 0.0, _MOST))
        share = (2.0 * multiple * dot - multiple**2 * square) / total if total > 0 else 0.0
        start = (_grown(first, values[0], multiple), *values[1:])
        found.setdefault(candidate.key, []).append((share, at, start))
    suspects, leading = [], []
    for trials_here in found.values():
        trials_here.sort(key=lambda trial: -trial[0])
        share, at, _ = trials_here[0]
        candidate = trials[at][0]
        leading.append(at)
        # Starts on the other side belong to a candidate of their own signs.
        starts = tuple(s for _, i, s in trials_here if trials[i][0].signs == candidate.signs)
        suspects.append(Suspect(candidate=candidate, share=share, starts=starts[:_STARTS]))
    teams = find_teams([trials[at] for at in leading], directions[:, leading], residual)
    return sorted(suspects, key=lambda s: -s.share), teams


def shown_places(effect: Effect, springs: Sequence[bool], runs: Sequence[Run]) -> list[int]:
    """Return the places at which an effect would show in these runs.

    A cart that is held in all of them shows nothing, and of springs that always stretch alike,
    one stands for all.
    """
    shown: dict[tuple, int] = {}
    for place in effect.places(springs):
        if effect.place == "input":
            ends: tuple[int, ...] = (1,)
        else:
            ends = (place,) if effect.place == "cart" else (place - 1, place)
        # Which of its ends move, run by run: alike only where at most one of them ever does.
        moving = tuple(
            tuple(cart for cart in ends if 1 <= cart <= len(run.free) and run.free[cart - 1])
            for run in runs
        )
        if any(moving) or effect.place == "input":
            shown.setdefault(moving if effect.place == "spring" else (place,), place)
    return list(shown.values())


def find_teams(
    trials: Sequence[tuple[Candidate, tuple[float, ...]]], directions: Array, residual: Array
) -> list[Team]:
    """Return the best effect that acts on all carts, pair of candidates, and effect beside either.

    Each pays little alone where the other is missing; their joint share is that of a least-squares
    fit of all directions.
    """
    total = float(residual @ residual)
    gram, overlap = directions.T @ directions, directions.T @ residual
    by_effect: dict[str, list[int]] = {}
    for at, (candidate, _) in enumerate(trials):
        if candidate.effect.family:
            by_effect.setdefault(candidate.effect.key, []).append(at)
    families = [tuple(members) for members in by_effect.values() if len(members) > 1]
    beside = [(*family, at) for family in families for at in set(range(len(trials))) - {*family}]
    best: list[Team] = []
    for groups in (families, combinations(range(len(trials)), 2), beside):
        teams = []
        for group in groups:
            members = [trials[at] for at in group]
            if len({(c.effect.family or c.effect.key, c.place) for c, _ in members}) < len(group):
                continue  # two laws of friction on one cart
            G, g = gram[np.ix_(group, group)], overlap[list(group)]
            if np.linalg.det(G) <= _SUMMED * np.prod(np.diag(G)):
                continue
            multiples = np.linalg.solve(G, g)
            least = [-_MOST if c.effect.parameters[0].signed else 0.0 for c, _ in members]
            multiples = np.clip(multiples, least, _MOST)
            if np.all(multiples != 0.0):
                share = float(multiples @ (2.0 * g - G @ multiples)) / total
                starts = tuple(
                    tuple(
                        (_grown(c.effect.parameters[0], values[0], part * m), *values[1:])
                        for (c, values), m in zip(members, multiples.tolist(), strict=True)
                    )
                    for part in _PARTS
                )
                candidates = tuple(c for c, _ in members)
                teams.append(Team(candidates=candidates, share=share, starts=starts))
        best += sorted(teams, key=lambda team: -team.share)[:1]
    return best


def _grown(parameter: Parameter, value: float, multiple: float) -> float:
    """Return the trial value moved to the multiple of itself that the data ask for."""
    if parameter.neutral is None:
        return value
    multiple = float(np.sign(multiple) or 1.0) * max(abs(multiple), _LEAST)
    return parameter.neutral + multiple * (value - parameter.neutral)


def added_signals(
    fit: Fit,
    runs: Sequence[Run],
    trials: Sequence[tuple[Candidate, tuple[float, ...]]],
    *,
    mapper: Mapper,
) -> list[Array]:
    """Return per run (k, rows, samples of `thin`): the change of the readings under each trial.

    A trial is a candidate with the values of its parameters; a diverged one changes nothing.
    """
    models = [fit.with_effect(candidate, values) for candidate, values in trials]

    def change(pair: tuple[Run, Nuisance]) -> Array:
        run, nuisance = pair[0].thin, pair[1]
        base = simulate_run(fit, run, nuisance)
        out = np.empty((len(trials), *base.shape))
        for at, model in enumerate(models):
            out[at] = simulate_run(model, run, nuisance) - base
        return np.where(np.isfinite(out), out, 0.0)

    return list(mapper(change, zip(runs, fit.nuisance, strict=True)))
