"""Work in processes of its own: told by stages, to be stopped, still there after a reload."""

import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
_HANDS = 3  # processes for short tasks, of 150 MB each
_WAITING = 8  # requests about one folder; each keeps one of the server's 40 threads

State = Literal["waiting", "running", "done", "failed", "stopped"]


class Failed(PipelineError):
    """A task came to nothing; the text says why."""


class Busy(PipelineError):
    """A task was not begun, since others are under way; the text says which."""


@dataclass(kw_only=True, eq=False)
class Job:
    """A piece of long work.

    Attributes
    ----------
    place : the folder that it works in.
    asked : the task, and what it was given.
    said : what it is about now, or what became of it: the task's answer where that is a text.
    news : goes up whenever that changes.
    """

    id: str
    title: str
    place: Path
    asked: tuple[str, dict[str, Any]]
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
        """Begin a task; one that is under way with the same is not begun again.

        Raises
        ------
        Busy : something else is under way in the folder.
        """
        asked = task, given
        with self._lock:
            before = self._jobs.get(place)
            if before and not before.over:
                if before.asked != asked:
                    raise Busy(
                        f"{before.title} is under way in this folder ({before.said}): wait for its "
                        "end or stop it first"
                    )
                return before
            self._number += 1
            id_ = str(self._number)
            job = self._jobs[place] = Job(id=id_, title=title, place=place, asked=asked)
        threading.Thread(target=self._run, args=(job,), daemon=True).start()
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

    def _run(self, job: Job) -> None:
        while not self._turns.acquire(timeout=_GLANCE):
            if job.stop.is_set():
                return job.tell("stopped", "stopped before it began")
        job.tell("running", "starting")
        process = None
        try:
            process = LineProcess(_WORKER)
            answer = _work(
                process,
                *job.asked,
                limit=_LONGEST,
                stop=job.stop,
                tell=lambda stage: job.tell("running", stage),
            )
            job.tell("done", answer if isinstance(answer, str) else "done")
        except Failed as error:
            job.tell("stopped" if job.stop.is_set() else "failed", str(error))
        except OSError as error:
            job.tell("failed", f"no process could be started for it ({error.strerror or error})")
        except BaseException as error:  # who waits for it is told; the log has the rest
            job.tell("failed", f"the desk itself failed ({type(error).__name__}: {error})")
            raise
        finally:
            if process is not None:
                process.close()
            self._turns.release()


class Hand:
    """Processes for short tasks, which look at files and fill in tables.

    The tasks of a folder are done one after the other: who has a slow file waits for it, and with
    them who looks at the same folder.
    """

    def __init__(self) -> None:
        self._free: queue.LifoQueue[LineProcess | None] = queue.LifoQueue()
        for _ in range(_HANDS):
            self._free.put(None)
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._folders: dict[str, tuple[threading.Semaphore, threading.Lock]] = {}

    def do(self, task: str, **given: Any) -> Any:
        """Return the answer of a task.

        Raises
        ------
        Failed : with the reason; what a file does to the process, the next task does not feel.
        Busy : too many wait for the folder already.
        """
        with self._turn(given.get("folder")):
            process = self._free.get()
            try:
                if self._closed.is_set():
                    raise Failed("the desk is ending")
                if process is None or not process.runs:
                    process = LineProcess(_WORKER)
                return _work(process, task, given, limit=_SHORT, stop=self._closed, tell=str)
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
            raise Busy("a file of this folder is still being looked at; try again in a minute")
        try:
            with one:
                yield
        finally:
            waiting.release()

    def close(self) -> None:
        """End the processes, and what they are about."""
        self._closed.set()
        processes = [self._free.get() for _ in range(_HANDS)]
        for process in processes:
            if process is not None:
                process.close()
            self._free.put(None)


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
                raise _ended(process, process.last_words())
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
