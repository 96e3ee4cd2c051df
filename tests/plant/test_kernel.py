"""The compiled simulator agrees with exact solutions and with two slower simulators."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.arrays import Array
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.plant.simulator import kernel, sensitivity
from pipeline.plant.simulator.kernel import StartState, describe_run
from pipeline.plant.simulator.tables import Cart, Tables, linear_tables
from tests.helpers.effects import SIZES, model_with
from tests.truth.bench import Hidden, simulate_truth

COUNT = 0.00227  # cm, one encoder step


def sample_times(count: int, interval: float) -> Array:
    """Return evenly spaced times from zero."""
    return np.linspace(0.0, (count - 1) * interval, count)


def simulate(
    tables: Tables, t, u, *, x0=None, v0=None, free=None, refine=1.0, guided=None, knots=None
):
    """Return the readings (n, samples) of one run from one initial state."""
    n = tables.cart.shape[0]
    x0, v0 = (np.zeros((1, n)) if one is None else np.array([one]) for one in (x0, v0))
    moving = [free is None or i + 1 in free for i in range(n)]
    run = describe_run(t, u, free=moving, guided=guided, knots=knots)._replace(refine=refine)
    (y,), _ = kernel.simulate([(tables, StartState(x0, v0, np.ones(n)))], run)
    return y


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("irregular", [False, True])
def test_linear_chain_is_exact(preset, irregular):
    """Without effects the simulator agrees with the matrix exponential, at any sample times."""
    chain = PRESETS[preset]
    rng = np.random.default_rng(1)
    t = sample_times(600, 0.00884)
    if irregular:
        t = np.asarray(t + rng.uniform(-0.002, 0.002, t.size), dtype=np.float64)
    u = 0.03 * rng.standard_normal(t.size)

    got = simulate(linear_tables(chain), t, u)

    # The series is cut off at (omega h)^6 / 720, or 1e-7 per step for omega h <= 0.2. These errors
    # change sign with the motion; 1e-6 is promised.
    assert_allclose(got, simulate_linear(chain, t, u), atol=1e-6 * np.abs(got).max())


def friction_decay(m, k, force, x0, t):
    """Return the exact decay of one cart with dry friction only, computed by half cycles."""
    omega, x, y, start = np.sqrt(k / m), x0, np.empty(t.size), 0.0
    centre = force / k  # the centre of a half cycle is on the side where the motion starts
    while True:
        side = np.sign(x)
        inside = (t >= start) & (t <= start + np.pi / omega)
        swing = x - side * centre
        y[inside] = side * centre + swing * np.cos(omega * (t[inside] - start))
        start, x = start + np.pi / omega, side * centre - swing
        if abs(x) <= centre:
            y[t > start] = x
            return y


def test_a_guided_cart_moves_its_neighbour():
    """If a cart is guided along its own free motion, the other cart moves as before."""
    tables = linear_tables(PRESETS["throne-2dof"])
    t = sample_times(2000, 1e-3)
    both = simulate(tables, t, np.where(t < 0.5, 1.0, 0.0))
    guided = np.array([0 * t, both[1]])

    got = simulate(tables, t, np.where(t < 0.5, 1.0, 0.0), free=(1,), guided=guided)

    # Straight lines between samples have an error of an eighth of the curvature, always inwards. An
    # oscillating cart responds with up to twice this error.
    np.testing.assert_allclose(got, both, atol=np.abs(np.diff(both[1], n=2)).max() / 4)


@pytest.mark.parametrize("rate", [113.1, 250.0, 1000.0])
def test_friction_decay_follows_the_events(rate):
    """With dry friction only, each half cycle of a decay is exact, and the cart stays at rest."""
    m, k, force = 2e-4, 0.035, 0.004
    chain = Chain(m=np.array([m]), c=np.array([0.0]), k=np.array([k, 0.0]))
    tables = linear_tables(chain)
    tables[0][0, Cart.COULOMB_FRICTION_FORCE] = force
    t = sample_times(round(4 * rate), 1 / rate)

    got = simulate(tables, t, 0 * t, x0=[2.0])[0]

    # 0.5 count is required; reversals are found as roots of the velocity.
    assert np.abs(got - friction_decay(m, k, force, 2.0, t)).max() < 0.05 * COUNT
    assert np.ptp(got[-50:]) == 0.0


def test_cart_stays_where_friction_holds_it():
    """A force below the dry friction does not move the cart; a force above it does."""
    tables = linear_tables(PRESETS["throne-1dof"])
    tables[0][0, Cart.COULOMB_FRICTION_FORCE] = 0.01
    t = sample_times(500, 0.004)

    assert np.all(simulate(tables, t, np.full(t.size, 0.0099)) == 0.0)
    assert np.abs(simulate(tables, t, np.full(t.size, 0.0101))).max() > 0.0


@pytest.mark.parametrize("key", list(SIZES))
def test_every_effect_agrees_with_the_fine_step_simulator(key):
    """For each effect, this simulator and an independent one with 50-µs steps agree."""
    chain = PRESETS["throne-2dof"]
    place = {"cart": 1, "spring": 2, "input": 0}[find_effect(key).place]
    values = dict(SIZES[key])
    m1, contact = chain.m[0], 60.0 * (chain.k[0] + chain.k[1])
    if key == "end_stop":
        values["damping"] = 0.4 * np.sqrt(values["stiffness"] * m1)
    if key == "backlash":
        values |= {
            "motor_mass": 0.15 * m1,
            "contact_stiffness": contact,
            "contact_damping": 0.3 * np.sqrt(contact * 0.15 * m1),
        }
    t = sample_times(450, 0.00884)
    u = np.where((t > 0.05) & (t < 2.0), 0.06, 0.0)

    got = simulate(model_with(key, chain, place=place, **values).tables(), t, u, refine=3.0)
    hidden = [Hidden(effect=key, place=place, parameters=SIZES[key])]
    truth = simulate_truth(m=chain.m, c=chain.c, k=chain.k, hidden=hidden, t=t, u=u, free=(1, 2))

    # The 50-µs steps cause 0.1 count, and a contact of the other simulator is softer by one step.
    limit = {"end_stop": 1.5, "backlash": 0.6}.get(key, 0.25)
    assert np.sqrt(np.mean((got - truth) ** 2)) < limit * COUNT
    linear = simulate(linear_tables(chain), t, u)
    assert np.sqrt(np.mean((linear - truth) ** 2)) > 2.0 * limit * COUNT


def test_delay_shifts_the_response():
    """A delay of n samples shifts the readings n samples later, or earlier if it is negative."""
    chain = PRESETS["throne-2dof"]
    t = sample_times(500, 0.005)
    u = np.where(t > 0.1, 0.03, 0.0)
    plain = simulate(linear_tables(chain), t, u)
    for delay, shift in ((0.02, 4), (-0.02, -4)):
        late = simulate(model_with("input_delay", chain, delay=delay).tables(), t, u)

        assert_allclose(late[:, 100:400], plain[:, 100 - shift : 400 - shift], atol=1e-6)


def test_diverging_model_is_reported_as_nan():
    """If a softening spring gives way, the readings become NaN, without a crash or endless run."""
    chain = PRESETS["throne-1dof"]
    t = sample_times(600, 0.005)

    tables = model_with("cubic_spring", chain, place=1, coefficient=-0.5).tables()
    run = describe_run(t, np.full(t.size, 0.05), free=[True])
    start = StartState(np.zeros((1, 1)), np.zeros((1, 1)), np.ones(1))

    readings, derivatives = kernel.simulate(
        [(tables, start)], run, of=np.array([[sensitivity.BY_MASS], [0]])
    )

    assert np.all(np.isnan(readings))
    assert np.all(np.isnan(derivatives))


_NOTHING_LEFT = """
import numpy as np
from pipeline.plant.simulator import kernel, generated_forces, sensitivity
from pipeline.plant.augmented import SteppedBench, compile_simulator
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.simulator.tables import linear_tables

files = [vars(module) for module in (kernel, generated_forces, sensitivity)]
stats = [one.stats for file in files for one in file.values() if hasattr(one, "stats")]
compile_simulator()
before = [dict(one.cache_misses) for one in stats]

chain = PRESETS["throne-2dof"]
SteppedBench(AugmentedChain(chain=chain)).step(0.1, following=0.0, interval=0.004)
t, still = 0.004 * np.arange(10), np.zeros((1, 2))
run = kernel.describe_run(t, np.ones(10), free=[True, True])
by_mass = np.array([[sensitivity.BY_MASS], [0]])
start = kernel.StartState(still, still, np.ones(2))
kernel.simulate([(linear_tables(chain), start)], run, of=by_mass)
assert [dict(one.cache_misses) for one in stats] == before
"""


def test_a_hidden_mass_starts_at_the_given_position():
    """A cart and its hidden mass, started apart, move as a chain of two carts."""
    chain = Chain(m=np.array([1.7e-4]), c=np.array([4e-4]), k=np.array([0.034, 0.0]))
    mass, stiffness = 2e-5, 0.004
    hidden = {"mass": mass, "stiffness": stiffness, "damping": 0.0}
    pair = Chain(
        m=np.array([1.7e-4, mass]), c=np.array([4e-4, 0.0]), k=np.array([0.034, stiffness, 0.0])
    )
    t = sample_times(800, 0.002)
    cart, offset = (0.8, -3.0), (0.15, 2.0)  # position in cm and velocity in cm/s

    tables = model_with("extra_mode", chain, place=1, **hidden).tables()
    x0, v0 = zip(cart, offset, strict=True)
    got = simulate(tables, t, np.zeros(t.size), x0=x0, v0=v0)

    start = np.array([cart[0], cart[1], cart[0] + offset[0], cart[1] + offset[1]])
    true = simulate_linear(pair, t, np.zeros(t.size), x0=start)[0]
    assert_allclose(got[0], true, atol=1e-6 * np.abs(true).max())


def test_after_compile_simulator_nothing_is_compiled():
    """After `compile_simulator`, no later call of the simulator compiles anything."""
    subprocess.run([sys.executable, "-c", _NOTHING_LEFT], check=True)


@pytest.mark.parametrize("preset", list(PRESETS))
def test_an_input_that_changes_within_a_step_is_exact(preset):
    """If the input changes within a simulation step, the motion is still right to 1e-4.

    Using the mean input over a step would cause an error of (omega h)² / 12, or 2e-3 of the motion.
    """
    chain = PRESETS[preset]
    t = sample_times(3001, 0.001)
    u = 0.03 * np.sin(2 * np.pi * (0.5 + 2.0 * t) * t)
    coarse = np.arange(0, t.size, 4)

    got = simulate(linear_tables(chain), t[coarse], u, knots=t)

    exact = simulate_linear(chain, t, u)[:, coarse]
    assert_allclose(got, exact, atol=1e-4 * np.abs(exact).max())


def test_a_jump_within_a_step_frees_a_held_cart_at_once():
    """If the input jumps within a step, a cart held by friction is freed at the jump."""
    chain = PRESETS["throne-1dof"]
    tables = model_with("coulomb_friction", chain, place=1, force=6e-3).tables()
    t, edge = sample_times(100, 4e-3), 0.0411
    knots, command = np.array([0.0, edge]), np.array([0.0, 0.02])

    def run(refine):
        return simulate(tables, t, command, knots=knots, refine=refine)

    assert np.abs(run(1.0) - run(64.0)).max() < 0.02 * COUNT


@pytest.mark.parametrize(
    ("key", "values"),
    [("actuator_lag", {"time_constant": 2.8e-3}), ("input_delay", {"delay": 2.8e-3})],
)
def test_lag_and_delay_are_right_in_long_steps(key, values):
    """In a fast sweep with four ticks per step, lag and delay are right to a tenth of a count."""
    chain = Chain(m=np.array([3e-4]), c=np.array([1e-3]), k=np.array([0.05, 0.0]))
    tables = model_with(key, chain, **values).tables()
    ticks = sample_times(4000, 1e-3)
    u = 0.16 * np.sin(2 * np.pi * (7 * ticks + 13 / 8 * ticks**2))

    def run(every: int, refine: float):
        return simulate(tables, ticks[::every], u, knots=ticks, refine=refine)[0]

    assert np.abs(run(4, 1.0) - run(1, 64.0)[::4]).max() < 0.1 * COUNT
