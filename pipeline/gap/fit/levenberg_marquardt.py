"""Fit a model to all runs at once: Levenberg-Marquardt, with each run's own unknowns eliminated.

Reference: J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.gap.data.runs import Run
from pipeline.gap.fit.linearise import (
    Linear,
    Locals,
    fresh_locals,
    linearise,
    move_locals,
    residual_points,
    run_cost,
    triangle,
)
from pipeline.gap.fit.structure import Structure
from pipeline.plant.chain import Array

Mapper = Callable[..., Iterable]

_SCATTER_START = 0.05  # spread of friction from run to run, before anything is known
_SCATTER_FLOOR, _SCATTER_TOP = 0.004, 0.2
_SCATTER_PRIOR = (3.0, 0.04)  # weight in runs, and spread, of the prior on that spread
_LOCAL_SCALES = (1.0, 0.3, 0.05)  # of a run's own step, where the whole one raises its cost
_SHOWN = 3e-4  # of a column: two that differ by less differ by their difference steps
_DEAD = 1e-9  # of the strongest column: a weaker one is rounding
_ANCHOR = 1e6  # standard errors per unit of log mass
_DAMP, _RELAX, _STIFFEN = 1e-3, 6.0, 6.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A fitted model.

    Attributes
    ----------
    theta : the vector of `structure`; covariance (size, size) of it, or None before the end.
    locals_ : one for each run, in their order.
    cost : sum of squared residuals over their noise, prior terms included.
    chi_square : without the prior terms; n_points the residuals behind it.
    run_chi : (runs,) chi-square per residual of each run; run_prior its prior terms.
    """

    structure: Structure
    theta: Array
    locals_: tuple[Locals, ...]
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
    structure: Structure,
    theta: Array,
    runs: Sequence[Run],
    locals_: Sequence[Locals],
    *,
    spread: Array,
    inflate: float = 1.0,
    mapper: Mapper = map,
) -> Fit:
    """Return the fit at given parameters and locals, without moving either."""

    def cost(pair: tuple[Run, Locals]) -> tuple[float, float]:
        return run_cost(structure, theta, *pair, spread=spread)

    costs = np.array(list(mapper(cost, zip(runs, locals_, strict=True))))
    return _fit_at(structure, theta, runs, locals_, costs, spread=spread, inflate=inflate)


def _fit_at(
    structure: Structure,
    theta: Array,
    runs: Sequence[Run],
    locals_: Sequence[Locals],
    costs: Array,
    *,
    spread: Array,
    inflate: float,
) -> Fit:
    points = np.array([residual_points(run) for run in runs])
    return Fit(
        structure=structure,
        theta=theta,
        locals_=tuple(locals_),
        cost=float(costs[:, 0].sum() + inflate**2 * costs[:, 1].sum()),
        chi_square=float(costs[:, 0].sum()),
        n_points=float(points.sum()),
        run_chi=costs[:, 0] / points,
        run_prior=costs[:, 1],
        run_points=points,
        spread=spread,
    )


def fit_model(
    structure: Structure,
    theta: Array,
    runs: Sequence[Run],
    *,
    locals_: Sequence[Locals] | None = None,
    spread: Array | None = None,
    iterations: int = 12,
    shared: bool = True,
    scatter_free: bool = True,
    learn_spread: bool = False,
    tolerance: float = 1e-3,
    mapper: Mapper = map,
) -> Fit:
    """Fit the shared parameters and every run's own unknowns.

    Parameters
    ----------
    theta : (size,) start; without `shared` it stays, and only the runs' own unknowns move.
    spread : (n,) expected spread of the dry friction from run to run; learnt if `learn_spread`.
    tolerance : relative fall of the cost below which the fit has converged.
    """
    low, high = structure.bounds()
    reach = structure.reach()
    theta = np.clip(theta, low, high)
    own = tuple(locals_) if locals_ is not None else tuple(fresh_locals(run) for run in runs)
    spread = np.full(structure.n, _SCATTER_START) if spread is None else spread
    moving = np.arange(theta.size if shared else 0)
    damp = _DAMP
    inflate = 1.0
    best = evaluate(structure, theta, runs, own, spread=spread, inflate=inflate, mapper=mapper)
    for iteration in range(iterations):
        inflate = max(1.0, np.sqrt(best.chi)) if np.isfinite(best.chi) else 1.0
        best = replace(best, cost=best.chi_square + inflate**2 * float(best.run_prior.sum()))

        def share(pair: tuple[Run, Locals], at: Fit = best, inflate: float = inflate) -> Linear:
            return linearise(
                structure,
                at.theta,
                *pair,
                inflate=inflate,
                spread=at.spread,
                scatter_free=scatter_free,
                shared=shared,
            )

        linear = list(mapper(share, zip(runs, best.locals_, strict=True)))
        stacked = np.concatenate([*(part.reduced for part in linear), _anchor(runs, moving.size)])
        if not np.all(np.isfinite(stacked)):
            break
        J, r = stacked[:, :-1], stacked[:, -1]
        # At a bound, with the step pointing outward, a parameter stays.
        delta = np.zeros(theta.size)
        active = moving
        accepted: Fit | None = None
        for _attempt in range(5):
            delta[:] = 0.0
            active = moving
            for _ in range(3):
                if active.size == 0:
                    break
                scale = np.linalg.norm(J[:, active], axis=0)
                scale = np.maximum(scale, 1e-9 * max(1e-30, scale.max()))
                A = np.concatenate([J[:, active], np.diag(np.sqrt(damp) * scale)])
                step = np.linalg.lstsq(A, np.concatenate([r, np.zeros(active.size)]), rcond=None)[0]
                out = (best.theta[active] + step <= low[active]) & (
                    best.theta[active] <= low[active]
                )
                out |= (best.theta[active] + step >= high[active]) & (
                    best.theta[active] >= high[active]
                )
                if not out.any():
                    delta[active] = step
                    break
                active = active[~out]
            # One long step must not carry the others with it: each is clipped by itself.
            delta = np.clip(delta, -reach, reach)
            delta = np.clip(best.theta + delta, low, high) - best.theta
            there = best.theta + delta

            def follow(
                job: tuple[Linear, Run, Locals, float],
                at: Fit = best,
                delta: Array = delta,
                there: Array = there,
                inflate: float = inflate,
            ) -> tuple[Locals, tuple[float, float]]:
                """Move a run's own unknowns with the step, less far where that is no gain."""
                part, run, own, before = job
                tried = []
                for scale in _LOCAL_SCALES:
                    moved = move_locals(part, own, delta[moving], scale)
                    cost = run_cost(structure, there, run, moved, spread=at.spread)
                    tried.append((cost[0] + inflate**2 * cost[1], moved, cost))
                    if tried[-1][0] <= before:
                        break
                _, moved, cost = min(tried, key=lambda t: t[0])
                return moved, cost

            before = best.run_chi * best.run_points + inflate**2 * best.run_prior
            followed = list(mapper(follow, zip(linear, runs, best.locals_, before, strict=True)))
            trial = _fit_at(
                structure,
                there,
                runs,
                [moved for moved, _ in followed],
                np.array([cost for _, cost in followed]),
                spread=best.spread,
                inflate=inflate,
            )
            if trial.cost < best.cost:
                accepted = trial
                break
            damp *= _STIFFEN
            damp = max(damp, 1e-3)
        if accepted is None:
            break
        fall = (best.cost - accepted.cost) / best.cost
        best = accepted
        damp = max(damp / _RELAX, 1e-9)
        if learn_spread and iteration >= 1:
            best = _learn_spread(best, runs, linear)
        if fall < tolerance:
            break
    return best


def _anchor(runs: Sequence[Run], size: int) -> Array:
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
    factors = np.array([own.scatter for own in fit.locals_])
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
            column = linear[r].own[j, j]
            variance = min(noise / column**2 if column else np.inf, spread[i] ** 2)
            total += (factors[r, i] - 1.0) ** 2 + variance
        spread[i] = np.clip(np.sqrt(total / (len(there) + weight)), _SCATTER_FLOOR, _SCATTER_TOP)
    return replace(fit, spread=spread)


def project(
    fit: Fit, runs: Sequence[Run], extras: Sequence[Array], *, mapper: Mapper = map
) -> tuple[Array, Array]:
    """Project changes of the readings off everything the fit can absorb.

    Parameters
    ----------
    extras : per run (k, rows, samples of `thin`): what k further effects would add to its readings.

    Returns
    -------
    (rows, k) what is left of them, and (rows,) what is left of the residual.
    """
    inflate = max(1.0, np.sqrt(fit.chi))

    def share(job: tuple[Run, Locals, Array]) -> Linear:
        run, own, extra = job
        return linearise(
            fit.structure,
            fit.theta,
            run,
            own,
            inflate=inflate,
            spread=fit.spread,
            scatter_free=True,
            extras=extra,
        )

    linear = list(mapper(share, zip(runs, fit.locals_, extras, strict=True)))
    stacked = np.concatenate([part.reduced for part in linear])
    shared, wide = stacked[:, : fit.theta.size], stacked[:, fit.theta.size :]
    if not np.all(np.isfinite(shared)):
        return np.full_like(wide[:, :-1], np.nan), wide[:, -1]  # no direction leads on from here
    # What no run shows, a held cart's mass or the share of two springs that act as one, absorbs
    # nothing.
    scale = np.linalg.norm(shared, axis=0)
    shared = shared / np.maximum(scale, _DEAD * scale.max())
    basis, power, _ = np.linalg.svd(shared, full_matrices=False)
    basis = basis[:, power > _SHOWN]
    left = triangle(wide - basis @ (basis.T @ wide))
    return left[:, :-1], left[:, -1]


def covariance(fit: Fit, runs: Sequence[Run], *, mapper: Mapper = map) -> Fit:
    """Return the fit with the covariance of its parameters, scaled by its own misfit.

    Where friction was fitted with one size for all runs, its spread is no part of the error.
    """
    scatter_free = any(np.any(own.scatter != 1.0) for own in fit.locals_)

    def share(pair: tuple[Run, Locals]) -> Linear:
        return linearise(
            fit.structure,
            fit.theta,
            *pair,
            inflate=max(1.0, np.sqrt(fit.chi)),
            spread=fit.spread,
            scatter_free=scatter_free,
        )

    linear = list(mapper(share, zip(runs, fit.locals_, strict=True)))
    parts = [*(part.reduced for part in linear), _anchor(runs, fit.theta.size)]
    J = np.concatenate(parts)[:, :-1]
    if not np.all(np.isfinite(J)):
        return fit
    _, s, vt = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-9 * s[0])
    cov = (vt.T / s**2) @ vt * max(1.0, fit.chi)
    return replace(fit, covariance=cov)
