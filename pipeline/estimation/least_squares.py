"""Nonlinear least squares, with variable projection, and the fit of damped sinusoids by it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.estimation.noise import relative_psd

# scipy is imported late, as it takes a fifth of a second: the process that draws fits nothing
if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# ----------------------------------------------------- residual and Jacobian from one evaluation

T = TypeVar("T")

MOST_EVALUATIONS = 100  # a fit that succeeds takes about ten


def minimise(
    at: Callable[[Array], tuple[Array, Array]],
    start: Array,
    *,
    max_evaluations: int = MOST_EVALUATIONS,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    scale: float | Literal["jac"] = 1.0,
    tolerance: float = 1e-8,
) -> "OptimizeResult":
    """Minimise the sum of squares of the residual, starting from `start` (n_p,).

    `at` returns the residual (n,) and the Jacobian (n, n_p) at p. `tolerance` is the relative
    change of the cost at which the search stops.
    """
    from scipy.optimize import least_squares

    once = evaluated_once(at)
    return least_squares(
        lambda p: once(p)[0],
        start,
        jac=lambda p: once(p)[1],  # pyright: ignore[reportArgumentType] - scipy's default is a string
        bounds=bounds,
        x_scale=scale,
        ftol=tolerance,
        max_nfev=max_evaluations,
    )


def evaluated_once(at: Callable[[Array], T]) -> Callable[[Array], T]:
    """Return `at` with its last result cached, for repeated calls with the same p (n_p,).

    Scipy asks for the residual at p, and then often for its derivatives at the same p.
    """
    last: list[tuple[Array, T]] = []

    def once(p: Array) -> T:
        if not (last and np.array_equal(last[0][0], p)):
            own = p.copy()  # MINPACK changes its array later
            last[:] = [(own, at(own))]
        return last[0][1]

    return once


# ---------------------------------------------------------------------- most unknowns are linear
#
# Reference: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, in Kaufman's form.

PRECISION = 1e-8  # relative tolerance of the sum of squares, of p, and of the slope
_FOUND = (1, 2, 3, 4)  # MINPACK's codes for convergence


class SeparableModel(Protocol):
    """A model at given values of its nonlinear unknowns."""

    @property
    def columns(self) -> Array:
        """The columns (n, n_linear) that multiply the linear unknowns."""
        ...

    def derivatives(self, linear: Array) -> Array:
        """Return d(columns @ linear)/dp (n, n_p) for the nonlinear unknowns p."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class SeparableFit:
    """The model at nonlinear unknowns p (n_p,), and the linear unknowns with the least residual.

    `basis` (n, n_linear) spans the model's columns, and `residual` (n,) is model - y; `converged`
    is False if the fit ran out of steps.
    """

    p: Array
    model: SeparableModel
    basis: Array
    linear: Array
    residual: Array
    converged: bool = False


def fit_separable(
    y: Array,
    model: Callable[[Array], SeparableModel],
    *,
    start: Array,
    max_evaluations: int = MOST_EVALUATIONS,
    scale: Array | float = 1.0,
    precision: float = PRECISION,
) -> SeparableFit:
    """Fit a model with nonlinear unknowns p to y (n,), starting from `start` (n_p,).

    `scale` is the typical size of p, `precision` the relative tolerance of the sum of squares, of p
    and of the slope.
    """
    from scipy.optimize import leastsq

    def jacobian(point: SeparableFit) -> Array:
        J = point.model.derivatives(point.linear)
        return J - point.basis @ (point.basis.T @ J)

    at = evaluated_once(lambda p: solve_linear(y, model, p))
    # `least_squares` runs the same MINPACK routine, but preparing each call takes as long as the
    # fit.
    with np.errstate(over="ignore"):  # in the covariance of p, which is not used
        p, *_, status = leastsq(
            lambda p: at(p).residual,
            start,
            Dfun=lambda p: jacobian(at(p)),
            full_output=True,
            ftol=precision,
            xtol=precision,
            gtol=precision,
            maxfev=max_evaluations,
            diag=np.broadcast_to(1 / np.asarray(scale, dtype=np.float64), start.shape),
        )
    return replace(at(p), p=p, converged=status in _FOUND)


def inverse_normal(model: SeparableModel, linear: Array) -> Array:
    """Return the inverse of J'J: the covariance of (p, linear) for white noise of variance 1."""
    full = np.column_stack([model.derivatives(linear), model.columns])
    size = np.maximum(np.linalg.norm(full, axis=0), np.finfo(float).tiny)
    inverse = np.linalg.pinv(np.linalg.qr(full / size, mode="r")) / size[:, None]
    return inverse @ inverse.T


def solve_linear(y: Array, model: Callable[[Array], SeparableModel], p: Array) -> SeparableFit:
    """Return the model at p (n_p,), with the linear unknowns that give the least residual."""
    at = model(p)
    X = at.columns
    basis, upper = np.linalg.qr(X)
    sizes = np.abs(np.diag(upper))
    least = np.finfo(np.float64).eps * len(X) * np.max(sizes)
    # Columns that differ by a thousand rounding errors need no singular values.
    if np.min(sizes) > 1e3 * least:
        from scipy.linalg import solve_triangular

        linear = solve_triangular(upper, y @ basis, check_finite=False)
    else:  # far from the solution, columns may be nearly equal; they then share their contribution
        basis, sizes, turn = np.linalg.svd(X, full_matrices=False)
        linear = (y @ basis / np.maximum(sizes, least)) @ turn
    return SeparableFit(p=p, model=at, basis=basis, linear=linear, residual=X @ linear - y)


# ---------------------------------------------------------------- damped sinusoids about a level

MOST_GROWTH = 50.0  # bound of an exponent, against overflow


@dataclass(frozen=True, kw_only=True, eq=False)
class Ringing:
    """A fit y = level + slope (t - t0) + sum of Re(amplitude exp(pole (t - t0))).

    Attributes
    ----------
    poles : poles (n_modes,) in the upper half plane, rad/s.
    amplitudes : complex amplitudes (n_modes,) at `t0`.
    covariance : covariance of (level, slope, decay rates, frequencies), for a residual that may be
        correlated. The row of the slope is zero if no slope was fitted.
    variance : variance of the residual near the frequencies, which the covariance assumes.
    rms : root mean square of the residual.
    converged : False if the fit ran out of steps.
    """

    t0: float
    level: float
    slope: float
    poles: ComplexArray
    amplitudes: ComplexArray
    covariance: Array
    variance: float
    rms: float
    converged: bool

    def __call__(self, t: Array) -> Array:
        """Return y at times t (n,)."""
        tau = t - self.t0
        waves = self.growth(t) * np.exp(1j * self.poles.imag[:, None] * tau)
        return self.level + self.slope * tau + (self.amplitudes[:, None] * waves).real.sum(0)

    def growth(self, t: Array) -> Array:
        """Return the size of each mode relative to its size at `t0`, (n_modes, n); at most e^50."""
        return np.exp(np.minimum(self.poles.real[:, None] * (t - self.t0), MOST_GROWTH))


def fit_ringing(t: Array, y: Array, *, poles: ComplexArray, drift: bool) -> Ringing:
    """Fit damped sinusoids, a level and (with `drift`) a linear drift, starting from given poles.

    The problem is linear in level, slope and amplitudes, so only decay rates and frequencies are
    searched.

    Parameters
    ----------
    t, y : times and readings (n,), at least 4 n_modes + 3 samples.
    poles : starting values (n_modes,) in the upper half plane, rad/s.
    """
    n_modes, scale = poles.size, float(np.mean(np.abs(poles)))
    tau = scale * (t - t[0])
    level = np.array([np.ones_like(t), t - t[0]] if drift else [np.ones_like(t)])
    k = len(level)
    # At the start, the decay rate is at least 1e-6 of the frequency.
    fit = fit_separable(
        y,
        lambda p: Waves(tau, p, level=level),
        start=np.append(np.maximum(-poles.real / scale, 1e-6), poles.imag / scale),
    )
    linear, residual, waves = fit.linear, fit.residual, fit.model
    X = waves.columns
    full = np.column_stack([X[:, :k], waves.derivatives(linear) / scale, X[:, k:]])
    kept = [0, 1] if drift else [0]
    kept += list(range(k, k + 2 * n_modes))
    inverse = np.linalg.pinv(np.linalg.qr(full, mode="r"))[kept]
    angle = float(np.median(fit.p[n_modes:])) * float(tau[-1] / (t.size - 1))
    variance = (
        float(residual @ residual)
        / max(t.size - full.shape[1], 1)
        * relative_psd(residual, angle=angle)
    )
    covariance = variance * (inverse @ inverse.T)
    if not drift:
        covariance = np.insert(np.insert(covariance, 1, 0.0, axis=0), 1, 0.0, axis=1)
    return Ringing(
        t0=float(t[0]),
        level=float(linear[0]),
        slope=float(linear[1]) if drift else 0.0,
        poles=scale * (-fit.p[:n_modes] + 1j * fit.p[n_modes:]),
        amplitudes=linear[k : k + n_modes] - 1j * linear[k + n_modes :],
        covariance=covariance,
        variance=variance,
        rms=float(np.sqrt(np.mean(residual**2))),
        converged=fit.converged,
    )


class Waves:
    """Damped waves (n_modes, n) at times `tau`, with a level (and drift).

    Decay rates and frequencies are p (2 n_modes,).
    """

    def __init__(self, tau: Array, p: Array, *, level: Array) -> None:
        self.tau, self.level = tau, level
        decay, frequency = p.reshape(2, -1, 1)
        growth = np.minimum(-decay * tau, MOST_GROWTH)
        self.waves: ComplexArray = np.exp(growth + 1j * frequency * tau)

    @property
    def columns(self) -> Array:
        """The factors of level, cosines and sines, (n, n_linear)."""
        return np.concatenate([self.level, self.waves.real, self.waves.imag]).T

    def derivatives(self, linear: Array) -> Array:
        """Return dy/dp (n, 2 n_modes)."""
        cosine, sine = linear[len(self.level) :].reshape(2, -1, 1)
        turned = -self.tau * (cosine - 1j * sine) * self.waves
        return np.concatenate([turned.real, turned.imag]).T


def find_poles(t: Array, y: Array, *, n_modes: int) -> ComplexArray:
    """Return rough poles of `n_modes` damped sinusoids about a level, upper half plane, rad/s.

    They are found by the matrix pencil method on evenly interpolated samples (Hua & Sarkar, IEEE
    Trans. ASSP 38, 1990). The level appears as one more pole, near zero. Fewer poles are returned
    if the data do not oscillate in so many modes.
    """
    # The matrix pencil is only a start for the fit; more samples would only take time.
    n = min(t.size, 300)
    grid = np.linspace(t[0], t[-1], n)
    hankel = np.lib.stride_tricks.sliding_window_view(np.interp(grid, t, y), n // 3)
    rows = np.linalg.svd(hankel, full_matrices=False)[2][: 2 * n_modes + 1].T
    z = np.linalg.eigvals(np.linalg.lstsq(rows[:-1], rows[1:], rcond=None)[0])
    s = np.log(z.astype(np.complex128)) / (grid[1] - grid[0])
    # Below this ratio of imaginary part to size, a pole is real except for rounding.
    return s[s.imag > 1e-3 * np.abs(s)]
