"""Grade a batch: find what is new, hand it to workers, compare recordings across all of it."""

import hashlib
import json
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import pipeline
from pipeline.grading.batch.so_far import class_so_far
from pipeline.grading.batch.worker import Setup, Task, failed
from pipeline.grading.batch.worker_process import Worker
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Batch, Grading, Member
from pipeline.grading.intake.files import digest
from pipeline.grading.intake.hand_ins import HandIn
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.shared import find_shared, same_recordings, same_team, shared_flag
from pipeline.grading.words import WORDS
from pipeline.schemas.grade import Flag

TIME_LIMIT = 120.0  # s for each hand-in
MEMORY_LIMIT = 1_000_000_000  # bytes
_COMPUTE_WITH = ("numpy", "scipy")

Progress = Callable[[int, int, str], None]
Executor = Callable[[Sequence[Task], Setup, float], Iterator[Grading]]


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
    book: Gradebook,
    scratch: Path,
    execute: Executor,
    limits: Limits | None = None,
    figures: bool = False,
    examples: Callable[[], Iterable[bytes]] = tuple,
    progress: Progress = _silent,
) -> Batch:
    """Grade what the gradebook does not know yet; every outcome is in it as soon as it is had.

    The class is all that the gradebook lists: what is not among `hand_ins` stays as it was, and is
    compared with them as before.

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
    code, text = code_version(), rubric.model_dump_json()
    rows: dict[str, Member] = {}
    unsettled, no_room = set[str](), set[str]()
    new = []
    for hand_in in hand_ins:
        task = _task(hand_in, basis=(code, text, figures))
        outcome = book.known(task.key, figures=False)
        if outcome is None and hand_in.problem:
            outcome = failed(task, hand_in.problem, out_of=rubric.out_of)
            book.put(outcome)
        if outcome is None or not outcome.settled:
            new.append(task)
        else:
            rows[task.id] = Member.of(outcome)
    total = len(hand_ins)
    progress(len(rows), total, "")
    if new:
        setup = Setup(
            rubric=text,
            time_limit=limits.time,
            memory_limit=limits.memory,
            scratch=str(scratch.resolve()),
            figures=figures,
        )
        for outcome in execute(new, setup, rubric.out_of):
            book.put(outcome)
            rows[outcome.submission] = Member.of(outcome)
            if outcome.status == "failed" and not outcome.settled:
                unsettled.add(outcome.submission)
            if outcome.lacks_room:
                no_room.add(outcome.submission)
            progress(len(rows), total, outcome.submission)
    progress(total, total, "comparing the recordings")
    before = class_so_far(rows, book)
    rows |= before.kept
    in_order = [rows[name] for name in sorted(rows)]
    return Batch(
        keys=tuple(row.key for row in in_order),
        shared=_shared(in_order, book, examples=examples),
        failed=tuple((row.submission, row.reason) for row in in_order if row.reason),
        unsettled=frozenset(unsettled),
        lacks_room=frozenset(no_room),
        kept=tuple(before.kept),
        moved=before.moved,
        taken_over=before.taken_over,
    )


def run_here(*, jobs: int) -> Executor:
    """Return what runs tasks in so many worker processes on this machine."""

    def execute(tasks: Sequence[Task], setup: Setup, out_of: float) -> Iterator[Grading]:
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)
        # At most one outcome a worker waits to be stored: memory stays flat.
        answers: queue.Queue[Grading | Exception] = queue.Queue(maxsize=jobs)
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
    answers: "queue.Queue[Grading | Exception]",
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
    """Return what changes whenever a grade may: a hash of code, words and what it computes with."""
    root = Path(pipeline.__file__).parent
    versions = [pipeline.__version__, *(f"{name} {version(name)}" for name in _COMPUTE_WITH)]
    total = hashlib.sha256(" ".join(versions).encode() + WORDS.path.read_bytes())
    for path in sorted(root.rglob("*.py")):
        total.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def _task(hand_in: HandIn, *, basis: tuple[str, str, bool]) -> Task:
    """Return the task of a hand-in; its key covers all that the outcome depends on."""
    files = digest(hand_in.sources)
    plain = asdict(hand_in) | {"sources": files}
    everything = json.dumps([*basis, plain], sort_keys=True)
    whole = hashlib.sha256(everything.encode("utf-8", "surrogateescape")).hexdigest()
    return Task(
        id=hand_in.id,
        key=f"{whole}-{files}",
        sources=tuple(str(source) for source in hand_in.sources),
        digest=files,
        owner=hand_in.owner,
        days_late=hand_in.days_late,
    )


def _shared(
    rows: Sequence[Member], book: Gradebook, *, examples: Callable[[], Iterable[bytes]]
) -> dict[str, Flag]:
    """Return the flags for recordings that stand in two submissions of this or earlier batches."""
    batch = [row for row in rows if row.fingerprints]
    names = {prints.submission: prints for prints in batch}
    here = {(prints.authors, prints.fingerprints) for prints in batch}  # under another name, too
    earlier = [
        prints
        for prints in book.prints()
        if prints.fingerprints
        and (prints.authors, prints.fingerprints) not in here
        and not _is_before(prints, names.get(prints.submission))
    ]
    found = find_shared(batch, earlier=earlier)
    if found and (handed_out := tuple(examples())):
        found = find_shared(batch, earlier=earlier, examples=handed_out)
    return {submission: shared_flag(records) for submission, records in found.items()}


def _is_before(earlier: Member, now: Member | None) -> bool:
    """Tell what a team handed in before, or this very batch graded otherwise: that is no news.

    Where only the ids of its authors were mended, the recordings tell.
    """
    if now is None:
        return False
    return same_team(earlier, now) or (earlier.of_class and same_recordings(earlier, now))
