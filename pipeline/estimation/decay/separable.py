"""Least squares in which most unknowns are linear: those are solved for at every step.

Reference: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, in Kaufman's form.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import leastsq

from pipeline.arrays import Array
from pipeline.estimation.minimise import evaluated_once

_PRECISION = 1e-8  # relative: of the sum of squares, of p, and of its slope
_FOUND = (1, 2, 3, 4)  # what MINPACK says where it came to one of them


class SeparableModel(Protocol):
    """A model at some values of its nonlinear unknowns."""

    @property
    def columns(self) -> Array:
        """What the linear unknowns multiply, (n, n_linear)."""
        ...

    def derivatives(self, linear: Array) -> Array:
        """Return the derivatives of columns @ linear by the nonlinear unknowns, (n, n_p)."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class SeparableFit:
    """The nonlinear unknowns p (n_p,) and the linear ones where the residual is least.

    `residual` (n,) is model - y; `converged` False where the fit ran out of steps.
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
) -> SeparableFit:
    """Fit a model of p to y (n,) from `start` (n_p,) on; `scale` is the size of p."""

    def jacobian(point: _Point) -> Array:
        J = point.model.derivatives(point.linear)
        return J - point.basis @ (point.basis.T @ J)

    at = evaluated_once(lambda p: _solved(y, model(p)))
    # `least_squares` runs the same MINPACK routine, and takes as long again to prepare each call.
    with np.errstate(over="ignore"):  # in its covariance of p, which nobody asks for
        p, *_, status = leastsq(
            lambda p: at(p).residual,
            start,
            Dfun=lambda p: jacobian(at(p)),
            full_output=True,
            ftol=_PRECISION,
            xtol=_PRECISION,
            gtol=_PRECISION,
            maxfev=max_evaluations,
            diag=np.broadcast_to(1 / np.asarray(scale, dtype=np.float64), start.shape),
        )
    best = at(p)
    return SeparableFit(p=p, linear=best.linear, residual=best.residual, converged=status in _FOUND)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """The model at some p (n_p,), its linear unknowns solved for; `basis` spans the columns."""

    model: SeparableModel
    basis: Array
    linear: Array
    residual: Array


def _solved(y: Array, model: SeparableModel) -> _Point:
    """Return the model with the linear unknowns that leave the least of y."""
    X = model.columns
    basis, sizes, turn = np.linalg.svd(X, full_matrices=False)
    # Columns that are alike, far from the fit, share what they explain.
    apart = np.maximum(sizes, np.finfo(np.float64).eps * len(X) * sizes[0])
    linear = (y @ basis / apart) @ turn
    return _Point(model=model, basis=basis, linear=linear, residual=X @ linear - y)
