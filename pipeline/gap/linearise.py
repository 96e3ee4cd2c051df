"""One run: its own unknowns, its readings under a model, and its share of a step.

A run's own unknowns are the carts' start (and restart) states, those of hidden masses where the
carts already move, the encoders' zeros, and a factor on the dry friction of each cart, which varies
from run to run. They enter the residual almost
linearly, so a QR factorisation of each run leaves a small problem in the shared parameters.
All derivatives are differences, simulated in one batch per run.

Reference: G. H. Golub, V. Pereyra, Inverse Problems 19 (2003), R1 (separable least squares).
"""

from dataclasses import dataclass

import numpy as np

from pipeline.gap.runs import Run
from pipeline.gap.structure import Structure
from pipeline.plant.chain import Array
from pipeline.plant.kernel import simulate_batch

_LOCAL_STEP = 1e-3  # of the run's swing, for derivatives with respect to start states


@dataclass(frozen=True, kw_only=True, eq=False)
class Locals:
    """What belongs to one run: start states (shots, 2 n), zeros (n,), friction factors (n,).

    The start states are those of the carts, then those of their hidden masses relative to them.
    """

    x0: Array
    v0: Array
    zero: Array
    scatter: Array


def fresh_locals(run: Run) -> Locals:
    """Return a run's unknowns where they are expected."""
    n = run.zero.size
    free = np.array(run.free)
    hidden = np.zeros((len(run.shots) - 1, n))
    return Locals(
        x0=np.hstack([np.where(free, run.shot_x - run.zero, 0.0), hidden]),
        v0=np.hstack([np.where(free, run.shot_v, 0.0), hidden]),
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
class Linear:
    """One run's share of a step: what is left for the shared parameters, and the way back."""

    reduced: Array  # (rows, size + 1) of R: shared parameters and residual
    own: Array  # R of the run-wide locals: [own | shared | residual]
    shots: Array  # (shots, ., .) R of each shot: [shot locals | own | shared | residual]
    layout: "Layout"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which local unknowns a run has: cart indices of each kind, n more for a hidden mass."""

    x0: tuple[int, ...]
    v0: tuple[int, ...]
    zero: tuple[int, ...]
    scatter: tuple[int, ...]
    first_v0: bool


def _layout(structure: Structure, run: Run, *, scatter_free: bool) -> Layout:
    free = tuple(i for i, moves in enumerate(run.free) if moves)
    multiple = len(run.shots) > 2
    dry = structure.dry if scatter_free else (False,) * structure.n
    moving = () if run.at_rest else tuple(structure.n + i for i in structure.hidden if i in free)
    return Layout(
        x0=free + moving,
        v0=free + moving if multiple or not run.at_rest else (),
        zero=run.rows if any(structure.springs) else (),
        scatter=tuple(i for i in free if dry[i]),
        first_v0=not run.at_rest,
    )


def _by_shot(residual: Array, run: Run) -> Array:
    """Weigh (…, rows, samples) and cut it into shots, padded with zeros to one length.

    Returns (…, shots, rows * longest).
    """
    residual = residual * run.weight
    counts = np.diff(run.shots)
    longest = int(counts.max())
    out = np.zeros((*residual.shape[:-2], len(counts), residual.shape[-2], longest))
    for s, (first, count) in enumerate(zip(run.shots[:-1], counts, strict=True)):
        out[..., s, :, :count] = residual[..., first : first + count]
    return out.reshape(*out.shape[:-2], out.shape[-2] * longest)


def residual_points(run: Run) -> float:
    """Return how many residuals a run adds to a fit, each by its weight."""
    return float((run.thin.weight**2).sum())


def triangle(matrix: Array) -> Array:
    """Return R of the QR factorisation of one matrix or a stack of them."""
    R: Array = np.linalg.qr(matrix, mode="r")  # pyright: ignore[reportAssignmentType]
    return R


def linearise(
    structure: Structure,
    theta: Array,
    run: Run,
    own: Locals,
    *,
    inflate: float,
    spread: Array,
    scatter_free: bool,
    extras: Array | None = None,
) -> Linear:
    """Return a run's residual and its derivatives, with its own unknowns eliminated.

    `inflate` widens the noise to the misfit of a model that is still wrong, as far as priors are
    concerned; `extras` (k, rows, samples of `run.thin`) are further columns to project.
    """
    run = run.thin
    layout = _layout(structure, run, scatter_free=scatter_free)
    n, P = structure.n, theta.size
    shots = len(run.shots) - 1
    steps = structure.steps()
    size = np.array([max(1e-9, s) for s in run.swing])
    by_cart = np.full(n, size.max())
    by_cart[list(run.rows)] = size
    by_cart = np.tile(by_cart, 2)
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
    rate = np.tile(np.maximum(rate, 1.0), 2)
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
    residual = _by_shot((run.y - model) / sigma, run)  # (shots, points)
    jac = (y[1:] - y[0]) / sigma / np.array(divisors)[:, None, None]
    jac = _by_shot(jac, run)  # (b - 1, shots, points)
    ones = np.zeros((len(layout.zero), len(run.rows), run.t.size))
    for z, i in enumerate(layout.zero):
        ones[z, run.rows.index(i)] = 1.0 / run.sigma[run.rows.index(i)]
    zero_columns = _by_shot(ones, run)
    theta_columns, local_columns = jac[:P], jac[P:]
    shot_columns = local_columns[: lanes_x + lanes_v]
    scatter_columns = local_columns[lanes_x + lanes_v :]
    further = [] if extras is None else [_by_shot(extras / sigma, run)]
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
    R = triangle(np.concatenate([matrix, prior], axis=1))
    rest = R[:, lanes_s:, lanes_s:].reshape(-1, R.shape[-1] - lanes_s)
    lanes_o = lanes_g + len(layout.zero)
    own_prior = np.zeros((lanes_o, rest.shape[-1]))
    for j, i in enumerate(layout.scatter):
        own_prior[j, j] = inflate / spread[i]
        own_prior[j, -1] = (1.0 - own.scatter[i]) * own_prior[j, j]
    for j, i in enumerate(layout.zero, start=lanes_g):
        own_prior[j, j] = inflate / run.zero_std[i]
        own_prior[j, -1] = (run.zero[i] - own.zero[i]) * own_prior[j, j]
    own_R = triangle(np.concatenate([rest, own_prior]))
    return Linear(
        reduced=own_R[lanes_o:, lanes_o:], own=own_R[:lanes_o], shots=R[:, :lanes_s], layout=layout
    )


def move_locals(linear: Linear, own: Locals, delta: Array, scale: float = 1.0) -> Locals:
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


def run_cost(
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
    run = run.thin
    model = simulate_run(structure, theta[None], run, own)[0]
    residual = _by_shot((run.y - model) / run.sigma[:, None], run)
    chi = float((residual**2).sum())
    if not np.isfinite(chi):
        return np.inf, 0.0
    rows = list(run.rows)
    prior = float((((own.zero - run.zero) / run.zero_std)[rows] ** 2).sum())
    dry = np.array(structure.dry) & np.array(run.free)
    prior += float((((own.scatter - 1.0) / spread)[dry] ** 2).sum())
    return chi, prior
