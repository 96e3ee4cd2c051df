"""Types of real and complex arrays, and functions for read-only copies."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def true_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return [start, stop) of each run of true values in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.pad(mask.astype(np.int8), 1)))
    return [(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def frozen_array(values: object, *, name: str, shape: tuple[int, ...] | None = None) -> Array:
    """Return a read-only float64 copy of an array, after checking its shape."""
    array = np.array(values, dtype=np.float64)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, found {array.shape}")
    array.flags.writeable = False
    return array


def freeze(instance: object, *names: str) -> None:
    """Replace the named array fields of a frozen dataclass by read-only copies."""
    for name in names:
        value = getattr(instance, name)
        if value is not None:
            object.__setattr__(instance, name, frozen_array(value, name=name))
