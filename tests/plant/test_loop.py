"""The sampled loop is simulated exactly, with the right order of events and its limits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.sampled_loop import (
    LoopSetup,
    Pid,
    StateFeedback,
    discretise,
    loop_matrix,
    replay,
    simulate_loop,
)
from pipeline.plant.simulate import simulate_linear

T = 0.00884  # s
TWO = PRESETS["throne-2dof"]
GAINS = np.array([0.03, 0.007, -0.04, -0.001])
CLOCK = T * np.arange(300.0)

# about 300 products of matrices of norm near one, each rounded to 1e-16
ROUNDING = 1e-11


def feedback(chain: Chain, gains: Array = GAINS, prefilter: float = 0.07) -> StateFeedback:
    return StateFeedback(gains=gains, prefilter=prefilter, model=chain)


@pytest.mark.parametrize("delay", [0, 1])
def test_with_an_exact_prediction_a_delay_only_shifts_the_motion(delay):
    """With the true model, a loop with delay moves as without delay, only later."""
    run = simulate_loop(TWO, feedback(TWO), t=CLOCK, reference=1.0, setup=LoopSetup(delay=delay))

    phi, gamma = discretise(TWO, T)
    x, expected = np.zeros(4), np.zeros((2, CLOCK.size))
    for tick in range(delay, CLOCK.size):
        expected[:, tick] = x[0::2]
        x = phi @ x + gamma * (0.07 - GAINS @ x)
    assert_allclose(run.x, expected, atol=ROUNDING)


@pytest.mark.parametrize("model", [None, PRESETS["throne-2dof"]])
def test_the_loop_matrix_gives_the_motion_of_the_loop(model):
    """Powers of the loop matrix give the motion after a start from a displacement."""
    controller = StateFeedback(gains=GAINS, prefilter=1.0, model=model)
    x0 = np.array([0.5, 3.0, -0.2, 1.0])
    run = simulate_loop(TWO, controller, t=CLOCK, reference=0.0, start=x0)

    matrix = loop_matrix(TWO, controller, sample_time=T)
    state = np.concatenate([x0, [0.5, 0.0, -0.2, 0.0], [0.0]])  # observer at rest
    for tick in range(CLOCK.size):
        assert_allclose(run.x[:, tick], state[[0, 2]], atol=ROUNDING)
        assert_allclose(run.u[tick], state[-1], atol=ROUNDING)
        state = matrix @ state


def test_the_input_stays_within_its_limit():
    """An input limit clips the input; a limit that is never reached changes nothing."""
    free = simulate_loop(TWO, feedback(TWO), t=CLOCK, reference=1.0)
    peak = np.abs(free.u).max()
    roomy = simulate_loop(
        TWO, feedback(TWO), t=CLOCK, reference=1.0, setup=LoopSetup(input_limit=1.01 * peak)
    )
    tight = simulate_loop(
        TWO, feedback(TWO), t=CLOCK, reference=1.0, setup=LoopSetup(input_limit=0.5 * peak)
    )

    assert_allclose(roomy.x, free.x, rtol=0, atol=0)
    assert np.abs(tight.u).max() == 0.5 * peak
    # The observer gets the clipped input, so the carts respond exactly to the clipped input.
    assert_allclose(tight.x, simulate_linear(TWO, CLOCK, tight.u), atol=ROUNDING)


def test_the_pid_uses_sums_and_differences():
    """The first two inputs of a PID follow from sums and differences of the error."""
    pid = Pid(kp=0.3, ki=2.0, kd=0.004, scale=0.1)
    run = simulate_loop(
        PRESETS["throne-1dof"], pid, t=CLOCK, reference=1.0, setup=LoopSetup(delay=0)
    )

    error = 1.0 - run.x[0, :2]
    kick = 0.1 * (0.3 * error[0] + 2.0 * error[0] * T + 0.004 * error[0] / T)
    second = 0.3 * error[1] + 2.0 * error.sum() * T + 0.004 * (error[1] - error[0]) / T
    assert_allclose(run.u[:2], [kick, 0.1 * second], rtol=1e-12)


def test_the_controller_sees_whole_encoder_steps():
    """The inputs of a proportional controller are multiples of the gain times the encoder step."""
    step = np.array([0.01, 0.0])
    run = simulate_loop(
        TWO, Pid(kp=0.02), t=CLOCK, reference=1.0, setup=LoopSetup(encoder_step=step, delay=0)
    )

    counts = run.u / (0.02 * 0.01)
    assert_allclose(counts, np.round(counts), atol=1e-9)
    assert np.ptp(counts) > 50


def test_a_controller_faster_than_the_log_acts_between_its_samples():
    """If only every tenth tick is logged, the motion is the same as with every tick."""
    fine = T / 10 * np.arange(2001.0)
    full = simulate_loop(TWO, feedback(TWO), t=fine, reference=1.0)
    logged = simulate_loop(
        TWO, feedback(TWO), t=fine[::10], reference=1.0, setup=LoopSetup(sample_time=T / 10)
    )

    assert_allclose(logged.x, full.x[:, ::10], atol=ROUNDING)
    assert_allclose(logged.u, full.u[::10], atol=ROUNDING)


def test_rounded_time_stamps_keep_the_reference_at_its_sample():
    """Time stamps rounded to the millisecond do not shift the reference's edge by a sample."""
    reference = np.where(np.arange(CLOCK.size) >= 57, 1.0, 0.0)
    exact = simulate_loop(TWO, feedback(TWO), t=CLOCK, reference=reference)
    rounded = simulate_loop(TWO, feedback(TWO), t=np.round(CLOCK, 3), reference=reference)

    # A time stamp is off by at most 0.5 ms, and a sample lasts 8.84 ms.
    assert np.abs(rounded.x - exact.x).max() < 0.0005 * np.abs(np.diff(exact.x)).max() / T * 1.1
    assert_allclose(rounded.u, exact.u, atol=1e-3 * np.abs(exact.u).max())


def test_a_reversed_drive_needs_negated_gains():
    """If the drive is reversed, negated gains give the same forces."""
    mirrored = Pid(kp=-0.02, kd=-0.0005)
    run = simulate_loop(TWO, Pid(kp=0.04, kd=0.001), t=CLOCK, reference=1.0)
    other = simulate_loop(TWO, mirrored, t=CLOCK, reference=1.0, setup=LoopSetup(drive=-2.0))

    assert_allclose(other.x, run.x, atol=ROUNDING)
    assert_allclose(other.u, -run.u / 2, atol=ROUNDING)


def test_the_rest_adds_to_the_readings():
    """An encoder zeroed away from rest shifts the readings, and the controller reacts to them."""
    shift = np.array([0.3, -0.1])
    run = simulate_loop(TWO, Pid(kp=0.02), t=CLOCK, reference=1.0, setup=LoopSetup(rest=shift))
    same = simulate_loop(TWO, Pid(kp=0.02), t=CLOCK, reference=1.0 - 0.3)

    assert_allclose(run.x, same.x + shift[:, None], atol=ROUNDING)


def test_held_carts_are_walls():
    """If cart 2 of two is held, cart 1 moves as a single cart on two springs."""
    alone = Chain(m=TWO.m[:1], c=TWO.c[:1], k=TWO.k[:2])
    pid = Pid(kp=0.02, kd=0.001)
    run = simulate_loop(TWO, pid, t=CLOCK, reference=1.0, setup=LoopSetup(free=[1]))

    assert_allclose(run.x, simulate_loop(alone, pid, t=CLOCK, reference=1.0).x, atol=ROUNDING)


def test_a_replay_gives_the_logged_input():
    """From the readings of a PID run without delay, the control law gives the logged input."""
    pid = Pid(kp=0.02, ki=0.01, kd=0.0004, scale=0.7, cart=2)
    run = simulate_loop(TWO, pid, t=CLOCK, reference=1.0, setup=LoopSetup(delay=0))

    stated = replay(pid, t=CLOCK, y=run.x, reference=np.ones(CLOCK.size), free=(1, 2))

    assert_allclose(stated, run.u, atol=ROUNDING)


def test_a_pid_on_a_held_cart_is_refused():
    """A PID on a held cart is refused, as the cart cannot be controlled."""
    with pytest.raises(DataError, match=r"cart 2 .*\[1\]"):
        simulate_loop(TWO, Pid(kp=1.0, cart=2), t=CLOCK, reference=1.0, setup=LoopSetup(free=[1]))
