"""Gains sent in counts act as in the submission's units; loops that would do harm are refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.experiments.gains import (
    CountScales,
    LoopTrial,
    bench_scales,
    controller_table,
)
from pipeline.experiments.plan import PidLoop, PlanLimits, Recording, StateLoop
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import LoopSetup, Pid, StateFeedback, discretise, simulate_loop
from pipeline.protocol import Description, Start, StateGains, Wave, encode
from pipeline.results import Analysis, FeedbackDesign
from pipeline.simulated.controller import ReferenceCore
from pipeline.submission import Submission
from pipeline.workflow import analyse
from tests.helpers.examples import recorded

COUNT = 0.00227  # cm
DUTY = 0.5 / 4096  # V
BENCH = Description(
    name="bench",
    encoders=2,
    carts=2,
    commands=frozenset("cfhkms"),
    input_per_count=DUTY,
    position_unit="cm",
    position_per_count=COUNT,
)
LIMITS = PlanLimits(input=0.5, travel=2.5)
SECONDS = 2.0


@pytest.fixture(scope="module", params=["one-cart", "two-cart"])
def identified(request) -> tuple[Submission, Analysis]:
    """Return a shipped example with the carts identified from decays, steps and sweep."""
    submission = recorded(request.param, "decay", "step", "sweep")
    return submission, analyse(submission)


def closing(loop, *, carts=2, amplitude=1.0) -> Recording:
    return Recording(
        id="control",
        kind="closed_loop",
        carts=tuple(range(1, carts + 1)),
        wave="square",
        amplitude=amplitude,
        frequency=0.5 / SECONDS,
        controller=loop,
    )


def gains_of(identified, loop, *, limits=LIMITS, bench=BENCH, **changes):
    submission, analysis = identified
    return LoopTrial(
        recording=closing(loop, carts=analysis.bench.n, **changes),
        submission=submission,
        analysis=analysis,
        bench=bench,
        limits=limits,
    ).gains()


def design_of(analysis: Analysis) -> FeedbackDesign:
    assert analysis.feedback is not None
    return analysis.feedback


def state_gains_of(identified, loop) -> StateGains:
    gains = gains_of(identified, loop)
    assert isinstance(gains, StateGains)
    return gains


def on_the_bench(chain: Chain | None, gains, *, encoder: int) -> tuple[Array, Array]:
    """Run the chain under the bench's own controller.

    Return positions (n_carts, n) and inputs (n,).
    """
    assert chain is not None
    core, period = ReferenceCore(BENCH), BENCH.period
    core.receive(encode(gains))
    step = Start(
        wave=Wave.SQUARE, encoder=encoder, frequency=0.5 / SECONDS, amplitude=round(1.0 / COUNT)
    )
    core.receive(encode(step))
    phi, gamma = discretise(chain, period)
    x, ticks = np.zeros(2 * chain.n), round(2 * SECONDS / period)
    positions, inputs = np.zeros((chain.n, ticks)), np.zeros(ticks)
    for tick in range(ticks):
        counts = np.rint(x[0::2] / COUNT).astype(int).tolist()
        duty = core.tick([*counts, *[0] * (BENCH.encoders - chain.n)], stamp=tick, now=tick)
        positions[:, tick], inputs[tick] = x[0::2], duty * DUTY
        x = phi @ x + gamma * duty * DUTY
    return positions, inputs


def simulated(chain: Chain | None, law, *, delay: int) -> tuple[Array, Array]:
    assert chain is not None
    t = BENCH.period * np.arange(round(2 * SECONDS / BENCH.period), dtype=np.float64)
    run = simulate_loop(
        chain,
        law,
        t=t,
        reference=np.where(t >= SECONDS, round(1.0 / COUNT) * COUNT, 0.0),
        setup=LoopSetup(sample_time=BENCH.period, delay=delay, encoder_step=COUNT, input_limit=0.5),
    )
    return run.x, run.u


def test_the_designed_loop_runs_on_the_bench_as_simulated(identified):
    """With gains in counts and duty, the carts move as in the simulation in V and cm."""
    _, analysis = identified
    design, chain = design_of(analysis), analysis.chain
    gains = state_gains_of(identified, StateLoop(cart=analysis.bench.n))
    assert len(gains.gains) == 2 * BENCH.encoders

    x, u = on_the_bench(chain, gains, encoder=1)

    law = StateFeedback(gains=design.gains, prefilter=design.prefilter)
    expected_x, expected_u = simulated(chain, law, delay=1)
    # Rounding to whole duty counts errs by up to half a count, 0.06 mV, at up to 29 cm/V. An
    # encoder may then change one tick earlier, and the velocity gain turns this into a pulse of one
    # tick.
    assert_allclose(x, expected_x, atol=2 * COUNT)
    velocity_gain = np.abs(gains.gains[1::2]).max()
    assert_allclose(u, expected_u, atol=DUTY * (2 + velocity_gain * 2 / BENCH.period))
    assert abs(u - expected_u).mean() < 0.05 * abs(expected_u).max()
    assert abs(x[analysis.bench.n - 1, -1] - 1.0) < 0.02


def test_a_pid_is_sent_as_typed_and_runs_as_simulated(identified):
    """PID gains typed in duty counts per count act as the same gains in V and cm."""
    _, analysis = identified
    loop = PidLoop(kp=0.05, ki=0.1, kd=0.005)
    gains = gains_of(identified, loop)

    x, u = on_the_bench(analysis.chain, gains, encoder=1)

    law = Pid(kp=0.05, ki=0.1, kd=0.005, scale=DUTY / COUNT, cart=1)
    expected_x, expected_u = simulated(analysis.chain, law, delay=0)
    assert_allclose(x, expected_x, atol=3 * COUNT)
    assert abs(u - expected_u).mean() < 0.05 * abs(expected_u).max()


def test_the_submission_gets_the_controller_that_ran(identified):
    """After a run `submission.toml` has the controller that ran, in V and cm."""
    submission, analysis = identified
    scales = bench_scales(submission, bench=BENCH, analysis=analysis)
    assert scales == CountScales(input=DUTY, position=COUNT)
    sent = gains_of(identified, StateLoop(cart=analysis.bench.n))
    table = controller_table(sent, cart=analysis.bench.n, scales=scales, carts=analysis.bench.n)
    assert table["type"] == "state_feedback"
    assert_allclose(table["gains"], design_of(analysis).gains, rtol=1e-5)  # six digits
    assert_allclose(table["prefilter"], design_of(analysis).prefilter, rtol=1e-5)
    pid = gains_of(identified, PidLoop(kp=0.05))
    assert controller_table(pid, cart=1, scales=scales, carts=2) == {
        "type": "pid", "kp": 0.05, "ki": 0.0, "kd": 0.0, "scale": DUTY, "cart": 1,
    }  # fmt: skip


def test_a_reversed_input_reverses_the_gains(identified):
    """If positive duty pushes the carts backwards, gains are sent with the opposite sign."""
    submission, analysis = identified
    turned = tuple(replace(r, input_scale=-r.input_scale) for r in analysis.records)
    reversed_ = replace(analysis, records=turned)
    loop = StateLoop(cart=analysis.bench.n)
    straight = state_gains_of(identified, loop)
    back = state_gains_of((submission, reversed_), loop)
    assert_allclose(back.gains, -np.array(straight.gains))
    assert back.prefilter == -straight.prefilter
    with pytest.raises(DataError, match="unstable"):
        gains_of((submission, reversed_), PidLoop(kp=0.5, ki=10.0))


def test_the_scale_of_the_submission_replaces_that_of_the_bench(identified):
    """If the submission states `per_count`, the gains are scaled by it, not by the bench's."""
    submission, analysis = identified
    stated = submission.system.input.model_copy(update={"per_count": 2 * DUTY})
    system = submission.system.model_copy(update={"input": stated})
    other = submission.model_copy(update={"system": system})
    assert bench_scales(other, bench=BENCH, analysis=analysis).input == 2 * DUTY


@pytest.mark.parametrize(
    ("loop", "limits", "amplitude", "message"),
    [
        (PidLoop(kp=0.1, kd=20.0), LIMITS, 1.0, "unstable"),
        (PidLoop(kp=0.01, kd=-0.05), LIMITS, 1.0, "unstable"),
        (PidLoop(kp=3.0, kd=0.02), PlanLimits(input=0.1, travel=2.5), 1.0, "input"),
        (StateLoop(), PlanLimits(input=0.01, travel=2.5), 1.0, "input .*0.01"),
        (StateLoop(), PlanLimits(input=0.5, travel=0.9), 1.0, "travel limit"),
        (StateLoop(), PlanLimits(input=0.5, travel=0.9), -1.0, "travel limit"),
        (StateLoop(), LIMITS, 40.0, "(moves a cart|needs an input|would overshoot)"),
        (StateLoop(gains=(0.0, -1.0), prefilter=1.0), LIMITS, 1.0, "unstable"),
        (StateLoop(cart=2), LIMITS, 1.0, "cart 2"),
    ],
)
def test_a_loop_that_would_do_harm_is_refused(loop, limits, amplitude, message):
    """The gains of a loop that is unstable or passes a limit on either side are refused."""
    submission = recorded("one-cart", "step", "sweep")
    with pytest.raises(DataError, match=message) as caught:
        gains_of((submission, analyse(submission)), loop, limits=limits, amplitude=amplitude)
    assert "control: " not in str(caught.value)  # the caller's message adds this name


def test_a_slow_bench_that_misses_the_goal_is_refused(identified):
    """If the bench's rate is too low for the designed loop, the error says what to change."""
    loop, slow = StateLoop(cart=identified[1].bench.n), replace(BENCH, period=0.05)
    with pytest.raises(DataError, match=r"sample_time = 0\.05"):
        gains_of(identified, loop, bench=slow)


@pytest.mark.parametrize("example", ["one-cart", "two-cart", "three-cart"])
def test_a_proposed_pid_brings_cart_1_to_the_level(example):
    """The PID proposed for a bench brings its cart 1 to within 2 % of 1 cm in 5 s."""
    submission = recorded(example, "step", "sweep")
    analysis = analyse(submission)
    bench = replace(BENCH, encoders=max(2, analysis.bench.n), carts=analysis.bench.n)
    recording = closing(None, carts=analysis.bench.n)
    trial = LoopTrial(
        recording=recording, submission=submission, analysis=analysis, bench=bench, limits=LIMITS
    )
    pid = trial.propose_pid()
    law = Pid(kp=pid.kp, ki=pid.ki, kd=pid.kd, scale=DUTY / COUNT)
    assert analysis.chain is not None
    t = np.arange(0, 5, BENCH.period)
    run = simulate_loop(
        analysis.chain,
        law,
        t=t,
        reference=1.0,
        setup=LoopSetup(delay=0, encoder_step=COUNT, input_limit=0.5),
    )
    assert abs(run.x[0, -1] - 1.0) < 0.02
    assert run.x[0].max() < 1.1
    weak = PlanLimits(input=0.001, travel=2.5)
    with pytest.raises(DataError, match=r"no PID .*input"):
        replace(trial, limits=weak).propose_pid()
