"""Repeated initial estimates are combined into a mean with a standard error."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.estimation.estimates import combine_repeats


def test_the_mean_of_repeats_has_the_error_of_their_spread():
    """If repeats scatter more than their errors claim, the mean's error comes from the scatter."""
    values = [1.00, 1.02, 0.98, 1.01, 0.99]
    got = combine_repeats(values, std=[1e-4] * 5, source="step")
    assert_allclose(got.value, 1.0, rtol=1e-12)
    assert got.std == pytest.approx(np.std(values, ddof=1) / np.sqrt(5), rel=1e-12)


def test_stated_errors_count_if_the_spread_is_smaller():
    """If repeats agree better than their errors claim, the mean's error comes from these errors."""
    got = combine_repeats([1.0, 1.0], std=[0.3, 0.4], source="step")
    assert got.std == pytest.approx(0.25, rel=1e-12)  # √(0.3² + 0.4²) / 2
