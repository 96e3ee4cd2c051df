"""Search where the misfit has many valleys: contacts and hidden masses, from many starts.

Trial values are scattered about the best so far, ever closer (a cross-entropy search); what the
model would absorb of each is projected off, so only the effect itself is searched.

Reference: R. Y. Rubinstein, Methodology and Computing in Applied Probability 1 (1999), 127-190.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import Run
from pipeline.gap.fit.levenberg_marquardt import Fit, Mapper, evaluate, fit_model, project
from pipeline.gap.search.screen import Suspect, added_signals

_ELITE, _SCATTERED = 5, 32
_WIDE = (0.6, 0.35, 0.2, 0.1)  # spread of the trials, in logarithms or scales
_CYCLE = ((0.15, 0.1, 0.06, 0.03), (0.05, 0.03, 0.02, 0.01), (0.02, 0.01, 0.01, 0.005))
_MOST_CYCLES = 2
_REFITTED = 3  # of the best trials of a round


def zoom(
    fit: Fit,
    runs: Sequence[Run],
    suspect: Suspect,
    *,
    widths: Sequence[float] = _WIDE,
    seed: int = 0,
    mapper: Mapper = map,
) -> Suspect:
    """Return the suspect with better starts for the effect it would add to a fit.

    The same `seed` scatters the same way: a verdict must not depend on chance.
    """
    rng = np.random.default_rng(seed)
    candidate = suspect.candidate
    signed = np.array([p.signed for p in candidate.effect.parameters])
    scales = np.array(candidate.scales)
    elite = [np.array(start) for start in suspect.starts[:_ELITE]]
    best: list[tuple[float, Array]] = []
    for width in widths:
        trials = [*elite] if not best else []
        for _ in range(_SCATTERED):
            value = elite[rng.integers(len(elite))]
            step = width * rng.standard_normal(value.size)
            trials.append(np.where(signed, value + step * scales, value * np.exp(step)))
        signals = added_signals(fit, runs, [(candidate, tuple(v)) for v in trials], mapper=mapper)
        directions, residual = project(fit, runs, signals, mapper=mapper)
        costs = ((residual[:, None] - directions) ** 2).sum(axis=0)
        best += [(float(cost), value) for cost, value in zip(costs, trials, strict=True)]
        best.sort(key=lambda pair: pair[0])
        elite = [value for _, value in best[:_ELITE]]
    starts = tuple(tuple(float(v) for v in value) for value in elite)
    return Suspect(candidate=candidate, share=suspect.share, starts=starts)


def polish(fit: Fit, runs: Sequence[Run], *, enough: float, mapper: Mapper = map) -> Fit:
    """Return a better fit near one whose last effect is a contact.

    Each bounce depends on the one before, so the slope leads into the nearest of many narrow
    valleys. The effect's values are scattered about the fit, wide and close in turn, until its
    chi-square per point is `enough` or a whole cycle brings nothing.
    """
    index = len(fit.structure.effects) - 1
    candidate = fit.structure.effects[index]
    for cycle in range(_MOST_CYCLES):
        before = fit.cost
        for at, widths in enumerate(_CYCLE):
            if fit.chi < enough:
                return fit
            base = fit.without(index)
            bare = evaluate(base, runs, fit.nuisance, spread=fit.spread, mapper=mapper)
            values = fit.terms[index].values
            here = Suspect(candidate=candidate, share=1.0, starts=(values,))
            seed = 1 + cycle * len(_CYCLE) + at
            there = zoom(bare, runs, here, widths=widths, seed=seed, mapper=mapper)
            trials = []
            for start in there.starts[:_REFITTED]:
                model = bare.with_effect(candidate, start)
                trials.append(
                    fit_model(
                        model,
                        runs,
                        nuisance=fit.nuisance,
                        spread=fit.spread,
                        iterations=8,
                        tolerance=1e-4,
                        mapper=mapper,
                    )
                )
            fit = min([fit, *trials], key=lambda f: f.chi_square)
        if fit.cost >= before:
            break
    return fit
