"""The controller's state machine, tick by tick."""

import numpy as np
import pytest

from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import LoopSetup, Pid, StateFeedback, simulate_loop
from pipeline.protocol import (
    EXTENSIONS,
    FULL_SCALE,
    Description,
    PidGains,
    Reading,
    Start,
    StateGains,
    Wave,
    encode,
    parse_reading,
    target_at,
)
from pipeline.simulated.controller import ReferenceCore

PERIOD = 1e-3
# Two carts in counts and duty counts: some 10 counts per duty count, 2 and 5 Hz.
CHAIN = Chain(m=np.array([2e-4, 1.5e-4]), c=np.array([2e-4, 1e-4]), k=np.array([0.0, 0.1, 0.06]))


def make_core(**changes) -> ReferenceCore:
    fields = {"name": "x", "encoders": 2, "carts": 2, "commands": EXTENSIONS} | changes
    return ReferenceCore(Description(**fields))


def run(core: ReferenceCore, commands: bytes, y, *, ticks: int, first: int = 0) -> list[Reading]:
    """Send commands to the core, advance it by some ticks, and return its lines.

    `y` gives the encoder counts at each tick.
    """
    core.receive(commands)
    for k in range(first, first + ticks):
        core.tick(y(k), stamp=k, now=k)
    lines = [parse_reading(line) for line in core.take().splitlines()]
    assert None not in lines
    return [line for line in lines if line is not None]


def still(k: int) -> tuple[int, int]:
    return 7, -3


@pytest.mark.parametrize("wave", Wave)
def test_a_run_streams_its_wave_and_ends(wave):
    """A run sends lines of the wave for REPS/FREQ seconds, clipped to full scale, and stops."""
    start = Start(wave=wave, frequency=8.0, amplitude=5000, cycles=3)
    lines = run(make_core(), encode(start), still, ticks=500)
    assert [line.ms for line in lines] == list(range(375))
    assert [line.target for line in lines] == [target_at(start, 1e-3 * ms) for ms in range(375)]
    assert all(line.duty == np.clip(line.target, -FULL_SCALE, FULL_SCALE) for line in lines)
    assert all(line.counts == (0, 0) for line in lines)  # zeroed at power-on


def test_each_wave_has_its_shape():
    """Each wave has the right value at eighths of its period, and a chirp the right frequency."""

    def eighths(wave: Wave) -> list[int]:
        start = Start(wave=wave, frequency=1.25, amplitude=1000)
        return [target_at(start, 0.1 * k) for k in range(8)]

    assert eighths(Wave.DELTA) == [1000, 0, 0, 0, 0, 0, 0, 0]
    assert eighths(Wave.SQUARE) == [0, 0, 0, 0, 1000, 1000, 1000, 1000]
    assert eighths(Wave.SINE) == [0, 707, 1000, 707, 0, -707, -1000, -707]
    assert eighths(Wave.TRIANGLE) == [0, 500, 1000, 500, 0, -500, -1000, -500]
    assert eighths(Wave.SAWTOOTH) == [0, 250, 500, 750, -1000, -750, -500, -250]
    pulse = Start(wave=Wave.DELTA, frequency=1.0, amplitude=9, cycles=2)
    assert [target_at(pulse, t) for t in (0.0, 0.049, 0.051, 1.0, 1.049, 1.051)] == [9, 9, 0] * 2

    chirp = Start(wave=Wave.CHIRP, frequency=1.0, amplitude=1_000_000, cycles=20)
    t = np.arange(0, 20, 1e-4)
    x = np.array([target_at(chirp, s, chirp_end=10.0) for s in t])
    rising = t[:-1][(x[:-1] < 0) & (x[1:] >= 0)]
    # The mean frequency between two upward zeros is the frequency halfway between them. Curvature
    # changes it by (ln 10 / 20 / f)² / 24, less than 1e-3.
    np.testing.assert_allclose(
        1 / np.diff(rising), 10 ** ((rising[1:] + rising[:-1]) / 40), rtol=1e-3
    )
    assert (
        target_at(Start(wave=Wave.CHIRP, frequency=2.0, amplitude=10), 0.125, chirp_end=2.0) == 10
    )


def simulated(controller, reference, *, delay):
    t = PERIOD * np.arange(reference.size)
    return simulate_loop(
        CHAIN,
        controller,
        t=t,
        reference=reference,
        setup=LoopSetup(sample_time=PERIOD, delay=delay, input_limit=FULL_SCALE, encoder_step=1.0),
    )


@pytest.mark.parametrize("amplitude", [400, 40_000])
def test_state_feedback_is_the_law_of_the_simulated_loop(amplitude):
    """State feedback gives the same duty as the simulated loop, including the clipping."""
    gains = StateGains(gains=(0.02, 0.002, 0.05, -0.001), prefilter=0.3)
    start = Start(wave=Wave.SQUARE, encoder=1, frequency=2.0, amplitude=amplitude)
    r = np.array([float(target_at(start, PERIOD * k)) for k in range(500)])
    loop = simulated(
        StateFeedback(gains=np.array(gains.gains), prefilter=gains.prefilter), r, delay=1
    )
    y = np.rint(loop.x).astype(int)
    lines = run(make_core(), encode(gains) + encode(start), lambda k: tuple(y[:, k]), ticks=500)
    assert np.abs(loop.u).max() > 100
    # Half a count is the rounding of the duty; another order of arithmetic may round the other way.
    np.testing.assert_allclose([line.duty for line in lines], loop.u, atol=0.5 + 1e-6)


@pytest.mark.parametrize("encoder", [1, 2])
def test_pid_is_the_law_of_the_simulated_loop(encoder):
    """A PID's duty equals that in the simulated loop, and acts in the same tick."""
    gains = PidGains(kp=0.05, ki=0.2, kd=0.001)
    start = Start(wave=Wave.SAWTOOTH, encoder=encoder, frequency=2.0, amplitude=3000)
    r = np.array([float(target_at(start, PERIOD * k)) for k in range(500)])
    loop = simulated(Pid(kp=gains.kp, ki=gains.ki, kd=gains.kd, cart=encoder), r, delay=0)
    y = np.rint(loop.x).astype(int)
    lines = run(make_core(), encode(gains) + encode(start), lambda k: tuple(y[:, k]), ticks=500)
    assert np.abs(loop.u).max() > 100
    np.testing.assert_allclose([line.duty for line in lines], loop.u, atol=0.5 + 1e-6)


def test_the_last_gains_count_from_the_next_start():
    """Gains that arrive during a run act only from the next start on."""
    core = make_core()
    lines = run(core, b"g;1;0;0;d;q;c;o;10;50;5;", still, ticks=100)
    assert lines[-1].duty == 50
    lines = run(core, b"f;0;0;0;0;2;", still, ticks=100, first=100)
    assert lines[-1].duty == 50
    lines = run(core, b"d;q;c;o;10;50;1;", still, ticks=100, first=200)
    assert lines[-1].duty == 100
    lines = run(core, b"g;3;0;0;d;q;c;o;10;50;1;", still, ticks=100, first=300)
    assert lines[-1].duty == 150


def test_a_reset_forgets_and_a_stop_does_not():
    """A reset with `z` clears counts and gains; a stop with `s` keeps both."""
    core = make_core()
    run(core, b"g;1;0;0;d;q;c;o;10;50;5;", lambda k: (k, 0), ticks=10)
    assert run(core, b"s;", lambda k: (k, 0), ticks=10, first=10) == []
    lines = run(core, b"d;q;c;o;10;50;1;", lambda k: (k, 0), ticks=10, first=20)
    assert (lines[0].counts, lines[-1].duty) == ((20, 0), -29)
    lines = run(core, b"z;d;q;c;o;10;50;1;", lambda k: (k, 0), ticks=100, first=30)
    assert lines[0].counts == (0, 0)
    assert {line.duty for line in lines} == {0}


def test_silence_after_a_heartbeat_cuts_the_motor():
    """100 ms after the last heartbeat the run ends, and no other run starts without a heartbeat.

    A bench that never had a heartbeat runs on, and a reset disarms the watchdog.
    """
    core = make_core()
    core.receive(b"k;d;q;o;o;1;50;9;")
    for k in range(600):  # a bench whose clock is six times as fast as wall time
        core.tick((0, 0), stamp=k, now=k // 6)
    assert len(core.take().splitlines()) == 600  # 99 ms of wall time
    core.tick((0, 0), stamp=600, now=100)
    assert core.take() == b""
    assert run(core, b"d;q;o;o;1;50;9;", still, ticks=50, first=700) == []
    assert len(run(core, b"k;d;q;o;o;1;50;9;", still, ticks=500, first=800)) == 100
    assert len(run(core, b"z;d;q;o;o;1;50;9;", still, ticks=500, first=1400)) == 500


def test_a_query_is_answered_during_a_run():
    """A query during a run is answered between two lines of the run.

    The command `h` changes nothing, and a stock bench answers no query.
    """
    core = make_core()
    core.receive(b"d;q;o;o;1;50;1;h;1;2;?;")
    core.tick((0, 0), stamp=0, now=0)
    answer, reading = core.take().splitlines()
    assert answer.startswith(b"?cartlab/1 name=x ")
    assert parse_reading(reading) == Reading(counts=(0, 0), target=0, duty=0, ms=0)
    assert run(make_core(commands=frozenset()), b"?;s;k;", still, ticks=3) == []
