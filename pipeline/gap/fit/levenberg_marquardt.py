"""Fit a model to all runs at once: Levenberg-Marquardt, the nuisance parameters eliminated.

Reference: J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import Run
from pipeline.gap.fit.linearise import (
    Linear,
    Nuisance,
    fresh_nuisance,
    linearise,
    move_nuisance,
    residual_points,
    run_cost,
)
from pipeline.gap.fit.structure import Model

Mapper = Callable[..., Iterable]

_SCATTER_START = 0.05  # spread of friction from run to run, before anything is known
_SCATTER_FLOOR, _SCATTER_TOP = 0.004, 0.2
_SCATTER_PRIOR = (3.0, 0.04)  # weight in runs, and spread, of the prior on that spread
_NUISANCE_SCALES = (1.0, 0.3, 0.05)  # of a run's own step, where the whole one raises its cost
_HUGE = 1e100  # a slope, where a parameter lets the simulation run away; its square is no number
_DEAD = 1e-9  # of the strongest column: a weaker one is rounding
_ANCHOR = 1e6  # standard errors per unit of log mass
_DAMP, _RELAX, _STIFFEN, _LEAST_DAMP = 1e-3, 6.0, 6.0, 1e-9
_ATTEMPTS = 5  # at a shorter step, each six times as damped, before the fit has converged
_RELEASES = 3  # of parameters at their bounds, which are rarely more than one


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit(Model):
    """A fitted model.

    Attributes
    ----------
    covariance : (size, size) of the vector, or None before the end.
    nuisance : one for each run, in their order.
    cost : sum of squared residuals over their noise, prior terms included.
    chi_square : without the prior terms; n_points the residuals behind it.
    run_chi : (runs,) chi-square per residual of each run; run_prior its prior terms.
    """

    nuisance: tuple[Nuisance, ...]
    cost: float
    chi_square: float
    n_points: float
    run_chi: Array
    run_prior: Array
    run_points: Array
    spread: Array
    covariance: Array | None = field(default=None)

    @property
    def chi(self) -> float:
        """Chi-square per residual."""
        return self.chi_square / self.n_points


def evaluate(
    model: Model,
    runs: Sequence[Run],
    nuisance: Sequence[Nuisance],
    *,
    spread: Array,
    inflate: float = 1.0,
    mapper: Mapper = map,
) -> Fit:
    """Return the fit at given parameters, shared and nuisance, without moving either."""

    def cost(pair: tuple[Run, Nuisance]) -> tuple[float, float]:
        return run_cost(model, *pair, spread=spread)

    costs = np.array(list(mapper(cost, zip(runs, nuisance, strict=True))))
    return _fit_at(model, runs, nuisance, costs, spread=spread, inflate=inflate)


def _fit_at(
    model: Model,
    runs: Sequence[Run],
    nuisance: Sequence[Nuisance],
    costs: Array,
    *,
    spread: Array,
    inflate: float,
) -> Fit:
    points = np.array([residual_points(run) for run in runs])
    return Fit(
        structure=model.structure,
        theta=model.theta,
        nuisance=tuple(nuisance),
        cost=float(costs[:, 0].sum() + inflate**2 * costs[:, 1].sum()),
        chi_square=float(costs[:, 0].sum()),
        n_points=float(points.sum()),
        run_chi=costs[:, 0] / points,
        run_prior=costs[:, 1],
        run_points=points,
        spread=spread,
    )


def fit_model(
    start: Model,
    runs: Sequence[Run],
    *,
    nuisance: Sequence[Nuisance] | None = None,
    spread: Array | None = None,
    iterations: int = 12,
    shared: bool = True,
    scatter_free: bool = True,
    learn_spread: bool = False,
    tolerance: float = 1e-3,
    mapper: Mapper = map,
) -> Fit:
    """Fit the shared parameters and every run's nuisance parameters.

    Parameters
    ----------
    start : where to begin; without `shared` it stays, and only nuisance parameters move.
    spread : (n,) expected spread of the dry friction from run to run; learnt if `learn_spread`.
    tolerance : relative fall of the cost below which the fit has converged.
    """
    structure = start.structure
    low, high = structure.bounds()
    best = evaluate(
        Model(structure=structure, theta=np.clip(start.theta, low, high)),
        runs,
        [fresh_nuisance(run) for run in runs] if nuisance is None else nuisance,
        spread=np.full(structure.n, _SCATTER_START) if spread is None else spread,
        mapper=mapper,
    )
    damp = _DAMP
    for iteration in range(iterations):
        inflate = inflation(best)
        best = replace(best, cost=best.chi_square + inflate**2 * float(best.run_prior.sum()))
        linear = _linearise_all(
            best, runs, inflate=inflate, scatter_free=scatter_free, shared=shared, mapper=mapper
        )
        reduced = [part.reduced for part in linear]
        stacked = np.concatenate([*reduced, anchor(runs, reduced[0].shape[1] - 1)])
        if not np.all(np.abs(stacked) < _HUGE):
            break
        for _attempt in range(_ATTEMPTS):
            delta = _step(stacked, best.theta, low, high, reach=structure.reach(), damp=damp)
            trial = _follow(best, runs, linear, delta, inflate=inflate, mapper=mapper)
            if trial.cost < best.cost:
                break
            damp = max(damp * _STIFFEN, _DAMP)
        else:
            break
        fall = (best.cost - trial.cost) / best.cost
        best = trial
        damp = max(damp / _RELAX, _LEAST_DAMP)
        if learn_spread and iteration >= 1:
            best = _learn_spread(best, runs, linear)
        if fall < tolerance:
            break
    return best


def inflation(fit: Fit) -> float:
    """Return by how much the misfit of a model that is still wrong widens the noise."""
    return max(1.0, float(np.sqrt(fit.chi))) if np.isfinite(fit.chi) else 1.0


def _linearise_all(
    fit: Fit,
    runs: Sequence[Run],
    *,
    inflate: float,
    scatter_free: bool = True,
    shared: bool = True,
    mapper: Mapper,
) -> list[Linear]:
    """Return every run's share of a step from a fit."""

    def share(job: tuple[Run, Nuisance]) -> Linear:
        run, nuisance = job
        return linearise(
            fit,
            run,
            nuisance,
            inflate=inflate,
            spread=fit.spread,
            scatter_free=scatter_free,
            shared=shared,
        )

    return list(mapper(share, zip(runs, fit.nuisance, strict=True)))


def _step(
    stacked: Array, theta: Array, low: Array, high: Array, *, reach: Array, damp: float
) -> Array:
    """Return the damped step of the shared parameters, inside their bounds and their reach.

    `stacked` (rows, moving + 1) has the Jacobian and the residual; with nothing moving it is 0.
    """
    J, r = stacked[:, :-1], stacked[:, -1]
    delta = np.zeros(theta.size)
    active = np.arange(J.shape[1])
    for _ in range(_RELEASES):
        if active.size == 0:
            break
        scale = np.linalg.norm(J[:, active], axis=0)
        scale = np.maximum(scale, _DEAD * max(1e-30, scale.max()))
        A = np.concatenate([J[:, active], np.diag(np.sqrt(damp) * scale)])
        step = np.linalg.lstsq(A, np.concatenate([r, np.zeros(active.size)]), rcond=None)[0]
        # At a bound, with the step pointing outward, a parameter stays.
        at = theta[active]
        out = (at + step <= low[active]) & (at <= low[active])
        out |= (at + step >= high[active]) & (at >= high[active])
        if not out.any():
            delta[active] = step
            break
        active = active[~out]
    # One long step must not carry the others with it: each is clipped by itself.
    delta = np.clip(delta, -reach, reach)
    return np.clip(theta + delta, low, high) - theta


def _follow(
    fit: Fit,
    runs: Sequence[Run],
    linear: Sequence[Linear],
    delta: Array,
    *,
    inflate: float,
    mapper: Mapper,
) -> Fit:
    """Return the fit after a step, the nuisance parameters moved with it.

    Less far in a run where that is no gain.
    """
    model = Model(structure=fit.structure, theta=fit.theta + delta)

    def move(job: tuple[Linear, Run, Nuisance, float]) -> tuple[Nuisance, tuple[float, float]]:
        part, run, nuisance, before = job
        tried = []
        for scale in _NUISANCE_SCALES:
            moved = move_nuisance(part, nuisance, delta[: part.reduced.shape[1] - 1], scale)
            cost = run_cost(model, run, moved, spread=fit.spread)
            tried.append((cost[0] + inflate**2 * cost[1], moved, cost))
            if tried[-1][0] <= before:
                break
        _, moved, cost = min(tried, key=lambda t: t[0])
        return moved, cost

    before = fit.run_chi * fit.run_points + inflate**2 * fit.run_prior
    moved = list(mapper(move, zip(linear, runs, fit.nuisance, before, strict=True)))
    return _fit_at(
        model,
        runs,
        [nuisance for nuisance, _ in moved],
        np.array([cost for _, cost in moved]),
        spread=fit.spread,
        inflate=inflate,
    )


def anchor(runs: Sequence[Run], size: int) -> Array:
    """Return a row that holds the first free mass where no input gives forces a scale."""
    if any(np.any(run.command) for run in runs):
        return np.zeros((0, size + 1))
    if not size:
        return np.zeros((0, 1))
    row = np.zeros((1, size + 1))
    row[0, int(np.argmax(np.any([run.free for run in runs], axis=0)))] = _ANCHOR
    return row


def _learn_spread(fit: Fit, runs: Sequence[Run], linear: Sequence[Linear]) -> Fit:
    """Learn how much the friction of each cart varies."""
    spread = fit.spread.copy()
    factors = np.array([nuisance.scatter for nuisance in fit.nuisance])
    noise = max(1.0, fit.chi)
    for i, dry in enumerate(fit.structure.dry):
        if not dry:
            continue
        there = [
            (r, linear[r].layout.scatter.index(i))
            for r, run in enumerate(runs)
            if i in linear[r].layout.scatter
        ]
        if not there:
            continue
        weight, prior = _SCATTER_PRIOR
        total = weight * prior**2
        for r, j in there:
            column = linear[r].run_wide[j, j]
            variance = min(noise / column**2 if column else np.inf, spread[i] ** 2)
            total += (factors[r, i] - 1.0) ** 2 + variance
        spread[i] = np.clip(np.sqrt(total / (len(there) + weight)), _SCATTER_FLOOR, _SCATTER_TOP)
    return replace(fit, spread=spread)
