"""Worker processes that do one task after another and can be stopped without harm to the parent.

The parent uses a `Supervisor`, the worker calls `serve`; they exchange lines of JSON. The first
line to the worker holds the settings, each further line holds one task. The worker answers `ready`
first, then `done` or `failed` for each task, after any number of `stage` lines.
"""

import faulthandler
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Literal

import psutil

from pipeline.errors import PipelineError
from pipeline.startup import collect_seldom, with_one_thread
from pipeline.words.progress import Progress, silent

_GLANCE = 0.05  # s between checks of time, memory and stop requests
_START_LIMIT = 120.0  # s. A cold start on a busy machine takes ten
_STARTS = 3  # attempts. The system may end a new process to free memory
# tasks after which a worker process is replaced, because libraries use more and more memory
_TASKS_EACH = 500
_GRACE = 30.0  # s by which a task may exceed its limit after its parent has ended
_LAST_WORDS = 300  # characters of a process's last output, or of an internal error.
_LUMP = 65_536  # bytes to read at once
# Only one thread computes. The other one only listens and does not need its own heap, which takes
# 64 MB in glibc.
_SPARING = {"MALLOC_ARENA_MAX": "1"}


class Failed(PipelineError):
    """A task failed; the text says why."""


class Ended(Failed):
    """A worker process ended before it answered.

    Attributes
    ----------
    how : why the process ended: `start` if it failed before it was ready, `crash` if it failed
        later.
    status : exit status or signal of the process, in words.
    stderr_end : the last part of what the process wrote to stderr.
    """

    def __init__(
        self,
        why: str,
        *,
        how: Literal["stopped", "time", "memory", "crash", "start"],
        status: str = "",
        stderr_end: str = "",
    ) -> None:
        super().__init__(why)
        self.how, self.status, self.stderr_end = how, status, stderr_end


class Supervisor:
    """Runs tasks in a worker process: starts it, stops it at a limit, replaces it if it fails."""

    def __init__(self, module: str, *, memory: int, setup: Mapping[str, Any] | None = None) -> None:
        self._module, self._memory = module, memory
        self._first = _json_line({"memory": memory, "setup": setup or {}})
        self._process: LineProcess | None = None
        self._is_ready, self._done = False, 0

    def do(
        self,
        task: Any,
        *,
        limit: float,
        stop: threading.Event | None = None,
        progress: Progress = silent,
    ) -> Any:
        """Do a task in the worker and return its answer; both are plain data.

        Parameters
        ----------
        limit : time limit in s, not counting the start of the process.
        stop : event that cancels the task when it is set.
        progress : function that is called with the name of each stage of the task.

        Raises
        ------
        Failed : the task failed.
        Ended : the task failed and its process ended.
        OSError : the computer cannot start a process.
        """
        stop = stop or threading.Event()
        process = self._ready(stop)
        most = process.memory + self._memory
        end = time.monotonic() + limit
        with suppress(OSError):  # it has ended; reading the answer will report that
            process.send(_json_line({"task": task, "limit": limit}))
        while True:
            answer = self._line(process, end=end, most=most, stop=stop)
            if answer is None:
                raise self._ended(process, f"stopped after {limit:g} s", "time")
            if "stage" in answer:
                progress(answer["stage"])
                continue
            self._done += 1
            if self._done >= _TASKS_EACH:
                self.close()
            if "failed" in answer:
                raise Failed(answer["failed"])
            return answer["done"]

    @property
    def runs(self) -> bool:
        """Whether the process is running and ready for the next task."""
        return self._process is not None and self._process.runs

    def launch(self) -> None:
        """Start another process, but do not wait until it is ready.

        Raises
        ------
        OSError : the computer cannot start a process.
        """
        self.close()
        self._process, self._is_ready, self._done = LineProcess(self._module), False, 0
        with suppress(OSError):  # it has ended; reading its answer will report that
            self._process.send(self._first)

    def start(self, stop: threading.Event) -> None:
        """Start the process before a task needs it; `stop` as for `do`.

        Raises
        ------
        Ended, OSError : as for `do`.
        """
        self._ready(stop)

    def close(self) -> None:
        """End the process; the next task will start another one."""
        process, self._process = self._process, None
        if process is not None:
            process.close()

    def _ready(self, stop: threading.Event) -> "LineProcess":
        stderr_end = why = ""
        for _ in range(_STARTS):
            if self._process is None or not self._process.runs:
                self.launch()
            process = self._process
            assert process is not None
            if self._is_ready:
                return process
            try:
                end = time.monotonic() + _START_LIMIT
                if self._line(process, end=end, most=float("inf"), stop=stop) is not None:
                    self._is_ready = True
                    return process
                why, stderr_end = (
                    f"the process did not start in {_START_LIMIT:g} s",
                    process.stderr_end(),
                )
            except Ended as error:
                if error.how == "stopped":
                    raise
                why, stderr_end = str(error), error.stderr_end
            self.close()
        raise Ended(why, how="start", stderr_end=stderr_end)

    def _line(
        self, process: "LineProcess", *, end: float, most: float, stop: threading.Event
    ) -> dict[str, Any] | None:
        """Return the next message of the process; None if it sends none before `end`."""
        while True:
            if stop.is_set():
                raise self._ended(process, "stopped", "stopped")
            if time.monotonic() > end:
                return None
            if process.memory > most:
                raise self._ended(process, "needed more memory than allowed", "memory")
            try:
                line = process.line(timeout=_GLANCE)
            except queue.Empty:
                continue
            if not line:
                raise self._ended(process, process.exit_message(), "crash", process.ending())
            return json.loads(line)

    def _ended(
        self,
        process: "LineProcess",
        why: str,
        how: Literal["stopped", "time", "memory", "crash"],
        status: str = "",
    ) -> Ended:
        stderr_end = process.stderr_end()
        self.close()
        return Ended(why, how=how, status=status, stderr_end=stderr_end)


class LineProcess:
    """A worker process that exchanges lines with this one.

    It is a plain subprocess, because a daemonic process, such as a Dask worker, may not start
    children with `multiprocessing`.
    """

    def __init__(self, module: str) -> None:
        self._stderr: IO[bytes] = tempfile.TemporaryFile()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                env={**with_one_thread(), **_SPARING},
            )
        except OSError:
            self._stderr.close()
            raise
        self._lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=self._listen, daemon=True).start()

    def send(self, line: bytes) -> None:
        """Send a line to the process.

        Raises
        ------
        OSError : the process has ended.
        """
        assert self._process.stdin is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()

    def line(self, *, timeout: float) -> bytes:
        """Return the next line that the process wrote; b"" if the process has ended.

        Raises
        ------
        queue.Empty : no line came within `timeout` (s).
        """
        return self._lines.get(timeout=timeout)

    @property
    def runs(self) -> bool:
        """Whether the process is still running."""
        return self._process.poll() is None

    @property
    def memory(self) -> int:
        """Bytes of memory that the process uses, 0 if it has ended."""
        try:
            return psutil.Process(self._process.pid).memory_info().rss
        except psutil.Error:
            return 0

    def ending(self) -> str:
        """Wait for the end of the process and return its exit status or signal in words."""
        code = self._process.wait()
        return f"signal {-code}" if code < 0 else f"exit status {code}"

    def stderr_end(self) -> str:
        """Return the end of what the process wrote to stderr; "" after `close`."""
        if self._stderr.closed:
            return ""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")[-4_000:]

    def exit_message(self) -> str:
        """Return how the process ended and the last line that it wrote to stderr."""
        words = self.stderr_end().strip().rpartition("\n")[2][-_LAST_WORDS:]
        return f"the process ended ({self.ending()}) {words}".rstrip()

    def close(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._stderr):
            with suppress(OSError):  # nobody needs the unsent data any more
                if pipe is not None:
                    pipe.close()

    def _listen(self) -> None:
        """Put every line of the process into the queue, then b"" at the end."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._lines.put(line)
        self._lines.put(b"")


def serve(prepare: Callable[..., Callable[[Any, Progress], Any]]) -> None:
    """Do the tasks that a `Supervisor` sends to this process; exit at once when the parent is gone.

    Parameters
    ----------
    prepare : called with the settings as keyword arguments. It returns a function that takes a task
        and a function to report its stages, and does the task.
    """
    collect_seldom()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the parent, which ends this
    say = reserve_stdout()
    faulthandler.enable()
    sent: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sent,), daemon=True).start()
    first = json.loads(sent.get())
    do = prepare(**first["setup"])
    with limited_memory(first["memory"]):
        say(ready=True)
        while True:
            asked = json.loads(sent.get())
            faulthandler.dump_traceback_later(asked["limit"] + _GRACE, exit=True)
            task = asked["task"]
            try:
                say(done=attempt(lambda task=task: do(task, lambda stage: say(stage=stage))))
            except Failed as error:
                say(failed=str(error))
            faulthandler.cancel_dump_traceback_later()


def attempt(work: Callable[[], Any]) -> Any:
    """Do a task and turn any error into `Failed`, so that the process keeps running.

    Raises
    ------
    Failed : the task raised an error; the text gives the reason.
    """
    try:
        return work()
    except PipelineError as error:
        raise Failed(str(error)) from error
    except MemoryError:
        raise Failed("needs more memory than allowed") from None
    except OSError as error:
        message = f"{error.filename or ''}: {error.strerror or error}".lstrip(": ")
        raise Failed(message) from error
    except Exception as error:
        traceback.print_exc()
        what = f"{type(error).__name__}: {error}"[:_LAST_WORDS]
        raise Failed(f"cartlab itself failed ({what}); please report it") from error


def reserve_stdout() -> Callable[..., None]:
    """Reserve stdout for answers and return the function that writes one as a line of JSON.

    Anything that libraries print goes to stderr.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def say(**line: Any) -> None:
        answers.write(_json_line(line))
        answers.flush()

    return say


def lines_sent() -> Iterator[bytes]:
    """Yield the lines that the parent sends to a worker process, until the parent is gone.

    This function does not use `sys.stdin`: Python aborts if it exits while a thread waits for
    `sys.stdin`.
    """
    rest = b""
    while lump := os.read(0, _LUMP):
        *lines, rest = (rest + lump).split(b"\n")
        yield from lines


@contextmanager
def limited_memory(more: int) -> Iterator[bool]:
    """Limit the growth of this process's address space to `more` bytes, on Linux only.

    A lower limit that is set already remains. Yields whether the new limit holds.
    """
    if sys.platform != "linux":
        yield False
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + more
    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    lower = before == resource.RLIM_INFINITY or limit < before
    if lower:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield lower
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))


def _listen(sent: "queue.SimpleQueue[bytes]") -> None:
    for line in lines_sent():
        sent.put(line)
    os._exit(0)  # this may interrupt a write, but files are written whole or not at all


def _json_line(value: Any) -> bytes:
    return json.dumps(value).encode() + b"\n"
