"""Fit a model to all runs at once: Levenberg-Marquardt, restarts, standard errors.

Reference: J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.arrays import Array
from pipeline.estimation.force_balance import bump
from pipeline.estimation.noise import high_frequency_noise, noise_beyond_rounding, score_covariance
from pipeline.gap.parameters import (
    FRICTION_SPREAD,
    GapModel,
    Linear,
    Nuisance,
    Structure,
    columns_of,
    fresh_nuisance,
    layout_of,
    linearise,
    move_nuisance,
    nuisance_step,
    residual_points,
    run_cost,
    run_prior,
    simulate_run,
    start_prior,
    usual_sizes,
)
from pipeline.gap.runs import GapRun, cut_shots
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.generated_forces import hysteresis, sliding, stribeck
from pipeline.plant.simulator.tables import Drive, Tables

# ---------------------------------------------------------------------- one step within bounds


def bounded_step(
    at: Array,
    bounds: tuple[Array, Array, Array],
    active: np.ndarray,
    *,
    solve: Callable[[np.ndarray], Array],
    rounds: int,
) -> Array:
    """Return a step of the parameters `at` (size,) within their bounds and step limits.

    `bounds` are the lower bounds, the upper bounds, and the largest step of each parameter. `solve`
    returns the step of the `active` parameters, given by index. A parameter at a bound that would
    step outward is fixed, and the others are solved again, at most `rounds` times.
    """
    low, high, reach = bounds
    delta = np.zeros(at.size)
    for _ in range(rounds):
        if not active.size:
            break
        step = solve(active)
        here = at[active]
        out = (here + step <= low[active]) & (here <= low[active])
        out |= (here + step >= high[active]) & (here >= high[active])
        if not out.any():
            delta[active] = step
            break
        active = active[~out]
    # Each step is clipped separately, so that a long step does not shorten the others.
    return np.clip(at + np.clip(delta, -reach, reach), low, high) - at


# ---------------------------------------------------------------------- the fit

Mapper = Callable[..., Iterable]

_SCATTER_FLOOR, _SCATTER_TOP = 0.004, 0.2
_DAMP, _RELAX, _STIFFEN, _LEAST_DAMP = 1e-3, 6.0, 6.0, 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class GapFit(GapModel):
    """A fitted model.

    Attributes
    ----------
    covariance : covariance (size, size) of the parameter vector, if dry friction is the same in all
        runs; None before the search ends.
    between_runs : the covariance (size, size) that the variation of dry friction adds.
    nuisance : the nuisance parameters of each run, in the order of the runs.
    costs : sum of squares of residuals in units of the noise, and prior terms, (runs, 2).
    points : number of residuals (runs,) of each run.
    spread : relative standard deviation (n,), from run to run, of each cart's dry friction.
    inflate : factor on the noise in the prior terms of the `cost`.
    """

    nuisance: tuple[Nuisance, ...]
    costs: Array
    points: Array
    spread: Array
    inflate: float
    covariance: Array | None = field(default=None)
    between_runs: Array | float = field(default=0.0)

    @property
    def cost(self) -> float:
        """The sum of squares of all runs, with prior terms."""
        return self.chi_square + self.inflate**2 * float(self.costs[:, 1].sum())

    @property
    def chi_square(self) -> float:
        """The cost without prior terms."""
        return float(self.costs[:, 0].sum())

    @property
    def n_points(self) -> float:
        """The number of residuals."""
        return float(self.points.sum())

    @property
    def run_chi(self) -> Array:
        """Chi-square per residual (runs,) of each run."""
        return self.costs[:, 0] / self.points

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

    return GapFit(
        structure=model.structure,
        theta=model.theta,
        nuisance=tuple(nuisance),
        costs=np.array(list(mapper(cost, zip(runs, nuisance, strict=True)))),
        points=np.array([residual_points(run) for run in runs]),
        spread=spread,
        inflate=inflate,
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
    best = evaluate(
        GapModel(structure=structure, theta=np.clip(start.theta, low, high)),
        runs,
        goes_on.nuisance if goes_on else [fresh_nuisance(run) for run in runs],
        spread=goes_on.spread if goes_on else np.full(structure.n, FRICTION_SPREAD),
        mapper=how.mapper,
    )
    damp = _DAMP
    for iteration in range(how.iterations):
        best = replace(best, inflate=best.inflation)
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
            best = _learn_spread(best, linear)
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

    before = fit.costs @ [1.0, inflate**2]
    moved = list(how.mapper(move, zip(linear, runs, fit.nuisance, before, strict=True)))
    nuisance, costs = zip(*moved, strict=True)
    return replace(
        fit, theta=model.theta, nuisance=nuisance, costs=np.array(costs), inflate=inflate
    )


def anchor(runs: Sequence[GapRun], size: int) -> Array:
    """Return an equation that fixes the first free mass if no input sets the scale of forces."""
    if any(run.driven for run in runs):
        return np.zeros((0, size + 1))
    if not size:
        return np.zeros((0, 1))
    row = np.zeros((1, size + 1))
    # Its weight is a million standard errors per unit of log mass.
    row[0, int(np.argmax(np.any([run.free for run in runs], axis=0)))] = 1e6
    return row


def _learn_spread(fit: GapFit, linear: Sequence[Linear]) -> GapFit:
    """Estimate how much each cart's friction differs from run to run."""
    spread, noise = fit.spread.copy(), max(1.0, fit.chi)
    weight, prior = 3.0, 0.04  # the prior counts as three runs with a spread of 4 %
    for i in range(spread.size):
        there = [
            (nuisance.scatter[i], part.run_wide[j, j])
            for nuisance, part in zip(fit.nuisance, linear, strict=True)
            for j, cart in enumerate(part.layout.scatter)
            if cart == i
        ]
        if not there:
            continue
        total = weight * prior**2
        for factor, column in there:
            variance = min(noise / column**2 if column else np.inf, spread[i] ** 2)
            total += (factor - 1.0) ** 2 + variance
        spread[i] = np.clip(np.sqrt(total / (len(there) + weight)), _SCATTER_FLOOR, _SCATTER_TOP)
    return replace(fit, spread=spread)


# ----------------------------------------------------- other rest positions in the friction band

_BAD_RUN, _BAD_SHARE = 1.5, 2.0  # limits of a run's chi-square: absolute, and times the median
_RESTARTS = ((0.8, 1.0), (-0.8, 1.0), (1.6, 1.0), (-1.6, 1.0), (0.0, 0.94), (0.0, 1.06))


def restart_runs(
    fit: GapFit, runs: Sequence[GapRun], mapper: Mapper, *, usual: float | None = None
) -> GapFit:
    """Restart the worst runs' nuisance parameters at other rest positions of the carts.

    `usual` is the chi-square of a good run, by default the median of these runs. A cart may rest
    anywhere inside the band of friction or cogging, and its encoder is zeroed at this rest. So the
    misfit of a run has several local minima over encoder zero and friction. The shared parameters
    stay the same.
    """
    if not fit.structure.many_rests:
        return fit
    usual = float(np.median(fit.run_chi)) if usual is None else usual
    worst = fit.run_chi > max(_BAD_RUN, _BAD_SHARE * usual)
    band = _rest_band(fit)
    rest = np.array(fit.structure.dry)

    def again(run: GapRun, start: Nuisance) -> GapFit:
        how = Fitting(shared=False, iterations=6)
        return fit_model(replace(fit, nuisance=(start,)), [run], how)

    def starts(run: GapRun, own: Nuisance) -> Iterator[Nuisance]:
        free = np.array(run.free)
        moves = [(run.zero + shift * band, factor) for shift, factor in _RESTARTS]
        if run.at_rest:  # the encoders were perhaps zeroed at the equilibrium of the springs
            moves.append((run.start, 1.0))
        for zero, factor in moves:
            x0 = own.x0.copy()
            if run.at_rest:
                x0[0, : free.size] = np.where(free, run.start - zero, 0.0)
            yield Nuisance(
                x0=x0,
                v0=own.v0,
                zero=np.where(free, zero, 0.0),
                scatter=np.where(rest & free, factor, 1.0),
            )

    nuisance, bad = list(fit.nuisance), np.flatnonzero(worst).tolist()
    lowest = fit.costs[:, 0].tolist()
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


# ---------------------------------------------------------------- the linear chain, from nothing


_EQUAL_MASSES = 1e-3  # weight, relative to the equations of motion


def first_chain(runs: Sequence[GapRun], *, springs: Sequence[bool]) -> Chain:
    """Estimate masses, dampings and springs by modulating functions.

    Without any input the first mass is 1.
    """
    from scipy.optimize import nnls  # takes a quarter of a second, so it is imported here

    n = len(springs) - 1
    rows = [j for j, there in enumerate(springs) if there]
    rows = rows[:1] if n == 1 else rows
    columns = 2 * n + len(rows)
    equations, sides = zip(*(_equations(run, rows) for run in runs), strict=True)
    A, b = np.concatenate(equations), np.concatenate(sides)
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0  # a cart that never moves keeps the smallest values
    A = A / scale
    if not np.any(b):
        # With free decays alone, forces are relative to the first mass. If each cart moves alone,
        # nothing relates its mass to the others, so a small weight makes the masses equal.
        first = int(np.argmax(np.any([run.free for run in runs], axis=0)))
        weight = np.where(np.arange(n) == first, 1e3, _EQUAL_MASSES)
        A = np.vstack([A, np.eye(n, columns) * weight[:, None]])
        b = np.append(b, weight * scale[:n])
    p = nnls(A, b)[0] / scale
    m = np.maximum(p[:n], 0.02 * max(1e-12, np.abs(p[:n]).max()))
    k = np.zeros(n + 1)
    k[rows] = np.maximum(p[2 * n :], 1e-3 * max(1e-12, np.abs(p[2 * n :]).max(initial=0.0)))
    diagonal = k[:-1] + k[1:]
    # Every damping ratio is at least 0.002.
    floor = 2 * 0.002 * np.sqrt(m * np.maximum(diagonal, 1e-12))
    return Chain(m=m, c=np.maximum(p[n : 2 * n], floor), k=k)


def _equations(run: GapRun, rows: Sequence[int]) -> tuple[Array, Array]:
    """Return the coefficients and right sides of equations, one per moving cart and window."""
    # Windows of 0.3 s, every 50 ms, for a bench of carts.
    step = max(1, round(0.05 * run.pace / run.record.sample_time))
    width = max(8, round(0.3 * run.pace / run.record.sample_time))
    x, n = run.by_cart(run.y, run.zero), run.zero.size
    columns = 2 * n + len(rows)
    moving = [i for i in run.rows if run.free[i]]
    if run.t.size <= width or not moving:
        return np.zeros((0, columns)), np.zeros(0)

    def windows(signal: Array) -> Array:
        return sliding_window_view(signal, width, axis=-1)[..., :-1:step, :]

    t = windows(run.t)
    span = t[:, -1:] - t[:, :1]
    # Weights of the trapezoidal rule, (windows, width).
    dt = np.diff(t, axis=1, prepend=t[:, :1], append=t[:, -1:])
    rule = 0.5 * (dt[:, 1:] + dt[:, :-1])
    w, w1, w2 = (rule * one for one in bump((t - t[:, :1]) / span, span=span))
    stretch = np.diff(x, axis=0, prepend=0.0, append=0.0)
    # A held input acts during the interval after its sample.
    u = windows(run.input)
    force = 0.5 * (u + np.concatenate([u[:, :1], u[:, :-1]], axis=1))
    A, b = np.zeros((len(moving), len(t), columns)), np.zeros((len(moving), len(t)))
    for equation, right, i in zip(A, b, moving, strict=True):
        equation[:, i] = (w2 * windows(x[i])).sum(1)
        equation[:, n + i] = -(w1 * windows(x[i])).sum(1)
        for at, j in enumerate(rows, start=2 * n):
            if j in (i, i + 1):
                pull = (w * windows(stretch[j])).sum(1)
                equation[:, at] += pull if j == i else -pull
        if i == 0:
            right[:] = (w * force).sum(1)
    size = max(1e-12, float(np.abs(x).max()))
    return A.reshape(-1, columns) / size, b.ravel() / size


# Shares of the stiffest spring: below the first, a spring may not exist; with the second, it does.
_NO_SPRING, _A_SPRING = 0.01, 0.1
_AS_GOOD = 1.01  # times the cost


def fit_baseline(
    runs: Sequence[GapRun], *, springs: Sequence[bool], start: Chain | None, mapper: Mapper = map
) -> tuple[GapFit, list[GapRun]]:
    """Fit the linear chain; return the fit and the runs with their measured noise.

    Short pieces, each with a start state, are fitted first, from two initial chains: the identified
    one and an independent estimate. From the better result, whole runs are then fitted. A spring
    that ends at almost nothing is left out of the model, if the model fits as well without it.
    """
    structure = Structure(springs=tuple(springs))
    # In pieces of 0.6 s, a missing effect does little harm.
    shots = [cut_shots(run, length=0.6) for run in runs]
    starts = [chain for chain in (start,) if chain is not None]
    starts.append(first_chain(runs, springs=springs))
    how = Fitting(mapper=mapper, iterations=15)
    fits = [fit_model(structure.start(chain), shots, how) for chain in starts]
    best = min(fits, key=lambda fit: fit.cost)
    noisy = measure_noise(best, shots, runs)
    fit = fit_model(best.without_nuisance, noisy, replace(how, iterations=25))
    chain = fit.structure.chain(fit.theta)
    missing = np.array(springs) & (chain.k < _NO_SPRING * chain.k.max())
    if structure.n == 1 or not missing.any():
        return fit, noisy
    # If the recordings say nothing about a spring, it stays where it is put.
    stiff = replace(chain, k=np.where(missing, _A_SPRING * chain.k.max(), chain.k))
    again = fit_model(structure.start(stiff), noisy, replace(how, iterations=40))
    k = again.structure.chain(again.theta).k
    missing &= k < _NO_SPRING * k.max()
    lean = Structure(springs=tuple((np.array(springs) & ~missing).tolist())).start(chain)
    without = fit_model(lean, noisy, replace(how, iterations=25)) if missing.any() else fit
    return (without if without.cost < _AS_GOOD * fit.cost else fit), noisy


def measure_noise(fit: GapFit, shots: Sequence[GapRun], runs: Sequence[GapRun]) -> list[GapRun]:
    """Return the runs with measured noise: encoder rounding or high-frequency residual.

    The larger of the two counts for each cart.
    """
    found: dict[int, list[float]] = {}
    resting: dict[int, list[float]] = {}
    for shot, nuisance in zip(shots, fit.nuisance, strict=True):
        model = simulate_run(fit, shot, nuisance)
        for j, row in enumerate(shot.rows):
            for part in (slice(a, b) for a, b in pairwise(shot.shots)):
                # Only a moving encoder shows its noise, because one at rest repeats the same
                # reading.
                moving = np.mean(shot.weight[j, part] ** 2) > 0.9
                side = found if moving else resting
                side.setdefault(row, []).append(high_frequency_noise((shot.y - model)[j, part]))
    out = []
    for run in runs:
        floor = np.array([run.record.encoder_step(row + 1) / np.sqrt(12.0) for row in run.rows])
        measured = np.array([np.median(found.get(row) or resting[row]) for row in run.rows])
        span = np.ptp(run.y, axis=1)
        out.append(replace(run, sigma=np.maximum(np.maximum(floor, measured), 1e-7 * span)))
    return out


def fit_nuisance(fit: GapFit, runs: Sequence[GapRun], mapper: Mapper = map) -> GapFit:
    """Fit only the nuisance parameters of runs to which the model was not fitted."""
    how = Fitting(mapper=mapper, shared=False, iterations=40, tolerance=1e-4)
    fresh = tuple(fresh_nuisance(run) for run in runs)
    found = fit_model(replace(fit, nuisance=fresh), runs, how)
    if fit.structure.many_rests and found.chi > fit.chi:
        found = fit_model(restart_runs(found, runs, mapper, usual=fit.chi), runs, how)
    return found


# -------------------------------------------------- standard errors if the residual is not white
#
# While a cart rests, its encoder repeats one reading, and friction lets it rest anywhere. All these
# readings share one rounding error, which limits how well friction is known. So the covariance is
# H⁻¹ S H⁻¹, where H is the information of the fit. S is the covariance caused by such encoder
# errors, computed from many random draws. Variances are raised, if necessary, to those of white
# noise and to those that the residual's correlation implies.
#
# Reference: L. Ljung, System Identification, 2nd ed., section 9.5, for this formula; B. Efron, R.
# J. Tibshirani, An Introduction to the Bootstrap, 1993, section 6.5, for the random draws.

_DRAWS = 60  # random draws of encoder errors; a standard error is then accurate to 9 %
_HIDDEN = 1e-9  # share of the strongest direction; weaker ones count as unknown


def covariance(fit: GapFit, runs: Sequence[GapRun], mapper: Mapper = map) -> GapFit:
    """Return the fit with the covariance of its parameters, or without it if the model diverges.

    The variation of dry friction from run to run is added as the fit learnt it. If the fit used the
    same friction for all runs, the variation is estimated from the residuals (R. DerSimonian, N.
    Laird, Controlled Clinical Trials 7 (1986), 177-188).
    """
    # Each run has its own draws.
    draws = [np.random.default_rng([0, index]) for index in range(len(runs))]
    weighed = list(mapper(partial(_weigh, fit), runs, fit.nuisance, draws))
    told = np.sum([of_run for of_run, _ in weighed], axis=0)
    if not np.all(np.isfinite(told)):
        return fit
    held = anchor(runs, fit.theta.size)[:, :-1]
    H, expected, found = told + np.stack([held.T @ held, *np.zeros((2, *told.shape[1:]))])
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    size = np.maximum(size, _HIDDEN * size.max())
    power, directions = np.linalg.eigh(H / np.outer(size, size))
    power = np.maximum(power, _HIDDEN * power[-1])
    inverse = (directions / power) @ directions.T / np.outer(size, size)
    expected, found = inverse @ expected @ inverse, inverse @ found @ inverse
    least = np.maximum(np.diag(found), np.diag(inverse))
    more = np.sqrt(np.maximum(1.0, least / np.maximum(np.diag(expected), _HIDDEN * least)))
    cov = expected * np.outer(more, more)
    # The encoders cause no error in a direction that no run determines; its variance is that of
    # H⁻¹.
    np.fill_diagonal(cov, np.maximum(np.diag(cov), least))
    return replace(
        fit, covariance=cov, between_runs=_varying_friction(fit, [f for _, f in weighed])
    )


def _weigh(
    fit: GapFit, run: GapRun, nuisance: Nuisance, rng: np.random.Generator
) -> tuple[Array, dict[int, tuple[float, float]]]:
    """Return what one run tells about the parameters, and about the friction of each cart.

    The first is H, S from encoder errors, and S from the residual's correlation, (3, size, size),
    all NaN if the model diverges at these parameters or next to them. The second is, for each cart
    with dry friction, the deviation of its friction in this run from that of the model, relative,
    and the information about it.
    """
    thin, inflate = run.thin, fit.inflation
    layout = layout_of(fit.structure, thin, scatter_free=True)
    columns = columns_of(fit, thin, nuisance, layout)
    if not np.all(np.isfinite(columns)):
        return np.full((3, fit.theta.size, fit.theta.size), np.nan), {}
    columns = columns * thin.weight / thin.sigma[:, None]
    starts = len(layout.x0) + len(layout.v0)
    local = starts + len(layout.scatter) + len(layout.zero)
    own = _by_piece(columns[:starts], thin)
    N = np.concatenate([own, columns[starts:local].reshape(local - starts, own.shape[1])]).T
    prior = np.zeros((N.shape[1], N.shape[1]))
    pieces = start_prior(layout, thin, usual_sizes(fit, thin), inflate=inflate)
    for piece, firm in enumerate(pieces):
        at = slice(piece * starts, (piece + 1) * starts)
        prior[at, at] = firm
    wide = 1 + local - starts  # the last column is the residual
    firm = run_prior(layout, thin, nuisance, wide, spread=fit.spread, inflate=inflate)
    prior[len(own) :, len(own) :] = firm[:, :-1]
    friction = N[:, len(own) : len(own) + len(layout.scatter)]
    if not fit.scattered:
        kept = np.delete(np.arange(N.shape[1]), len(own) + np.arange(len(layout.scatter)))
        N, prior = N[:, kept], prior[np.ix_(kept, kept)]
    J = columns[local:-1].reshape(fit.theta.size, -1).T
    known = np.hstack([J, friction])
    held = np.concatenate([known, np.zeros((len(prior), known.shape[1]))])
    known = known - N @ np.linalg.lstsq(np.concatenate([N, prior]), held, rcond=None)[0]
    left, friction_left = known[:, : fit.theta.size], known[:, fit.theta.size :]
    H = J.T @ left
    told = friction_left.T @ columns[-1].ravel()
    sizes = (friction_left**2).sum(0)
    J = left.T.reshape(columns[local:-1].shape)
    weight = J * thin.weight / thin.sigma[:, None]
    errors = np.array(list(_errors(fit, run, nuisance, rng=rng)))
    scores = np.tensordot(errors, weight, axes=((1, 2), (1, 2)))
    factors = {
        i: (float(told[j] / sizes[j]), float(sizes[j]))
        for j, i in enumerate(layout.scatter)
        if sizes[j] > 0.0
    }
    return np.stack([H, scores.T @ scores / _DRAWS, score_covariance(columns[-1], J)]), factors


def _varying_friction(fit: GapFit, runs: Sequence[dict[int, tuple[float, float]]]) -> Array:
    """Return the covariance (size, size) that the variation of dry friction between runs causes.

    All dry friction of a cart has the same factor in a run. The recordings show the friction only
    multiplied by the mean of the factors.
    """
    out = np.zeros((fit.theta.size, fit.theta.size))
    for i in {i for of_run in runs for i in of_run}:
        factors, weight = np.array([of_run[i] for of_run in runs if i in of_run]).T
        if fit.scattered:
            variance = float(fit.spread[i]) ** 2 / weight.size
        else:
            share = weight / weight.sum()
            variance = _between_runs(factors, weight) * float(share @ share)
        direction = fit.structure.friction_direction(i)
        out += variance * np.outer(direction, direction)
    return out


def _between_runs(factors: Array, weight: Array) -> float:
    """Return the variance of factors between runs, beyond that of their own errors."""
    if factors.size == 1:
        return 0.0
    mean = float(weight @ factors) / float(weight.sum())
    excess = float(weight @ (factors - mean) ** 2) - (factors.size - 1)
    size = float(weight.sum() - (weight @ weight) / weight.sum())
    return max(0.0, excess / size)


def _by_piece(columns: Array, run: GapRun) -> Array:
    """Rearrange columns (starts, rows, samples) to (starts of all pieces, points)."""
    pieces = np.zeros((len(run.shots) - 1, *columns.shape))
    for piece, (first, end) in enumerate(zip(run.shots, run.shots[1:], strict=False)):
        pieces[piece, :, :, first:end] = columns[:, :, first:end]
    return pieces.reshape(-1, columns[0].size)


def _errors(
    fit: GapFit, run: GapRun, nuisance: Nuisance, *, rng: np.random.Generator
) -> Iterator[Array]:
    """Yield random encoder errors (rows, samples) of the fitted motion, averaged as in the fit."""
    x = simulate_run(fit, run, nuisance)
    steps = np.array([run.record.encoder_step(row + 1) for row in run.rows])
    noise = [noise_beyond_rounding(s, step=step) for s, step in zip(run.sigma, steps, strict=True)]
    for _ in range(_DRAWS):
        read = x + np.array(noise)[:, None] * rng.standard_normal(x.shape)
        for row, step in zip(read, steps, strict=True):
            if step > 0:
                phase = rng.uniform(-0.5, 0.5)
                row[:] = step * (np.round(row / step + phase) - phase)
        yield run.thinned(read - x)
