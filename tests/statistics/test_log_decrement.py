"""Rates of friction found in decays: never without it, always with it; honest errors."""

import numpy as np
import pytest

from tests.stages.test_log_decrement import flags, standardised


@pytest.mark.slow
@pytest.mark.sample
def test_friction_is_not_seen_where_there_is_none():
    """At most 1 % of 600 clean decays are called friction."""
    assert flags(600, d=0.0).mean() <= 0.01


@pytest.mark.slow
@pytest.mark.sample
def test_friction_of_a_tenth_of_a_millimetre_is_always_seen():
    """At least 99 % of 400 decays with d = 0.01 cm are called friction."""
    assert flags(400, d=0.01).mean() >= 0.99


@pytest.mark.slow
def test_the_standard_errors_are_honest():
    """Over 400 noisy decays the 95 % intervals hold the truth in 92 to 98 %."""
    covered = np.mean(np.abs(standardised(400)) < 1.96, axis=0)
    assert np.all((covered[:2] > 0.92) & (covered[:2] < 0.98))
    assert covered[2] > 0.92  # a turning point uses several samples, so its error is an upper bound
