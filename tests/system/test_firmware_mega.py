"""The firmware's sketch on a simulated Arduino Mega: pins, interrupts, timers, serial line."""

import time
from collections.abc import Callable
from contextlib import closing
from functools import partial

import numpy as np
import pytest

from pipeline.protocol import (
    Description,
    PidGains,
    Reading,
    Start,
    StateGains,
    Wave,
    encode,
    format_description,
    parse_description,
    parse_reading,
)
from pipeline.simulated.controller import ReferenceCore
from pipeline.simulated.emulator import VirtualCarts
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.links import Link, open_link
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.firmware_host import acquire, kept_going
from tests.helpers.firmware_mega import Mega, build_sketch, memory, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=f"{missing()} is not installed")

PERIOD = 0.004  # s between two lines at 115200 baud, in the Mega's time


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_sketch(tmp_path_factory.mktemp("sketch"))


@pytest.fixture(scope="module")
def board(program, tmp_path_factory):
    """Return one simulated board for all tests; each test resets it."""
    return Mega(program, tmp_path_factory.mktemp("board"))


@pytest.fixture
def mega(board):
    board.send(b";s;z;")
    board.run(0.05)
    board.take()
    return board


def _readings(mega: Mega) -> list[Reading]:
    *lines, _ = mega.take().split(b"\n")  # the last line may still be on its way
    readings = [parse_reading(line) for line in lines]
    assert None not in readings
    return [reading for reading in readings if reading]


def _describe(mega: Mega) -> Description:
    mega.send(b"?;")
    mega.run(0.05)
    answer = mega.take()
    description = parse_description(answer)
    assert format_description(description) == answer
    return description


def test_the_board_describes_itself(mega, program):
    """The board answers a query with a description in the form of the protocol.

    The sketch uses less than a quarter of the Mega's flash and RAM.
    """
    description = _describe(mega)
    assert (description.encoders, description.period) == (2, PERIOD)
    assert description.commands == frozenset("cfks")
    flash, ram = memory(program)
    assert flash < 64 * 1024
    assert ram < 2 * 1024


def test_a_run_has_the_requested_length_and_ends_at_a_stop(mega):
    """A run of a tenth of a second sends 25 lines, 4 ms apart, and then the motor is off.

    It is also off one tick after the three bytes of a stop have arrived.
    """
    mega.send(encode(Start(wave=Wave.DELTA, frequency=10.0, amplitude=-4096)))
    mega.run(0.03)
    assert mega.duty == -4096
    mega.run(0.17)
    assert mega.duty == 0
    assert [reading.ms for reading in _readings(mega)] == list(range(0, 100, 4))
    mega.send(encode(Start(wave=Wave.SQUARE, frequency=10.0, amplitude=2000, cycles=9)))
    mega.run(0.08)
    assert mega.duty == 2000
    mega.send(b";s;")
    mega.run(3 * 87e-6 + PERIOD + 0.0005)
    assert mega.duty == 0


def test_every_edge_at_the_pins_counts(mega):
    """Two encoders at 50,000 edges per second, back and forth, lose no count."""
    rng = np.random.default_rng(5)
    turns = rng.integers(-60, 61, size=(50, 2))
    mega.send(encode(Start(wave=Wave.SINE, frequency=1.0, amplitude=1000)))
    mega.run(0.05)
    for turn in turns:
        mega.turn(0, int(turn[0]))
        mega.turn(1, int(turn[1]))
    mega.run(2 * PERIOD)
    assert _readings(mega)[-1].counts == tuple(turns.sum(axis=0))


@pytest.mark.slow
@pytest.mark.sample
def test_a_third_encoder_needs_one_changed_line(tmp_path):
    """If it is built for three encoders, the sketch also counts at pins 20 and 21, and says so."""
    mega = Mega(build_sketch(tmp_path, encoders=3), tmp_path)
    mega.run(0.05)
    assert _describe(mega).encoders == 3
    mega.send(b"z;" + encode(Start(wave=Wave.SINE, frequency=1.0, amplitude=1000)))
    mega.run(0.05)
    for encoder, counts in enumerate((30, -20, 10)):
        mega.turn(encoder, counts)
    mega.run(2 * PERIOD)
    assert _readings(mega)[-1].counts == (30, -20, 10)


@pytest.mark.parametrize("wave", [wave for wave in Wave if wave not in "dqm"])
def test_waves_equal_those_of_the_reference(mega, wave):
    """Each wave of the board differs from the reference's wave by at most one duty count.

    The board's floats have 32 bits, which hold 2000 counts to a thousandth of a count.
    """
    start = Start(wave=wave, frequency=2.0, amplitude=2000)
    mega.send(encode(start))
    mega.run(0.55)
    readings = _readings(mega)
    reference = ReferenceCore(_describe(mega))
    reference.receive(encode(start))
    for reading in readings:
        reference.tick(reading.counts, stamp=reading.ms, now=0)
        expected = parse_reading(reference.take())
        assert expected is not None
        # A sawtooth that falls at half its period may fall a tick late.
        falls = wave is Wave.SAWTOOTH and abs(reading.ms - 250) <= 4
        assert abs(reading.target - expected.target) <= 1 or falls
    assert len(readings) == 125


@pytest.mark.parametrize(
    "gains",
    [PidGains(kp=0.8, ki=1.0, kd=0.04), StateGains(gains=(0.9, 0.05, 0.2, 0.01), prefilter=1.5)],
)
def test_the_board_closes_a_loop_over_its_pins(mega, gains):
    """Over the board's pins, a closed loop holds a simulated cart at the target.

    The reference computes from the board's own lines, so both differ only by rounding to 24 bits. A
    duty of some thousand counts is exact to a thousandth, but its rounding may differ by a count.
    """
    start = Start(wave=Wave.SQUARE, encoder=1, frequency=0.5, amplitude=800)
    mega.send(encode(gains) + encode(start))
    x, v, at, before = 0.0, 0.0, 0, mega.clock
    while mega.clock - before < 2.1:
        last = mega.clock
        mega.run(0.001)
        for encoder, counts in enumerate((round(x) - at, 0)):
            mega.turn(encoder, counts)
        at = round(x)
        step = mega.clock - last
        v += step * (200.0 * mega.duty - 2.0 * v - 100.0 * x)
        x += step * v
    readings = _readings(mega)
    assert [reading.ms for reading in readings] == list(range(0, 2000, 4))
    assert 400 < readings[-1].counts[0] < 1200  # the cart follows the target of 800
    reference = ReferenceCore(_describe(mega))
    reference.receive(encode(gains) + encode(start))
    for reading in readings:
        duty = reference.tick(reading.counts, stamp=reading.ms, now=0)
        assert abs(reading.duty - duty) <= 1


def test_a_silent_host_stops_the_motor(mega):
    """The motor's pins go off at the first tick after 100 ms without a heartbeat."""
    mega.send(encode(Start(wave=Wave.SQUARE, frequency=1e-3, amplitude=0)))
    mega.send(b"k;" + encode(Start(wave=Wave.SINE, frequency=1.0, amplitude=3000)))
    before = mega.clock
    while mega.duty == 0:
        mega.run(0.0005)
        assert mega.clock - before < 0.1
    while mega.duty:
        mega.run(0.0005)
    # The heartbeat came up to 3 ms before the run began; the motor moved at most a tick after that.
    assert 0.095 < mega.clock - before < 0.115


def test_a_storm_of_edges_does_not_keep_the_motor_on(program, tmp_path):
    """If a loose wire sends 250,000 edges per second, the board resets and the motor stops."""
    mega = Mega(program, tmp_path)
    mega.run(0.05)
    mega.send(encode(Start(wave=Wave.SQUARE, frequency=10.0, amplitude=2000, cycles=9)))
    mega.run(0.08)
    assert mega.duty == 2000
    mega.flicker(1, 0.2, every=4e-6)
    assert mega.duty == 0
    mega.flicker(1, 0.3, every=4e-6)
    assert mega.duty == 0
    mega.run(0.3)  # the wire no longer flickers: the board answers, and the motor is off
    mega.take()
    assert _describe(mega).encoders == 2
    assert mega.duty == 0


SUBMISSION = """
version = 1
[system]
carts = 1
position = { unit = "cm", per_count = 0.00227 }
input = { unit = "V" }
"""
PLAN = """
version = 1
[limits]
input = 0.5
travel = 2.5
[[recordings]]
id = "step"
kind = "step"
carts = [1]
wave = "square"
amplitude = 0.03
frequency = 0.1
settle = 0.1
"""
STEP = 1e-3  # s between exchanges of data between carts and board


def _serve(mega: Mega, carts: VirtualCarts, link: Link, until: Callable[[], bool]) -> None:
    """Connect board and simulated carts, in real time or as fast as possible."""
    at, ahead = carts.counts(), mega.clock - time.monotonic()
    volts = 5 / 4096 / carts.input_per_count  # carts' duty counts per count of the sketch
    while not until():
        time.sleep(max(0.0, mega.clock - time.monotonic() - ahead))
        mega.send(link.receive())
        begun, counts = mega.clock, carts.counts()
        for encoder, (new, old) in enumerate(zip(counts, at, strict=True)):
            mega.turn(encoder, new - old)
        at = counts
        mega.run(max(0.0, begun + STEP - mega.clock))
        carts.move(round(mega.duty * volts))
        link.send(mega.take())


@pytest.mark.slow
def test_acquire_records_with_the_board(mega, tmp_path):
    """`acquire` records a step through pty, serial line, PWM, carts and encoder pins.

    The gain of the recorded step is that of the carts.
    """
    (tmp_path / "submission.toml").write_text(SUBMISSION, encoding="utf-8")
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    bench = prepare_bench(preset="throne-1dof")
    carts = VirtualCarts(bench, seed=1, period=STEP)
    with closing(open_link("pty")) as link, kept_going(partial(_serve, mega, carts, link)):
        acquire(tmp_path, port=link.address, only=["step"])
    [gain] = analyse(load_submission(tmp_path)).step_gains
    # The level is 390 encoder counts, and the noise of a fifth of a count is under 0.1 %. After 5
    # s, 1 % of the swing is left, which changes the mean by up to 1 %.
    assert gain.gain == pytest.approx(bench.chain.static_gains()[0], rel=0.01)
