"""Record why the desk ends, on stderr and in a log."""

import faulthandler
import os
import platform
import re
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Self

import psutil

from pipeline import __version__
from pipeline.errors import PipelineError
from pipeline.output import OWNERS_FOLDER

_BEGINS, _ENDS = "begins:", "ends:"  # the first words of the lines about a desk as a whole
_WHOLE = re.compile(rf"\S+ \S+ (\S+) (\d{{1,9}}) ({_BEGINS}|{_ENDS})")


class CrashLog:
    """Record what ends the desk; use it as a context manager around the server.

    A desk that is killed cannot record its end. The next desk then records it instead, and
    `killed` says so.

    Parameters
    ----------
    say : function that writes a line to stderr.

    Attributes
    ----------
    asked : set when a signal asks the desk to end.
    log : file that records why desks ended.
    killed : message that an earlier desk was killed or crashed, or "".
    """

    def __init__(self, *, say: Callable[[str], None]) -> None:
        self.asked = threading.Event()
        self.log, self.killed = find_log(), ""
        self._say, self._why = say, "no reason was given"
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        # Without a log, as in a home folder that is not writable, stderr has the important lines.
        killed: list[int] = []
        with suppress(OSError):
            killed = _list_killed(self.log)
            self._file = open(self.log, "ab", buffering=0, opener=_open_private)
        if killed:
            self.killed = (
                "an earlier desk was killed or crashed. Saved files are intact; its last change "
                f"may be missing. The log says where a library crashed: {self.log}"
            )
            for process in killed:
                self._note(f"{_ENDS} was killed or crashed before it could say why", process)
        faulthandler.enable(file=self._file or sys.stderr)
        threading.excepthook = self._report_thread_error
        # All signals that a program can catch: Ctrl-C, kill, a closed terminal or session.
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):
            number = getattr(signal, name, None)
            # nohup makes a program ignore SIGHUP; it stays ignored.
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._signalled)
        self._note(f"{_BEGINS} cartlab {__version__}, Python {platform.python_version()}")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, where: object) -> None:
        if isinstance(error, BaseException):
            self._why = _name(error)
            self._note_traceback(error)
        # The command line itself prints these two kinds of errors.
        if not isinstance(error, PipelineError | OSError):
            self._say(f"cartlab: the desk ends: {self._why}")
        faulthandler.disable()
        self._note(f"{_ENDS} {self._why}")
        if self._file:
            self._file.close()

    def _note(self, text: str, process: int | None = None) -> None:
        """Write lines to the log, with the time, the computer, and the id of a desk's process."""
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%SZ")
        prefix = f"{now} {_computer()} {process or os.getpid()} "
        lines = "".join(f"{prefix}{line}\n" for line in text.splitlines())
        with suppress(OSError, ValueError):  # the disk is full, or the desk has ended
            if self._file:
                self._file.write(lines.encode(errors="replace"))

    def _signalled(self, number: int, _: object) -> None:
        self._why = signal.Signals(number).name
        self.asked.set()

    def _report_thread_error(self, raised: threading.ExceptHookArgs) -> None:
        """Report an exception that ended a thread; the desk itself continues."""
        if raised.exc_value is None or isinstance(raised.exc_value, SystemExit):
            return
        name = raised.thread.name if raised.thread else "?"
        self._say(f"cartlab: the desk: {_name(raised.exc_value)} in thread {name}")
        self._note(f"in thread {name}:")
        self._note_traceback(raised.exc_value)

    def _note_traceback(self, error: BaseException) -> None:
        with suppress(MemoryError, RecursionError):
            self._note("".join(traceback.format_exception(error)))


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


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _list_killed(log: Path) -> list[int]:
    """Return the processes of this computer's desks that began, did not end, and are gone."""
    if not log.exists():
        return []
    begun: dict[int, bool] = {}
    for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
        if (match := _WHOLE.match(line)) and match[1] == _computer():
            begun[int(match[2])] = match[3] == _BEGINS
    # In a new container, this process may have the id of a killed desk.
    return [
        one for one in begun if begun[one] and (one == os.getpid() or not psutil.pid_exists(one))
    ]


def _computer() -> str:
    """Return the name of this computer or container; only its own processes can be looked up."""
    return "-".join(platform.node().split()) or "-"


def _name(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")
