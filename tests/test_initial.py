"""Initial estimates from repeats: mean, standard error, and the repeat that stands off."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.results import Estimate, StepEdge, StepGain
from pipeline.stages.initial import combine_repeats, estimate_initially


def test_the_mean_of_repeats_has_the_error_of_their_spread():
    """Five repeats that scatter more than they claim: the spread over √5 counts."""
    values = [1.00, 1.02, 0.98, 1.01, 0.99]
    got = combine_repeats(values, std=[1e-4] * 5, source="step").estimate
    assert_allclose(got.value, 1.0, rtol=1e-12)
    assert got.std == pytest.approx(np.std(values, ddof=1) / np.sqrt(5), rel=1e-12)


def test_errors_that_are_larger_than_the_spread_win():
    """Repeats that agree by luck are not more certain than each of them claims."""
    got = combine_repeats([1.0, 1.0], std=[0.3, 0.4], source="step").estimate
    assert got.std == pytest.approx(0.25, rel=1e-12)  # √(0.3² + 0.4²) / 2


def test_one_repeat_far_off_is_left_out():
    """Four repeats within a percent and one half as large again: that one is named."""
    got = combine_repeats([1.0, 1.01, 1.5, 0.99, 1.0], std=[0.01] * 5, source="step")
    assert got.outliers == (2,)
    assert_allclose(got.estimate.value, 1.0, rtol=1e-12)


@pytest.mark.parametrize("values", [[1.0, 1.5], [1.0, 1.0, 1.5], [1.0, 1.001, 1.0, 1.004]])
def test_too_few_repeats_or_small_differences_name_nobody(values):
    """Of two or three nobody can be told to be wrong, and 0.4 % is nobody's concern."""
    assert combine_repeats(values, std=[1e-6] * len(values), source="step").outliers == ()


def _step(experiment, gain, cart=1):
    edge = StepEdge(
        t=1.0,
        u_before=0.0,
        u_after=1.0,
        level_before=0.0,
        level_after=gain,
        window_before=(0.0, 1.0),
        window_after=(3.0, 4.0),
        gain=gain,
        gain_std=0.01,
    )
    return StepGain(
        experiment=experiment,
        cart=cart,
        edges=(edge,),
        gain=gain,
        gain_std=0.01,
        rest_shift=None,
        interval=None,
    )


def test_steps_win_over_the_lowest_dwell_and_outliers_are_reported():
    """A gain measured by steps replaces that of the response; the run left out is named."""
    gains = [_step(f"step-{i}", g) for i, g in enumerate([2.0, 2.01, 1.99, 2.0, 3.0], 1)]
    response = {"K_1": Estimate(value=1.8, std=0.1, source="frequency_response")}
    response["omega_a"] = Estimate(value=9.0, std=0.1, source="frequency_response")
    estimates, left_out = estimate_initially(
        carts=2, log_decrements=[], step_gains=gains, from_response=response
    )
    assert estimates["K_1"].source == "step"
    assert_allclose(estimates["K_1"].value, 2.0, rtol=1e-12)
    assert estimates["omega_a"].source == "frequency_response"
    assert list(left_out) == ["step-5"]
    assert left_out["step-5"].startswith("K_1 = 3 stands off")
