"""Work in processes of its own: told by stages, to be stopped, still there after a reload."""

import json
import os
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import PipelineError
from pipeline.processes import LineProcess

MEMORY = 4_000_000_000  # bytes of a process
_WORKER = "pipeline.desk.worker"
_GLANCE = 0.1  # s between looks at the clock, the memory and who wants it stopped
_LONGEST = 1800.0  # s of a job
_SHORT = 180.0  # s of a short task, the start of its process on a busy machine included

State = Literal["waiting", "running", "done", "failed", "stopped"]


class Failed(PipelineError):
    """A task came to nothing; the text says why."""


@dataclass(kw_only=True, eq=False)
class Job:
    """A piece of long work.

    Attributes
    ----------
    place : the folder that it works in.
    said : what it is about now, or what became of it.
    news : goes up whenever that changes.
    """

    id: str
    title: str
    place: Path
    state: State = "waiting"
    said: str = "waiting for its turn"
    news: int = 0
    began: float = field(default_factory=time.monotonic)
    stop: threading.Event = field(default_factory=threading.Event)

    @property
    def over(self) -> bool:
        """Whether nothing more happens."""
        return self.state in ("done", "failed", "stopped")

    def tell(self, state: State, said: str) -> None:
        """Note what it is about."""
        self.state, self.said, self.news = state, said, self.news + 1


class Jobs:
    """The long work of this desk: as many at once as there are processors, one in a folder."""

    def __init__(self) -> None:
        self._jobs: dict[Path, Job] = {}
        self._lock = threading.Lock()
        self._turns = threading.Semaphore(os.cpu_count() or 1)
        self._number = 0

    def start(self, task: str, *, title: str, place: Path, **given: Any) -> Job:
        """Begin a task; where work in its folder is under way, that is what is returned."""
        with self._lock:
            before = self._jobs.get(place)
            if before and not before.over:
                return before
            self._number += 1
            job = self._jobs[place] = Job(id=str(self._number), title=title, place=place)
        threading.Thread(target=self._run, args=(job, task, given), daemon=True).start()
        return job

    def of(self, place: Path) -> Job | None:
        """Return the last job in a folder."""
        return self._jobs.get(place)

    def close(self) -> None:
        """Stop all, and wait until their processes have ended."""
        for job in list(self._jobs.values()):
            job.stop.set()
        while any(not job.over for job in self._jobs.values()):
            time.sleep(_GLANCE)

    def _run(self, job: Job, task: str, given: dict[str, Any]) -> None:
        while not self._turns.acquire(timeout=_GLANCE):
            if job.stop.is_set():
                return job.tell("stopped", "stopped before it began")
        job.tell("running", "starting")
        process = LineProcess(_WORKER)
        try:
            _work(
                process,
                task,
                given,
                limit=_LONGEST,
                stop=job.stop,
                tell=lambda stage: job.tell("running", stage),
            )
            job.tell("done", "done")
        except Failed as error:
            job.tell("stopped" if job.stop.is_set() else "failed", str(error))
        finally:
            process.close()
            self._turns.release()


class Hand:
    """A process for short tasks, one after the other: it looks at files and fills in tables."""

    def __init__(self) -> None:
        self._lock, self._never = threading.Lock(), threading.Event()
        self._process: LineProcess | None = None

    def do(self, task: str, **given: Any) -> Any:
        """Return the answer of a task.

        Raises
        ------
        Failed : with the reason; what a file does to the process, the next task does not feel.
        """
        with self._lock:
            process = self._process
            if process is None or not process.runs:
                process = self._process = LineProcess(_WORKER)
            return _work(process, task, given, limit=_SHORT, stop=self._never, tell=str)

    def close(self) -> None:
        """End the process."""
        with self._lock:
            if self._process is not None:
                self._process.close()


def _work(
    process: LineProcess,
    task: str,
    given: dict[str, Any],
    *,
    limit: float,
    stop: threading.Event,
    tell: Callable[[str], object],
) -> Any:
    """Have a process do a task; one that passes a limit, or is to stop, is ended."""
    end = time.monotonic() + limit
    try:
        process.send(json.dumps([task, given]).encode() + b"\n")
        while True:
            try:
                line = process.line(timeout=_GLANCE)
            except queue.Empty:
                if stop.is_set():
                    raise _ended(process, "stopped") from None
                if time.monotonic() > end:
                    raise _ended(process, f"stopped after {limit:g} s") from None
                if process.memory > MEMORY:
                    raise _ended(process, "needed more memory than allowed") from None
                continue
            if not line:
                raise _ended(process, f"the process ended ({process.ending()})")
            answer = json.loads(line)
            if "stage" in answer:
                tell(answer["stage"])
            elif "failed" in answer:
                raise Failed(answer["failed"])
            else:
                return answer["done"]
    except OSError as error:
        raise _ended(process, f"the process ended ({error.strerror})") from None


def _ended(process: LineProcess, why: str) -> Failed:
    process.close()
    return Failed(why)
