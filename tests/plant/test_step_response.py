"""Overshoot and settling time agree with the closed form of a second-order system."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.plant.simulate import overshoot_percent, settling_time

T = np.linspace(0.0, 4.0, 40001)


def second_order(omega_n: float, zeta: float) -> np.ndarray:
    omega_d = omega_n * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * omega_n * T)
    return 1 - decay * (np.cos(omega_d * T) + zeta / np.sqrt(1 - zeta**2) * np.sin(omega_d * T))


@pytest.mark.parametrize("zeta", [0.1, 0.3, 0.6])
@pytest.mark.parametrize(("before", "level"), [(0.0, 1.0), (2.0, -3.0)])
def test_overshoot_is_the_closed_form(zeta, before, level):
    """The overshoot of a second-order step, up or down, is exp(-pi zeta / sqrt(1 - zeta²))."""
    y = before + (level - before) * second_order(20.0, zeta)

    got = overshoot_percent(y, before=before, level=level)

    # The highest sample is below the peak by (omega dt)²/2 = 2e-6 of the oscillation.
    assert_allclose(got, 100 * np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), atol=1e-3)


def test_settling_time_is_the_last_entry_into_the_band():
    """The settling time is the last time the response enters the 2 % band, to within a sample."""
    y = second_order(20.0, 0.2)
    got = float(settling_time(T, y, before=0.0, level=1.0))

    assert np.all(np.abs(y[T >= got] - 1) <= 0.02)
    assert np.abs(y[np.searchsorted(T, got) - 1] - 1) > 0.02
    # The envelope reaches 2 % at about 4 / (zeta omega), and the response within half a cycle of
    # that.
    assert_allclose(got, np.log(50) / 4.0, atol=np.pi / 20)
    # A recording that begins later has the same settling time.
    assert settling_time(T + 3.0, y, before=0.0, level=1.0) == pytest.approx(got)


def test_noise_widens_the_band():
    """A response that is outside the band only because of noise counts as settled."""
    y = second_order(20.0, 0.5) + 0.03 * np.sin(2000 * T)

    assert np.isnan(settling_time(T, y, before=0.0, level=1.0))
    assert settling_time(T, y, before=0.0, level=1.0, noise=0.04) < 0.5
