"""The largest value in a window that slides along a series.

`scipy.ndimage` has such a filter too, but loading it takes longer than reading a submission.
"""

from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)


def most_around(values: NDArray[T], width: int) -> NDArray[T]:
    """Return, for each value, the largest of the `width` values centred on it; `width` is odd."""
    padded = np.pad(values, width // 2, mode="edge")
    return sliding_window_view(padded, width).max(axis=-1)
