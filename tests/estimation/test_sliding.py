"""The largest value in a window that slides along a series is found."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d

from pipeline.estimation.interventions import running_max


@pytest.mark.parametrize("width", [1, 3, 7, 61])
@pytest.mark.parametrize("n", [1, 2, 30, 500])
def test_the_sliding_maximum_is_that_of_scipy(n, width):
    """The sliding maximum equals scipy's, even near the ends or with a long window."""
    values = np.random.default_rng(n + width).standard_normal(n)

    assert np.array_equal(running_max(values, width), maximum_filter1d(values, width))
