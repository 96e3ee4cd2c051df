"""Nonlinear least squares that gets residual and Jacobian from one evaluation."""

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from pipeline.arrays import Array

T = TypeVar("T")


def minimise(
    at: Callable[[Array], tuple[Array, Array]],
    start: Array,
    *,
    max_evaluations: int,
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    scale: float | Literal["jac"] = 1.0,
    tolerance: float = 1e-8,
) -> OptimizeResult:
    """Minimise the sum of squares of the residual, starting from `start` (n_p,).

    `at` returns the residual (n,) and the Jacobian (n, n_p) at p. `tolerance` is the relative
    change of the cost at which the search stops.
    """
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
