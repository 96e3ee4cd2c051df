"""Progress is one changing line on a terminal, and otherwise a new line from time to time."""

import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest
from rich.progress import Progress

from pipeline.cli.common import progress_line
from pipeline.cli.grading import _batch_progress, counting
from pipeline.resources import EXAMPLES
from tests.helpers.commandline import cartlab_here
from tests.helpers.waiting import until


def test_short_work_prints_no_progress_to_a_pipe(tmp_path):
    """If stderr is no terminal, a short command prints only its summary, as plain text."""
    done = cartlab_here("report", EXAMPLES / "one-cart", "--out", tmp_path, "--no-pdf")
    assert done.stdout == ""
    assert not [mark for mark in ("\x1b", " … ", "free decays") if mark in done.stderr]
    assert done.stderr.splitlines()[0]


@pytest.fixture
def at_terminal(tmp_path):
    """Return a function that runs a report at a pseudo terminal, perhaps with Ctrl-C at a word.

    It returns the exit status and what the terminal shows.
    """
    import pty

    def run(example: str, *, ctrl_c_at: bytes = b"") -> tuple[int, str]:
        ours, theirs = pty.openpty()
        command = [sys.executable, "-m", "pipeline", "report", str(EXAMPLES / example)]
        with subprocess.Popen([*command, "--no-pdf", "--out", tmp_path], stderr=theirs) as running:
            os.close(theirs)
            seen = b""
            while ctrl_c_at not in seen and (more := _read(ours)):  # a short stage may be missing
                seen += more
            if ctrl_c_at:
                running.send_signal(signal.SIGINT)
            seen += b"".join(iter(lambda: _read(ours), b""))
        os.close(ours)
        return running.returncode, seen.decode()

    return run


@pytest.mark.parametrize("work", [progress_line, _batch_progress])
def test_long_work_prints_progress_to_a_pipe(work, monkeypatch, capsys):
    """If stderr is no terminal, long work prints lines ever more rarely, and none after its end."""
    monkeypatch.setattr("pipeline.cli.common.FIRST_WORD", 0.02)
    said, threads = [], threading.active_count()

    def hear() -> str:
        said.append(capsys.readouterr().err)
        return "".join(said)

    with work() as progress:
        progress(*((3, 40, "fitting") if work is _batch_progress else ("fitting",)))
        began = time.monotonic()
        until(lambda: hear().count("fitting …") >= 3, "three lines")
        # The three lines come after 0.02, 0.06 and 0.14 s at the earliest.
        assert time.monotonic() - began > 0.1
    assert threading.active_count() == threads
    assert ("3 of 40:" in hear()) == (work is _batch_progress)


def test_earlier_grades_do_not_count_as_speed():
    """Submissions graded in an earlier run do not count in the estimate of the time left."""
    now = 0.0
    bar = Progress(get_time=lambda: now, disable=True)
    show = counting(bar)
    now = 0.5
    show(990, 1000, "")
    for done in range(991, 997):
        now += 2.0
        show(done, 1000, "")
    assert bar.tasks[0].completed == 996
    assert bar.tasks[0].time_remaining == pytest.approx(8.0, abs=1.0)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_a_terminal_shows_stage_and_time(at_terminal, tmp_path):
    """On a terminal a line shows the current stage and the time; it is removed at the end."""
    status, seen = at_terminal("one-cart")
    assert status == 0
    assert re.search(r"report: .*0:00:0", seen, re.DOTALL)
    last = seen.rstrip().splitlines()[-2:]
    assert last == [f"wrote {tmp_path / 'report.html'}", "status: fine"]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_ctrl_c_is_answered(at_terminal):
    """After Ctrl-C a message says that the report was stopped, and the exit status is 130."""
    status, seen = at_terminal("three-cart", ctrl_c_at=b"report: ")
    assert status == 130
    assert "stopped;" in seen.splitlines()[-1]


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # on Linux the other end is already closed
        return b""
