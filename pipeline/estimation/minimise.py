"""Nonlinear least squares in which residual and Jacobian come of one evaluation."""

from collections.abc import Callable
from typing import Any, Literal, TypeVar

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from pipeline.arrays import Array

T = TypeVar("T")


def minimise(
    at: Callable[[Array], T],
    start: Array,
    *,
    residual: Callable[[T], Array],
    jacobian: Callable[[T], Array],
    max_evaluations: int,
    method: Literal["trf", "lm"] = "trf",
    bounds: tuple[Any, Any] = (-np.inf, np.inf),
    scale: Array | float | Literal["jac"] = 1.0,
    tolerance: float = 1e-8,
) -> OptimizeResult:
    """Minimise the sum of squares of residual(at(p)) from `start` (n_p,) on.

    Scipy asks for the residual at p, and then often for its derivatives (n, n_p) there: `at` is
    worked out once for both. `tolerance` is the relative change of the cost to stop at.
    """
    last: list[tuple[Array, T]] = []

    def once(p: Array) -> T:
        if not (last and np.array_equal(last[0][0], p)):
            last[:] = [(p.copy(), at(p))]
        return last[0][1]

    return least_squares(
        lambda p: residual(once(p)),
        start,
        jac=lambda p: jacobian(once(p)),  # pyright: ignore[reportArgumentType] - scipy's default is a string
        method=method,
        bounds=bounds,
        x_scale=scale,
        ftol=tolerance,
        max_nfev=max_evaluations,
    )
