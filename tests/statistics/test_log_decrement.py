"""Dry friction is found only in decays that have it; standard errors are right."""

import numpy as np
import pytest

from tests.estimation.test_log_decrement import flags, standardised


@pytest.mark.slow
@pytest.mark.sample
def test_friction_is_not_found_if_there_is_none():
    """Of 600 decays without friction, friction is reported in at most 1 %."""
    assert flags(600, d=0.0).mean() <= 0.01


@pytest.mark.slow
@pytest.mark.sample
def test_friction_of_a_tenth_of_a_millimetre_is_found():
    """Of 400 decays with friction of d = 0.01 cm, friction is reported in at least 99 %."""
    assert flags(400, d=0.01).mean() >= 0.99


@pytest.mark.slow
def test_the_standard_errors_are_right():
    """Over 400 noisy decays, 92 to 98 % of the 95 % intervals contain the true value."""
    covered = np.mean(np.abs(standardised(400)) < 1.96, axis=0)
    assert np.all((covered[:2] > 0.92) & (covered[:2] < 0.98))
    assert covered[2] > 0.92  # errors of turning points are stated too large
