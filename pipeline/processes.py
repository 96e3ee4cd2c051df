"""Processes of our own that do one task after another, so that a bad one can be stopped.

`python -m MODULE` reads a line of JSON for each task on stdin and answers in lines on stdout.
"""

import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import psutil

_STDERR_SHOWN = 4_000  # characters
_LAST_WORDS = 300  # characters of what a process said before it died
_LUMP = 65_536  # bytes
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


class LineProcess:
    """A process that works, a plain subprocess.

    A daemonic process such as a Dask worker may not have children of `multiprocessing`.
    """

    def __init__(self, module: str) -> None:
        self._stderr: IO[bytes] = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                env=_environment(),
            )
        except OSError:
            self._stderr.close()
            raise
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def send(self, line: bytes) -> None:
        """Hand a line to the process.

        Raises
        ------
        OSError : it has ended.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()

    def line(self, *, timeout: float) -> bytes:
        """Return the next line that it wrote; b"" where it has ended.

        Raises
        ------
        queue.Empty : none came within `timeout` (s).
        """
        return self._lines.get(timeout=timeout)

    @property
    def runs(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    @property
    def memory(self) -> int:
        """Bytes that it holds, 0 where it has ended."""
        try:
            return psutil.Process(self._process.pid).memory_info().rss
        except psutil.Error:
            return 0

    def ending(self) -> str:
        """Wait for its end and return how it was."""
        code = self._process.wait()
        return f"signal {-code}" if code < 0 else f"exit status {code}"

    def said(self) -> str:
        """Return the end of what it wrote to stderr."""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")[-_STDERR_SHOWN:]

    def last_words(self) -> str:
        """Return how it ended and the last line that it wrote to stderr."""
        words = self.said().strip().rpartition("\n")[2][-_LAST_WORDS:]
        return f"the process ended ({self.ending()}) {words}".rstrip()

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._stderr):
            try:
                if pipe is not None:
                    pipe.close()
            except OSError:
                pass  # what was not sent yet is not wanted any more

    def _listen(self) -> None:
        """Keep every line, b"" where they end."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._lines.put(line)
        self._lines.put(b"")


def lines_sent() -> Iterator[bytes]:
    """Yield the lines that the parent sends, in such a process, until it is gone.

    They are not read from `sys.stdin`: Python cannot end while a thread waits for that, and aborts.
    """
    rest = b""
    while lump := os.read(0, _LUMP):
        *lines, rest = (rest + lump).split(b"\n")
        yield from lines


def limit_memory(more: int) -> None:
    """Let the address space of this process grow by so many bytes; only Linux can."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + more
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


def _environment() -> dict[str, str]:
    """Return the environment of such a process: one thread each, and the same package as here."""
    package = str(Path(__file__).resolve().parents[1])
    before = os.environ.get("PYTHONPATH")
    path = f"{package}{os.pathsep}{before}" if before else package
    return {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": path}
