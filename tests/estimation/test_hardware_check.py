"""The check of model against bench is tested on simulated benches and on a real one."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline import submission
from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.hardware_check import check_hardware
from pipeline.estimation.state_feedback import design_feedback
from pipeline.identify.model_checks import check_loops
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.sampled_loop import Controller, LoopSetup, Pid, StateFeedback, simulate_loop
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ExperimentKind, FeedbackDesign, HardwareCheck, Record
from pipeline.submission import Design
from tests.helpers.time_records import COUNT, record_of

T = 0.00884  # s
NOISE = 0.001  # cm
CLOCK = T * np.arange(700, dtype=np.float64)
STEPS = np.where((CLOCK > 0.5) & (CLOCK < 3.5), 1.0, 0.0)  # cm
FOUR = Chain(m=np.full(4, 3e-4), c=np.full(4, 4e-4), k=np.array([0.1, 0.12, 0.1, 0.09, 0.05]))
PLANTS = {**PRESETS, "four": FOUR}
LAST_CART = [(name, plant.n) for name, plant in PLANTS.items()]
TWO = PRESETS["throne-2dof"]


def encoder(x: Array, seed: int = 1) -> Array:
    """Return noisy readings in whole counts."""
    shaken = x + NOISE * np.random.default_rng(seed).standard_normal(x.shape)
    return COUNT * np.round(shaken / COUNT)


def noise_floor(y: Array) -> float:
    """Return the NRMSE of a perfect model, whose error is only noise and rounding."""
    return float(np.sqrt((NOISE**2 + COUNT**2 / 12) / np.mean(y**2)))


def record(
    y: Array,
    *,
    u: Array | None,
    t: Array = CLOCK,
    reference: Array | None = None,
    kind: ExperimentKind = "closed_loop",
    free: tuple[int, ...] | None = None,
) -> Record:
    return record_of(t, u, y, kind=kind, free=free, reference=reference, id="control")


def pushed(y: Array, u: Array = 0.06 * STEPS, t: Array = CLOCK) -> tuple[HardwareCheck, ...]:
    """Return the checks of a run of two carts without a controller."""
    return check_hardware(record(y, u=u, t=t, kind="step"), TWO)


PidController = partial(submission.PidController, type="pid")
StateController = partial(submission.StateFeedbackController, type="state_feedback")


def designed(chain: Chain, cart: int) -> FeedbackDesign:
    return design_feedback(
        chain, Design(cart=cart, reference=1.0, overshoot_percent=10.0, settling_time=1.0)
    )


def stated(design: FeedbackDesign, factor: float = 1.0) -> submission.StateFeedbackController:
    return StateController(gains=tuple(factor * design.gains), prefilter=factor * design.prefilter)


def of(checks: tuple[HardwareCheck, ...], loop: str) -> dict[int, HardwareCheck]:
    return {check.cart: check for check in checks if check.loop == loop}


def known(value: float | None) -> float:
    assert value is not None
    return value


def bench(
    chain: Chain, law: Controller, *, sample_time: float | None = None, limit: float | None = None
) -> tuple[Array, Array]:
    """Return the readings and the logged input of a closed-loop run."""
    run = simulate_loop(
        chain,
        law,
        t=CLOCK,
        reference=STEPS,
        setup=LoopSetup(sample_time=sample_time, input_limit=limit, encoder_step=COUNT),
    )
    return encoder(run.x), run.u


def run_design(chain: Chain, cart: int) -> tuple[FeedbackDesign, Array, Array]:
    """Return a design for the cart, and readings and input of its loop."""
    design = designed(chain, cart)
    law = StateFeedback(gains=design.gains, prefilter=design.prefilter, model=chain)
    return design, *bench(chain, law)


@pytest.mark.parametrize(("name", "cart"), LAST_CART)
def test_a_true_model_leaves_the_noise(name, cart):
    """With a true model, the errors of the open-loop and closed-loop simulations are only noise.

    Both simulations have the measured overshoot, settling time and level.
    """
    chain = PLANTS[name]
    design, y, u = run_design(chain, cart)

    checks = check_hardware(
        record(y, u=u, reference=STEPS), chain, controller=stated(design), controlled_cart=cart
    )

    assert [(c.loop, c.cart) for c in checks] == [
        (loop, j) for loop in ("closed", "open") for j in range(1, chain.n + 1)
    ]
    for check in checks:
        # The controller reacts to the rounding of its readings, which adds up to a third.
        assert check.nrmse < 1.35 * noise_floor(y[check.cart - 1])
        assert check.note == ""
        # The scale's error is the noise divided by the square root of the 340 moving samples.
        assert_allclose(known(check.input_scale), 1.0, atol=1e-3)
        # A level at rest is rounded by half a count, and the controller follows the rounding.
        assert_allclose(
            known(check.steady_state_measured), known(check.steady_state_model), atol=COUNT
        )
    steered = of(checks, "closed")[cart]
    assert_allclose(known(steered.steady_state_measured), 1.0, atol=COUNT)
    # Noise raises the maximum by about three standard deviations, 0.4 % of a 1 cm step.
    assert_allclose(known(steered.overshoot_measured), known(steered.overshoot_model), atol=0.8)
    assert_allclose(known(steered.settling_measured), known(steered.settling_model), atol=0.05)


@pytest.mark.parametrize(
    ("name", "cart", "factor"),
    [(name, cart, factor) for name, cart in LAST_CART for factor in (-1.0, -0.5, 3.0)],
)
def test_a_logged_input_of_another_sign_or_scale_is_corrected(name, cart, factor):
    """If the logged input has another sign or scale, its factor is found, reported and used."""
    chain = PLANTS[name]
    design, y, u = run_design(chain, cart)

    checks = check_hardware(
        record(y, u=u / factor, reference=STEPS), chain, controller=stated(design, 1 / factor)
    )

    for check in checks:
        assert_allclose(known(check.input_scale), factor, rtol=1e-3)
        assert check.nrmse < 1.35 * noise_floor(y[check.cart - 1])
    assert f"multiplied by {known(of(checks, 'open')[1].input_scale):.3g}" in checks[chain.n].note


def test_a_gain_of_the_bench_20_percent_off_is_not_corrected():
    """If the bench's gain is 20 % above the model's gain, this is reported but not corrected."""
    for check in pushed(encoder(1.2 * simulate_linear(TWO, CLOCK, 0.06 * STEPS))):
        assert check.note == ""
        assert_allclose(known(check.input_scale), 1.2, atol=1e-3)
        # The model's level is low by 0.2 of 1.2.
        assert_allclose(check.nrmse, 0.2 / 1.2, rtol=0.02)
        assert_allclose(
            known(check.steady_state_measured), 1.2 * known(check.steady_state_model), rtol=0.01
        )


def test_a_stated_scale_that_the_log_contradicts_is_noted():
    """If the scale of the PID was left out, the factor found in the log is used."""
    law = Pid(kp=2.0, kd=0.1, scale=0.009765625)
    run = simulate_loop(TWO, law, t=CLOCK, reference=STEPS)
    y = encoder(run.x)

    checks = check_hardware(
        record(y, u=run.u, reference=STEPS),
        TWO,
        controller=PidController(kp=2.0, kd=0.1),
        controlled_cart=1,
    )

    # The scale is the median ratio of the input to a law that uses rounded readings.
    assert re.search(r"0\.0097\d times", checks[0].note)
    assert checks[0].nrmse < 1.35 * noise_floor(y[0])


@pytest.mark.parametrize("wrong", ["input", "reference", "gains", "controlled_cart", "counts"])
def test_a_wrong_statement_about_a_run_fails_a_check(wrong):
    """If a column's unit, the gains or the controlled cart are wrong, a check fails."""
    design, y, u = run_design(TWO, 2)
    gains = stated(design).gains
    swapped = StateController(gains=(gains[1], gains[0], *gains[2:]), prefilter=design.prefilter)
    run = record(
        y / COUNT if wrong == "counts" else y,
        u=10 * u if wrong == "input" else u,
        reference=10 * STEPS if wrong == "reference" else STEPS,
    )

    checks = check_hardware(
        run,
        TWO,
        controller=swapped if wrong == "gains" else stated(design),
        controlled_cart=1 if wrong == "controlled_cart" else 2,
    )

    assert [(c.id, c.outcome) for c in check_loops(checks)] == [(f"hardware.{run.id}", "fail")]
    true = check_hardware(
        record(y, u=u, reference=STEPS), TWO, controller=stated(design), controlled_cart=2
    )
    assert check_loops(true) == []


def test_noisy_velocities_do_not_change_the_scale():
    """If velocities are mostly noise, as at 1 kHz, the controller's scale is still accepted."""
    t = 0.001 * np.arange(4000, dtype=np.float64)
    steps = np.where((t > 0.2) & (t < 2.5), 1.0, 0.0)
    design = design_feedback(
        TWO,
        Design(cart=2, reference=1.0, overshoot_percent=10.0, settling_time=1.0, sample_time=0.001),
    )
    law = StateFeedback(gains=design.gains, prefilter=design.prefilter, model=TWO)
    run = simulate_loop(TWO, law, t=t, reference=steps, setup=LoopSetup(encoder_step=COUNT))
    y = run.x + 0.01 * np.random.default_rng(5).standard_normal(run.x.shape)

    checks = check_hardware(
        record(y, u=run.u, t=t, reference=steps), TWO, controller=stated(design)
    )

    for check in checks:
        assert check.note == ""
        # This is the noise over the motion; 4000 samples give it to 1/sqrt(8000), or 1 %.
        assert check.nrmse < 1.05 * 0.01 / np.sqrt(np.mean(y[check.cart - 1] ** 2))


@pytest.mark.parametrize(
    ("law", "sample_time", "limit"),
    [
        (Pid(kp=0.02, ki=0.03, kd=0.001, cart=1), None, None),
        (Pid(kp=0.02, kd=0.001, cart=1), 0.000884, None),
        (Pid(kp=0.2, kd=0.01, cart=1), None, 0.06),  # the limit is a plateau in the log
        (StateFeedback(gains=np.array([0.03, 0.006, -0.03, 0.0]), prefilter=0.06), None, None),
    ],
)
def test_fast_slow_and_limited_controllers_are_simulated_to_the_noise(law, sample_time, limit):
    """For slow, fast and limited controllers, simulation errors are only noise."""
    y, u = bench(TWO, law, sample_time=sample_time, limit=limit)
    controller = (
        PidController(kp=law.kp, ki=law.ki, kd=law.kd, cart=law.cart)
        if isinstance(law, Pid)
        else StateController(gains=tuple(law.gains), prefilter=law.prefilter)
    )

    checks = check_hardware(record(y, u=u, reference=STEPS), TWO, controller=controller)

    assert limit is None or np.sum(np.abs(u) >= limit) > 5
    for check in of(checks, "closed").values():
        # Differences of rounded readings make the controller restless, which doubles the noise.
        assert check.nrmse < 2 * noise_floor(y[check.cart - 1])


def test_a_pid_reads_the_controlled_cart_unless_it_names_one():
    """A PID controller that names no cart uses the one given as `controlled_cart`."""
    law = Pid(kp=0.008, kd=0.0008, cart=2)
    y, u = bench(TWO, law)
    run = record(y, u=u, reference=STEPS)
    unnamed = PidController(kp=0.008, kd=0.0008)
    named = PidController(kp=0.008, kd=0.0008, cart=2)

    for controller, cart in ((unnamed, 2), (named, 1), (named, None)):
        checks = check_hardware(run, TWO, controller=controller, controlled_cart=cart)
        assert of(checks, "closed")[2].nrmse < 2 * noise_floor(y[1])


def test_a_displaced_rest_does_not_change_the_error():
    """If encoders were not zeroed at rest, the open-loop simulation's error is still only noise."""
    y = encoder(simulate_linear(TWO, CLOCK, 0.06 * STEPS) + np.array([[3.0], [-2.0]]))

    for check, rest in zip(pushed(y), (3.0, -2.0), strict=True):
        floor = noise_floor(y[check.cart - 1] - rest)
        assert 0.9 * floor < check.nrmse < 1.1 * floor
        assert_allclose(
            known(check.steady_state_measured), known(check.steady_state_model), atol=COUNT
        )


def test_each_cart_settles_within_its_own_noise():
    """If only cart 2 is noisy, its settling time allows for this, and that of cart 1 does not."""
    y = encoder(simulate_linear(TWO, CLOCK, 0.06 * STEPS))
    y[1] += 0.05 * np.random.default_rng(3).standard_normal(CLOCK.size)

    quiet, noisy = pushed(y)

    assert_allclose(known(quiet.settling_measured), known(quiet.settling_model), atol=0.05)
    # The wider band is reached earlier; without it, noise would leave the band to the end.
    assert known(noisy.settling_measured) < known(noisy.settling_model)


def test_a_record_that_begins_in_motion_has_its_start_fitted():
    """If a sweep was cut from a longer recording, the carts' motion at its start is fitted."""
    u = -0.05 * np.sin(2 * np.pi * (0.5 * CLOCK + 0.4 * CLOCK**2))
    x = simulate_linear(TWO, CLOCK, u) + 0.7
    cut = slice(200, None)
    y = encoder(x[:, cut])

    checks = check_hardware(record(y, u=u[cut], t=CLOCK[cut], kind="sweep"), TWO)

    for check in checks:
        assert check.nrmse < 1.1 * noise_floor(y[check.cart - 1] - 0.7)
        # The motion is 1 cm and the noise 0.0012 cm, over 500 samples.
        assert_allclose(known(check.input_scale), 1.0, atol=5e-4)
        assert check.overshoot_measured is None


@pytest.mark.parametrize("start", [0, 30, 57, 90, 240])
def test_a_cut_closed_loop_is_checked_from_the_cut(start):
    """If a closed-loop run is cut, its motion at the cut is found and simulated from there.

    The cut may be at rest, just after the step, or after settling.
    """
    design, y, u = run_design(TWO, 2)
    y, whole = y[:, start:], noise_floor(y[1])

    run = record(y, u=u[start:], t=CLOCK[start:], reference=STEPS[start:])
    opened = of(check_hardware(run, TWO, controller=stated(design)), "open")[2]

    assert_allclose(known(opened.input_scale), 1.0, atol=0.01)
    # A rest position known from one reading is off by up to a count for the whole run.
    assert opened.nrmse < 1.35 * whole + COUNT / np.sqrt(np.mean(y[1] ** 2))


def test_uneven_and_rounded_time_does_no_harm():
    """If samples are missing and times are rounded to 1 ms, the simulation still fits."""
    rng = np.random.default_rng(3)
    kept = np.sort(rng.permutation(CLOCK.size)[:600])
    t = np.round(CLOCK[kept], 3)
    y = encoder(simulate_linear(TWO, t, 0.06 * STEPS[kept]))

    for check in pushed(y, 0.06 * STEPS[kept], t):
        assert check.nrmse < 1.1 * noise_floor(y[check.cart - 1])


def test_held_and_unmeasured_carts_have_no_check():
    """Only carts that were free and measured are checked; a held cart acts as a wall."""
    u = 0.06 * STEPS
    held = simulate_linear(TWO, CLOCK, u, free=[1])
    y = np.vstack([encoder(held), np.zeros((1, CLOCK.size))])
    checks = check_hardware(record(y, u=u, kind="step", free=(1,)), TWO)
    assert [check.cart for check in checks] == [1]
    assert checks[0].nrmse < 1.1 * noise_floor(y[0])

    first_only = record(encoder(simulate_linear(TWO, CLOCK, u))[:1], u=u, kind="step", free=(1, 2))
    assert [check.cart for check in check_hardware(first_only, TWO)] == [1]


@pytest.mark.parametrize(
    ("controller", "note"),
    [
        (None, ""),
        (StateController(gains=(), prefilter=1.0), "no gains"),
        (PidController(), "kp, ki or kd"),
    ],
)
def test_without_gains_the_measured_input_alone_is_checked(controller, note):
    """If no gains are stated, only the simulation with the measured input is made.

    A note asks for the gains of a stated controller.
    """
    law = Pid(kp=0.02, kd=0.001)
    y, u = bench(TWO, law)

    checks = check_hardware(record(y, u=u, reference=STEPS), TWO, controller=controller)

    assert [check.loop for check in checks] == ["open", "open"]
    assert note in checks[0].note
    assert bool(note) == bool(checks[0].note)
    assert all(check.overshoot_measured is not None for check in checks)


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (record(np.ones((2, 700)) * STEPS, u=None), "a logged input"),
        (record(np.ones((2, 700)) * STEPS, u=np.zeros(700)), "a logged input"),
        (record(np.ones((2, 700)), u=STEPS), "cart that moves"),
        (record(np.ones((2, 700)) * STEPS, u=STEPS, free=(2,)), "cart 1, .*, found free \\[2\\]"),
    ],
)
def test_runs_that_cannot_be_checked_are_refused(run, message):
    """A run cannot be checked without motion, with cart 1 held, or without input and controller."""
    with pytest.raises(DataError, match=f"control: .*{message}"):
        check_hardware(run, TWO)


# ------------------------------------------------------------------- a real bench


def ucsd(folder: Path, name: str, *, sign: float) -> Record:
    """Read one closed-loop log of the UCSD bench, in counts and volts."""
    rows = [re.findall(r"-?\d+\.?\d*", line) for line in (folder / name).read_text().splitlines()]
    _, stamp, reference, y1, y2, u = np.array([row for row in rows if len(row) == 6], float).T
    index = np.arange(stamp.size)
    t, y = index * np.polyfit(index, stamp, 1)[0], np.array([y1, y2])
    return record_of(t, sign * u, y, kind="closed_loop", count=1.0, reference=reference, id=name)


UCSD_MASS, UCSD_SPRING = np.array([5.5e-6, 3.7e-6]), np.array([1.79e-3, 1.03e-3, 0.0])
UCSD = Chain(  # units V, count and s; damping ratio about 0.1
    m=UCSD_MASS, c=0.2 * UCSD_MASS * np.array([22.6, 16.6]), k=UCSD_SPRING
)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("name", "gains", "closed_limit"),
    [
        ("closed_loop_pid.csv", {"kp": 0.5, "ki": 0.5, "kd": 0.03}, 0.03),
        ("closed_loop_kp.csv", {"kp": 0.05}, 0.15),
        ("closed_loop_kd.csv", {"kp": 0.05, "kd": 0.0044}, 0.25),
    ],
)
def test_the_ucsd_logs_differ_in_sign_and_scale(real_data, name, gains, closed_limit, sign):
    """The real closed-loop logs fit if their input is scaled by two to four, with either sign."""
    run = ucsd(real_data / "ecp210-ucsd", name, sign=sign)

    checks = check_hardware(
        run,
        UCSD,
        controller=PidController(scale=5 / 512, **gains),
        controlled_cart=1,
        input_limit=4.884,
    )

    closed, opened = of(checks, "closed")[1], of(checks, "open")[1]
    assert 2.0 < sign * known(closed.input_scale) < 4.0
    assert "multiplied by" in opened.note
    assert ("opposite sign" in closed.note) == (sign < 0)
    assert closed.nrmse < closed_limit
    if name == "closed_loop_pid.csv":  # because of integral action
        assert_allclose(known(closed.steady_state_measured), 1000.0, rtol=0.01)
        assert_allclose(known(closed.steady_state_model), 1000.0, rtol=0.01)


# ----------------------------------------------------------------- arbitrary records


@given(
    n=st.integers(3, 60),
    n_carts=st.integers(1, 3),
    kind=st.sampled_from(["step", "sweep", "closed_loop", "sine", "decay"]),
    shape=st.sampled_from(["noise", "step", "constant", "zero", "huge"]),
    with_input=st.booleans(),
    with_reference=st.booleans(),
    controller=st.sampled_from(
        [
            None,
            PidController(kp=1.0, ki=3.0, kd=-0.2),
            PidController(kp=1.0, cart=3),
            StateController(gains=(1.0, 1.0), prefilter=-2.0),
            StateController(gains=(9.0,) * 4, prefilter=1e9),
        ]
    ),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=150, deadline=None)
def test_any_record_gives_finite_numbers_or_a_clear_error(
    n, n_carts, kind, shape, with_input, with_reference, controller, seed
):
    """Short or absurd records never crash the check, and no result is NaN."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(1e-4, 0.02, n))
    base = {
        "noise": rng.standard_normal(n),
        "step": np.where(np.arange(n) > n // 3, 1.0, 0.0),
        "constant": np.ones(n),
        "zero": np.zeros(n),
        "huge": 1e9 * rng.standard_normal(n),
    }[shape]
    run = record(
        rng.standard_normal((n_carts, 1)) * base,
        u=base[rng.permutation(n)] if with_input else None,
        t=t,
        reference=base if with_reference else None,
        kind=kind,
    )
    chain = PRESETS[f"throne-{n_carts}dof"]
    try:
        checks = check_hardware(run, chain, controller=controller, controlled_cart=1)
    except DataError:
        return
    assert checks
    for check in checks:
        numbers = [value for value in vars(check).values() if isinstance(value, float)]
        assert np.isfinite(numbers).all()
