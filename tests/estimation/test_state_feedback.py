"""State-feedback gains agree with those of other programs, and designs meet their goals."""

import re
from typing import Literal

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import linear_sum_assignment

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.state_feedback import (
    MASS_SPRING_ERROR,
    design_feedback,
    level_error_percent,
    lqr_gains,
    place_poles,
    stays_stable,
)
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.sampled_loop import (
    LoopSetup,
    StateFeedback,
    discretise,
    loop_matrix,
    simulate_loop,
)
from pipeline.plant.simulate import overshoot_percent, settling_time, simulate_linear
from pipeline.results import FeedbackDesign
from pipeline.submission import Design

T = 0.00884  # s
RIGID = Chain(m=np.array([2e-4]), c=np.array([1e-4]), k=np.zeros(2))
FREE_PAIR = Chain(m=np.full(2, 3e-4), c=np.full(2, 4e-4), k=np.array([0.0, 0.12, 0.0]))
FOUR = Chain(m=np.full(4, 3e-4), c=np.full(4, 4e-4), k=np.array([0.1, 0.12, 0.1, 0.09, 0.05]))
BROKEN = Chain(m=np.ones(3), c=np.ones(3), k=np.array([1.0, 1.0, 0.0, 1.0]))
PLANTS = {**PRESETS, "rigid": RIGID, "free pair": FREE_PAIR, "four": FOUR}
EVERY_CART = [(name, cart) for name, plant in PLANTS.items() for cart in range(1, plant.n + 1)]
METHODS: tuple[Literal["lqr", "poles"], ...] = ("lqr", "poles")


def design(
    chain: Chain,
    *,
    cart: int = 1,
    reference: float = 1.0,
    settling: float = 1.0,
    limit: float | None = None,
    sample_time: float | None = None,
    method: Literal["lqr", "poles"] = "lqr",
) -> FeedbackDesign:
    task = Design(
        cart=cart,
        reference=reference,
        overshoot_percent=10.0,
        settling_time=settling,
        input_limit=limit,
        sample_time=sample_time,
        method=method,
    )
    return design_feedback(chain, task)


@pytest.mark.parametrize("method", METHODS)
def test_a_quarter_of_the_step_may_use_a_quarter_of_the_input(method):
    """A design near its input limit is the same for a smaller step with a smaller limit."""
    chain = PRESETS["throne-2dof"]
    limit = 1.05 / float(chain.static_gains()[-1])
    whole = design(chain, cart=2, limit=limit, method=method)
    quarter = design(chain, cart=2, reference=0.25, limit=0.25 * limit, method=method)
    assert 0.9 * limit < whole.peak_input <= limit
    assert_allclose(quarter.gains, whole.gains, rtol=1e-7)


def off_by(chain: Chain, rng: np.random.Generator) -> Chain:
    """Return the chain with errors of up to 3 % in masses and springs and 30 % in dampings."""
    return Chain(
        m=chain.m * (1 + 0.03 * rng.uniform(-1, 1, chain.n)),
        c=chain.c * (1 + 0.30 * rng.uniform(-1, 1, chain.n)),
        k=chain.k * (1 + 0.03 * rng.uniform(-1, 1, chain.n + 1)),
    )


# ------------------------------------------------------------------ the algorithms


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("weight", [1e-2, 1.0, 1e2])
def test_lqr_gains_agree_with_control(name, weight):
    """The doubling algorithm finds the same gains as `control.dlqr`."""
    phi, gamma = discretise(PLANTS[name], T)
    gamma = gamma / np.abs(gamma).max()
    Q = weight * np.diag(np.tile([1.0, 1e-3], PLANTS[name].n))

    got = lqr_gains(phi, gamma, Q)

    expected, _, _ = control.dlqr(phi, gamma[:, None], Q, np.eye(1))
    # Both programs solve a Riccati equation with a condition number below 1e6.
    assert_allclose(got, np.asarray(expected)[0], rtol=1e-8, atol=1e-10 * np.abs(got).max())


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("sample_time", [T, 0.001])
def test_placed_poles_are_the_requested_ones(name, sample_time):
    """The eigenvalues of phi - gamma G are the requested poles."""
    chain = PLANTS[name]
    phi, gamma = discretise(chain, sample_time)
    unit = np.tile([1.0, 20.0], chain.n)  # gives positions and velocities similar sizes
    phi, gamma = phi * unit / unit[:, None], gamma / unit
    decay, turn = np.linspace(-4, -10, chain.n), np.linspace(5, 45, chain.n)
    wanted = np.exp(sample_time * np.array([decay + 1j * turn, decay - 1j * turn]).T.ravel())

    got = np.linalg.eigvals(phi - np.outer(gamma, place_poles(phi, gamma, wanted)))

    away = np.abs(wanted[:, None] - got[None, :])
    rows, columns = linear_sum_assignment(away)
    # Poles at least 0.4 T apart: eight such poles have a condition number up to 1e8 at 1 ms.
    assert away[rows, columns].max() < 1e-7


@pytest.mark.parametrize("name", ["throne-2dof", "throne-3dof", "four"])
def test_level_error_is_the_effect_of_wrong_springs(name):
    """The stated error of the level adds up what a 3 % error of each spring causes."""
    chain, cart = PLANTS[name], 2
    gains = design(chain, cart=cart, method="poles").gains

    def level(k: Array) -> float:
        K = Chain(m=chain.m, c=chain.c, k=k).stiffness.copy()
        K[0] += gains[0::2]
        return float(np.linalg.inv(K)[cart - 1, 0])

    h = 1e-5
    moved = [level(chain.k * (1 + h * spring)) - level(chain.k) for spring in np.eye(chain.n + 1)]
    expected = 100 * MASS_SPRING_ERROR * np.abs(moved).sum() / h / abs(level(chain.k))

    # A one-sided difference errs by h times the curvature, about ten times the slope here.
    assert_allclose(level_error_percent(chain, gains, cart=cart), expected, rtol=1e-3)


def test_a_loop_at_the_edge_of_stability_is_not_robust():
    """The designed gains count as robustly stable; gains at the edge of stability do not."""
    chain = PRESETS["throne-3dof"]
    gains = design(chain, cart=3).gains
    assert stays_stable(chain, StateFeedback(gains=gains, prefilter=1, model=chain), sample_time=T)

    def times(scale: float) -> StateFeedback:
        return StateFeedback(gains=scale * gains, prefilter=1.0, model=chain)

    stable, unstable = 1.0, 100.0
    while unstable / stable > 1.0001:
        middle = np.sqrt(stable * unstable)
        radius = np.abs(np.linalg.eigvals(loop_matrix(chain, times(middle), sample_time=T))).max()
        stable, unstable = (middle, unstable) if radius < 1 else (stable, middle)
    edge = times(stable)
    assert not stays_stable(chain, edge, sample_time=T)


# --------------------------------------------------------------------- the design


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("name", "cart"), EVERY_CART)
def test_the_design_meets_its_goal_on_the_true_plant(name, cart, method):
    """In a fine simulation, the designed loop meets its overshoot and settling time."""
    chain = PLANTS[name]
    got = design(chain, cart=cart, method=method)

    assert got.reachable
    assert got.gains.shape == (2 * chain.n,)
    t = T / 4 * np.arange(800.0)
    controller = StateFeedback(gains=got.gains, prefilter=got.prefilter, model=chain)
    y = simulate_loop(chain, controller, t=t, reference=1.0, setup=LoopSetup(sample_time=T)).x[
        cart - 1
    ]
    overshoot = float(overshoot_percent(y, before=0.0, level=np.float64(1.0)))
    settled = float(settling_time(t, y, before=0.0, level=np.float64(1.0)))
    assert overshoot < 10.0
    assert settled < 1.0
    # The design checks only the ticks; between the ticks the position changes little.
    assert_allclose(overshoot, got.overshoot_percent, atol=0.2)
    assert got.settling_time is not None
    assert_allclose(settled, got.settling_time, atol=T)
    assert_allclose(y[-1], 1.0, atol=2e-3)


@pytest.mark.parametrize(("name", "cart"), [(n, c) for n, c in EVERY_CART if n in PRESETS])
def test_lqr_hardly_overshoots_and_tolerates_model_error(name, cart):
    """LQR designs overshoot by at most 0.6 %.

    They stay stable if the plant differs from the model by a few percent.
    """
    chain, rng = PRESETS[name], np.random.default_rng(7)
    got = design(chain, cart=cart)

    assert got.overshoot_percent <= 0.6
    assert got.settling_time is not None
    assert got.settling_time <= 0.8
    assert got.message == ""
    controller = StateFeedback(gains=got.gains, prefilter=got.prefilter, model=chain)
    for _ in range(60):
        matrix = loop_matrix(off_by(chain, rng), controller, sample_time=T)
        assert np.abs(np.linalg.eigvals(matrix)).max() < 1.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", PLANTS)
def test_poles_and_prefilter_are_those_of_the_gains(name, method):
    """The poles returned are the loop's eigenvalues, and the prefilter is its inverse DC gain."""
    chain = PLANTS[name]
    got = design(chain, cart=chain.n, method=method)

    phi, gamma = discretise(chain, got.sample_time)
    loop = phi - np.outer(gamma, got.gains)
    z = np.exp(got.poles * got.sample_time)
    away = np.abs(z[:, None] - np.linalg.eigvals(loop)[None, :])
    assert away[linear_sum_assignment(away)].max() < 1e-9
    level = np.linalg.solve(np.eye(2 * chain.n) - loop, gamma)[2 * chain.n - 2]
    assert_allclose(got.prefilter * level, 1.0, rtol=1e-9)
    if got.requested_poles is None:
        assert method == "lqr"
    else:
        assert method == "poles"
        # A goal without overshoot gives double real poles, which move by the square root of
        # rounding.
        assert_allclose(got.poles, got.requested_poles, rtol=1e-4)


@given(
    position=st.floats(1e-4, 1e4),
    force=st.floats(1e-4, 1e4),
    method=st.sampled_from(METHODS),
)
@settings(max_examples=6, deadline=None)
def test_units_do_not_matter(position, force, method):
    """In other units of position and input, the design gives the same controller."""
    chain = PRESETS["throne-2dof"]
    other = Chain(**{name: getattr(chain, name) * force / position for name in ("m", "c", "k")})
    base = design(chain, cart=2, limit=0.08, method=method)
    same = design(other, cart=2, limit=0.08 * force, reference=position, method=method)

    # Rounding could change the chosen candidate only if two were equal to within 1e-12.
    assert_allclose(same.gains, base.gains * force / position, rtol=1e-7)
    assert_allclose(same.prefilter, base.prefilter * force / position, rtol=1e-7)
    assert_allclose(same.overshoot_percent, base.overshoot_percent, atol=1e-6)
    assert same.settling_time == base.settling_time


@pytest.mark.parametrize("name", ["throne-2dof", "throne-3dof"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("share", "settling", "reachable", "said"),
    [
        # without a limit, the designs need 1.12 to 1.78 of what holds the step
        (1.05, 1.0, True, ""),
        # too little to hold the step, or to reach it in time
        (0.8, 1.0, False, "at most 0.8"),
        (1.05, 0.15, False, "0.15 s within ±{limit:.3g}"),
    ],
)
def test_the_input_limit_is_kept(name, method, share, settling, reachable, said):
    """The best design within the input limit is given; a message says what is out of reach."""
    chain = PRESETS[name]
    limit = share / float(chain.static_gains()[-1])  # a share of what holds the step
    got = design(chain, cart=chain.n, settling=settling, limit=limit, method=method)

    assert got.reachable == reachable
    assert got.peak_input <= limit + 1e-12
    assert np.abs(got.u).max() <= limit + 1e-12
    assert np.abs(got.u).max() < limit or not reachable  # so the limit does not cut the input
    assert said.format(limit=limit) in got.message


def test_gains_that_cancel_a_soft_plant_give_a_warning():
    """If requested poles are far from the poles of a soft plant, a warning gives the level's error.

    The level is then sensitive to errors in the springs.
    """
    got = design(FOUR, cart=4, settling=0.5, method="poles")

    assert level_error_percent(FOUR, got.gains, cart=4) > 5.0
    assert "the springs" in got.message


def test_a_fast_plant_is_sampled_faster():
    """If no sample time is stated, the design chooses one that suits the fastest mode."""
    chain = PRESETS["throne-2dof"]
    fast = Chain(m=chain.m / 400, c=chain.c / 20, k=chain.k)  # twenty times as fast as `chain`
    got = design(fast, cart=2, settling=0.05)

    assert got.sample_time <= 0.5 / np.abs(fast.poles).max() * (1 + 1e-9)
    assert got.reachable
    assert design(chain, cart=2).sample_time == T
    assert design(chain, cart=2, sample_time=0.002).sample_time == 0.002


@pytest.mark.parametrize(
    ("chain", "cart", "reference", "message"),
    [
        (PRESETS["throne-2dof"], 3, 1.0, "found 3"),
        (PRESETS["throne-2dof"], 1, 0.0, "reference"),
        (BROKEN, 1, 1.0, "carts 2 and 3"),
    ],
)
def test_impossible_tasks_are_refused(chain, cart, reference, message):
    """A missing cart, a reference of zero, and a cart that the motor cannot reach are refused."""
    with pytest.raises(DataError, match=message):
        design(chain, cart=cart, reference=reference)


# ------------------------------------------------------------------ slow sampling


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sample_time", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("name", PRESETS)
def test_the_step_is_right_between_the_ticks_of_a_slow_clock(name, sample_time, method):
    """At slow sampling the simulated step, and its overshoot, include the motion between ticks."""
    chain = PRESETS[name]
    found = design(chain, cart=chain.n, sample_time=sample_time, method=method)

    expected = simulate_linear(chain, t=found.t, u=found.u)

    # The input is held, so both are exact; several hundred rounding errors add up.
    assert_allclose(found.y, expected, atol=1e-8)
    assert np.diff(found.t).max() * np.abs(chain.poles).max() <= 0.51
    level = np.float64(1.0)
    overshoot = overshoot_percent(expected[chain.n - 1], before=0.0, level=level)
    assert_allclose(found.overshoot_percent, overshoot, atol=1e-5)


@pytest.mark.parametrize("name", ["throne-1dof", "throne-2dof"])
def test_a_design_worse_than_no_feedback_is_refused(name):
    """A clock so slow that feedback adds overshoot is refused, with a sample time that works."""
    chain = PRESETS[name]
    with pytest.raises(DataError) as refused:
        design(chain, cart=chain.n, sample_time=0.5, method="poles")

    numbers = re.findall(r"([\d.]+) (?:%|s,)", str(refused.value))
    alone, found, proposed, overshoot = map(float, numbers)
    t = np.linspace(0, 3, 3000)
    step = simulate_linear(chain, t=t, u=np.ones_like(t))[chain.n - 1]
    peak = overshoot_percent(step, before=0.0, level=chain.static_gains()[chain.n - 1])
    assert_allclose(alone, peak, rtol=0.01)  # three digits, and 512 points
    assert found > alone
    better = design(chain, cart=chain.n, sample_time=proposed, method="poles")
    assert better.reachable
    assert_allclose(better.overshoot_percent, overshoot, atol=0.06)
