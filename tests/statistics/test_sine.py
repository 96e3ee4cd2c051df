"""The standard errors of fitted sines are right."""

import numpy as np
import pytest

from tests.estimation.test_sine import coverage


@pytest.mark.slow
@pytest.mark.parametrize("from_rest", [True, False])
def test_the_standard_errors_are_right(from_rest):
    """In about 95 % of 400 dwells, 95 % intervals of gain and phase contain the true value."""
    covered = np.mean(np.abs(coverage(400, from_rest=from_rest)) < 1.96, axis=0)
    # The binomial standard error is 1.1 %. Rounding errors are not normal, and after seven time
    # constants 0.1 % of a transient is left.
    assert np.all(covered > 0.89)
    assert np.all(covered < 0.985)
