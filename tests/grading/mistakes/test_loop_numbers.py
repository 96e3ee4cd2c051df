"""Reported gains are judged by simulating their loop, however fast the controller samples."""

from decimal import Decimal

import numpy as np
import pytest

from pipeline.estimation.state_feedback import design_feedback
from pipeline.grading.mistakes.controller import Controller, diagnose_controller, loop_numbers
from pipeline.plant.chain import PRESETS, Chain
from pipeline.submission import Design

CHAIN = Chain(m=np.array([1.0]), c=np.array([0.2]), k=np.array([4.0, 0.0]))
OMEGA, ZETA = 6.0, 0.6
GAINS = np.array(
    [OMEGA**2 - 4.0, 2 * ZETA * OMEGA - 0.2]
)  # poles of x'' + 2 zeta omega x' + omega²


@pytest.mark.parametrize("sample_time", [1e-2, 1e-3, 5e-4, 1e-4])
def test_a_loops_step_figures_are_those_of_the_textbook(sample_time):
    """Overshoot is the textbook's, and the settling time hardly depends on the sample time."""
    numbers = loop_numbers(CHAIN, GAINS, cart=1, settling=1.0, sample_time=sample_time)
    assert numbers is not None
    assert numbers.stable
    overshoot = 100 * np.exp(-np.pi * ZETA / np.sqrt(1 - ZETA**2))
    assert numbers.overshoot == pytest.approx(overshoot, abs=0.02 + 500 * sample_time)
    slow = loop_numbers(CHAIN, GAINS, cart=1, settling=1.0, sample_time=2e-3)
    assert slow is not None
    assert numbers.settling_time == pytest.approx(slow.settling_time, abs=3e-3 + 3 * sample_time)
    assert numbers.prefilter == pytest.approx(OMEGA**2, rel=1e-6)


def test_a_loop_without_a_static_gain_has_no_step_figures():
    """If extreme carts give the loop no finite static gain, no step figures are computed."""
    K, omega, zeta = 28.9, 1e20, 2.0
    stiff = Chain(
        m=np.array([1 / (K * omega**2)]),
        c=np.array([2 * zeta / (K * omega)]),
        k=np.array([1 / K, 0.0]),
    )
    gains = np.array([0.0028, 0.0005])
    assert loop_numbers(stiff, gains, cart=1, settling=1.0, sample_time=None) is None


@pytest.mark.parametrize(
    "mistake",
    [
        lambda g: -g,
        lambda g: [g[0], g[2], g[1], g[3]],  # positions first
        lambda g: [g[2], g[3], g[0], g[1]],  # of the other cart
        lambda g: [g[1], g[0], g[3], g[2]],  # positions and velocities exchanged
        lambda g: [g[0], g[1], -g[2], g[3]],
    ],
    ids=["signs", "positions first", "carts", "exchanged", "one sign"],
)
def test_every_known_mistake_in_gains_is_undone(mistake):
    """`diagnose_controller` finds the gains that were meant, which are those that ran."""
    chain, goal = PRESETS["throne-2dof"], Design(cart=2, sample_time=0.00884)
    right = design_feedback(chain, goal)
    controller = Controller(
        gains=np.array(mistake(right.gains)), prefilter=Decimal(f"{right.prefilter:.4g}"),
        overshoot=Decimal(f"{right.overshoot_percent:.2g}"),
        settling=Decimal(f"{right.settling_time:.3g}"), ran=right.gains, models=(chain,), goal=goal,
        blurred=False, own=True, reference=chain,
    )  # fmt: skip
    flags, meant = diagnose_controller(controller)
    assert [flag.code for flag in flags] == ["wrong_gains"]
    assert flags[0].evidence["slip"]
    assert meant == pytest.approx(right.gains)
