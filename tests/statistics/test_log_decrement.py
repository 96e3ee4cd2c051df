"""Dry friction is found in decays that have it, and in no others; standard errors are right."""

import numpy as np
import pytest

from tests.stages.test_log_decrement import flags, standardised


@pytest.mark.slow
@pytest.mark.sample
def test_friction_is_not_seen_where_there_is_none():
    """Of 600 decays without friction, at most 1 % are said to have friction."""
    assert flags(600, d=0.0).mean() <= 0.01


@pytest.mark.slow
@pytest.mark.sample
def test_friction_of_a_tenth_of_a_millimetre_is_always_seen():
    """Of 400 decays with a friction of d = 0.01 cm, at least 99 % are said to have friction."""
    assert flags(400, d=0.01).mean() >= 0.99


@pytest.mark.slow
def test_the_standard_errors_are_honest():
    """Over 400 noisy decays the 95 % intervals hold the truth in 92 to 98 %."""
    covered = np.mean(np.abs(standardised(400)) < 1.96, axis=0)
    assert np.all((covered[:2] > 0.92) & (covered[:2] < 0.98))
    assert covered[2] > 0.92  # a turning point uses several samples, so its error is an upper bound
