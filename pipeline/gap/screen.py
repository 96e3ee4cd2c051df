"""Rank every effect at every place by how much of the gap it would explain.

An output-error score test: each effect is simulated at a few trial sizes beside the fitted
model; what the model could absorb (its parameters, every run's own unknowns) is projected off,
and the best multiple of what is left is subtracted from the residual.

Reference: T. Söderström, P. Stoica, System Identification, section 11.5 (score tests).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from pipeline.gap.fit import Fit, Mapper, project
from pipeline.gap.linearise import Locals, simulate_run
from pipeline.gap.runs import Run
from pipeline.gap.structure import Candidate, Structure, bench_scales
from pipeline.plant.chain import Array, Chain
from pipeline.plant.effects.base import Effect, Parameter

_MOST = 3.0  # a multiple beyond this is no longer what was simulated
_LEAST = 0.1  # … and one below starts a fit where it has no slope
_STARTS = 8


@dataclass(frozen=True, kw_only=True)
class Suspect:
    """A candidate, the share of the gap it would explain, and start values, the best first."""

    candidate: Candidate
    share: float
    starts: tuple[tuple[float, ...], ...]


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
    skip: Sequence[str] = ("force_offset",),
    mapper: Mapper = map,
) -> list[Suspect]:
    """Return all suspects, the most telling first; one for each effect and place.

    `runs` are what `fit` was fitted to (pieces or whole); `whole` give the typical sizes.
    """
    taken = {c.key for c in fit.structure.effects}
    dry = {c.place for c in fit.structure.effects if c.effect.family == "dry friction"}
    chain = fit.structure.chain(fit.theta)
    trials: list[tuple[Candidate, tuple[float, ...]]] = []
    for effect in catalogue:
        if effect.grows_from or effect.key in skip:
            continue  # what grows from a simpler effect starts from that one's fit
        for place in effect.places(springs):
            if (effect.key, place) in taken or (effect.family == "dry friction" and place in dry):
                continue
            trials += candidates_at(effect, place, runs=whole, chain=chain)
    signals = added_signals(fit, runs, trials, mapper=mapper)
    directions, residual = project(fit, runs, signals, mapper=mapper)
    total = float(residual @ residual)
    # A direction the model absorbs almost whole says nothing; keep rounding out of it.
    power = np.einsum("ij,ij->j", directions, directions)
    overlap = directions.T @ residual
    found: dict[tuple[str, int], list[tuple[float, Candidate, tuple[float, ...]]]] = {}
    for (candidate, values), square, dot in zip(trials, power, overlap, strict=True):
        if not np.isfinite(square) or square <= 0.0:
            continue
        first = candidate.effect.parameters[0]
        multiple = float(np.clip(dot / square, -_MOST if first.signed else 0.0, _MOST))
        share = (2.0 * multiple * dot - multiple**2 * square) / total if total > 0 else 0.0
        start = (_grown(first, values[0], multiple), *values[1:])
        found.setdefault(candidate.key, []).append((share, candidate, start))
    suspects = []
    for trials_here in found.values():
        trials_here.sort(key=lambda trial: -trial[0])
        share, candidate, _ = trials_here[0]
        # Starts on the other side belong to a candidate of their own signs.
        starts = tuple(start for _, c, start in trials_here if c.signs == candidate.signs)
        suspects.append(Suspect(candidate=candidate, share=share, starts=starts[:_STARTS]))
    return sorted(suspects, key=lambda s: -s.share)


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
    vectors = [(fit.structure.with_effect(candidate), values) for candidate, values in trials]

    def change(pair: tuple[Run, Locals]) -> Array:
        run, own = pair[0].thin, pair[1]
        base = simulate_run(fit.structure, fit.theta[None], run, own)[0]
        out = np.empty((len(trials), *base.shape))
        for at, (structure, values) in enumerate(vectors):
            theta = _extended(structure, fit.theta, values)
            out[at] = simulate_run(structure, theta[None], run, own)[0] - base
        return np.where(np.isfinite(out), out, 0.0)

    return list(mapper(change, zip(runs, fit.locals_, strict=True)))


def _extended(structure: Structure, theta: Array, values: Sequence[float]) -> Array:
    """Return theta with the coordinates of one further effect."""
    candidate = structure.effects[-1]
    coordinates = [
        v / scale if p.signed else np.log(max(abs(v), 1e-7 * scale))
        for p, v, scale in zip(candidate.effect.parameters, values, candidate.scales, strict=True)
    ]
    return np.concatenate([theta, coordinates])


def extend(fit: Fit, candidate: Candidate, values: Sequence[float]) -> tuple[Structure, Array]:
    """Return structure and start vector of a fit with an effect added."""
    structure = fit.structure.with_effect(candidate)
    return structure, _extended(structure, fit.theta, values)
