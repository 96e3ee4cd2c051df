"""What people get wrong at a bench is said, and harms nothing that was recorded."""

import re
import signal
import socket
import time
from collections.abc import Sequence

import pytest

from pipeline.bench.acquire import acquire
from pipeline.bench.experiments import cart_remarks
from pipeline.bench.links import open_link
from pipeline.bench.observer import Anomalies
from pipeline.bench.protocol import EXTENSIONS, Description, Reading
from pipeline.bench.serial_line import open_line
from pipeline.errors import ConfigError, HardwareError
from pipeline.submission import load_submission
from tests.acquisitions import Notes, host, sine, write_work
from tests.benches import emulator


def test_another_bench_than_the_submission_is_of_is_refused(tmp_path):
    """A submission of two carts takes nothing from a bench that states one."""
    work = write_work(tmp_path, [sine("dwell", seconds=1)])
    with emulator("--speed", "20", preset="throne-1dof") as bench:
        with pytest.raises(ConfigError, match=r"has 2 carts, the bench 'throne-1dof' has 1: is"):
            acquire(work, port=bench.address, observers=[Notes()])
    assert not (work / "raw").exists()


def test_a_bench_of_more_carts_is_said(tmp_path):
    """Whoever holds the third cart by hand may go on; the wrong cable is named."""
    submission = load_submission(write_work(tmp_path, []))
    bench = Description(name="three", encoders=3, carts=3, commands=EXTENSIONS)
    (remark,) = cart_remarks(submission, bench)
    assert "carts = 2, the bench 'three' has 3: if this is not the wrong bench" in remark
    assert cart_remarks(submission, Description(name="stock", encoders=3, carts=3)) == []


def test_a_run_in_which_nothing_moves_is_not_recorded(tmp_path):
    """Two encoders that are not plugged in make no dwell; it is offered again, twice."""
    work = write_work(tmp_path, [sine("dwell", seconds=2)])
    notes = Notes()
    dead = ("--fault", "stuck=1@0", "--fault", "stuck=2@0")
    with emulator("--speed", "20", *dead) as bench:
        outcomes = acquire(work, port=bench.address, observers=[notes], only=["dwell"])
    assert [o.partial[:26] for o in outcomes] == ["no cart that is free moved"] * 3
    assert load_submission(work).experiments == ()


def test_a_second_session_in_a_folder_is_refused(tmp_path):
    """It is told which process records there, and what that one records stays whole."""
    work = write_work(tmp_path / "work", [sine("dwell", seconds=6)])
    with emulator() as first, emulator("--speed", "20", "--seed", "1") as second:
        process = host(work, first.address, "--only", "dwell", "--yes")
        end = time.monotonic() + 30
        while not (work / "raw" / "dwell-1.raw").exists():
            assert time.monotonic() < end, "no run began"
            time.sleep(0.02)
        with pytest.raises(ConfigError, match=rf"another cartlab \(process {process.pid}\) writes"):
            acquire(work, port=second.address, observers=[Notes()])
        process.communicate(timeout=30)
    assert process.returncode == 0
    assert sorted(path.name for path in (work / "data").iterdir()) == ["dwell.txt"]


class Late(Notes):
    """Keeps the computer busy once, for longer than a watchdog waits."""

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines, and be slow after the first of them."""
        if not self.readings_seen:
            time.sleep(0.3)
        super().readings(batch, anomalies)


def test_a_busy_computer_is_named_where_the_watchdog_bites(tmp_path):
    """A host that sends no heartbeat for 0.3 s says so, not only that the bench fell silent."""
    work = write_work(tmp_path, [sine("dwell", seconds=5)])
    notes = Late()
    with emulator() as bench:
        outcome, *_ = acquire(work, port=bench.address, observers=[notes], only=["dwell"])
    assert "fell silent" in outcome.partial
    assert re.search(r"too busy, it sent no heartbeat for [34]\d\d ms", outcome.partial)


class LastMoment(Notes):
    """Presses Ctrl-C when the last lines are there."""

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines."""
        super().readings(batch, anomalies)
        if batch[-1].ms >= 1990:
            signal.raise_signal(signal.SIGINT)


def test_an_interrupt_after_the_last_line_keeps_the_run(tmp_path):
    """A run that was over when Ctrl-C came is recorded; the session ends all the same."""
    work = write_work(tmp_path, [sine("first", seconds=2), sine("second", seconds=2)])
    notes = LastMoment()
    with emulator("--speed", "4") as bench, pytest.raises(KeyboardInterrupt):
        acquire(work, port=bench.address, observers=[notes])
    assert [experiment.id for experiment in load_submission(work).experiments] == ["first"]
    assert [outcome.partial for outcome in notes.outcomes] == [""]
    assert not (work / "data" / "first.partial.txt").exists()


def test_a_network_port_typed_as_a_device_is_told_how_to_write_it():
    """Neither a number nor HOST:PORT is a device; the form that works is named."""
    for port in ("41001", "127.0.0.1:41001"):
        with pytest.raises(HardwareError, match=r"is written socket://HOST:PORT"):
            open_line(port, baud=115_200)


def test_a_port_that_is_taken_says_what_to_choose():
    """A second emulator on the port of the first is told that 0 takes any."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(ConfigError, match="choose another port, or 0 for any"):
            open_link(f"socket://127.0.0.1:{taken.getsockname()[1]}")


def test_one_is_not_many():
    """One line, one encoder, two resets."""
    assert str(Anomalies(lost=1, stuck=1, resets=2)) == "1 line lost, 2 resets, 1 encoder stuck"
    assert str(Anomalies(lost=2, stuck=2, resets=1)) == "2 lines lost, 1 reset, 2 encoders stuck"
