"""Long work in separate processes: it reports stages, can be stopped, and survives a reload."""

import os
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import PipelineError
from pipeline.processes import Failed, Supervisor

_GLANCE = 0.1  # s between two checks whether a job may start or must stop
_SHORT_WORKERS = 3  # number of processes for short tasks; each takes 150 MB
_WAITING = 8  # requests that may wait for one folder; each holds one of the server's 40 threads

State = Literal["waiting", "running", "done", "failed", "stopped"]


class Busy(PipelineError):
    """A task was not started, because the folder is busy; the message says why."""


@dataclass(kw_only=True, eq=False)
class Job:
    """One piece of long work.

    Attributes
    ----------
    task : name and arguments of the task.
    message : the current stage; at the end, the error, or the task's result if it is text.
    version : number that grows with every change of state or stage.
    """

    title: str
    place: Path
    task: tuple[str, dict[str, Any]]
    state: State = "waiting"
    message: str = "waiting for its turn"
    version: int = 0
    stop: threading.Event = field(default_factory=threading.Event)
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def over(self) -> bool:
        """Whether the job has ended."""
        return self.state in ("done", "failed", "stopped")

    def without_message(self) -> "Job":
        """Return a copy that hides the stages, for a person who may not read them."""
        return replace(
            self, title="Work in this folder", message="done" if self.over else "under way"
        )

    def update(self, state: State, message: str) -> None:
        """Set the state and the stage."""
        with self.lock:
            self.state, self.message, self.version = state, message, self.version + 1

    def snapshot(self) -> "Job":
        """Return a copy whose state and stage belong together and no longer change."""
        with self.lock:
            return replace(self)


class Jobs:
    """The desk's long tasks: at most one job per folder and one per processor at a time."""

    def __init__(self) -> None:
        self._jobs: dict[Path, Job] = {}
        self._lock = threading.Lock()
        self._turns = threading.Semaphore(os.cpu_count() or 1)

    def start(self, task: str, *, title: str, place: Path, **arguments: Any) -> Job:
        """Start a task; if the same task is running already, do nothing.

        Raises
        ------
        Busy : another job is running in the folder.
        """
        call = task, arguments
        with self._lock:
            before = self._jobs.get(place)
            if before and not before.over:
                if before.task != call:
                    raise Busy(
                        f"{before.title} is running in this folder: wait until it ends, or stop "
                        "it first"
                    )
                return before
            job = self._jobs[place] = Job(title=title, place=place, task=call)
        threading.Thread(target=self._run, args=(job,), daemon=True).start()
        return job

    def of(self, place: Path) -> Job | None:
        """Return the last job in a folder, as a copy that does not change."""
        job = self._jobs.get(place)
        return job and job.snapshot()

    def list_of(self, task: str) -> list[Job]:
        """Return the jobs of one task, the newest first."""
        with self._lock:
            jobs = [job for job in reversed(self._jobs.values()) if job.task[0] == task]
        return [job.snapshot() for job in jobs]

    def close(self) -> None:
        """Stop all jobs, and wait until their processes have ended."""
        for job in list(self._jobs.values()):
            job.stop.set()
        while any(not job.over for job in self._jobs.values()):
            time.sleep(_GLANCE)

    def _run(self, job: Job) -> None:
        while not self._turns.acquire(timeout=_GLANCE):
            if job.stop.is_set():
                return job.update("stopped", "stopped before it began")
        job.update("running", "starting")
        process = _worker()
        try:
            answer = process.do(
                job.task,
                limit=1800.0,
                stop=job.stop,
                progress=lambda stage: job.update("running", stage),
            )
            job.update("done", answer if isinstance(answer, str) else "done")
        except Failed as error:
            job.update("stopped" if job.stop.is_set() else "failed", str(error))
        except OSError as error:
            job.update("failed", f"its process could not be started ({error.strerror or error})")
        except BaseException as error:  # shown on the waiting page; the log has the traceback
            job.update("failed", f"the desk itself failed ({type(error).__name__}: {error})")
            raise
        finally:
            process.close()
            self._turns.release()


class WorkerPool:
    """Processes for short tasks, which look at files and fill in tables.

    The tasks of one folder run one after the other. So a slow file delays only people who look at
    the same folder.

    A process that ended is replaced at once in the background, because starting one takes a second.
    """

    def __init__(self) -> None:
        self._free: queue.LifoQueue[Supervisor] = queue.LifoQueue()
        self._closed = threading.Event()
        for _ in range(_SHORT_WORKERS):
            self._free.put(_worker())
        self._lock, self._starting = threading.Lock(), threading.Lock()
        self._folders: dict[str, tuple[threading.Semaphore, threading.Lock]] = {}

    def do(self, task: str, **arguments: Any) -> Any:
        """Run a task and return its answer.

        Raises
        ------
        Failed : the task failed; the text says why. The next task is not affected.
        Busy : too many requests already wait for the folder.
        """
        with self._turn(arguments.get("folder")):
            process = self._free.get()
            try:
                if self._closed.is_set():
                    raise Failed("the desk is ending")
                return process.do((task, arguments), limit=180.0, stop=self._closed)
            finally:
                if process.runs or self._closed.is_set():
                    self._free.put(process)
                else:
                    self._replace(process)

    def start(self) -> None:
        """Start all processes in the background, for a desk that many people will use soon.

        They start one after the other, so that the first is ready as early as possible.
        """
        for _ in range(_SHORT_WORKERS):
            self._replace(self._free.get())

    def _replace(self, process: Supervisor) -> None:
        threading.Thread(target=self._start, args=(process,), daemon=True).start()

    def _start(self, process: Supervisor) -> None:
        try:
            # The next task tries again, and reports an error.
            with self._starting, suppress(Failed, OSError):
                process.start(self._closed)
        finally:
            self._free.put(process)

    @contextmanager
    def _turn(self, folder: str | None) -> Iterator[None]:
        if folder is None:
            yield
            return
        with self._lock:
            new = threading.Semaphore(_WAITING), threading.Lock()
            waiting, one = self._folders.setdefault(folder, new)
        if not waiting.acquire(blocking=False):
            raise Busy("a file of this folder is still being read; try again in a minute")
        try:
            with one:
                yield
        finally:
            waiting.release()

    def close(self) -> None:
        """End the processes and their tasks."""
        self._closed.set()
        processes = [self._free.get() for _ in range(_SHORT_WORKERS)]
        for process in processes:
            process.close()
            self._free.put(process)


def _worker() -> Supervisor:
    return Supervisor("pipeline.desk.tasks", memory=4_000_000_000)
