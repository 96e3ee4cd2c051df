"""What reported gains do on a chain, however fast the controller samples."""

import numpy as np
import pytest

from pipeline.grading.loop_numbers import loop_numbers
from pipeline.plant.chain import Chain

CHAIN = Chain(m=np.array([1.0]), c=np.array([0.2]), k=np.array([4.0, 0.0]))
OMEGA, ZETA = 6.0, 0.6
GAINS = np.array(
    [OMEGA**2 - 4.0, 2 * ZETA * OMEGA - 0.2]
)  # poles of x'' + 2 zeta omega x' + omega²


@pytest.mark.parametrize("sample_time", [1e-2, 1e-3, 5e-4, 1e-4])
def test_a_fast_controller_is_seen_to_settle(sample_time):
    """The textbook's overshoot and the same settling time, to a sample's and its delay's error."""
    numbers = loop_numbers(CHAIN, GAINS, cart=1, settling=1.0, sample_time=sample_time)
    assert numbers is not None
    assert numbers.stable
    overshoot = 100 * np.exp(-np.pi * ZETA / np.sqrt(1 - ZETA**2))
    assert numbers.overshoot == pytest.approx(overshoot, abs=0.02 + 500 * sample_time)
    slow = loop_numbers(CHAIN, GAINS, cart=1, settling=1.0, sample_time=2e-3)
    assert slow is not None
    assert numbers.settling_time == pytest.approx(slow.settling_time, abs=3e-3 + 3 * sample_time)
    assert numbers.prefilter == pytest.approx(OMEGA**2, rel=1e-6)


@pytest.mark.parametrize("k", [1e58, 1e250])
def test_a_loop_without_a_static_gain_has_no_numbers(k):
    """Of a chain so stiff that the carts do not move, no prefilter brings them anywhere."""
    stiff = Chain(m=np.array([1e-5]), c=np.array([0.0]), k=np.array([k, 0.0]))
    numbers = loop_numbers(stiff, GAINS, cart=1, settling=1.0, sample_time=None)
    assert numbers is None or np.isfinite(numbers.prefilter)
