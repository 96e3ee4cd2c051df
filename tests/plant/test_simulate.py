"""The simulator of linear chains is exact."""

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import propagate, simulate_linear

THREE = PRESETS["throne-3dof"]
SAMPLE_TIME = 0.00884


def clock(n, sample_time=SAMPLE_TIME):
    return sample_time * np.arange(n, dtype=np.float64)


def irregular_times(rng, n, mean=SAMPLE_TIME):
    return np.concatenate([[0.0], np.cumsum(mean * rng.uniform(0.2, 1.8, size=n - 1))])


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("zeta", [0.02, 0.1, 0.7])
def test_step_of_one_cart_is_the_textbook_step(zeta):
    """At irregular times, one cart's step response follows the textbook formula."""
    k, omega_n = 0.03, 13.2
    m = k / omega_n**2
    chain = Chain(m=np.array([m]), c=np.array([2 * zeta * omega_n * m]), k=np.array([k, 0.0]))
    t = irregular_times(np.random.default_rng(1), 300)

    x = simulate_linear(chain, t, np.full(t.size, 0.06))

    omega_d, sigma = omega_n * np.sqrt(1 - zeta**2), zeta * omega_n
    expected = 2.0 * (
        1 - np.exp(-sigma * t) * (np.cos(omega_d * t) + sigma / omega_d * np.sin(omega_d * t))
    )
    # Rounding: 300 products of 2 x 2 matrices, each off by a few 1e-16.
    assert_allclose(x[0], expected, atol=1e-12)


def test_free_decay_from_a_state():
    """A cart released at 1 cm with a velocity follows a damped cosine and sine."""
    chain = PRESETS["throne-1dof"]
    t = irregular_times(np.random.default_rng(2), 400)

    x = simulate_linear(chain, t, np.zeros(t.size), x0=np.array([1.0, -3.0]))

    sigma = chain.zeta_carts[0] * chain.omega_carts[0]
    omega_d = np.sqrt(chain.omega_carts[0] ** 2 - sigma**2)
    sine = (-3.0 + sigma) / omega_d
    expected = np.exp(-sigma * t) * (np.cos(omega_d * t) + sine * np.sin(omega_d * t))
    assert_allclose(x[0], expected, atol=1e-12)


def test_agrees_with_python_control():
    """On a uniform clock, python-control's sampled system gives the same positions."""
    rng = np.random.default_rng(3)
    t = clock(500)
    u = 0.05 * rng.standard_normal(t.size)

    sampled = control.sample_system(control.ss(*THREE.state_space()), SAMPLE_TIME, method="zoh")
    expected = control.forced_response(sampled, T=t, U=u).outputs

    # Both matrix exponentials have errors of about 1e-13 of the largest motion.
    assert_allclose(simulate_linear(THREE, t, u), expected, atol=1e-10 * np.abs(expected).max())


def test_held_carts_are_walls():
    """If cart 3 is held, carts 1 and 2 move as a chain of two with a wall in its place."""
    short = Chain(m=THREE.m[:2], c=THREE.c[:2], k=THREE.k[:3])
    t = clock(300)
    u = np.full(t.size, 0.02)

    assert_array_equal(simulate_linear(THREE, t, u, free=(1, 2)), simulate_linear(short, t, u))


def test_steady_state_of_a_band_limited_sine():
    """A band-limited input is a smooth sine between its few samples."""
    omega = 2 * np.pi * 4.0
    t = clock(500, 0.03)  # 8 samples per period
    x = simulate_linear(THREE, t, np.sin(omega * t), hold="band_limited")

    response = THREE.frequency_response(np.array([omega]))[:, 0]
    expected = np.imag(response[:, None] * np.exp(1j * omega * t))
    inner = (t > 11.0) & (t < 14.5)  # the interpolation is cut off at the ends
    # Straight lines between 64 points per period have an error of (2 pi / 64)^2 / 12 = 8e-4.
    assert_allclose(x[:, inner], expected[:, inner], atol=1.2e-3 * np.abs(response).max())
    held = simulate_linear(THREE, t, np.sin(omega * t))
    assert rms(held[:, inner] - expected[:, inner]) > 0.2 * rms(expected[:, inner])


def test_a_linearly_rising_input_is_exact():
    """For a linearly rising input, a free mass moves as x = t³ / 6m at any sample times."""
    A, B, C, _ = Chain(m=np.array([2.0]), c=np.zeros(1), k=np.zeros(2)).state_space()
    t = irregular_times(np.random.default_rng(5), 80, mean=0.02)

    x = C @ propagate(A, B, t, t, x0=np.zeros(2), linear=True)

    assert_allclose(x[0], t**3 / 12, atol=1e-12)
