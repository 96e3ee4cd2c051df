"""The virtual bench over a real line: pyserial talks to `cartlab emulate` in another process."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import serial

from pipeline.errors import ConfigError
from pipeline.plant.chain import PRESETS
from pipeline.protocol import (
    STOCK_STOP,
    WATCHDOG,
    Hands,
    Reading,
    Signal,
    Start,
    Wave,
    encode,
    parse_description,
    parse_reading,
)
from pipeline.simulated.emulator import TRUE_PERIOD, VirtualCarts, read_fault
from pipeline.simulated.hidden import prepare_bench
from tests.helpers.benches import Emulator, emulator
from tests.helpers.waiting import started

QUIET = 0.3  # longest time in s that a read waits
MOTOR_OFF = 1000  # ms after the last heartbeat: the watchdog's 100, and some for a busy machine


@contextmanager
def host(bench: Emulator) -> Iterator[serial.SerialBase]:
    """Open the line as a host does, with the bench reset."""
    line = serial.serial_for_url(bench.address, timeout=QUIET)
    try:
        line.write(encode(Signal.RESET))
        yield line
    finally:
        line.close()


def play(
    bench: Emulator, line: serial.SerialBase, *commands: bytes, heard: bytearray | None = None
) -> bytes:
    """Return all bytes until a run has ended, and add them to `heard` as they come."""
    heard, runs = bytearray() if heard is None else heard, bench.runs
    line.write(b"".join(commands))
    # Small pieces, since pyserial loses a piece that it has partly read if the cable is pulled.
    while (got := line.read(64)) or bench.runs == runs:
        heard += got
    return bytes(heard)


def stream(bench: Emulator, line: serial.SerialBase, start: Start) -> list[Reading]:
    """Make a run; check that every line is a reading."""
    readings = [parse_reading(text) for text in play(bench, line, encode(start)).splitlines()]
    assert None not in readings
    return [reading for reading in readings if reading is not None]


@pytest.fixture(scope="module")
def fast_bench() -> Iterator[Emulator]:
    """Yield the two-cart preset on a clock ten times as fast as wall time."""
    with emulator("--speed", "10", "--seed", "3", watchdog=WATCHDOG) as bench:
        yield bench


def test_a_step_gives_the_static_gain(fast_bench):
    """A step's motion, scaled by the description, gives the preset's static gain."""
    with host(fast_bench) as line:
        line.write(encode(Signal.QUERY))
        scales = parse_description(line.readline())
        start = Start(wave=Wave.SQUARE, frequency=0.05, amplitude=1000)
        readings = stream(fast_bench, line, start)
    x = np.array([reading.counts for reading in readings]).T
    duty = np.array([reading.duty for reading in readings])
    level = x[:, -3000:].mean(axis=1) - x[:, : x.shape[1] // 3].mean(axis=1)
    gain = level * scales.position_per_count / (duty[-1] * scales.input_per_count)
    expected = PRESETS["throne-2dof"].static_gains()
    # The mean of rounded counts is off by 0.15 count, twice, in at least 1400. After 7 s, 2e-3 of
    # the slower mode (0.9/s) is left. Averaging over its swings reduces that much further.
    np.testing.assert_allclose(gain, expected, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("hide", [[], ["force_offset"]])
def test_a_run_does_not_depend_on_the_ticks_before_it(hide):
    """After a pause of any length, a released cart gives the same counts, tremor and noise."""
    runs = []
    for pause in (0, 700, 5000):  # the run starts before, while and after a virtual hand pulls
        carts = VirtualCarts(prepare_bench(preset="throne-1dof", hide=hide), seed=1)
        carts.take_in_hand(Hands(released=1))
        for _ in range(pause):
            carts.counts()
            carts.move(0)
        carts.start()
        x = []
        for _ in range(6000):
            x.append(carts.counts()[0])
            carts.move(-2000)
        runs.append(x[1:])
    assert runs[0] == runs[1] == runs[2]
    held = np.array(runs[0][:280])  # until 0.3 s after the start there is only tremor
    assert 0 < np.ptp(held) < 0.03 * np.abs(held).max()
    if not hide:
        gain = PRESETS["throne-1dof"].static_gains()[0]
        rest = -2000 * carts.input_per_count * gain / 0.00227
        # After 5 s the swing has decayed to e^(-1.32 · 5) = 1e-3 of at most 1.8 cm and the rest
        # position.
        assert np.mean(runs[0][-400:]) == pytest.approx(rest, abs=5e-3 * (800 + abs(rest)))


def damaged(readings: bytes) -> tuple[list[Reading], int]:
    """Return the lines that a host can read, and the number of those that it cannot."""
    parsed = [parse_reading(line) for line in readings.split(b"\n") if line]
    return [reading for reading in parsed if reading is not None], parsed.count(None)


def test_faults_come_at_the_requested_time():
    """An encoder sticks and the cable is pulled at the times that were requested."""
    options = ("--speed", "5", "--fault", "stuck=2@1", "--fault", "disconnect@2")
    with emulator(*options) as bench:
        with host(bench) as line:
            start = encode(Start(wave=Wave.SINE, frequency=1.0, amplitude=200, cycles=3))
            heard = bytearray()
            with pytest.raises(serial.SerialException, match="disconnected"):
                play(bench, line, start, heard=heard)
        counts = np.array([reading.counts for reading in damaged(bytes(heard))[0]])
        assert 1990 <= len(counts) <= 1999
        assert np.ptp(counts[1000:], axis=0)[1] == 0 < np.ptp(counts[:1000], axis=0)[1]
        assert np.ptp(counts[1000:], axis=0)[0] > 50
        assert bench.event("run")["ended"] == "done"  # the bench does not need its host
        with host(bench) as line:
            start = Start(wave=Wave.SINE, frequency=1.0, amplitude=200, cycles=1)
            again = stream(bench, line, start)
        assert len({reading.counts[1] for reading in again}) == 1


@pytest.mark.parametrize("way", ["falls silent", "goes away", "is killed"])
def test_the_motor_is_cut_if_the_host(fast_bench, way):
    """100 ms after the last heartbeat the run is over, however fast the bench's clock runs."""
    start = encode(Signal.HEARTBEAT) + encode(
        Start(wave=Wave.SINE, frequency=0.01, amplitude=300, cycles=1)
    )
    if way == "is killed":
        script = (
            "import serial, sys, time\n"
            f"line = serial.serial_for_url({fast_bench.address!r})\n"
            f"line.write({start!r})\n"
            "while True: time.sleep(0.03); line.write(b'k;'); print('beat', flush=True)\n"
        )
        with started([sys.executable, "-c", script], stdout=subprocess.PIPE) as child:
            for _ in range(10):
                assert child.stdout is not None
                child.stdout.readline()
    else:
        with host(fast_bench) as line:
            if way == "falls silent":
                play(fast_bench, line, start)
            else:
                line.write(start)
    # Both clocks are read in whole ms.
    assert 99 <= fast_bench.event("motor off")["ms_after_heartbeat"] <= MOTOR_OFF
    assert fast_bench.event("run")["ended"] == "watchdog"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_a_closed_pseudo_terminal_stops_the_motor():
    """If a host closes a pseudo-terminal, its run ends, and the next host finds the motor off."""
    # Between the start and the closing, the host has 2 s before the watchdog acts.
    with emulator("--port", "pty", "--speed", "5", watchdog=2.0) as bench:
        with host(bench) as line:
            start = Start(wave=Wave.SINE, frequency=0.01, amplitude=300, cycles=1)
            line.write(encode(Signal.HEARTBEAT) + encode(start))
            assert line.read(1000)
        assert [bench.event("client")["connected"] for _ in range(2)] == [True, False]
        assert 1999 <= bench.event("motor off")["ms_after_heartbeat"] <= 2000 + MOTOR_OFF
        ended = bench.event("run")
        assert ended["ended"] == "watchdog"
        assert ended["lines"] < start.duration / TRUE_PERIOD
        with host(bench) as line:
            assert line.read(1) == b""
            readings = stream(bench, line, Start(wave=Wave.DELTA, frequency=1.0, amplitude=0))
        assert {reading.duty for reading in readings} == {0}


def test_a_host_that_leaves_an_unguarded_bench_stops_nothing(fast_bench):
    """Without any heartbeat a run goes on to its end after the host has left."""
    with host(fast_bench) as line:
        line.write(encode(Start(wave=Wave.SINE, frequency=0.5, amplitude=30, cycles=1)))
    assert fast_bench.event("run")["ended"] == "done"
    with host(fast_bench) as line:
        line.write(encode(Start(wave=Wave.SINE, frequency=0.01, amplitude=30, cycles=1)))
        line.read(100)
        # A start command that noise cut short precedes the stop.
        play(fast_bench, line, b"d;q;o;\xff", encode(Signal.STOP))
    ended = fast_bench.event("run")
    assert ended["ended"] == "stopped"
    assert ended["lines"] < 20_000


def test_a_stock_bench_has_no_query_and_no_stop():
    """A stock bench answers no query and has no cart two; only the stock stop ends its run."""
    with (
        emulator("--stock", "--period", "2.005", preset="throne-1dof") as bench,
        host(bench) as line,
    ):
        line.write(b"?;s;")
        assert line.read(1) == b""
        line.write(encode(Start(wave=Wave.SQUARE, frequency=1.0, amplitude=300, cycles=99)))
        line.write(b"s;")
        heard = b""
        while len(heard) < 8_000:
            heard += line.read(4096)
        line.write(b"".join(map(encode, STOCK_STOP)))
        readings, spoiled = damaged(heard[: heard.rindex(b"\n")])
        assert spoiled == 0
        assert bench.event("run")["ended"] == "restarted"
    assert {reading.counts[1] for reading in readings} == {0}
    assert np.diff([reading.ms for reading in readings[:400]]).mean() == pytest.approx(2.005, 2e-3)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("drop", "give a rate, drop=0.01, or a time, drop@5"),
        ("drop=0.1@3", "give a rate"),
        ("drop=2", "between 0 and 1"),
        ("dorp=0.1", "did you mean 'drop'"),
        ("stuck=0.5", "which encoder"),
        ("drop=1.2.3", "could not convert"),
        ("drop:0.1", "write KIND=RATE"),
    ],
)
def test_an_unknown_fault_is_reported(fault, message):
    """A fault that does not exist gives one clear message."""
    with pytest.raises(ConfigError, match=message):
        read_fault(fault)
