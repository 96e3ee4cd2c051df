"""The last point that least squares asked for: a residual and its Jacobian are of the same one."""

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from pipeline.arrays import Array

T = TypeVar("T")


class LastPoint(Generic[T]):
    """A function of parameters p (n_p,) that is worked out once where it is asked for twice."""

    def __init__(self, evaluate: Callable[[Array], T]) -> None:
        self._evaluate = evaluate
        self._last: tuple[Array, T] | None = None

    def __call__(self, p: Array) -> T:
        """Return the function at p."""
        if self._last is None or not np.array_equal(self._last[0], p):
            self._last = p.copy(), self._evaluate(p)
        return self._last[1]
