"""The step, margins and gains of a designed loop are checked with python-control."""

from dataclasses import replace
from typing import Literal

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.estimation.state_feedback import design_feedback
from pipeline.identify.model_checks import design_margins, verify_design
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.margins import Margins, closed_loop, stability_margins
from pipeline.plant.sampled_loop import StateFeedback, broken_loop
from pipeline.results import FeedbackDesign
from pipeline.submission import Design

RIGID = Chain(m=np.array([2e-4]), c=np.array([1e-4]), k=np.zeros(2))
FREE_PAIR = Chain(m=np.full(2, 3e-4), c=np.full(2, 4e-4), k=np.array([0.0, 0.12, 0.0]))
LIGHTLY_DAMPED = replace(PRESETS["throne-2dof"], c=PRESETS["throne-2dof"].c / 1000)
UNDAMPED = replace(PRESETS["throne-2dof"], c=np.zeros(2))
PLANTS = {**PRESETS, "rigid": RIGID, "free pair": FREE_PAIR, "lightly damped": LIGHTLY_DAMPED}
CASES = [(name, method) for name in PLANTS for method in ("lqr", "poles")]
# Sample time and settling time in s: default, fast sampling, slow goal, fast goal.
PACES = [(None, 1.0), (1e-4, 1.0), (None, 30.0), (0.02, 0.3)]


def designed(
    chain: Chain,
    method: Literal["poles", "lqr"],
    *,
    sample_time: float | None = None,
    settling_time: float = 1.0,
) -> tuple[FeedbackDesign, StateFeedback]:
    design = design_feedback(
        chain,
        Design(
            cart=chain.n,
            reference=1.0,
            overshoot_percent=10.0,
            settling_time=settling_time,
            sample_time=sample_time,
            method=method,
        ),
    )
    return design, design.controller(chain)


@pytest.mark.parametrize(("name", "method"), CASES)
def test_the_closed_loop_gives_the_step_of_the_design(name, method):
    """The closed loop, as a python-control model, has named states and gives the design's step."""
    chain = PLANTS[name]
    design, controller = designed(chain, method)

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
    # Both are exact; a few hundred rounding errors add up.
    assert_allclose(response.outputs.reshape(chain.n, -1), design.y, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "method", "sample_time", "settling_time"),
    # Placed poles are tested only at the default pace, since other paces make no difference. The
    # first loop's gain is limited on both sides, and the nearest limit is not the smallest factor.
    [
        ("throne-3dof", "poles", 0.02, 0.3),
        *(
            (name, method, *pace)
            for pace in PACES
            for name, method in CASES
            if method == "lqr" or pace == PACES[0]
        ),
    ],
)
def test_margins_are_the_edge_of_stability(name, method, sample_time, settling_time):
    """Within its margins the loop is stable, and just beyond them it is unstable.

    The test changes the loop's gain or phase up to each margin and beyond, and computes the poles.
    |1 + L| is never below the modulus margin, and reaches it.
    """
    chain = PLANTS[name]
    design, controller = designed(
        chain, method, sample_time=sample_time, settling_time=settling_time
    )
    A, B, C = broken_loop(chain, controller, sample_time=design.sample_time)

    found = Margins.of(*stability_margins(chain, controller, sample_time=design.sample_time))

    assert found.gain is not None
    assert found.phase_deg is not None
    assert found.omega_gain is not None
    assert found.omega_phase is not None

    def is_stable(factor: complex) -> bool:
        return bool(np.abs(np.linalg.eigvals(A - factor * np.outer(B, C))).max() < 1)

    def response(omega):
        z = np.exp(1j * np.reshape(omega, (-1, 1, 1)) * design.sample_time)
        return np.linalg.solve(z * np.eye(B.size) - A, B[:, None])[:, :, 0] @ C

    gain, turn = np.log(found.gain), -1j * np.radians(found.phase_deg)
    for exponent in (gain, turn):
        assert all(is_stable(np.exp(share * exponent)) for share in np.linspace(-0.99, 0.99, 23))
        assert not is_stable(np.exp(1.002 * exponent))
    # A crossing is found to 1e-11 of its frequency; near a lightly damped mode, L varies 1e4 times
    # as fast.
    assert_allclose(found.gain * response(found.omega_gain), -1.0, atol=1e-6)
    assert_allclose(np.exp(turn) * response(found.omega_phase), -1.0, atol=1e-6)
    grid = np.geomspace(1e-2, np.pi / design.sample_time, 3000)
    nearest = np.abs(1 + response(grid)).min()
    assert nearest > 0.999 * found.modulus
    if name != "lightly damped":  # there, the grid misses the modes
        assert nearest < 1.01 * found.modulus


@pytest.mark.parametrize("name", ["rigid", "free pair", "throne-2dof"])
def test_margins_mean_the_same_as_those_of_python_control(name):
    """The six numbers, in this order, are those of `control.stability_margins`.

    With a spring to a wall, cartlab also counts the limit at frequency 0, which is smaller here.
    """
    design, controller = designed(PLANTS[name], "lqr")
    T = design.sample_time
    A, B, C = broken_loop(PLANTS[name], controller, sample_time=T)
    loop = control.StateSpace(A, B[:, None], C[None, :], 0, T)
    omega = np.geomspace(0.1, 0.999 * np.pi / T, 2000)
    measured = control.FrequencyResponseData(loop(np.exp(1j * omega * T)), omega, smooth=True)

    own = stability_margins(PLANTS[name], controller, sample_time=T)

    # The spline between 2,000 frequencies, which are 0.3 % apart, is off by less than 1e-5.
    expected = control.stability_margins(measured)
    tied = name == "throne-2dof"
    assert_allclose(own[1::3] if tied else own, expected[1::3] if tied else expected, rtol=1e-5)
    if tied:
        assert own[3] == own[5] == 0
        assert own[0] < expected[0]


def test_an_unstable_loop_has_no_margins():
    """An unstable loop has no margins, and the stage says so."""
    chain = PRESETS["throne-3dof"]
    design, controller = designed(chain, "lqr")
    wild = StateFeedback(gains=50 * controller.gains, prefilter=1.0, model=chain)
    with pytest.raises(DataError, match="is unstable"):
        stability_margins(chain, wild, sample_time=design.sample_time)
    with pytest.raises(DataError, match="is unstable"):
        design_margins(chain, replace(design, gains=wild.gains))


def test_undamped_carts_have_no_margins():
    """If a fit puts a damping at zero, no margins are given.

    The largest stable gain of the undamped model would say nothing about the bench.
    """
    design, _ = designed(UNDAMPED, "lqr")
    with pytest.raises(DataError, match="no damping"):
        design_margins(UNDAMPED, design)


@pytest.mark.parametrize("sample_time", [None, 0.001])
@pytest.mark.parametrize(("name", "method"), CASES)
def test_the_gains_are_verified(name, method, sample_time):
    """The check of the gains passes for the design and fails if one gain is 1 % off."""
    chain = PLANTS[name]
    design, _ = designed(chain, method, sample_time=sample_time)
    assert verify_design(chain, design).outcome == "pass"
    spoilt = design.gains.copy()
    spoilt[0] *= 1.01
    check = verify_design(chain, replace(design, gains=spoilt))
    assert check.outcome == "fail"
    assert check.value is not None
    assert check.limit is not None
    assert check.value > check.limit


def test_double_poles_are_verified_too():
    """A design with double poles passes the check of its gains."""
    chain = PRESETS["throne-3dof"]
    design, _ = designed(chain, "poles", settling_time=0.1)
    assert design.requested_poles is not None
    assert len(np.unique(np.round(design.requested_poles, 6))) < 6
    assert verify_design(chain, design).outcome == "pass"


def test_a_design_that_is_not_finite_does_not_pass():
    """A design whose prefilter is NaN fails the check."""
    chain = PRESETS["throne-1dof"]
    design, _ = designed(chain, "lqr")
    assert verify_design(chain, replace(design, prefilter=np.nan)).outcome == "fail"
