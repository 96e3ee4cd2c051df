"""The parent's side of a worker: hand it a task, and stop it where it passes a limit."""

import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import IO

import psutil

from pipeline.errors import ConfigError
from pipeline.grading.batch.worker import (
    OUT_OF_MEMORY,
    Setup,
    Task,
    failed,
    read_grading,
    task_line,
)
from pipeline.grading.gradings import Grading

_GLANCE = 0.05  # s between looks at the clock and the memory
_START_LIMIT = 120.0  # s; a cold start on a busy machine takes ten
_STARTS = 3  # whoever frees memory may end a process that has just begun
_STDERR_SHOWN = 4_000  # characters
_TASKS_EACH = 500  # then a fresh process: what libraries keep does not pile up
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


class Worker:
    """A worker process, started when needed and replaced after a fault.

    `python -m pipeline.grading.batch.worker` is a plain subprocess, since a daemonic process such
    as a Dask worker may not have children of `multiprocessing`.
    """

    def __init__(self, setup: Setup, *, out_of: float) -> None:
        self._setup = setup
        self._out_of = out_of
        self._process: subprocess.Popen[bytes] | None = None
        self._answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._stderr: IO[bytes] | None = None
        self._done = 0

    def run(self, task: Task) -> Grading:
        """Return the outcome of a task: a crash or a limit passed is one, too.

        Raises
        ------
        ConfigError : no worker starts on this machine.
        """
        process = self._ready()
        used_before = _memory(process.pid)
        try:
            _send(process, task_line(task))
        except OSError:
            return self._fault(task, "the grader crashed before it began")
        end = time.monotonic() + self._setup.time_limit
        while True:
            try:
                line = self._answers.get(timeout=_GLANCE)
            except queue.Empty:
                if time.monotonic() > end:
                    return self._fault(task, f"stopped after {self._setup.time_limit:g} s")
                if _memory(process.pid) - used_before > self._setup.memory_limit:
                    return self._fault(task, self._too_large())
                continue
            if not line:
                process.wait()
                return self._fault(task, f"the grader crashed ({_ending(process.returncode)})")
            self._done += 1
            outcome = read_grading(line)
            if not outcome.settled or self._done >= _TASKS_EACH:
                self.close()
            if outcome.reason != OUT_OF_MEMORY:
                return outcome
            return failed(
                task, self._too_large(), authors=outcome.authors, out_of=self._out_of, settled=False
            )

    def close(self) -> None:
        """End the process; the next task starts another."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for pipe in (process.stdin, self._stderr):
            if pipe is not None:
                _close(pipe)

    def _too_large(self) -> str:
        return f"needed more than {self._setup.memory_limit / 1e9:g} GB of memory"

    def _fault(self, task: Task, reason: str) -> Grading:
        detail = self._said()
        self.close()
        return failed(task, reason, out_of=self._out_of, settled=False, detail=detail)

    def _ready(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        for _ in range(_STARTS):
            if process := self._started():
                return process
        said = self._said().strip().splitlines() or ["nothing was said"]
        self.close()
        raise ConfigError(f"the grading processes do not start: {said[-1]}")

    def _started(self) -> subprocess.Popen[bytes] | None:
        """Return a fresh process that is ready for tasks; None where it ended before."""
        self.close()
        self._stderr = tempfile.TemporaryFile()
        self._process = process = subprocess.Popen(
            [sys.executable, "-P", "-m", "pipeline.grading.batch.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=_environment(),
        )
        self._answers, self._done = queue.SimpleQueue(), 0
        threading.Thread(target=_listen, args=(process, self._answers), daemon=True).start()
        try:
            _send(process, task_line(self._setup))
            first = self._answers.get(timeout=_START_LIMIT)
        except (OSError, queue.Empty):
            first = b""
        return process if first == b"ready\n" else None

    def _said(self) -> str:
        """Return the end of what the process wrote to stderr."""
        if self._stderr is None:
            return ""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")[-_STDERR_SHOWN:]


def _send(process: subprocess.Popen[bytes], line: bytes) -> None:
    assert process.stdin is not None
    process.stdin.write(line)
    process.stdin.flush()


def _listen(process: subprocess.Popen[bytes], answers: "queue.SimpleQueue[bytes]") -> None:
    """Put every line of a process into a queue, b"" where they end."""
    assert process.stdout is not None
    with process.stdout as lines:
        for line in lines:
            answers.put(line)
    answers.put(b"")


def _close(pipe: IO[bytes]) -> None:
    try:
        pipe.close()
    except OSError:
        pass  # what was not sent yet is not wanted any more


def _environment() -> dict[str, str]:
    """Return the environment of a worker: one thread each, and the same package as here."""
    package = str(Path(__file__).resolve().parents[3])
    before = os.environ.get("PYTHONPATH")
    path = f"{package}{os.pathsep}{before}" if before else package
    return {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "PYTHONPATH": path}


def _memory(pid: int) -> int:
    """Return the bytes a process holds, 0 where it has ended."""
    try:
        return psutil.Process(pid).memory_info().rss
    except psutil.Error:
        return 0


def _ending(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit status {code}"
