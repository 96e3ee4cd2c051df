"""Grade a batch: find what is new, hand it to workers, compare recordings across all of it."""

import hashlib
import json
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pipeline
from pipeline.grading.batch import Batch, Outcome, Prints, Store
from pipeline.grading.grade import SCHEMA, Flag
from pipeline.grading.intake import HandIn
from pipeline.grading.intake_files import digest
from pipeline.grading.rubric import Rubric
from pipeline.grading.shared import find_shared, same_team, shared_flag
from pipeline.grading.worker import Setup, Task, failed
from pipeline.grading.worker_process import Worker

TIME_LIMIT = 120.0  # s for each hand-in
MEMORY_LIMIT = 1_000_000_000  # bytes

Progress = Callable[[int, int, str], None]
Executor = Callable[[Sequence[Task], Setup, float], Iterator[Outcome]]


def _silent(done: int, total: int, what: str) -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What one hand-in may take: seconds, and bytes beyond what a worker needs itself."""

    time: float = TIME_LIMIT
    memory: int = MEMORY_LIMIT


def grade_batch(
    hand_ins: Sequence[HandIn],
    *,
    rubric: Rubric,
    store: Store,
    scratch: Path,
    execute: Executor,
    limits: Limits | None = None,
    figures: bool = False,
    examples: Callable[[], Iterable[bytes]] = tuple,
    progress: Progress = _silent,
) -> Batch:
    """Grade what the store does not know yet; every outcome is in the store as soon as it is had.

    Stopped at any moment and started again, it ends as if it had not been.

    Parameters
    ----------
    execute : what runs the tasks: `run_here(jobs=…)` or `cluster.run_on(address)`.
    figures : draw those of the feedback, too.
    examples : packed fingerprints of recordings that were handed out with the task; asked for
        only where recordings are shared.
    progress : called with how many are done, of how many, and what was done last.
    """
    limits = limits or Limits()
    code = code_version()
    text = rubric.model_dump_json()
    tasks, hopeless = [], []
    for hand_in in hand_ins:
        task = _task(hand_in, basis=(code, text, figures))
        (hopeless if hand_in.problem else tasks).append((task, hand_in.problem))
    for task, problem in hopeless:
        if store.known(task.key) is None:
            store.put(failed(task, problem, out_of=rubric.out_of))
    new = [task for task, _ in tasks if not _is_settled(store.known(task.key))]
    total = len(hand_ins)
    done = total - len(new)
    progress(done, total, "")
    if new:
        setup = Setup(
            rubric=text,
            time_limit=limits.time,
            memory_limit=limits.memory,
            scratch=str(scratch.resolve()),
            figures=figures,
        )
        for outcome in execute(new, setup, rubric.out_of):
            store.put(outcome)
            done += 1
            progress(done, total, outcome.submission)
    keys = {task.id: task.key for task, _ in (*tasks, *hopeless)}
    progress(done, total, "comparing the recordings")
    return Batch(
        keys=tuple(keys[name] for name in sorted(keys)),
        shared=_shared([keys[name] for name in sorted(keys)], store, examples=examples),
    )


def run_here(*, jobs: int) -> Executor:
    """Return what runs tasks in so many worker processes on this machine."""

    def execute(tasks: Sequence[Task], setup: Setup, out_of: float) -> Iterator[Outcome]:
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)
        # At most one outcome a worker waits to be stored: memory stays flat.
        answers: queue.Queue[Outcome | Exception] = queue.Queue(maxsize=jobs)
        stop = threading.Event()
        workers = [Worker(setup, out_of=out_of) for _ in range(min(jobs, len(tasks)))]
        threads = [
            threading.Thread(target=_work, args=(worker, waiting, answers, stop), daemon=True)
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in tasks:
                answer = answers.get()
                if isinstance(answer, Exception):
                    raise answer
                yield answer
        finally:
            stop.set()
            for worker in workers:
                worker.close()

    return execute


def _work(
    worker: Worker,
    waiting: "queue.SimpleQueue[Task]",
    answers: "queue.Queue[Outcome | Exception]",
    stop: threading.Event,
) -> None:
    while not stop.is_set():
        try:
            task = waiting.get_nowait()
        except queue.Empty:
            return worker.close()
        try:
            answers.put(worker.run(task))
        except Exception as error:  # said where the outcomes are waited for
            answers.put(error)
            return


def code_version() -> str:
    """Return what changes whenever a grade may: a hash of all of the package's code."""
    root = Path(pipeline.__file__).parent
    total = hashlib.sha256(pipeline.__version__.encode())
    for path in sorted(root.rglob("*.py")):
        total.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def _task(hand_in: HandIn, *, basis: tuple[str, str, bool]) -> Task:
    """Return the task of a hand-in; its key covers all that the outcome depends on."""
    plain = asdict(hand_in) | {"sources": digest(hand_in.sources)}
    everything = json.dumps([SCHEMA, *basis, plain], sort_keys=True)
    return Task(
        id=hand_in.id,
        key=hashlib.sha256(everything.encode("utf-8", "surrogateescape")).hexdigest(),
        sources=tuple(str(source) for source in hand_in.sources),
        owner=hand_in.owner,
        days_late=hand_in.days_late,
    )


def _is_settled(outcome: Outcome | None) -> bool:
    return outcome is not None and outcome.settled


def _shared(
    keys: Sequence[str], store: Store, *, examples: Callable[[], Iterable[bytes]]
) -> dict[str, Flag]:
    """Return the flags for recordings that stand in two submissions of this or earlier batches."""
    batch = [
        Prints(
            submission=outcome.submission,
            authors=outcome.authors,
            fingerprints=outcome.fingerprints,
        )
        for outcome in map(store.known, keys)
        if outcome is not None and outcome.fingerprints
    ]
    names = {prints.submission: prints for prints in batch}
    earlier = [
        prints
        for prints in store.prints()
        if prints.fingerprints
        # What a team handed in before, or this very batch graded otherwise, is not news.
        and not (prints.submission in names and same_team(prints, names[prints.submission]))
    ]
    found = find_shared(batch, earlier=earlier)
    if found and (handed_out := tuple(examples())):
        found = find_shared(batch, earlier=earlier, examples=handed_out)
    return {submission: shared_flag(records) for submission, records in found.items()}
