"""Mistakes of people at a bench are reported, and harm no recorded data."""

import re
import signal
import time
from collections.abc import Sequence

import pytest
from typer.testing import CliRunner

from pipeline.bench.acquire import acquire
from pipeline.bench.events import Anomalies
from pipeline.bench.experiments import prepare_submission
from pipeline.cli import app
from pipeline.errors import ConfigError
from pipeline.protocol import EXTENSIONS, WATCHDOG, Description, Reading
from pipeline.submission import load_submission
from tests.helpers.acquisitions import (
    Notes,
    carried_out,
    causes,
    host,
    sine,
    until_bytes,
    write_work,
)
from tests.helpers.benches import emulator


def test_a_bench_with_too_few_carts_is_refused(tmp_path):
    """A bench with one cart is refused for a submission of two carts."""
    work = write_work(tmp_path, [sine("dwell", seconds=1)])
    with emulator("--speed", "20", preset="throne-1dof") as bench:
        with pytest.raises(ConfigError, match="'throne-1dof' has 1"):
            carried_out(work, bench.address)
    assert not (work / "raw").exists()


def test_a_run_in_which_nothing_moves_is_not_recorded(tmp_path):
    """A dwell in which no encoder moves is tried three times and never recorded."""
    work = write_work(tmp_path, [sine("dwell", seconds=2)])
    dead = ("--fault", "stuck=1@0", "--fault", "stuck=2@0")
    with emulator("--speed", "20", *dead) as bench:
        outcomes = carried_out(work, bench.address)
    assert [causes(o.partial) for o in outcomes] == [["still"]] * 3
    assert load_submission(work).experiments == ()


@pytest.mark.slow
@pytest.mark.sample
def test_a_second_session_in_a_folder_is_refused(tmp_path, real, fast):
    """A second session in the same folder is refused, and the message names the first process."""
    work = write_work(tmp_path / "work", [sine("dwell", seconds=6)])
    with host(work, real.address, "--only", "dwell", "--yes") as process:
        until_bytes(work / "raw" / "dwell-1.raw", process)
        with pytest.raises(ConfigError, match=str(process.pid)):
            carried_out(work, fast.address)
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


@pytest.mark.slow
@pytest.mark.sample
def test_a_busy_computer_is_named_if_the_watchdog_acts(tmp_path):
    """If the computer is too busy to send a heartbeat, the message says so."""
    work = write_work(tmp_path, [sine("dwell", seconds=5)])
    with emulator(watchdog=WATCHDOG) as bench:
        outcome, *_ = carried_out(work, bench.address, notes=Late())
    assert causes(outcome.partial) == ["silent", "busy"]
    late = re.search(r"heartbeat for (\d+) ms", outcome.partial)
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
        acquire(work, port=bench.address, observer=notes)
    assert [experiment.id for experiment in load_submission(work).experiments] == ["first"]
    assert [outcome.partial for outcome in notes.outcomes] == [""]
    assert not (work / "data" / "first.partial.txt").exists()


def test_a_new_submission_says_what_the_bench_does_not_know(tmp_path):
    """A new submission asks to check its springs, and has authors and design as comments."""
    bench = Description(name="two", encoders=2, carts=2, commands=EXTENSIONS, position_unit="cm")
    folder = tmp_path / "new"
    assert prepare_submission(folder, bench, stock=False).authors == ()
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8")
    assert re.search(r"(?m)^springs = \[true, true, true\]  # check", text)
    path.write_text(re.sub(r"(?m)^#(?! )", "", text), encoding="utf-8")
    submission = load_submission(folder)
    assert [author.id for author in submission.authors] == ["s1024"]
    assert submission.design is not None


def test_files_are_imported_only_into_a_submission(tmp_path):
    """If the folder to import into does not exist, the message says how to make a submission."""
    where = str(tmp_path / "new")
    done = CliRunner().invoke(app, ["acquire", where, "--import", str(tmp_path), "--once"])
    assert isinstance(done.exception, ConfigError)
    assert f"new {where}" in str(done.exception)
