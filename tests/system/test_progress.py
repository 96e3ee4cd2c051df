"""Progress on a terminal; elsewhere only what a person has to know."""

import os
import signal
import subprocess
import sys

import pytest
from rich.progress import Progress

from pipeline.cli.grading import counting
from pipeline.resources import EXAMPLES
from tests.helpers.commandline import cartlab_here


def test_a_pipe_sees_no_progress(tmp_path):
    """Where stderr is no terminal there is the summary alone, without control characters."""
    done = cartlab_here("report", EXAMPLES / "one-cart", "--out", tmp_path, "--no-pdf")

    assert done.stdout == ""
    assert "\x1b" not in done.stderr
    assert "free decays" not in done.stderr
    assert done.stderr.startswith("A single cart was identified")


def test_what_was_known_before_is_no_speed():
    """Of 1000 hand-ins 990 were graded before; at 2 s for each of the others 8 s are left."""
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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_a_terminal_sees_what_is_done_and_for_how_long(tmp_path):
    """On a terminal the stages pass by with the time, and the line is gone in the end."""
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "pipeline", "report", str(EXAMPLES / "one-cart")]
    with subprocess.Popen([*command, "--out", str(tmp_path)], stderr=theirs) as running:
        os.close(theirs)
        seen = b"".join(iter(lambda: _read(ours), b"")).decode()
    os.close(ours)

    assert running.returncode == 0
    assert "report: " in seen
    assert "0:00:0" in seen
    assert seen.rstrip().endswith(f"wrote {tmp_path / 'report.html'} and {tmp_path / 'report.pdf'}")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo terminals")
def test_ctrl_c_is_answered(tmp_path):
    """Who stops a report at work is told so, and the exit status is that of Ctrl-C."""
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "pipeline", "report", str(EXAMPLES / "three-cart")]
    with subprocess.Popen([*command, "--out", str(tmp_path)], stderr=theirs) as running:
        os.close(theirs)
        seen = b""
        while b"free decays" not in seen and (more := _read(ours)):
            seen += more
        running.send_signal(signal.SIGINT)
        seen += b"".join(iter(lambda: _read(ours), b""))
    os.close(ours)

    assert running.returncode == 130
    assert seen.decode().rstrip().endswith("stopped; the same command begins anew")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # on Linux the other end has been closed
        return b""
