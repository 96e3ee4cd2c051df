"""The parent's side of a worker: hand it a task, and stop it where it passes a limit."""

import queue
import time

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
from pipeline.processes import LineProcess

_GLANCE = 0.05  # s between looks at the clock and the memory
_START_LIMIT = 120.0  # s; a cold start on a busy machine takes ten
_STARTS = 3  # whoever frees memory may end a process that has just begun
_TASKS_EACH = 500  # then a fresh process: what libraries keep does not pile up


class Worker:
    """A worker process, started when needed and replaced after a fault."""

    def __init__(self, setup: Setup, *, out_of: float) -> None:
        self._setup = setup
        self._out_of = out_of
        self._process: LineProcess | None = None
        self._done = 0

    def run(self, task: Task) -> Grading:
        """Return the outcome of a task: a crash or a limit passed is one, too.

        Raises
        ------
        ConfigError : no worker starts on this machine.
        """
        process = self._ready()
        used_before = process.memory
        try:
            process.send(task_line(task))
        except OSError:
            return self._fault(task, "the grader crashed before it began")
        end = time.monotonic() + self._setup.time_limit
        while True:
            try:
                line = process.line(timeout=_GLANCE)
            except queue.Empty:
                if time.monotonic() > end:
                    return self._fault(task, f"stopped after {self._setup.time_limit:g} s")
                if process.memory - used_before > self._setup.memory_limit:
                    return self._fault(task, self._too_large())
                continue
            if not line:
                return self._fault(task, f"the grader crashed ({process.ending()})")
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
        if process is not None:
            process.close()

    def _too_large(self) -> str:
        return f"needed more than {self._setup.memory_limit / 1e9:g} GB of memory"

    def _fault(self, task: Task, reason: str) -> Grading:
        detail = self._process.said() if self._process else ""
        self.close()
        return failed(task, reason, out_of=self._out_of, settled=False, detail=detail)

    def _ready(self) -> LineProcess:
        if self._process is not None and self._process.runs:
            return self._process
        said = ""
        for _ in range(_STARTS):
            self.close()
            self._process, self._done = LineProcess("pipeline.grading.batch.worker"), 0
            try:
                self._process.send(task_line(self._setup))
                if self._process.line(timeout=_START_LIMIT) == b"ready\n":
                    return self._process
            except (OSError, queue.Empty):
                pass  # it ended, or hangs: another is tried
            said = self._process.said()
        self.close()
        last = said.strip().splitlines() or ["nothing was said"]
        raise ConfigError(f"the grading processes do not start: {last[-1]}")
