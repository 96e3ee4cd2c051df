"""The designed loop as python-control sees it: its step, its margins, its gains once more."""

from dataclasses import replace

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.designed_loop import closed_loop, stability_margins
from pipeline.plant.loop import StateFeedback, broken_loop
from pipeline.results import FeedbackDesign
from pipeline.stages.design_check import design_margins, verify_design
from pipeline.stages.state_feedback import Method, design_feedback

RIGID = Chain(m=np.array([2e-4]), c=np.array([1e-4]), k=np.zeros(2))
FREE_PAIR = Chain(m=np.full(2, 3e-4), c=np.full(2, 4e-4), k=np.array([0.0, 0.12, 0.0]))
LIGHTLY_DAMPED = replace(PRESETS["throne-2dof"], c=PRESETS["throne-2dof"].c / 20)
PLANTS = {**PRESETS, "rigid": RIGID, "free pair": FREE_PAIR, "lightly damped": LIGHTLY_DAMPED}
CASES = [(name, method) for name in PLANTS for method in ("lqr", "poles")]


def designed(name: str, method: Method) -> tuple[Chain, FeedbackDesign, StateFeedback]:
    chain = PLANTS[name]
    design = design_feedback(
        chain,
        cart=chain.n,
        reference=1.0,
        overshoot_percent=10.0,
        settling_time=1.0,
        method=method,
    )
    controller = StateFeedback(gains=design.gains, prefilter=design.prefilter, model=chain)
    return chain, design, controller


@pytest.mark.parametrize(("name", "method"), CASES)
def test_the_closed_loop_makes_the_step_of_the_design(name, method):
    """Its states are named, and its step response is the run that the design was judged by."""
    chain, design, controller = designed(name, method)

    loop = closed_loop(chain, controller, sample_time=design.sample_time)

    assert loop.dt == design.sample_time
    assert loop.input_labels == ["r"]
    assert loop.output_labels == [f"x{i + 1}" for i in range(chain.n)]
    assert loop.state_labels == [
        *(f"{letter}{i + 1}" for i in range(chain.n) for letter in "xv"),
        "u",
    ]
    ticks = np.arange(design.t.size)
    response = control.step_response(loop, ticks * loop.dt)
    # Both are exact between the samples; rounding adds up over some hundred of them.
    assert_allclose(response.outputs.reshape(chain.n, -1), design.y, atol=1e-10)


@pytest.mark.parametrize(("name", "method"), CASES)
def test_margins_lie_on_the_edge_of_stability(name, method):
    """A little less than the gain or phase margin leaves the loop stable, a little more does not.

    The modulus margin is the smallest distance from -1 of a response a hundred times as dense.
    """
    chain, design, controller = designed(name, method)
    A, B, C = broken_loop(chain, controller, sample_time=design.sample_time)

    found = stability_margins(chain, controller, sample_time=design.sample_time)

    assert found is not None
    assert found.gain is not None
    assert found.phase_deg is not None
    assert found.omega_phase is not None

    def is_stable(factor: float) -> bool:
        return np.abs(np.linalg.eigvals(A - factor * np.outer(B, C))).max() < 1

    # Between the frequencies looked at the response is interpolated by cubics, to some 1e-5.
    assert is_stable(1 + 0.9999 * (found.gain - 1))
    assert not is_stable(1 + 1.0001 * (found.gain - 1))

    def response(omega):
        z = np.exp(1j * np.asarray(omega) * design.sample_time)
        return (C @ np.linalg.solve(z[..., None, None] * np.eye(B.size) - A, B[:, None]))[..., 0]

    turned = response(found.omega_phase) * np.exp(-1j * np.radians(found.phase_deg))
    assert_allclose(turned, -1.0, atol=1e-3)
    omega = np.linspace(1e-3, np.pi / design.sample_time, 60_000)
    assert_allclose(found.modulus, np.abs(1 + response(omega)).min(), rtol=1e-3)


def test_an_unstable_loop_has_no_margins():
    """Where the loop runs away there is nothing to be far from, and the stage says so."""
    chain, design, controller = designed("throne-3dof", "lqr")
    wild = StateFeedback(gains=50 * controller.gains, prefilter=1.0, model=chain)
    assert stability_margins(chain, wild, sample_time=design.sample_time) is None
    with pytest.raises(DataError, match="margins need a stable loop"):
        design_margins(chain, replace(design, gains=wild.gains))


@pytest.mark.parametrize(("name", "method"), CASES)
def test_control_finds_the_same_gains(name, method):
    """The check passes for what was designed, and fails where one gain is a hundredth off."""
    chain, design, _ = designed(name, method)
    assert verify_design(chain, design).outcome == "pass"
    spoilt = design.gains.copy()
    spoilt[0] *= 1.01
    check = verify_design(chain, replace(design, gains=spoilt))
    assert check.outcome == "fail"
    assert check.value is not None
    assert check.limit is not None
    assert check.value > check.limit
