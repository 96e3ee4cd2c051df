"""Checks of single estimates: what they promise of a number."""

from pipeline.checks.estimates import check_steps
from pipeline.results import StepGain


def test_the_interval_of_a_cart_that_sticks_is_no_bound():
    """Two steps of one bench may give intervals that share no gain: neither need hold it."""
    steps = [
        StepGain(
            experiment=f"step-{i}",
            cart=1,
            edges=(),
            gain=sum(interval) / 2,
            gain_std=0.1,
            rest_shift=0.012,
            interval=interval,
            note="",
        )
        for i, interval in enumerate([(29.33, 30.55), (27.85, 28.75)])
    ]
    checks = check_steps(steps, gain_unit="cm/V")
    assert [check.outcome for check in checks] == ["fail", "fail"]
    assert all("may be farther off" in check.message for check in checks)
