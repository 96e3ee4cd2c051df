"""Mistakes of people at a bench are reported, and harm no recorded data."""

import re
import signal
import socket
import time
from collections.abc import Sequence

import pytest
from typer.testing import CliRunner

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Anomalies
from pipeline.bench.experiments import cart_remarks, prepare_submission
from pipeline.bench.serial_line import open_line
from pipeline.cli import app
from pipeline.errors import ConfigError, HardwareError
from pipeline.experiments.plan import PlanLimits
from pipeline.protocol import EXTENSIONS, WATCHDOG, Description, Reading
from pipeline.simulated.emulator.links import open_link
from pipeline.submission import load_submission
from tests.helpers.acquisitions import Notes, host, sine, until_bytes, write_work
from tests.helpers.benches import emulator


def test_a_bench_with_too_few_carts_is_refused(tmp_path):
    """A bench with one cart is refused for a submission of two carts."""
    work = write_work(tmp_path, [sine("dwell", seconds=1)])
    with emulator("--speed", "20", preset="throne-1dof") as bench:
        with pytest.raises(
            ConfigError, match=r"has 2 carts, but the bench 'throne-1dof' has 1: are"
        ):
            acquire(work, port=bench.address, observers=[Notes()])
    assert not (work / "raw").exists()


def test_a_bench_with_more_carts_is_reported(tmp_path):
    """If the bench has more carts than the submission, a message says so and the run goes on."""
    submission = load_submission(write_work(tmp_path, []))
    bench = Description(name="three", encoders=3, carts=3, commands=EXTENSIONS)
    (remark,) = cart_remarks(submission, bench)
    assert "carts = 2, but the bench 'three' has 3: if it is the right bench" in remark
    assert cart_remarks(submission, Description(name="stock", encoders=3, carts=3)) == []


def test_a_run_in_which_nothing_moves_is_not_recorded(tmp_path):
    """A dwell in which no encoder moves is tried three times and never recorded."""
    work = write_work(tmp_path, [sine("dwell", seconds=2)])
    notes = Notes()
    dead = ("--fault", "stuck=1@0", "--fault", "stuck=2@0")
    with emulator("--speed", "20", *dead) as bench:
        outcomes = acquire(work, port=bench.address, observers=[notes], only=["dwell"])
    assert [o.partial[:27] for o in outcomes] == ["no free cart moved: is one "] * 3
    assert load_submission(work).experiments == ()


def test_a_second_session_in_a_folder_is_refused(tmp_path, real, fast):
    """A second session in the same folder is refused, and the message names the first process."""
    work = write_work(tmp_path / "work", [sine("dwell", seconds=6)])
    with host(work, real.address, "--only", "dwell", "--yes") as process:
        until_bytes(work / "raw" / "dwell-1.raw", process)
        refused = rf"another cartlab \(process {process.pid}\) is writing"
        with pytest.raises(ConfigError, match=refused):
            acquire(work, port=fast.address, observers=[Notes()])
        process.communicate()
    assert process.returncode == 0
    assert sorted(path.name for path in (work / "data").iterdir()) == ["dwell.txt"]


class Late(Notes):
    """An observer that once keeps the computer busy for longer than the watchdog waits."""

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines, and be slow after the first batch."""
        if not self.readings_seen:
            time.sleep(0.3)
        super().readings(batch, anomalies)


def test_a_busy_computer_is_named_if_the_watchdog_acts(tmp_path):
    """If the computer is too busy to send a heartbeat, the message says so."""
    work = write_work(tmp_path, [sine("dwell", seconds=5)])
    notes = Late()
    with emulator(watchdog=WATCHDOG) as bench:
        outcome, *_ = acquire(work, port=bench.address, observers=[notes], only=["dwell"])
    assert "fell silent" in outcome.partial
    late = re.search(r"too busy and sent no heartbeat for (\d+) ms", outcome.partial)
    assert late is not None
    assert int(late[1]) >= 1e3 * WATCHDOG


class LastMoment(Notes):
    """An observer that presses Ctrl-C when the last lines have arrived."""

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Note the lines."""
        super().readings(batch, anomalies)
        if batch[-1].ms >= 1999:
            signal.raise_signal(signal.SIGINT)


def test_an_interrupt_after_the_last_line_keeps_the_run(tmp_path):
    """If Ctrl-C comes after the last line, the run is kept and the session ends."""
    work = write_work(tmp_path, [sine("first", seconds=2), sine("second", seconds=2)])
    notes = LastMoment()
    with emulator("--speed", "4") as bench, pytest.raises(KeyboardInterrupt):
        acquire(work, port=bench.address, observers=[notes])
    assert [experiment.id for experiment in load_submission(work).experiments] == ["first"]
    assert [outcome.partial for outcome in notes.outcomes] == [""]
    assert not (work / "data" / "first.partial.txt").exists()


def test_a_network_port_typed_as_a_device_is_corrected():
    """If a network port is typed as a device, the message shows the right notation."""
    for port in ("41001", "127.0.0.1:41001"):
        with pytest.raises(HardwareError, match=r"is written socket://HOST:PORT"):
            open_line(port, baud=115_200)


def test_a_port_that_is_taken_says_what_to_choose():
    """If a port is taken, a second emulator's message says that port 0 picks a free one."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(ConfigError, match="choose another port, or 0 for any"):
            open_link(f"socket://127.0.0.1:{taken.getsockname()[1]}")


def test_nouns_agree_with_their_numbers():
    """In messages the noun agrees with its number: one line, one encoder, two resets."""
    assert str(Anomalies(lost=1, stuck=1, resets=2)) == "1 line lost, 2 resets, 1 encoder stuck"
    assert str(Anomalies(lost=2, stuck=2, resets=1)) == "2 lines lost, 1 reset, 2 encoders stuck"


def test_a_new_submission_says_what_the_bench_does_not_know(tmp_path):
    """A new submission asks to check its springs, and has authors and design as comments."""
    bench = Description(name="two", encoders=2, carts=2, commands=EXTENSIONS, position_unit="cm")
    folder = tmp_path / "new"
    assert prepare_submission(folder, bench, stock=False).authors == ()
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8")
    assert "springs = [true, true, true]  # check: wall-1, 1-2, 2-wall; false for" in text
    path.write_text(re.sub(r"(?m)^#(?! )", "", text), encoding="utf-8")
    submission = load_submission(folder)
    assert [author.id for author in submission.authors] == ["s1024"]
    assert submission.design is not None


def test_no_report_is_offered_if_nothing_was_recorded(tmp_path, fast):
    """If every run passes a limit, the message says what to change and offers no report."""
    near = PlanLimits(input=0.5, travel=0.05)
    work = write_work(tmp_path, [sine("dwell", seconds=4)], limits=near)
    with host(work, fast.address, "--only", "dwell", "--yes") as process:
        _, said = process.communicate()
    assert process.returncode == 1
    assert "divide the amplitude in plan.toml by four. If the bench" in said
    assert "again: confirmed by --yes" not in said
    assert "cartlab report" not in said


def test_files_are_imported_only_into_a_submission(tmp_path):
    """If the folder to import into does not exist, the message says how to make a submission."""
    where = str(tmp_path / "new")
    done = CliRunner().invoke(app, ["acquire", where, "--import", str(tmp_path), "--once"])
    assert isinstance(done.exception, ConfigError)
    assert f"run `cartlab new {where} --carts N`" in str(done.exception)
