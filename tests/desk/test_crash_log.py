"""A desk reports what ended it, and the next desk removes what it left."""

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.desk.app import DeskServer
from pipeline.desk.served_files import clear_scratch, scratch_folder
from tests.helpers.desks import Visitor
from tests.helpers.waiting import PATIENCE, address, started

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no such signals")

LONG = [pytest.mark.slow, pytest.mark.sample]  # each case starts a desk

# A desk in which a line on stdin ends a thread or the whole process at any moment.
DESK = """
import ctypes, os, sys, threading
from pipeline.cli import main

def interrupt():
    how, name = sys.stdin.readline().split()
    if how == "exit":
        os._exit(3)
    if how == "thread":
        raise ValueError("boom")
    (ident,) = [one.ident for one in threading.enumerate() if one.name == name]
    raised = ctypes.py_object({"memory": MemoryError, "exit0": SystemExit}[how])
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), raised)

threading.Thread(target=interrupt, name="other", daemon=True).start()
sys.argv = ["cartlab", "desk", "--no-browser", *sys.argv[1:]]
main()
"""


@contextmanager
def a_desk(tmp_path: Path, *options: str) -> Iterator[tuple[subprocess.Popen, str, Callable]]:
    """Start a desk.

    Yield the desk's process, its address, and a function that waits for its end and returns exit
    status, output and log.
    """
    log = tmp_path / "state" / "cartlab" / "desk.log"
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path / "state")}
    command = [sys.executable, "-c", DESK, *options]
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE, "encoding": "utf-8"}
    with started(command, env=environment, **pipes) as desk:
        url = address(desk)

        def ended() -> tuple[int, str, str]:
            assert desk.stderr is not None
            status = desk.wait(PATIENCE)
            said = desk.stderr.read()
            kept = log.read_text(encoding="utf-8") if log.exists() else ""
            return status, said, kept

        yield desk, url, ended


@pytest.mark.slow
@pytest.mark.sample
def test_a_desk_outlives_its_terminal_and_an_exception_in_another_thread(tmp_path):
    """A desk started with nohup survives the end of its terminal.

    It also survives an exception in one of its other threads, whose traceback is in the log.
    """
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the desk inherits this setting
    try:
        with a_desk(tmp_path) as (desk, url, ended):
            desk.send_signal(signal.SIGHUP)
            visitor = Visitor.of(url)
            assert desk.stdin is not None
            assert desk.stderr is not None
            desk.stdin.write("thread other\n")
            desk.stdin.flush()
            assert re.fullmatch("cartlab: .*ValueError: boom.* other\n", desk.stderr.readline())
            assert visitor.get("/").status == 200
            desk.terminate()
            status, said, kept = ended()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert (status, said.count("\n")) == (0, 1)
    assert said.endswith(" ends: SIGTERM\n")
    assert kept.endswith(" ends: SIGTERM\n")
    assert 'raise ValueError("boom")' in kept or "ValueError: boom" in kept


def test_the_next_desk_removes_the_files_of_a_killed_one(tmp_path, monkeypatch):
    """The temporary folder of a killed desk is removed when the next desk starts.

    Folders of running desks, and folders that no desk made, stay.
    """
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code = (
        "import sys, tempfile; tempfile.tempdir = sys.argv[1]\n"
        "from pipeline.desk.served_files import scratch_folder\n"
        "with scratch_folder() as folder:\n"
        "    (folder / 'upload.zip').write_bytes(b'x'); print(folder, flush=True); input()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "encoding": "utf-8"}
    (tmp_path / "cartlab-notes").mkdir()
    with scratch_folder() as mine, started(command, **pipes) as other:
        assert other.stdout is not None
        theirs = Path(other.stdout.readline().strip())
        clear_scratch()
        assert mine.is_dir()
        assert (theirs / "upload.zip").is_file()
        other.kill()
        other.wait()
        with DeskServer():
            assert not theirs.exists()
        assert mine.is_dir()
    assert [path.name for path in tmp_path.iterdir()] == ["cartlab-notes"]


@pytest.mark.parametrize(
    ("sent", "status", "told"),
    [
        pytest.param("SIGINT", 0, "ends: SIGINT", marks=LONG),
        pytest.param("SIGHUP", 0, "ends: SIGHUP", marks=LONG),
        pytest.param("SIGKILL", -9, "", marks=LONG),
        ("SIGSEGV", -11, ""),
        pytest.param("memory MainThread", 1, "ends: MemoryError", marks=LONG),
        pytest.param("memory server", 2, "server stopped", marks=LONG),
        pytest.param("exit0 server", 2, "server stopped", marks=LONG),
        pytest.param("exit now", 3, "", marks=LONG),
    ],
)
def test_what_ends_a_desk_is_reported(sent, status, told, tmp_path):
    """A signal, exception or exit that ends the desk is named on stderr and in the log.

    A desk that is killed says nothing; the next one reports it, once. After a crash in a library,
    the log has the lines of code that were running. The log says when the desk started; the secret
    is in neither.
    """
    number = getattr(signal, sent, None)
    if number and number != signal.SIGKILL and signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip(f"the tests were started with {sent} ignored, as by nohup")
    with a_desk(tmp_path) as (desk, url, ended):
        if number:
            desk.send_signal(number)
        else:
            assert desk.stdin is not None
            desk.stdin.write(f"{sent}\n")
            desk.stdin.flush()
        found, said, kept = ended()
    assert found == status
    assert told in said
    assert told in kept
    assert (" ends: " in kept) == bool(told)
    assert f" {desk.pid} begins: cartlab " in kept.splitlines()[0]
    assert url.split("/")[3] not in kept
    if status == 0:
        assert said == f"cartlab: the desk {told}\n"
        assert kept.endswith(f" {desk.pid} {told}\n")
    assert ("most recent call first" in kept) == (sent == "SIGSEGV")
    assert ("Traceback" in kept) == sent.startswith(("memory", "exit0"))
    for again in (not told, False):  # the next desk and the one after it
        with a_desk(tmp_path) as (desk, _, ended):
            desk.terminate()
            _, said, _ = ended()
        assert [word in said for word in ("earlier desk", str(tmp_path))] == [again, again]
