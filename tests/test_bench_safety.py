"""The motor does not stay on, whatever the line, the terminal or a plan does."""

import signal
import sys
import time
from dataclasses import replace

import pytest

from pipeline.bench.acquire import acquire
from pipeline.bench.gains import Scales
from pipeline.bench.orders import make_order
from pipeline.bench.serial_line import open_line
from pipeline.bench.session import Session
from pipeline.errors import ConfigError
from pipeline.submission import System
from tests.acquisitions import LIMITS, Notes, host, sine, write_work
from tests.benches import emulator

TWO_CARTS = System(carts=2, springs=(True,) * 3)


class Alone(Notes):
    """Nobody is there."""

    def confirm(self, instruction: str) -> None:
        """Refuse."""
        raise ConfigError(f"{instruction}: nobody")


def test_lines_that_cannot_be_read_end_a_run(tmp_path):
    """While nothing that comes is a line no limit can be checked, so the motor is stopped."""
    work = write_work(tmp_path, [sine("dwell", seconds=10)])
    with emulator("--fault", "garble=1") as bench:
        (outcome,) = acquire(work, port=bench.address, observers=[Alone()], only=["dwell"])
        sent = bench.event("run")
    assert outcome.partial == "stopped: what the bench sends cannot be read, so nothing is watched"
    assert sent["ended"] == "stopped"
    assert sent["lines"] < 5000


def test_a_bench_that_goes_on_after_its_run_is_stopped(tmp_path):
    """A bench that runs more cycles than it was told, as after a changed digit, is stopped."""
    recording = sine("dwell", seconds=1)
    with emulator() as bench, open_line(bench.address, baud=115_200) as line:
        order = make_order(
            sine("dwell", seconds=20),
            limits=LIMITS,
            scales=Scales(input=line.bench.input_per_count, position=0.00227),
            system=TWO_CARTS,
            bench=line.bench,
        )
        session = Session(line, carts=2, limits=LIMITS, observer=Notes())
        outcome = session.record(replace(order, recording=recording), tmp_path / "dwell-1.raw")
        sent = bench.event("run")
    assert outcome.partial == "stopped: the bench went on past the end of the run"
    assert sent["ended"] == "stopped"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows no SIGHUP")
def test_a_closed_terminal_stops_the_motor(tmp_path):
    """SIGHUP ends a run with a stop, not a watchdog, and what came is saved."""
    work = write_work(tmp_path, [sine("dwell", seconds=30)])
    with emulator() as bench:
        process = host(work, bench.address, "--only", "dwell")
        raw, end = work / "raw" / "dwell-1.raw", time.monotonic() + 30
        while not raw.exists() or raw.stat().st_size < 5_000:
            assert time.monotonic() < end, "no run began"
            time.sleep(0.02)
        process.send_signal(signal.SIGHUP)
        process.communicate(timeout=20)
        assert bench.event("run")["ended"] == "stopped"
    assert process.returncode == 1
    assert (work / "data" / "dwell.partial.txt").exists()
