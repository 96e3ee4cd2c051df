"""Least squares in which most unknowns are linear: those are solved for at every step.

Reference: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432, in Kaufman's form.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares

from pipeline.plant.chain import Array


class Model(Protocol):
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
    model: Callable[[Array], Model],
    *,
    start: Array,
    max_evaluations: int,
    scale: Array | float = 1.0,
) -> SeparableFit:
    """Fit a model of p to y (n,) from `start` (n_p,) on; `scale` is the size of p."""
    projection = _Projection(y, model)
    fit = least_squares(
        projection.residual,
        start,
        jac=projection.jacobian,  # pyright: ignore[reportArgumentType] - scipy's default is a string
        method="lm",
        max_nfev=max_evaluations,
        x_scale=scale,
    )
    at = projection.at(fit.x)
    return SeparableFit(
        p=fit.x, linear=at.linear, residual=at.residual, converged=bool(fit.success)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Point:
    """The model at some p (n_p,), its linear unknowns solved for; `basis` spans the columns."""

    p: Array
    model: Model
    basis: Array
    linear: Array
    residual: Array


class _Projection:
    """The fit without its linear unknowns; residual and Jacobian ask for the same point."""

    def __init__(self, y: Array, model: Callable[[Array], Model]) -> None:
        self._y = y
        self._model = model
        self._last: _Point | None = None

    def at(self, p: Array) -> _Point:
        if self._last is None or not np.array_equal(self._last.p, p):
            model = self._model(p)
            X = model.columns
            basis, sizes, turn = np.linalg.svd(X, full_matrices=False)
            # Columns that are alike, far from the fit, share what they explain.
            apart = np.maximum(sizes, np.finfo(np.float64).eps * len(X) * sizes[0])
            linear = (self._y @ basis / apart) @ turn
            residual = X @ linear - self._y
            self._last = _Point(
                p=p.copy(), model=model, basis=basis, linear=linear, residual=residual
            )
        return self._last

    def residual(self, p: Array) -> Array:
        return self.at(p).residual

    def jacobian(self, p: Array) -> Array:
        at = self.at(p)
        J = at.model.derivatives(at.linear)
        return J - at.basis @ (at.basis.T @ J)
