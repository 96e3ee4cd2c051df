"""Fit a model to all runs at once: Levenberg-Marquardt, with the nuisance parameters eliminated.

Reference: J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.bounded import bounded_step
from pipeline.gap.fit.linearise import (
    Linear,
    Nuisance,
    fresh_nuisance,
    layout_of,
    linearise,
    move_nuisance,
    nuisance_step,
    residual_points,
    run_cost,
)
from pipeline.gap.fit.structure import GapModel

Mapper = Callable[..., Iterable]

_SCATTER_FLOOR, _SCATTER_TOP = 0.004, 0.2
_DAMP, _RELAX, _STIFFEN, _LEAST_DAMP = 1e-3, 6.0, 6.0, 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class GapFit(GapModel):
    """A fitted model.

    Attributes
    ----------
    covariance : covariance (size, size) of the parameter vector; None before the search ends.
    nuisance : the nuisance parameters of each run, in the order of the runs.
    cost : sum of squares of residuals in units of the noise, with prior terms.
    chi_square : the cost without prior terms.
    n_points : the number of residuals.
    run_chi : chi-square per residual (runs,) of each run.
    run_prior : prior terms (runs,) of each run.
    run_points : number of residuals (runs,) of each run.
    spread : relative standard deviation (n,), from run to run, of each cart's dry friction.
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

    @property
    def inflation(self) -> float:
        """Factor on the noise, at least 1, that makes it as large as the misfit."""
        return max(1.0, float(np.sqrt(self.chi))) if np.isfinite(self.chi) else 1.0

    @property
    def scattered(self) -> bool:
        """Whether dry friction differs between the runs."""
        return any(bool(np.any(nuisance.scatter != 1.0)) for nuisance in self.nuisance)

    @property
    def without_nuisance(self) -> GapModel:
        """The model without nuisance parameters: each run then starts at its expected state."""
        return GapModel(structure=self.structure, theta=self.theta)


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """Options of a fit.

    Attributes
    ----------
    mapper : a function that maps another function over the runs.
    iterations : the largest number of iterations.
    tolerance : relative decrease of the cost below which the fit has converged.
    shared : whether the shared parameters are fitted. If not, only the parameters of single runs
        are.
    scatter_free : whether dry friction may differ between runs.
    learn_spread : whether the size of the differences in friction is estimated too.
    """

    mapper: Mapper = map
    iterations: int = 12
    tolerance: float = 1e-3
    shared: bool = True
    scatter_free: bool = True
    learn_spread: bool = False


def evaluate(
    model: GapModel,
    runs: Sequence[GapRun],
    nuisance: Sequence[Nuisance],
    *,
    spread: Array,
    inflate: float = 1.0,
    mapper: Mapper = map,
) -> GapFit:
    """Return the fit at given shared and nuisance parameters, without changing them."""

    def cost(pair: tuple[GapRun, Nuisance]) -> tuple[float, float]:
        return run_cost(model, *pair, spread=spread)

    costs = np.array(list(mapper(cost, zip(runs, nuisance, strict=True))))
    return _fit_at(model, runs, nuisance, costs, spread=spread, inflate=inflate)


def _fit_at(
    model: GapModel,
    runs: Sequence[GapRun],
    nuisance: Sequence[Nuisance],
    costs: Array,
    *,
    spread: Array,
    inflate: float,
) -> GapFit:
    points = np.array([residual_points(run) for run in runs])
    return GapFit(
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


def fit_model(start: GapModel, runs: Sequence[GapRun], how: Fitting) -> GapFit:
    """Fit the shared parameters and every run's nuisance parameters.

    `start` is the initial point. If it is a fit of the same runs, its nuisance parameters are used
    too.
    """
    structure = start.structure
    low, high = structure.bounds()
    bounds = low, high, structure.largest_step()
    goes_on = start if isinstance(start, GapFit) else None
    # At first, friction is assumed to differ by 5 % between runs.
    best = evaluate(
        GapModel(structure=structure, theta=np.clip(start.theta, low, high)),
        runs,
        goes_on.nuisance if goes_on else [fresh_nuisance(run) for run in runs],
        spread=goes_on.spread if goes_on else np.full(structure.n, 0.05),
        mapper=how.mapper,
    )
    damp = _DAMP
    for iteration in range(how.iterations):
        inflate = best.inflation
        best = replace(best, cost=best.chi_square + inflate**2 * float(best.run_prior.sum()))
        linear = _linearise_all(best, runs, how)
        reduced = [part.reduced for part in linear]
        stacked = np.concatenate([*reduced, anchor(runs, reduced[0].shape[1] - 1)])
        # If the simulation diverges, the square of its slope is not a number.
        if not np.all(np.abs(stacked) < 1e100):
            break
        # Each attempt has six times the damping of the last one, and so a shorter step. If none
        # reduces the cost, the fit has converged.
        for _attempt in range(5):
            delta = _step(stacked, best.theta, bounds, damp=damp)
            trial = _follow(best, runs, linear, delta, how)
            if trial.cost < best.cost:
                break
            damp = max(damp * _STIFFEN, _DAMP)
        else:
            break
        fall = (best.cost - trial.cost) / best.cost
        best = trial
        damp = max(damp / _RELAX, _LEAST_DAMP)
        if how.learn_spread and iteration >= 1:
            best = _learn_spread(best, runs, linear)
        if fall < how.tolerance:
            break
    return best


def _linearise_all(fit: GapFit, runs: Sequence[GapRun], how: Fitting) -> list[Linear]:
    """Return the contribution of every run to a step."""

    def share(job: tuple[GapRun, Nuisance]) -> Linear:
        run, nuisance = job
        free, shared = how.scatter_free, how.shared
        layout = layout_of(fit.structure, run.thin, scatter_free=free, shared=shared)
        return linearise(fit, run, nuisance, layout, inflate=fit.inflation, spread=fit.spread)

    return list(how.mapper(share, zip(runs, fit.nuisance, strict=True)))


def _step(
    stacked: Array, theta: Array, bounds: tuple[Array, Array, Array], *, damp: float
) -> Array:
    """Return the damped step of the shared parameters, within their bounds and step limits.

    `stacked` (rows, moving + 1) holds the Jacobian and the residual. If no parameter moves, the
    step is 0.
    """
    J, r = stacked[:, :-1], stacked[:, -1]

    def solve(active: np.ndarray) -> Array:
        scale = np.linalg.norm(J[:, active], axis=0)
        # A column below this share of the strongest one is rounding error.
        scale = np.maximum(scale, 1e-9 * max(1e-30, scale.max()))
        A = np.concatenate([J[:, active], np.diag(np.sqrt(damp) * scale)])
        right = np.concatenate([r, np.zeros(active.size)])
        return np.asarray(np.linalg.lstsq(A, right, rcond=None)[0], dtype=np.float64)

    # Three rounds are enough: more than one parameter is rarely at its bound.
    return bounded_step(theta, bounds, np.arange(J.shape[1]), solve=solve, rounds=3)


def _follow(
    fit: GapFit, runs: Sequence[GapRun], linear: Sequence[Linear], delta: Array, how: Fitting
) -> GapFit:
    """Return the fit after a step of the shared parameters, with nuisance parameters adjusted.

    If the cost of a run would rise, its nuisance parameters move less far.
    """
    model, inflate = GapModel(structure=fit.structure, theta=fit.theta + delta), fit.inflation

    def move(job: tuple[Linear, GapRun, Nuisance, float]) -> tuple[Nuisance, tuple[float, float]]:
        part, run, nuisance, before = job
        tried, step = [], nuisance_step(part, delta[: part.reduced.shape[1] - 1])
        # Shares of the run's own step, tried until its cost does not rise.
        for scale in (1.0, 0.3, 0.05):
            moved = move_nuisance(part.layout, nuisance, step, scale)
            cost = run_cost(model, run, moved, spread=fit.spread)
            tried.append((cost[0] + inflate**2 * cost[1], moved, cost))
            if tried[-1][0] <= before:
                break
        _, moved, cost = min(tried, key=lambda t: t[0])
        return moved, cost

    before = fit.run_chi * fit.run_points + inflate**2 * fit.run_prior
    moved = list(how.mapper(move, zip(linear, runs, fit.nuisance, before, strict=True)))
    return _fit_at(
        model,
        runs,
        [nuisance for nuisance, _ in moved],
        np.array([cost for _, cost in moved]),
        spread=fit.spread,
        inflate=inflate,
    )


def anchor(runs: Sequence[GapRun], size: int) -> Array:
    """Return an equation that fixes the first free mass if no input sets the scale of forces."""
    if any(np.any(run.command) for run in runs):
        return np.zeros((0, size + 1))
    if not size:
        return np.zeros((0, 1))
    row = np.zeros((1, size + 1))
    # Its weight is a million standard errors per unit of log mass.
    row[0, int(np.argmax(np.any([run.free for run in runs], axis=0)))] = 1e6
    return row


def _learn_spread(fit: GapFit, runs: Sequence[GapRun], linear: Sequence[Linear]) -> GapFit:
    """Estimate how much each cart's friction differs from run to run."""
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
        weight, prior = 3.0, 0.04  # the prior counts as three runs with a spread of 4 %
        total = weight * prior**2
        for r, j in there:
            column = linear[r].run_wide[j, j]
            variance = min(noise / column**2 if column else np.inf, spread[i] ** 2)
            total += (factors[r, i] - 1.0) ** 2 + variance
        spread[i] = np.clip(np.sqrt(total / (len(there) + weight)), _SCATTER_FLOOR, _SCATTER_TOP)
    return replace(fit, spread=spread)
