"""Report why the desk ends, whatever the cause, on stderr and in a log."""

import faulthandler
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

from pipeline import __version__
from pipeline.desk import crash_watch
from pipeline.errors import PipelineError
from pipeline.output import OWNERS_FOLDER


class CrashLog:
    """Report what ends the desk; use it as a context manager around the server.

    Parameters
    ----------
    say : function that writes a line to stderr.

    Attributes
    ----------
    asked : set when a signal asks the desk to end.
    log : file that records why desks ended.
    """

    def __init__(self, *, say: Callable[[str], None]) -> None:
        self.asked = threading.Event()
        self.log = find_log()
        self._say, self._why = say, "no reason was given"
        # The watching process has a session of its own, so that closing the terminal does not end
        # it.
        self._watch = subprocess.Popen(
            [sys.executable, "-I", crash_watch.__file__, str(self.log), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )

    def __enter__(self) -> Self:
        assert self._watch.stdin is not None
        faulthandler.enable(file=self._watch.stdin)
        threading.excepthook = self._report_thread_error
        # All signals that a program can catch: Ctrl-C, kill, a closed terminal or session.
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):
            number = getattr(signal, name, None)
            # nohup makes a program ignore SIGHUP; it stays ignored.
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._signalled)
        self.note(f"begins: cartlab {__version__}, Python {platform.python_version()}")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, where: object) -> None:
        if isinstance(error, BaseException):
            self._why = _name(error)
            self._note_traceback(error)
        # The command line itself prints these two kinds of errors.
        if not isinstance(error, PipelineError | OSError):
            self._say(f"cartlab: the desk ends: {self._why}")
        faulthandler.disable()
        self.note(f"{crash_watch.REASON}{self._why}")
        with suppress(OSError):
            if self._watch.stdin is not None:
                self._watch.stdin.close()
        self._watch.wait()

    def note(self, text: str) -> None:
        """Write lines to the log."""
        lines = "".join(f"\t{line}\n" for line in text.splitlines())
        with suppress(OSError, ValueError):  # the watching process was killed
            assert self._watch.stdin is not None
            self._watch.stdin.write(lines.encode(errors="replace"))
            self._watch.stdin.flush()

    def _signalled(self, number: int, _: object) -> None:
        self._why = signal.Signals(number).name
        self.asked.set()

    def _report_thread_error(self, raised: threading.ExceptHookArgs) -> None:
        """Report an exception that ended a thread; the desk itself continues."""
        if raised.exc_value is None or isinstance(raised.exc_value, SystemExit):
            return
        name = raised.thread.name if raised.thread else "?"
        self._say(f"cartlab: the desk: {_name(raised.exc_value)} in thread {name}")
        self.note(f"in thread {name}:")
        self._note_traceback(raised.exc_value)

    def _note_traceback(self, error: BaseException) -> None:
        with suppress(MemoryError, RecursionError):
            self.note("".join(traceback.format_exception(error)))


def find_log() -> Path:
    """Return the path of the log; create its folder if possible."""
    defaults = {"win32": "~/AppData/Local", "darwin": "~/Library/Logs"}
    root = os.environ.get("XDG_STATE_HOME") or defaults.get(sys.platform, "~/.local/state")
    try:
        log = Path(root).expanduser() / "cartlab" / "desk.log"
    except RuntimeError:  # the user has no home folder
        log = Path(tempfile.gettempdir()) / "cartlab-desk.log"
    with suppress(OSError):  # the home folder is not writable: stderr has the most important lines
        log.parent.mkdir(OWNERS_FOLDER, parents=True, exist_ok=True)
        if log.stat().st_size > 1_000_000:  # bytes; a larger log is started again
            log.unlink()
    return log


def _name(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")
