"""Restart the worst runs with other rest positions in the friction band."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.levenberg_marquardt import Fitting, GapFit, Mapper, evaluate, fit_model
from pipeline.gap.fit.linearise import Nuisance, residual_points
from pipeline.plant.simulator.laws import hysteresis, sliding, stribeck
from pipeline.plant.simulator.tables import Drive, Tables

_BAD_RUN, _BAD_SHARE = 1.5, 2.0  # limits of a run's chi-square: absolute, and times the median
_RESTARTS = ((0.8, 1.0), (-0.8, 1.0), (1.6, 1.0), (-1.6, 1.0), (0.0, 0.94), (0.0, 1.06))


def restart_runs(fit: GapFit, runs: Sequence[GapRun], mapper: Mapper) -> GapFit:
    """Restart the worst runs' nuisance parameters at other rest positions of the carts.

    A cart may rest anywhere inside the band of friction or cogging, and its encoder is zeroed at
    this rest. So the misfit of a run has several local minima over encoder zero and friction. The
    shared parameters stay the same.
    """
    if not fit.structure.many_rests:
        return fit
    worst = fit.run_chi > max(_BAD_RUN, _BAD_SHARE * float(np.median(fit.run_chi)))
    band = _rest_band(fit)
    rest = np.array(fit.structure.dry)

    def again(run: GapRun, start: Nuisance) -> GapFit:
        how = Fitting(shared=False, iterations=6)
        return fit_model(replace(fit, nuisance=(start,)), [run], how)

    def starts(run: GapRun, own: Nuisance) -> Iterator[Nuisance]:
        free = np.array(run.free)
        for shift, factor in _RESTARTS:
            move = np.where(free, shift * band, 0.0)
            yield Nuisance(
                x0=own.x0 - np.append(move, np.zeros(move.size)) if run.at_rest else own.x0,
                v0=own.v0,
                zero=np.where(free, run.zero, 0.0) + move,
                scatter=np.where(rest & free, factor, 1.0),
            )

    nuisance, bad = list(fit.nuisance), np.flatnonzero(worst).tolist()
    lowest = [chi * residual_points(run) for run, chi in zip(runs, fit.run_chi, strict=True)]
    trials = [(r, start) for r in bad for start in starts(runs[r], nuisance[r])]
    fits = mapper(again, [runs[r] for r, _ in trials], [start for _, start in trials])
    for (r, _), trial in zip(trials, fits, strict=True):
        if trial.chi_square < lowest[r]:
            nuisance[r], lowest[r] = trial.nuisance[0], trial.chi_square
    return evaluate(fit, runs, nuisance, spread=fit.spread, inflate=fit.inflation, mapper=mapper)


def _rest_band(fit: GapFit) -> Array:
    """Return how far (n,) from its springs' equilibrium each cart usually rests."""
    chain = fit.structure.chain(fit.theta)
    force = holding_force(fit.tables)
    if not np.any(chain.k > 0):
        return np.zeros(chain.n)
    compliance = np.abs(np.linalg.pinv(chain.stiffness))
    return np.sqrt(((0.5 * compliance * force) ** 2).sum(axis=1))


def holding_force(tables: Tables) -> Array:
    """Return the largest force (n,) that friction or cogging can hold on each cart."""
    cart, _, drive = tables
    dry = [sliding(cart, i, 0.0) + stribeck(cart, i, 0.0, 0.0) for i in range(len(cart))]
    force = np.array(dry) + [hysteresis(cart, i, 0.0)[0] for i in range(len(cart))]
    force[0] += drive[Drive.COGGING_FORCE]
    return force
