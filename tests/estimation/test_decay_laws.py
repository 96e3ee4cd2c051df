"""The models of decays are differentiated right, and standard errors follow the derivatives."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.estimation.decay import find_decay, fit_decay, fit_log_decrement
from pipeline.estimation.decay_laws import DECAY, DRAG, FREQUENCY, SHIFT, Modulated, Swings
from pipeline.estimation.least_squares import Waves
from tests.helpers.time_records import COUNT, record_of

T = np.linspace(0.0, 3.0, 200)
LEVEL = np.array([np.ones_like(T), T])
MODELS = {
    # name: the model at p, p, linear unknowns
    "waves": (lambda p: Waves(T, p, level=LEVEL), [0.5, 0.8, 12.0, 20.0],
              [0.1, 0.02, 1.0, 0.3, -0.4, 0.2]),
    "swings": (lambda p: Swings(T, p, direction=-1.0), [-0.01, 0.6, 20.0], [0.1, 0.02, 1.0, 0.03]),
    "stopped swings": (lambda p: Swings(T, p, direction=1.0, cycles=7.0), [-0.01, 0.6, 20.0],
                       [0.1, 0.02, 1.0, 0.03]),
    "drag": (lambda p: Modulated(T, p, free=[DECAY, FREQUENCY, DRAG], power=2), [0.4, 20.0, 0.5],
             [0.1, 0.02, 1.0, 0.3, 0.05, -0.02]),
    "shift": (lambda p: Modulated(T, p, free=[DECAY, FREQUENCY, SHIFT], power=3), [0.4, 20.0, 0.8],
              [0.1, 0.02, 1.0, 0.3, 0.05, -0.02]),
    "bent drift": (lambda p: Modulated(T, p, free=[DECAY, FREQUENCY], bends=3, length=3.0),
                   [0.4, 20.0], [0.1, 0.02, 0.05, -0.03, 1.0, 0.3]),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_the_derivatives_are_those_of_the_model(name):
    """The derivatives by the nonlinear unknowns agree with central differences."""
    model, p, linear = MODELS[name]
    p, linear = np.array(p), np.array(linear)
    step = 1e-6 * np.diag(np.maximum(np.abs(p), 0.1))
    found = model(p).derivatives(linear).T
    for row, dp in zip(found, step, strict=True):
        by_difference = (model(p + dp).columns - model(p - dp).columns) @ linear / (2 * dp.sum())
        # A difference errs by rounding / step = 1e-16 / 1e-7 = 1e-9 of y, and by less than that for
        # its step. At a turning point a sample may change its half cycle, where y is smooth.
        assert_allclose(row, by_difference, atol=1e-6 * np.abs(row).max())


def test_the_errors_of_an_exponential_are_those_of_its_pole():
    """The errors of ζ and ω_n follow from the covariance of decay rate and damped frequency."""
    pole = complex(-0.4, np.sqrt(1 - 0.4**2)) * 20.0  # a larger ζ correlates the two more
    t = np.arange(90) / 113.1
    run = record_of(t, None, np.real(np.exp(pole * t))[None], kind="decay")
    got = fit_log_decrement(run, cart=1)
    stretch, turning = find_decay(run, cart=1, size=COUNT)
    decay = fit_decay(
        t, run.position(1), stretch=stretch, run=turning, floor=COUNT / np.sqrt(12), step=COUNT
    )
    assert got.law.name == "exponential"

    def numbers(rate, omega_d):
        omega_n = np.hypot(rate, omega_d)
        return np.array([rate / omega_n, omega_n])

    (found,), step = decay.fit.poles, 1e-4
    at = np.array([-found.real, found.imag])
    J = np.array([numbers(*(at + h)) - numbers(*(at - h)) for h in step * np.eye(2)]).T / (2 * step)
    expected = np.sqrt(np.diag(J @ decay.fit.covariance[2:, 2:] @ J.T))
    # A central difference errs by (step / 20)² = 3e-11 and by rounding of 1e-16 / step.
    assert_allclose([got.zeta_std, got.omega_n_std], expected, rtol=1e-6)
