"""Joint fit of one chain to time records: steps, sweeps, decays and closed loops at once.

It is an output-error fit: the chain is simulated exactly from the measured input, and simulated
positions are compared with the measured ones. The start and encoder zeros of each record enter
linearly and are eliminated, so the search moves only the physical parameters. It starts from a
linear regression and needs no initial guess.

Reference: L. Ljung, System Identification, 2nd ed., sections 7.5 and 10.2, and section 9.5 for
residuals that are not white.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.force_balance import Windows
from pipeline.estimation.least_squares import minimise
from pipeline.estimation.noise import (
    local_noise,
    long_run_variance,
    rounding_left,
    score_covariance,
)
from pipeline.estimation.parametrisation import (
    Modes,
    Parametrisation,
    critical_damping,
    drive_modes,
    even_chain,
    find_modes,
    named_estimates,
    physical_start,
)
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import OVERSAMPLING, interpolate_band_limited
from pipeline.results import EXPLAINED, ChainFit, Estimate, ExperimentKind, Record
from pipeline.setup import Setup

# ------------------------------------------------- the part of a record that a chain can explain

# A free decay is used after its largest swing has fallen to this share, because the hand or stop
# has then let go of the cart.
_RELEASED_BELOW = 0.5
_FEWEST_SAMPLES = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class FitWindow:
    """The part of a record that the fit uses.

    Attributes
    ----------
    t : times (n,), s, from 0.
    y : positions (p, n) of the free measured carts.
    drive_t, drive_u : times and values (n_d,) of the held input, on a grid `stride` times finer
        than t. Without an input on a free cart, drive_u is None.
    carts, free : measured and free carts, as in `Record` but without held carts.
    stated_sigma : standard error (p,) of a position, from encoder step and local noise.
    sigma : standard error (p,) used for the weights, at least `stated_sigma`.
    step : encoder steps (p,), position units; zero if unknown.
    at_rest : whether the carts start at rest. Otherwise position and speed at t = 0 are unknown.
    shared : variance (p,), over sigma², of the error that all readings before the input share.
        While nothing moves, the encoder always rounds in the same way.
    """

    id: str
    kind: ExperimentKind
    t: Array
    y: Array
    drive_t: Array
    drive_u: Array | None
    stride: int
    carts: tuple[int, ...]
    free: tuple[int, ...]
    stated_sigma: Array
    sigma: Array
    step: Array
    at_rest: bool
    shared: Array | float = 0.0

    @property
    def n_resting(self) -> int:
        """Number of samples before the input begins; 0 without an input."""
        if self.drive_u is None or not np.any(self.drive_u):
            return 0
        return int(np.searchsorted(self.t, self.drive_t[np.flatnonzero(self.drive_u)[0]]))

    @property
    def is_constant(self) -> bool:
        """Whether the input is on from the first sample and never changes.

        If the start is unknown too, its force is indistinguishable from an encoder zero.
        """
        return self.drive_u is not None and not np.ptp(self.drive_u)

    def rms_in_motion(self, residual: Array) -> Array:
        """Return the root mean square (p,) of residuals (p, n) after the input begins.

        Before the input begins, it is chance whether an encoder flickers between two counts or
        stays on one.
        """
        return np.sqrt(np.mean(residual[:, self.n_resting :] ** 2, axis=1))

    def informed(self, residual: Array, *, at_rest: bool) -> "FitWindow":
        """Return this window with its standard errors taken from the residuals of a fit.

        No standard error falls below the stated one.

        Parameters
        ----------
        residual : residuals (p, n), position units.
        """
        sigma = np.maximum(self.stated_sigma, np.sqrt(np.mean(residual**2, axis=1)))
        moving = self.rms_in_motion(residual)
        left = [
            rounding_left(rms, step=step)
            for rms, step in zip(moving.tolist(), self.step.tolist(), strict=True)
        ]
        shared = (np.array(left) * self.step / sigma) ** 2 / 12 if at_rest else 0.0
        return replace(self, sigma=sigma, at_rest=at_rest, shared=shared)

    def thinned(self, most: int) -> "FitWindow":
        """Return this window with at most 2 × `most` samples; the input keeps all samples."""
        step = max(self.t.size // most, 1)
        return replace(self, t=self.t[::step], y=self.y[:, ::step], stride=self.stride * step)


@dataclass(frozen=True, kw_only=True, eq=False)
class Misfit:
    """Residuals of a chain in one window, with the best start and encoder zeros.

    Attributes
    ----------
    residual : (p, n), model minus measured, over sigma.
    jacobian : derivatives (n_p, p, n) of the residual with respect to theta. The nuisance
        parameters (start and encoder zeros) are adjusted along with theta.
    n_nuisance : number of eliminated nuisance parameters.
    """

    residual: Array
    jacobian: Array
    n_nuisance: int

    @cached_property
    def triangle(self) -> Array:
        """The triangle of a QR decomposition of Jacobian and residual, the residual last."""
        jacobian = self.jacobian.reshape(self.jacobian.shape[0], -1)
        columns = np.vstack([jacobian, self.residual.reshape(1, -1)]).T
        return np.asarray(np.linalg.qr(columns, mode="r"))


def usable_segment(record: Record) -> slice:
    """Return the samples of a record that a linear chain can explain.

    For a driven record these are all samples. For a decay they begin after the release, when the
    largest swing about the final rest has halved. The hand or stop has then let go of the cart.

    Raises
    ------
    DataError : nothing moves, or no sample remains after the release.
    """
    if record.kind != "decay":
        return slice(0, record.t.size)
    rest = np.median(record.y[:, -max(record.t.size // 10, 1) :], axis=1)
    swing = np.max(np.abs(record.y - rest[:, None]), axis=0)
    if not np.max(swing) > 3 * np.max(record.resolution, initial=0.0):
        raise DataError(f"{record.id}: time fit needs a cart that moves, found none")
    # The hold ends when the swing falls below 95 % of its largest value.
    held_until = int(np.flatnonzero(swing >= 0.95 * swing.max())[-1])
    released = np.flatnonzero(swing[held_until:] < _RELEASED_BELOW * swing.max())
    start = held_until + int(released[0]) if released.size else record.t.size
    if record.t.size - start < _FEWEST_SAMPLES:
        raise DataError(
            f"{record.id}: time fit needs {_FEWEST_SAMPLES} samples after the release, "
            f"found {record.t.size - start}"
        )
    return slice(start, record.t.size)


def open_window(record: Record) -> FitWindow:
    """Prepare a record for the fit.

    Raises
    ------
    DataError : no free cart was measured, a cart stands still (it sticks, or its encoder is dead),
        or too few samples are usable.
    """
    carts = record.measured_free
    used = usable_segment(record)
    t, y = record.t[used], np.array([record.position(cart)[used] for cart in carts])
    if not carts or t.size < _FEWEST_SAMPLES:
        raise DataError(
            f"{record.id}: time fit needs {_FEWEST_SAMPLES} samples of a free cart, found "
            f"{t.size if carts else 0}"
        )
    for cart, position in zip(carts, y, strict=True):
        if not np.ptp(position) > record.encoder_step(cart):
            raise DataError(f"{record.id}: time fit needs carts that move, cart {cart} does not")
    drive_t, drive_u, stride = t - t[0], None, 1
    if 1 in record.free and np.any(record.input[used]):
        drive_u = record.input[used]
        if record.hold == "band_limited":
            fine_t, fine_u = interpolate_band_limited(drive_t, drive_u)
            # Holding the value at the middle of an eight times finer step has an error of (omega dt
            # / 8)² / 24.
            drive_t, stride = fine_t, OVERSAMPLING
            drive_u = np.append((fine_u[1:] + fine_u[:-1]) / 2, fine_u[-1])
    steps = np.array([record.encoder_step(cart) for cart in carts])
    noise = np.array([local_noise(t, position) for position in y])
    # The error assumed, from the motion's range, if the data show neither noise nor encoder steps.
    least = 1e-6 * float(np.max(np.ptp(y, axis=1)))
    sigma = np.maximum(np.maximum(noise, steps / np.sqrt(12)), least)
    return FitWindow(
        id=record.id,
        kind=record.kind,
        t=t - t[0],
        y=y,
        drive_t=drive_t,
        drive_u=drive_u,
        stride=stride,
        carts=carts,
        free=tuple(sorted(record.free)),
        stated_sigma=sigma,
        sigma=sigma,
        step=steps,
        at_rest=False,
    )


@np.errstate(over="ignore", invalid="ignore")  # far from the data, where the fit refuses a step
def compare(window: FitWindow, modes: Modes) -> Misfit:
    """Compare a chain, given by its modes, with a window.

    Start and encoder zeros enter linearly, so they are eliminated: residual and Jacobian are
    projected onto the rest of the space. This is variable projection in Kaufman's form (G. Golub &
    V. Pereyra, Inverse Problems 19, 2003, section 3).
    """
    p, n = window.y.shape
    rows = [window.free.index(cart) for cart in window.carts]
    shapes, d_shapes = modes.shapes[rows], modes.d_shapes[:, rows]
    free_motion = np.exp(modes.poles[:, None] * window.t)  # (n_m, n)
    columns = [np.repeat(np.eye(p)[:, :, None], n, axis=2)]  # encoder zeros
    if not window.at_rest:
        start = modes.entry.T[:, None] * shapes  # (2f, p, n_m)
        columns.append(_real_part(start, free_motion))
    local = weighed(np.concatenate(columns), window).reshape(-1, p * n).T
    scale = np.linalg.norm(local, axis=0)
    scale[scale == 0] = 1.0
    Q, R = np.linalg.qr(local / scale)
    U, s, Vt = np.linalg.svd(R)
    # Below this relative singular value, two nuisance parameters have the same effect.
    kept = s > 1e-9 * s[0]
    basis = Q @ U[:, kept]

    signals, d_weights = [], []  # modal signals, and their weights in the Jacobian
    rest = -window.y
    if window.drive_u is not None:
        q, dq = drive_modes(modes.poles, window.drive_t, window.drive_u)
        signals += [q[:, :: window.stride], dq[:, :: window.stride]]
        by_shape = shapes * modes.drive
        rest = rest + _real_part(by_shape, signals[0])
        d_weights += [
            d_shapes * modes.drive + shapes * modes.d_drive[:, None],
            by_shape * modes.d_poles[:, None],
        ]
    rest = weighed(rest, window).reshape(-1)
    along = basis.T @ rest
    if not window.at_rest:
        found = -(Vt[kept].T @ (along / s[kept])) / scale
        x0 = found[p:]
        z0, d_z0 = modes.entry @ x0, modes.d_entry @ x0
        signals += [free_motion, free_motion * window.t]
        d_weights += [d_shapes * z0 + shapes * d_z0[:, None], shapes * z0 * modes.d_poles[:, None]]
    n_p = modes.d_poles.shape[0]
    if signals:
        jacobian = _real_part(np.concatenate(d_weights, axis=2), np.concatenate(signals))
    else:
        jacobian = np.zeros((n_p, p, n))
    jacobian = weighed(jacobian, window).reshape(n_p, p * n)
    jacobian = jacobian - (jacobian @ basis) @ basis.T
    return Misfit(
        residual=(rest - basis @ along).reshape(p, n),
        jacobian=jacobian.reshape(n_p, p, n),
        n_nuisance=int(np.count_nonzero(kept)),
    )


def weighed(values: Array, window: FitWindow) -> Array:
    """Return values (…, p, n) over sigma, whitened before the input begins.

    The n readings until then have a common error. Their covariance matrix has the eigenvalue
    1 + n shared along the vector of ones, and 1 in all other directions.
    """
    scaled = values / window.sigma[:, None]
    if np.any(window.shared) and (n := window.n_resting):
        mean = np.mean(scaled[..., :n], axis=-1)
        scaled[..., :n] -= (mean * (1 - 1 / np.sqrt(1 + n * window.shared)))[..., None]
    return scaled


def _real_part(weights: ComplexArray, signals: ComplexArray) -> Array:
    """Return Re(weights @ signals) for (…, n_m) and (n_m, n), by one real product."""
    return np.concatenate([weights.real, -weights.imag], axis=-1) @ np.concatenate(
        [signals.real, signals.imag]
    )


# -------------------------------------------------------- the search, from a regression's result
#
# For the start, each cart's equation of motion is multiplied by a bump φ and integrated by parts
# (`force_balance`). The result,
# with means over the bump, is
#
#     m_i x_i'' + c_i x_i' + k_i (x_i - x_{i-1}) + k_{i+1} (x_i - x_{i+1}) = u.
#
# Cart 1's equation gives its mass, damping and springs in input units. The equation of each further
# cart gives them relative to the spring before it. An encoder zero acts as a constant force in its
# record.

WIDTHS = (0.15, 0.3, 0.6, 1.2)  # s; a bump should last about one period of the carts


def regress_chain(windows: Sequence[FitWindow], *, bench: Setup, width: float) -> Chain | None:
    """Regress a chain from the windows, with bumps of `width` (s).

    The result is None if some cart's equation cannot be set up, because the cart or a free
    neighbour was not measured. It is also None if the equation gives an impossible value (a
    negative mass or coupling).
    """
    n = bench.n
    m, c, k = np.zeros(n), np.zeros(n), np.zeros(n + 1)
    means = [_means(window, n=n, width=width) for window in windows]
    for cart in range(1, n + 1):
        seen = [
            mean
            for window, mean in zip(windows, means, strict=True)
            if mean is not None and _has_equation(window, cart, n)
        ]
        if not seen:
            return None
        rows, targets = zip(*(_equation(cart, bench, *mean) for mean in seen), strict=True)
        zeros = np.zeros((sum(map(len, rows)), len(rows)))  # a constant force in each record
        ends = np.cumsum([0, *map(len, rows)])
        for column, (first, last) in enumerate(pairwise(ends)):
            zeros[first:last, column] = 1.0
        columns = np.hstack([np.concatenate(rows), zeros])
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0] = 1.0
        found = np.linalg.lstsq(columns / scale, np.concatenate(targets), rcond=None)[0] / scale
        unit = 1.0 if cart == 1 else k[cart - 1]
        m[cart - 1], c[cart - 1], k[cart] = unit * found[:3]
        if cart == 1:
            k[0] = found[3]
        if not m[cart - 1] > 0 or (cart < n and not k[cart] > 0):
            return None
    start = physical_start(Chain(m=m, c=c, k=k), bench=bench)
    omega = np.maximum(start.omega_carts, 1 / width)
    # Noise may make a regressed damping negative, so each cart has at least ζ = 0.005.
    return Chain(m=start.m, c=np.maximum(c, 0.01 * omega * start.m), k=start.k)


def _has_equation(window: FitWindow, cart: int, n: int) -> bool:
    """Return whether a cart's equation can be set up: it moves, and all forces on it are known."""
    near = {j for j in (cart - 1, cart, cart + 1) if 1 <= j <= n and j in window.free}
    driven = cart > 1 or window.drive_u is not None
    return driven and cart in window.free and near <= set(window.carts)


def _equation(cart: int, bench: Setup, x: Array, force: Array) -> tuple[Array, Array]:
    """Return the columns of m, c and the springs of a cart's equation, and its right side.

    The spring before the cart is a column only for cart 1; otherwise it is the right side. `x` and
    `force` are those of `_means`.
    """
    stretch = x[0, cart] - x[0, cart - 1], x[0, cart] - x[0, cart + 1]
    columns = [x[2, cart], x[1, cart], stretch[1] * bench.stiff[cart]]
    if cart > 1:
        return np.stack(columns, axis=1), -stretch[0]
    columns.append(stretch[0] * bench.stiff[0])
    return np.stack(columns, axis=1), force


def _means(window: FitWindow, *, n: int, width: float) -> tuple[Array, Array] | None:
    """Return means (3, n + 2, n_b) of position, velocity and acceleration, (n_b,) of the input.

    Walls, held and unmeasured carts are at zero. The result is None if the record is shorter than
    two bumps, or if a bump holds too few samples.
    """
    t, duration = window.t, window.t[-1]
    samples = round(t.size * width / duration)
    # Fewer than eight samples do not integrate φ'' well.
    if duration < 2 * width or samples < 8:
        return None
    # Bumps overlap by three quarters; closer or more than 400 bumps would only take time.
    count = min(int((duration - width) / (0.25 * width)) + 1, 400)
    first = np.linspace(0, t.size - samples, count).astype(np.intp)
    x, force = np.zeros((3, n + 2, count)), np.zeros(count)
    x[:, window.carts] = Windows(t, first=first, width=samples).means(window.y)
    if window.drive_u is not None:
        stride = window.stride
        driven = Windows(window.drive_t, first=first * stride, width=(samples - 1) * stride + 1)
        force = driven.held_mean(window.drive_u)
    return x, force


def even_chains(windows: Sequence[FitWindow], *, bench: Setup) -> list[Chain]:
    """Return chains of equal carts, from slow to fast, with about the static gain of the records.

    They serve for records that a regression cannot use, such as one with an unmeasured cart. Their
    frequencies cover all that the records can show.
    """
    driven = [window for window in windows if window.drive_u is not None]
    # The input may be on from the first sample, so its range includes zero.
    ranges = [np.ptp(np.append(0.0, w.drive_u)) for w in driven if w.drive_u is not None]
    swing = np.median([np.ptp(w.y[0]) / u for w, u in zip(driven, ranges, strict=True)])
    # The longest record has two periods of the slowest resonance, and a period of the fastest one
    # has eight samples.
    slowest = 4 * np.pi / max(w.t[-1] for w in driven)
    fastest = 2 * np.pi / (8 * min(float(np.median(np.diff(w.t))) for w in driven))
    if not swing > 0 or fastest <= slowest or not bench.tied:
        return []  # without a spring to a wall there is no static gain
    ratio = fastest / slowest
    # The fit converges from a third away.
    count = int(np.log(ratio) / np.log(1.5)) + 1
    chains = []
    for omega in slowest * ratio ** (np.arange(count + 1) / count):
        # After a step, the range of a lightly damped cart is 1.6 times its static change.
        values = {"K_1": swing / 1.6, "omega_a": omega}
        chains.append(even_chain(values, bench=bench))
    return chains


# Share of a record's power (about its mean) that a chain may leave unexplained. Carts with dry
# friction leave some 2 %, a wrong chain most of it.
FOLLOWED = 0.1
# Relative change of the cost at which a search ends. With n samples, 1/n is one standard error.
_SEARCH_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """One chain compared with all windows.

    Attributes
    ----------
    theta : the fit vector (n_p,) of `Parametrisation`.
    misfits : the misfit of each window.
    converged : whether the search that led to this chain converged.
    n_evaluations : number of chains that this search compared with the windows.
    """

    parametrisation: Parametrisation
    theta: Array
    windows: Sequence[FitWindow]
    misfits: Sequence[Misfit]
    converged: bool = False
    n_evaluations: int = 1

    @property
    def chain(self) -> Chain:
        """The chain of theta."""
        return self.parametrisation.unpack(self.theta)

    @cached_property
    def cost(self) -> float:
        """The sum of squared standardised residuals."""
        return float(sum(np.sum(misfit.residual**2) for misfit in self.misfits))

    @property
    def n_points(self) -> int:
        """The number of measured positions."""
        return sum(window.y.size for window in self.windows)

    @property
    def dof(self) -> int:
        """Degrees of freedom: positions minus all fitted and nuisance parameters."""
        return self.n_points - self.theta.size - sum(misfit.n_nuisance for misfit in self.misfits)

    @cached_property
    def unexplained_share(self) -> float:
        """The share of the motion's power (about its mean) that the chain does not explain."""
        power = sum(
            float(np.sum(((w.y - w.y.mean(axis=1, keepdims=True)) / w.sigma[:, None]) ** 2))
            for w in self.windows
        )
        return self.cost / power if power > 0 else 1.0

    @property
    def follows(self) -> bool:
        """Whether the chain explains the motion down to the noise, or nearly all of it."""
        return self.unexplained_share < FOLLOWED or self.cost < EXPLAINED * self.dof


def evaluate_chain(
    windows: Sequence[FitWindow], parametrisation: Parametrisation, theta: Array
) -> Attempt:
    """Compare the chain of theta with all windows."""
    chain, dp_dtheta = parametrisation.unpack(theta), parametrisation.dp_dtheta(theta)
    modes = {
        free: find_modes(chain, free=free, parametrisation=parametrisation, dp_dtheta=dp_dtheta)
        for free in {window.free for window in windows}
    }
    misfits = [compare(window, modes[window.free]) for window in windows]
    return Attempt(parametrisation=parametrisation, theta=theta, windows=windows, misfits=misfits)


def minimise_from(
    windows: Sequence[FitWindow],
    parametrisation: Parametrisation,
    theta: Array,
    *,
    tolerance: float = _SEARCH_TOLERANCE,
) -> Attempt:
    """Minimise the sum of squared residuals, starting from theta, to a relative `tolerance`."""
    # The logarithm of a damping or spring that does not exist goes towards minus infinity. e^-15 of
    # the start counts as zero, and no step overflows.
    reach = np.where(parametrisation.logarithmic, 15.0, np.inf)
    lower = np.maximum(parametrisation.bounds[0], theta - reach)
    upper = np.minimum(parametrisation.bounds[1], theta + reach)

    def residual_and_jacobian(x: Array) -> tuple[Array, Array]:
        triangle = stacked_triangle(evaluate_chain(windows, parametrisation, x).misfits)
        return triangle[:, -1], triangle[:, :-1]

    solution = minimise(
        residual_and_jacobian,
        np.clip(theta, lower, upper),
        bounds=(lower, upper),
        scale="jac",
        tolerance=tolerance,
        max_evaluations=60,
    )
    return replace(
        evaluate_chain(windows, parametrisation, solution.x),
        converged=solution.status > 0,
        n_evaluations=solution.nfev,
    )


def stacked_triangle(misfits: Sequence[Misfit]) -> Array:
    """Condense Jacobians and residuals to (n_p + 1, n_p + 1), the residuals in the last column.

    The result is the triangle of a QR decomposition, with the same products of columns as the full
    matrix. So least squares has the same solution with n_p + 1 rows instead of thousands.
    """
    triangles = np.concatenate([misfit.triangle for misfit in misfits])
    return np.asarray(np.linalg.qr(triangles, mode="r"))


def search(
    windows: Sequence[FitWindow],
    parametrisation: Parametrisation,
    *,
    given: Chain | None,
) -> tuple[Attempt, int, bool]:
    """Return the best chain from several starts; stop early if one explains the records.

    Also return the number of starts, and whether some starts were not tried although no chain
    explained the records.

    Parameters
    ----------
    given : a chain to start from, or None.

    Raises
    ------
    DataError : the records suggest no start at all.
    """
    bench = parametrisation.bench
    regressed = [regress_chain(windows, bench=bench, width=width) for width in WIDTHS]
    # 700 samples per record are enough for the search to come close.
    full, windows = windows, [window.thinned(700) for window in windows]
    near = [parametrisation.pack(chain) for chain in (given, *regressed) if chain is not None]
    near.sort(key=lambda theta: evaluate_chain(windows, parametrisation, theta).cost)
    even = [parametrisation.pack(chain) for chain in even_chains(windows, bench=bench)]
    best: Attempt | None = None
    tried = comparisons = 0
    cut_short = False
    for theta in (*near, *even):
        # A comparison of a chain with a record takes about 1 ms. With all carts measured, a search
        # takes up to 200. With an unmeasured cart, it takes some 3000 to reach the noise, or 5000
        # if dry friction or backlash prevents this. Records that no chain explains could take any
        # number.
        if cut_short := comparisons >= 10_000:
            break
        found = minimise_from(windows, parametrisation, theta)
        tried, comparisons = tried + 1, comparisons + found.n_evaluations * len(windows)
        best = found if best is None or found.cost < best.cost else best
        # Chains of equal carts are far from the true chain, so a search from them may end at a
        # wrong one. All of them are tried, unless one explains the records down to their noise.
        if best.follows if tried <= len(near) else best.cost < EXPLAINED * best.dof:
            break
    if best is None:
        raise DataError(
            "time fit: needs records that a chain with these springs can follow, found none: "
            "are the springs stated right?"
        )
    return evaluate_chain(full, parametrisation, best.theta), tried, cut_short


# ---------------------------------------------------------------------- the stage

_TOLERANCE = 1e-9  # relative change of the cost; far below one standard error for any record


def fit_records(records: Sequence[Record], *, bench: Setup, start: Chain | None = None) -> ChainFit:
    """Fit one chain to all records at once.

    Records may differ in length, sample rate, and free and measured carts; held carts are removed
    from the chain. Decays are used from their release, and a closed loop with its measured input. A
    record that cannot be used is left out, and the fit's message says so.

    Parameters
    ----------
    bench : the carts and springs of the bench.
    start : a chain to start from, in addition to the starts from the records.

    Returns
    -------
    The fit. Its covariance allows for correlated residuals, for example due to dry friction. But
    `chi_square_per_dof` compares the residuals only with encoder step and local noise.

    Raises
    ------
    DataError : no record drives cart 1, or the records do not determine a parameter.
    """
    parametrisation = Parametrisation(bench=bench)
    windows, remarks = _open(records)
    attempt, n_starts, cut_short = search(windows, parametrisation, given=start)
    explained = attempt.follows
    windows = [_informed(attempt, index) for index in range(len(windows))]
    attempt = minimise_from(windows, parametrisation, attempt.theta, tolerance=_TOLERANCE)
    covariance = _covariance(attempt)
    while zero := _negligible(attempt, covariance):
        parametrisation = parametrisation.holding_at_zero(*zero)
        theta = parametrisation.pack(attempt.chain)
        attempt = minimise_from(windows, parametrisation, theta, tolerance=_TOLERANCE)
        covariance = _covariance(attempt)
    if not explained:
        remarks.insert(0, "no chain reproduces the recordings")
    elif cut_short:
        remarks.insert(0, f"the search ended after {n_starts} starts; more might find a better fit")
    elif not attempt.converged:
        remarks.insert(0, "the search did not converge")
    return _result(attempt, explained=explained, n_starts=n_starts, remarks=remarks)


def _open(records: Sequence[Record]) -> tuple[list[FitWindow], list[str]]:
    """Return the windows of all usable records, and notes on the records left out."""
    windows, left_out = [], []
    for record in records:
        try:
            windows.append(open_window(record))
        except DataError as error:
            left_out.append(str(error))
    driven = [window for window in windows if window.drive_u is not None]
    if not driven:
        found = f"found none ({'; '.join(left_out)})" if left_out else "found none"
        raise DataError(f"time fit: needs a record that drives cart 1, {found}")
    if all(window.is_constant for window in driven):
        windows = [replace(w, at_rest=w.is_constant and w.kind != "decay") for w in windows]
    return windows, [f"left out: {reason}" for reason in left_out]


# ----------------------------------------------------- knowledge from the residuals


def _informed(attempt: Attempt, index: int) -> FitWindow:
    """Return a window with the standard errors and the start condition that its residuals show."""
    window, misfit = attempt.windows[index], attempt.misfits[index]
    at_rest = window.at_rest or (window.kind != "decay" and _starts_at_rest(attempt, index))
    return window.informed(misfit.residual * window.sigma[:, None], at_rest=at_rest)


def _starts_at_rest(attempt: Attempt, index: int) -> bool:
    """Return whether a free start would improve the fit only by chance.

    The window then counts as starting at rest. The improvement is that of the fit to all windows,
    to first order. Residuals beyond the stated noise are an error of the chain, of which a record
    has few independent values.
    """
    resting = replace(attempt.windows[index], at_rest=True)
    (held,) = evaluate_chain([resting], attempt.parametrisation, attempt.theta).misfits
    others = [misfit for i, misfit in enumerate(attempt.misfits) if i != index]
    misfit = attempt.misfits[index]
    gain = (
        stacked_triangle([*others, held])[-1, -1] ** 2
        - stacked_triangle([*others, misfit])[-1, -1] ** 2
    )
    # A record is assumed to have 20 independent values of the chain's own error.
    structure = (np.sum(misfit.residual**2) - misfit.residual.size) / 20
    chance = max(long_run_variance(misfit.residual), structure)
    freed = misfit.n_nuisance - held.n_nuisance
    # The improvement may exceed the expected one by five standard deviations.
    return bool(gain <= chance * (freed + 5.0 * np.sqrt(2 * freed)))


def _covariance(attempt: Attempt) -> Array:
    """Return the covariance (n_p, n_p) of the free physical parameters.

    It is a sandwich of the Gauss-Newton Hessian and the long-run covariance of the scores. It is at
    least the covariance for white residuals of the same size.

    Raises
    ------
    DataError : the records do not determine a parameter.
    """
    names = attempt.parametrisation.names
    to_physical = attempt.parametrisation.dp_dtheta(attempt.theta)[:, None, None]
    jacobians = [misfit.jacobian / to_physical for misfit in attempt.misfits]
    scale = np.sqrt(sum(np.sum(s**2, axis=(1, 2)) for s in jacobians))
    if not np.all(scale > 0):
        raise _undetermined(names[int(np.argmin(scale))])
    jacobians = [s / scale[:, None, None] for s in jacobians]
    long = np.concatenate([s.reshape(scale.size, -1) for s in jacobians], axis=1)
    R = np.asarray(np.linalg.qr(long.T, mode="r"))
    _, singular, Vt = np.linalg.svd(R)
    # Limit on the smallest singular value of the scaled Jacobian over its largest.
    if singular[-1] < 1e-9 * singular[0]:
        raise _undetermined(names[int(np.argmax(np.abs(Vt[-1])))])
    whitening = np.linalg.inv(R)  # jacobians @ whitening are orthonormal
    scores = np.zeros_like(R)
    for misfit, s in zip(attempt.misfits, jacobians, strict=True):
        white = (whitening.T @ s.reshape(scale.size, -1)).reshape(s.shape)
        scores += score_covariance(misfit.residual, white)
    values, vectors = np.linalg.eigh(scores * (attempt.n_points / attempt.dof))
    values = np.maximum(values, attempt.cost / attempt.dof)
    half = (whitening @ vectors) * np.sqrt(values) / scale[:, None]
    return half @ half.T


def _undetermined(name: str) -> DataError:
    return DataError(f"time fit: the records do not determine {name}")


def _negligible(attempt: Attempt, covariance: Array) -> tuple[str, ...]:
    """Return the wall springs that the fit moved to zero; failing that, such dampings.

    Carts without springs keep their dampings, because a body without forces has no modes.
    """
    parametrisation, chain = attempt.parametrisation, attempt.chain
    share = parametrisation.physical(chain) / np.sqrt(np.diag(covariance))
    # A damping or wall spring below 5 % of its standard error is held at zero.
    gone = [name for name, value in zip(parametrisation.names, share, strict=True) if value < 0.05]
    walls = tuple(name for name in gone if name in ("k_1", f"k_{chain.n + 1}"))
    is_held = chain.k[0] > 0 or chain.k[-1] > 0
    return walls or tuple(name for name in gone if read_name(name).symbol == "c" and is_held)


def _released(attempt: Attempt) -> Attempt:
    """Return the attempt in which dampings that were held at zero are free.

    Every cart has some damping, and numbers that depend on it must not look more certain than it
    is. A spring, however, may really be missing.
    """
    held, chain = attempt.parametrisation, attempt.chain
    springs = tuple(name for name in held.zero if read_name(name).symbol == "k")
    if springs == held.zero:
        return attempt
    free = replace(held, zero=springs)
    # 1e-6 of critical damping: almost zero, but its logarithm has derivatives.
    c = np.where(chain.c > 0, chain.c, 1e-6 * critical_damping(chain))
    return evaluate_chain(attempt.windows, free, free.pack(replace(chain, c=c)))


# ------------------------------------------------------------------- the outcome


def _result(
    attempt: Attempt, *, explained: bool, n_starts: int, remarks: Sequence[str]
) -> ChainFit:
    """Return the fit's result; its χ² compares the residuals with the stated standard errors."""
    parametrisation, chain = attempt.parametrisation, attempt.chain
    released = _released(attempt)
    names, covariance = released.parametrisation.names, _covariance(released)
    try:
        parameters = named_estimates(chain, names=names, covariance=covariance, source="time_fit")
    except DataError:  # several carts without a spring to a wall have no gains
        parameters: dict[str, Estimate] = {}
    chi_square = 0.0
    standardised = {}
    for window, misfit in zip(attempt.windows, attempt.misfits, strict=True):
        residual = misfit.residual * (window.sigma / window.stated_sigma)[:, None]
        chi_square += float(np.sum(residual**2))
        for cart, row in zip(window.carts, residual, strict=True):
            standardised[f"{window.id} cart {cart}"] = row
    return ChainFit(
        method="time_fit",
        chain=chain,
        names=names,
        covariance=covariance,
        at_bound=parametrisation.zero,
        parameters=parameters,
        chi_square_per_dof=chi_square / attempt.dof,
        dof=attempt.dof,
        n_points=attempt.n_points,
        n_starts=n_starts,
        converged=attempt.converged and explained,
        message=_message(attempt, remarks),
        standardised=standardised,
        experiments=tuple(dict.fromkeys(window.id for window in attempt.windows)),
    )


def _message(attempt: Attempt, remarks: Sequence[str]) -> str:
    """Describe how the fit went."""
    count = len(attempt.windows)
    parts = [
        f"{count} time record{'s' * (count > 1)}, "
        f"{100 * (1 - attempt.unexplained_share):.1f} % of the motion explained",
        *remarks,
    ]
    if attempt.parametrisation.zero:
        parts.append(f"held at zero: {', '.join(attempt.parametrisation.zero)}")
    moving = [w.id for w in attempt.windows if w.kind != "decay" and not w.at_rest]
    if moving:
        parts.append(f"in motion at the start: {', '.join(moving)}")
    return "; ".join(parts)
