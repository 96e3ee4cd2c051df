"""Least squares in which most unknowns are linear, and are solved for at every step.

Reference: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, in Kaufman's form.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import leastsq

from pipeline.arrays import Array
from pipeline.estimation.minimise import evaluated_once

PRECISION = 1e-8  # relative tolerance of the sum of squares, of p, and of the slope
_APART = 1e3  # rounding errors by which columns differ that need no singular values
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
    """The nonlinear unknowns p (n_p,), and the linear unknowns with the least residual.

    `residual` (n,) is model - y; `converged` is False if the fit ran out of steps.
    """

    p: Array
    linear: Array
    residual: Array
    converged: bool


def fit_separable(
    y: Array,
    model: Callable[[Array], SeparableModel],
    *,
    start: Array,
    max_evaluations: int,
    scale: Array | float = 1.0,
    precision: float = PRECISION,
) -> SeparableFit:
    """Fit a model with nonlinear unknowns p to y (n,), starting from `start` (n_p,).

    `scale` is the typical size of p, `precision` the relative tolerance of the sum of squares, of p
    and of the slope.
    """

    def jacobian(point: _Point) -> Array:
        J = point.model.derivatives(point.linear)
        return J - point.basis @ (point.basis.T @ J)

    at = evaluated_once(lambda p: _solved(y, model(p)))
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
    best = at(p)
    return SeparableFit(p=p, linear=best.linear, residual=best.residual, converged=status in _FOUND)


def squares_at(y: Array, model: SeparableModel) -> float:
    """Return the least sum of squares that a model leaves of y (n,)."""
    residual = _solved(y, model).residual
    return float(residual @ residual)


def inverse_normal(model: SeparableModel, linear: Array) -> Array:
    """Return the inverse of J'J: the covariance of (p, linear) for white noise of variance 1."""
    full = np.column_stack([model.derivatives(linear), model.columns])
    size = np.maximum(np.linalg.norm(full, axis=0), np.finfo(float).tiny)
    inverse = np.linalg.pinv(np.linalg.qr(full / size, mode="r")) / size[:, None]
    return inverse @ inverse.T


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """The model at some p (n_p,) with its best linear unknowns; `basis` spans the columns."""

    model: SeparableModel
    basis: Array
    linear: Array
    residual: Array


def _solved(y: Array, model: SeparableModel) -> _Point:
    """Return the model with the linear unknowns that give the least residual."""
    X = model.columns
    basis, upper = np.linalg.qr(X)
    sizes = np.abs(np.diag(upper))
    least = np.finfo(np.float64).eps * len(X) * np.max(sizes)
    if np.min(sizes) > _APART * least:
        linear = solve_triangular(upper, y @ basis, check_finite=False)
    else:  # far from the solution, columns may be nearly equal; they then share their contribution
        basis, sizes, turn = np.linalg.svd(X, full_matrices=False)
        linear = (y @ basis / np.maximum(sizes, least)) @ turn
    return _Point(model=model, basis=basis, linear=linear, residual=X @ linear - y)
