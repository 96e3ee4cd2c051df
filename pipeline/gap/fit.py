"""Fit a model to all runs at once: Levenberg-Marquardt, with each run's own unknowns eliminated.

A run's own unknowns are the carts' start (and restart) states, the encoders' zeros, and a factor
on the dry friction of each cart, which varies from run to run. They enter the residual almost
linearly, so a QR factorisation of each run leaves a small problem in the shared parameters.
All derivatives are differences, simulated in one batch per run.

Reference: G. H. Golub, V. Pereyra, Inverse Problems 19 (2003), R1 (separable least squares);
J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.gap.runs import Run
from pipeline.gap.structure import Structure
from pipeline.plant.chain import Array
from pipeline.plant.kernel import simulate_batch
from pipeline.plant.tables import Cart

Mapper = Callable[..., Iterable]

_SCATTER_START = 0.05  # spread of friction from run to run, before anything is known
_SCATTER_FLOOR, _SCATTER_TOP = 0.004, 0.2
_SCATTER_PRIOR = (3.0, 0.04)  # weight in runs, and spread, of the prior on that spread
_LOCAL_STEP = 1e-3  # of the run's swing, for derivatives with respect to start states
_LOCAL_SCALES = (1.0, 0.3, 0.05)  # of a run's own step, where the whole one raises its cost
_BAD_RUN, _BAD_SHARE = 1.5, 2.0  # chi-square, or share of the median run's, to start a run anew
_RESTARTS = ((0.8, 1.0), (-0.8, 1.0), (1.6, 1.0), (-1.6, 1.0), (0.0, 0.94), (0.0, 1.06))
_ANCHOR = 1e6  # standard errors per unit of log mass
_DAMP, _RELAX, _STIFFEN = 1e-3, 6.0, 6.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Locals:
    """What belongs to one run: start states (shots, n), zeros (n,), friction factors (n,)."""

    x0: Array
    v0: Array
    zero: Array
    scatter: Array


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
    log_det: float = 0.0

    @property
    def chi(self) -> float:
        """Chi-square per residual."""
        return self.chi_square / self.n_points


def fresh_locals(run: Run) -> Locals:
    """Return a run's unknowns where they are expected."""
    n = run.zero.size
    free = np.array(run.free)
    return Locals(
        x0=np.where(free, run.shot_x - run.zero, 0.0),
        v0=np.where(free, run.shot_v, 0.0),
        zero=np.where(free, run.zero, 0.0),
        scatter=np.ones(n),
    )


def simulate_run(structure: Structure, thetas: Array, run: Run, own: Locals) -> Array:
    """Return (b, rows, samples) readings of one run for many vectors, zeros included."""
    cart, spring, drive = structure.tables(thetas)
    b = len(thetas)
    y = simulate_batch(
        cart,
        spring,
        drive,
        np.broadcast_to(own.x0, (b, *own.x0.shape)),
        np.broadcast_to(own.v0, (b, *own.v0.shape)),
        np.broadcast_to(own.scatter, (b, own.scatter.size)),
        np.array(run.free),
        run.t,
        run.knots,
        run.command,
        np.array(run.shots),
        1.0,  # the simulator chooses its steps
    )
    return y[:, list(run.rows)] + own.zero[list(run.rows)][:, None]


# ------------------------------------------------------------------- one run linearised


@dataclass(frozen=True, kw_only=True, eq=False)
class _Linear:
    """One run's share of a step: what is left for the shared parameters, and the way back."""

    reduced: Array  # (rows, size + 1) of R: shared parameters and residual
    own: Array  # R of the run-wide locals: [own | shared | residual]
    shots: Array  # (shots, ., .) R of each shot: [shot locals | own | shared | residual]
    layout: "_Layout"


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Which local unknowns a run has: cart indices of each kind."""

    x0: tuple[int, ...]
    v0: tuple[int, ...]
    zero: tuple[int, ...]
    scatter: tuple[int, ...]
    first_v0: bool


def _layout(structure: Structure, run: Run, *, scatter_free: bool) -> _Layout:
    free = tuple(i for i, moves in enumerate(run.free) if moves)
    multiple = len(run.shots) > 2
    dry = structure.dry if scatter_free else (False,) * structure.n
    return _Layout(
        x0=free,
        v0=free if multiple or not run.at_rest else (),
        zero=run.rows if any(structure.springs) else (),
        scatter=tuple(i for i in free if dry[i]),
        first_v0=not run.at_rest,
    )


def _blocks(residual: Array, run: Run) -> Array:
    """Weigh (…, rows, samples) and average over blocks, so that white noise keeps its size.

    Returns (…, shots, rows * blocks), the shots padded with zeros to one length.
    """
    q = run.block
    residual = residual * run.weight
    counts = np.diff(run.shots) // q
    longest = int(counts.max())
    out = np.zeros((*residual.shape[:-2], len(counts), residual.shape[-2], longest))
    for s, (first, count) in enumerate(zip(run.shots[:-1], counts, strict=True)):
        piece = residual[..., first : first + count * q]
        if q > 1:
            piece = piece.reshape(*piece.shape[:-1], count, q).sum(-1) / np.sqrt(q)
        out[..., s, :, :count] = piece
    return out.reshape(*out.shape[:-2], -1)


def _residual_points(run: Run) -> float:
    q = run.block
    pieces = zip(run.shots[:-1], np.diff(run.shots) // q, strict=True)
    return sum(float((run.weight[:, a : a + m * q] ** 2).sum()) / q for a, m in pieces)


def _triangle(matrix: Array) -> Array:
    """Return R of the QR factorisation of one matrix or a stack of them."""
    R: Array = np.linalg.qr(matrix, mode="r")  # pyright: ignore[reportAssignmentType]
    return R


def _linearise(
    structure: Structure,
    theta: Array,
    run: Run,
    own: Locals,
    *,
    inflate: float,
    spread: Array,
    scatter_free: bool,
    extras: Array | None = None,
) -> _Linear:
    layout = _layout(structure, run, scatter_free=scatter_free)
    n, P = structure.n, theta.size
    shots = len(run.shots) - 1
    steps = structure.steps()
    size = np.array([max(1e-9, s) for s in run.swing])
    by_cart = np.full(n, size.max())
    by_cart[list(run.rows)] = size
    lanes_x, lanes_v, lanes_g = len(layout.x0), len(layout.v0), len(layout.scatter)
    b = 1 + P + lanes_x + lanes_v + lanes_g
    thetas = np.repeat(theta[None], b, axis=0)
    thetas[1 : P + 1] += np.diag(steps)
    x0 = np.repeat(own.x0[None], b, axis=0)
    v0 = np.repeat(own.v0[None], b, axis=0)
    g = np.repeat(own.scatter[None], b, axis=0)
    divisors = [*steps]
    lane = P + 1
    rate = np.sqrt(np.diag(structure.chain(theta).stiffness) / np.exp(theta[:n]))
    rate = np.maximum(rate, 1.0)
    for i in layout.x0:
        divisors.append(_LOCAL_STEP * by_cart[i])
        x0[lane, :, i] += divisors[-1]
        lane += 1
    for i in layout.v0:
        divisors.append(_LOCAL_STEP * by_cart[i] * rate[i])
        v0[lane, :, i] += divisors[-1]
        lane += 1
    for i in layout.scatter:
        divisors.append(1e-3)
        g[lane, i] += 1e-3
        lane += 1
    base = structure.tables(thetas[: P + 1])
    cart, spring, drive = (np.concatenate([a, np.repeat(a[:1], b - P - 1, axis=0)]) for a in base)
    y = simulate_batch(
        cart,
        spring,
        drive,
        x0,
        v0,
        g,
        np.array(run.free),
        run.t,
        run.knots,
        run.command,
        np.array(run.shots),
        1.0,  # the simulator chooses its steps
    )[:, list(run.rows)]
    sigma = run.sigma[:, None]
    model = y[0] + own.zero[list(run.rows)][:, None]
    residual = _blocks((run.y - model) / sigma, run)  # (shots, points)
    jac = (y[1:] - y[0]) / sigma / np.array(divisors)[:, None, None]
    jac = _blocks(jac, run)  # (b - 1, shots, points)
    ones = np.zeros((len(layout.zero), len(run.rows), run.t.size))
    for z, i in enumerate(layout.zero):
        ones[z, run.rows.index(i)] = 1.0 / run.sigma[run.rows.index(i)]
    zero_columns = _blocks(ones, run)
    theta_columns, local_columns = jac[:P], jac[P:]
    shot_columns = local_columns[: lanes_x + lanes_v]
    scatter_columns = local_columns[lanes_x + lanes_v :]
    further = [] if extras is None else [_blocks(extras / sigma, run)]
    wide = np.concatenate(
        [shot_columns, scatter_columns, zero_columns, theta_columns, *further, residual[None]]
    )  # (columns, shots, points)
    matrix = np.moveaxis(wide, 0, -1)  # (shots, points, columns)
    lanes_s = lanes_x + lanes_v
    # Weak priors keep what the data do not show from wandering: start states in units of the
    # swing; where a run starts at rest, its first velocity stays zero.
    prior = np.zeros((shots, lanes_s, matrix.shape[-1]))
    for j in range(lanes_s):
        i = (*layout.x0, *layout.v0)[j]
        weight = 1.0 / (by_cart[i] * (1.0 if j < lanes_x else rate[i]))
        prior[:, j, j] = weight * inflate * 1e-1
        if j >= lanes_x and not layout.first_v0:
            prior[0, j, j] = weight * 1e6
    R = _triangle(np.concatenate([matrix, prior], axis=1))
    rest = R[:, lanes_s:, lanes_s:].reshape(-1, R.shape[-1] - lanes_s)
    lanes_o = lanes_g + len(layout.zero)
    own_prior = np.zeros((lanes_o, rest.shape[-1]))
    for j, i in enumerate(layout.scatter):
        own_prior[j, j] = inflate / spread[i]
        own_prior[j, -1] = (1.0 - own.scatter[i]) * own_prior[j, j]
    for j, i in enumerate(layout.zero, start=lanes_g):
        own_prior[j, j] = inflate / run.zero_std[i]
        own_prior[j, -1] = (run.zero[i] - own.zero[i]) * own_prior[j, j]
    own_R = _triangle(np.concatenate([rest, own_prior]))
    return _Linear(
        reduced=own_R[lanes_o:, lanes_o:], own=own_R[:lanes_o], shots=R[:, :lanes_s], layout=layout
    )


def _move_locals(linear: _Linear, own: Locals, delta: Array, scale: float = 1.0) -> Locals:
    """Return the locals that go with a step of the shared parameters."""
    layout = linear.layout
    lanes_o = linear.own.shape[0]
    tail = np.concatenate([-delta, [1.0]])
    wide = np.zeros(0)
    if lanes_o:
        wide = np.linalg.solve(linear.own[:, :lanes_o], linear.own[:, lanes_o:] @ tail)
    lanes_s = linear.shots.shape[1]
    right = linear.shots[:, :, lanes_s:] @ np.concatenate([-wide, tail])
    moved = np.linalg.solve(linear.shots[:, :, :lanes_s], right[..., None])[..., 0]
    x0, v0 = own.x0.copy(), own.v0.copy()
    zero, scatter = own.zero.copy(), own.scatter.copy()
    x0[:, list(layout.x0)] += scale * moved[:, : len(layout.x0)]
    if layout.v0:
        change = scale * moved[:, len(layout.x0) :]
        if not layout.first_v0:
            change[0] = 0.0
        v0[:, list(layout.v0)] += change
    g = len(layout.scatter)
    scatter[list(layout.scatter)] += scale * np.clip(wide[:g], -0.3, 0.3)
    zero[list(layout.zero)] += scale * wide[g:]
    return Locals(x0=x0, v0=v0, zero=zero, scatter=np.clip(scatter, 0.3, 3.0))


def _run_cost(
    structure: Structure,
    theta: Array,
    run: Run,
    own: Locals,
    *,
    spread: Array,
) -> tuple[float, float]:
    """Return chi-square of a run, and its prior terms."""
    if not structure.visible(theta):
        return np.inf, 0.0
    model = simulate_run(structure, theta[None], run, own)[0]
    residual = _blocks((run.y - model) / run.sigma[:, None], run)
    chi = float((residual**2).sum())
    if not np.isfinite(chi):
        return np.inf, 0.0
    rows = list(run.rows)
    prior = float((((own.zero - run.zero) / run.zero_std)[rows] ** 2).sum())
    dry = np.array(structure.dry) & np.array(run.free)
    prior += float((((own.scatter - 1.0) / spread)[dry] ** 2).sum())
    return chi, prior


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
        return _run_cost(structure, theta, *pair, spread=spread)

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
    points = np.array([_residual_points(run) for run in runs])
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
    fixed: Sequence[int] = (),
    scatter_free: bool = True,
    learn_spread: bool = False,
    tolerance: float = 1e-3,
    mapper: Mapper = map,
) -> Fit:
    """Fit the shared parameters and every run's own unknowns.

    Parameters
    ----------
    theta : (size,) start. `fixed` lists entries that stay (all of them: only locals move).
    spread : (n,) expected spread of the dry friction from run to run; learnt if `learn_spread`.
    tolerance : relative fall of the cost below which the fit has converged.
    """
    low, high = structure.bounds()
    reach = structure.reach()
    theta = np.clip(theta, low, high)
    own = tuple(locals_) if locals_ is not None else tuple(fresh_locals(run) for run in runs)
    spread = np.full(structure.n, _SCATTER_START) if spread is None else spread
    moving = np.array([i for i in range(theta.size) if i not in set(fixed)], dtype=int)
    damp = _DAMP
    inflate = 1.0
    best = evaluate(structure, theta, runs, own, spread=spread, inflate=inflate, mapper=mapper)
    for iteration in range(iterations):
        inflate = max(1.0, np.sqrt(best.chi)) if np.isfinite(best.chi) else 1.0
        best = replace(best, cost=best.chi_square + inflate**2 * float(best.run_prior.sum()))

        def linearise(
            pair: tuple[Run, Locals], at: Fit = best, inflate: float = inflate
        ) -> _Linear:
            return _linearise(
                structure,
                at.theta,
                *pair,
                inflate=inflate,
                spread=at.spread,
                scatter_free=scatter_free,
            )

        linear = list(mapper(linearise, zip(runs, best.locals_, strict=True)))
        stacked = np.concatenate([*(part.reduced for part in linear), _anchor(runs, theta.size)])
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
                job: tuple[_Linear, Run, Locals, float],
                at: Fit = best,
                delta: Array = delta,
                there: Array = there,
                inflate: float = inflate,
            ) -> tuple[Locals, tuple[float, float]]:
                """Move a run's own unknowns with the step, less far where that is no gain."""
                part, run, own, before = job
                tried = []
                for scale in _LOCAL_SCALES:
                    moved = _move_locals(part, own, delta, scale)
                    cost = _run_cost(structure, there, run, moved, spread=at.spread)
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
    """Return a row that holds the first mass where no run has an input to give forces a scale."""
    if any(np.any(run.command) for run in runs):
        return np.zeros((0, size + 1))
    row = np.zeros((1, size + 1))
    row[0, 0] = _ANCHOR
    return row


def _learn_spread(fit: Fit, runs: Sequence[Run], linear: Sequence[_Linear]) -> Fit:
    """Learn how much the friction of each cart varies, and move the mean into the force."""
    spread = fit.spread.copy()
    theta = fit.theta.copy()
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
    return replace(fit, spread=spread, theta=theta)


def restart_runs(fit: Fit, runs: Sequence[Run], *, mapper: Mapper = map) -> Fit:
    """Start the worst runs' own unknowns anew from elsewhere in the friction band.

    A cart rests anywhere inside the band, and is zeroed there, so a run's misfit has several
    valleys in zero and friction. Shared parameters stay.
    """
    if not any(fit.structure.dry):
        return fit
    worst = fit.run_chi > max(_BAD_RUN, _BAD_SHARE * float(np.median(fit.run_chi)))
    band = _rest_band(fit)
    rest = np.array(fit.structure.dry)

    def again(job: tuple[Run, Locals, bool, float]) -> Locals:
        run, own, bad, chi = job
        if not bad:
            return own
        free = np.array(run.free)
        best, lowest = own, chi * _residual_points(run)
        for shift, factor in _RESTARTS:
            move = np.where(free, shift * band, 0.0)
            start = Locals(
                x0=own.x0 - move if run.at_rest else own.x0,
                v0=own.v0,
                zero=np.where(free, run.zero, 0.0) + move,
                scatter=np.where(rest & free, factor, 1.0),
            )
            trial = fit_model(
                fit.structure,
                fit.theta,
                [run],
                locals_=[start],
                spread=fit.spread,
                fixed=range(fit.theta.size),
                iterations=6,
            )
            if trial.chi_square < lowest:
                best, lowest = trial.locals_[0], trial.chi_square
        return best

    jobs = zip(runs, fit.locals_, worst, fit.run_chi, strict=True)
    locals_ = tuple(mapper(again, jobs))
    inflate = max(1.0, float(np.sqrt(fit.chi)))
    return evaluate(
        fit.structure,
        fit.theta,
        runs,
        locals_,
        spread=fit.spread,
        inflate=inflate,
        mapper=mapper,
    )


def _rest_band(fit: Fit) -> Array:
    """Return (n,) how far from equilibrium dry friction may leave each cart, about one sigma."""
    chain = fit.structure.chain(fit.theta)
    cart = fit.structure.tables(fit.theta[None])[0][0]
    force = cart[:, Cart.COULOMB] + cart[:, Cart.STATIC] + cart[:, Cart.DAHL]
    if not np.any(chain.k > 0):
        return np.zeros(chain.n)
    compliance = np.abs(np.linalg.pinv(chain.stiffness))
    return np.sqrt(((0.5 * compliance * force) ** 2).sum(axis=1))


def project(
    fit: Fit, runs: Sequence[Run], extras: Sequence[Array], *, mapper: Mapper = map
) -> tuple[Array, Array]:
    """Project changes of the readings off everything the fit can absorb.

    Parameters
    ----------
    extras : per run (k, rows, samples): what k further effects would add to the readings.

    Returns
    -------
    (rows, k) what is left of them, and (rows,) what is left of the residual.
    """
    inflate = max(1.0, np.sqrt(fit.chi))

    def linearise(job: tuple[Run, Locals, Array]) -> _Linear:
        run, own, extra = job
        return _linearise(
            fit.structure,
            fit.theta,
            run,
            own,
            inflate=inflate,
            spread=fit.spread,
            scatter_free=True,
            extras=extra,
        )

    linear = list(mapper(linearise, zip(runs, fit.locals_, extras, strict=True)))
    R = _triangle(np.concatenate([part.reduced for part in linear]))
    shared = fit.theta.size
    return R[shared:, shared:-1], R[shared:, -1]


def covariance(fit: Fit, runs: Sequence[Run], *, mapper: Mapper = map) -> Fit:
    """Return the fit with the covariance of its parameters, scaled by its own misfit.

    Where friction was fitted with one size for all runs, its spread is no part of the error.
    """
    scatter_free = any(np.any(own.scatter != 1.0) for own in fit.locals_)

    def linearise(pair: tuple[Run, Locals]) -> _Linear:
        return _linearise(
            fit.structure,
            fit.theta,
            *pair,
            inflate=max(1.0, np.sqrt(fit.chi)),
            spread=fit.spread,
            scatter_free=scatter_free,
        )

    linear = list(mapper(linearise, zip(runs, fit.locals_, strict=True)))
    parts = [*(part.reduced for part in linear), _anchor(runs, fit.theta.size)]
    J = np.concatenate(parts)[:, :-1]
    _, s, vt = np.linalg.svd(J, full_matrices=False)
    s = np.maximum(s, 1e-9 * s[0])
    cov = (vt.T / s**2) @ vt * max(1.0, fit.chi)
    log_det = float(
        sum(np.log(np.abs(np.diagonal(part.own[:, : part.own.shape[0]]))).sum() for part in linear)
    )
    return replace(fit, covariance=cov, log_det=log_det)
