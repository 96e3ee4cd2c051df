"""Ctrl-C while the program still loads ends it with status 130 and one line, not a traceback."""

import subprocess
import sys

import pytest

from pipeline.cli import STOPPED
from tests.helpers.places import ROOT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signal")

LONG = [pytest.mark.slow, pytest.mark.sample]

# This program presses Ctrl-C at the N-th import, which is the same moment on any machine. The first
# two imports are the package and its command line, before any of its code runs.
_PRESS = """
import os, signal, sys
at, *words = sys.argv[1:]
seen = 0

def press(event, args):
    global seen
    if event == "import":
        seen += 1
        if seen == int(at):
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["cartlab", *words]
sys.addaudithook(press)
from pipeline.cli import main
main()
"""


@pytest.mark.parametrize("at", [*range(3, 12), *range(12, 300, 24)])
def test_ctrl_c_while_the_commands_load_is_one_line(at):
    """Ctrl-C while the command line loads ends it with one line, which says that it stopped."""
    done = _pressed(at, "effects")
    assert (done.returncode, done.stderr.splitlines()) == (130, [STOPPED])


@pytest.mark.parametrize(
    "at", [400, 700, *(pytest.param(at, marks=LONG) for at in (500, 600, 800))]
)
def test_ctrl_c_while_a_command_loads_libraries_is_one_line(tmp_path, at):
    """Ctrl-C while a command loads its libraries gives one line."""
    out = tmp_path / "out"
    done = _pressed(at, "report", "submissions/one-cart", "--no-pdf", "--out", str(out))
    assert done.returncode == 130
    *progress, last = done.stderr.splitlines()
    assert last == STOPPED
    assert all(" … " in line for line in progress)  # a busy machine shows progress


def _pressed(at: int, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command during which Ctrl-C is pressed."""
    command = [sys.executable, "-c", _PRESS, str(at), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
