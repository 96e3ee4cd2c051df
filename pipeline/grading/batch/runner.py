"""Grade a batch: find new submissions, send them to workers, compare all recordings."""

import hashlib
import json
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import pipeline
from pipeline.errors import ConfigError
from pipeline.grading.batch.class_changes import find_class_changes
from pipeline.grading.batch.task import OUT_OF_MEMORY, Setup, Task, failed, read_grading
from pipeline.grading.grade import Flag, read_grade
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch, Example, Grading, Member
from pipeline.grading.intake.files import digest
from pipeline.grading.intake.find import HandIn
from pipeline.grading.intake.repairs import FOLDER, Repair, keep_original, read_repairs
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.copies import find_copies, same_recordings, same_team
from pipeline.grading.similarity.flag import shared_flag
from pipeline.grading.similarity.tables import Key, TypedNumber, find_shared_tables, typed_numbers
from pipeline.processes import Ended, Failed, Supervisor
from pipeline.resources import TEMPLATES

Progress = Callable[[int, int, str], None]
Executor = Callable[[Sequence[Task], Setup], Iterator[Grading]]

_AUTHORS_LIMIT = 60.0  # s to read the authors of a submission whose grading was stopped


def silent(done: int, total: int, what: str) -> None:
    """Report no progress."""


def grade_batch(
    hand_ins: Sequence[HandIn],
    *,
    setup: Setup,
    book: Gradebook,
    execute: Executor,
    examples: Callable[[], Iterable[Example]] = tuple,
    progress: Progress = silent,
) -> Batch:
    """Grade the submissions that are new to the gradebook, and store each outcome at once.

    The recordings of the whole class are compared. Submissions on the class list that are not in
    `hand_ins` keep their grades and are compared too.

    A run that is interrupted and started again gives the same result.

    Parameters
    ----------
    execute : function that runs the tasks: `run_here(jobs=…)` or `cluster.run_on(address)`.
    examples : function that returns the examples handed out with the assignment; it is called only
        if submissions share something.
    progress : function that is called with the number of submissions done, the total, and the last
        submission or step.
    """
    rows, new = _known_and_new(hand_ins, setup=setup, book=book)
    unsettled, no_room = set[str](), set[str]()
    total = len(hand_ins)
    progress(len(rows), total, "")
    for outcome in execute(new, setup) if new else ():
        book.put(outcome)
        rows[outcome.submission] = outcome.member
        if setup.out and (outcome.original or (setup.out / FOLDER).is_dir()):
            keep_original(setup.out, outcome.submission, outcome.original)
        if outcome.status == "failed" and not outcome.settled:
            unsettled.add(outcome.submission)
        if outcome.is_disk_full:
            no_room.add(outcome.submission)
        progress(len(rows), total, outcome.submission)
    progress(total, total, "comparing the recordings")
    before = find_class_changes(rows, book)
    rows |= before.kept
    in_order = [rows[name] for name in sorted(rows)]
    return Batch(
        keys=tuple(row.key for row in in_order),
        shared=_shared(in_order, book, rubric=setup.rubric, examples=examples),
        failed=tuple((row.submission, row.reason) for row in in_order if row.reason),
        unsettled=frozenset(unsettled),
        disk_full=frozenset(no_room),
        kept=tuple(before.kept),
        moved=before.moved,
        taken_over=before.taken_over,
    )


def _known_and_new(
    hand_ins: Sequence[HandIn], *, setup: Setup, book: Gradebook
) -> tuple[dict[str, Member], list[Task]]:
    """Return the known outcomes by submission, and the tasks that must run.

    A hand-in that cannot be opened is stored as failed and counts as known.
    """
    basis = code_version(), setup.rubric.model_dump_json(), setup.figures
    rows, new = {}, []
    for hand_in in hand_ins:
        repairs = read_repairs(setup.out, hand_in.id) if setup.out else {}
        task = _task(hand_in, basis=basis, repairs=repairs)
        outcome = book.known(task.key, figures=False)
        if outcome is None and hand_in.problem:
            outcome = failed(task, hand_in.problem, out_of=setup.rubric.out_of)
            book.put(outcome)
        if outcome is None or not outcome.settled:
            new.append(task)
        else:
            rows[task.id] = outcome.member
    return rows, new


def run_here(*, jobs: int) -> Executor:
    """Return a function that runs tasks in `jobs` worker processes on this machine."""

    def execute(tasks: Sequence[Task], setup: Setup) -> Iterator[Grading]:
        waiting: queue.SimpleQueue[Task] = queue.SimpleQueue()
        for task in tasks:
            waiting.put(task)
        # With a short queue, workers wait until outcomes are stored, and memory use stays flat.
        answers: queue.Queue[Grading | Exception] = queue.Queue(maxsize=jobs)
        stop = threading.Event()
        graders = [Grader(setup) for _ in range(min(jobs, len(tasks)))]
        threads = [
            threading.Thread(target=_work, args=(grader, waiting, answers, stop), daemon=True)
            for grader in graders
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
            for grader in graders:
                grader.close()

    return execute


class Grader:
    """A grading process; a submission that crashes it or exceeds a limit gets a failed outcome."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        given = {
            "rubric": setup.rubric.model_dump_json(),
            "scratch": str(setup.scratch.resolve()),
            "figures": setup.figures,
        }
        module = "pipeline.grading.batch.worker"
        self._process = Supervisor(module, memory=setup.memory_limit, setup=given)

    def run(self, task: Task, *, stop: threading.Event | None = None) -> Grading:
        """Run a task and return its outcome.

        Raises
        ------
        ConfigError : no grading process can be started on this machine.
        """
        too_large = f"needed more than {self._setup.memory_limit / 1e9:g} GB of memory"
        try:
            plain = self._process.do(
                ("grade", asdict(task)), limit=self._setup.time_limit, stop=stop
            )
        except Ended as end:
            if end.how == "start":
                last = end.stderr_end.strip().splitlines() or ["they gave no reason"]
                raise ConfigError(f"the grading processes do not start: {last[-1]}") from None
            reasons = {"memory": too_large, "crash": f"the grader crashed ({end.status})"}
            return self._failed(
                task,
                reasons.get(end.how, str(end)),
                authors=() if end.how == "stopped" else self._authors(task, stop),
                detail=end.stderr_end,
            )
        except Failed as error:
            self.close()  # after a failure, a new process is safer
            return self._failed(task, str(error), authors=self._authors(task, stop))
        outcome = read_grading(plain)
        if not outcome.settled:
            self.close()
        if outcome.reason == OUT_OF_MEMORY:
            return self._failed(task, too_large, authors=outcome.authors)
        return outcome

    def close(self) -> None:
        """End the process; the next task starts a new one."""
        self._process.close()

    def _authors(self, task: Task, stop: threading.Event | None) -> Sequence[str]:
        """Return the authors of a submission whose grading was stopped; () if it hides them."""
        try:
            plain = self._process.do(("authors", asdict(task)), limit=_AUTHORS_LIMIT, stop=stop)
        except Failed:
            return ()
        return tuple(plain)

    def _failed(
        self, task: Task, reason: str, *, authors: Sequence[str] = (), detail: str = ""
    ) -> Grading:
        return failed(
            task,
            reason,
            authors=authors,
            out_of=self._setup.rubric.out_of,
            settled=False,
            detail=detail,
        )


def _work(
    grader: Grader,
    waiting: "queue.SimpleQueue[Task]",
    answers: "queue.Queue[Grading | Exception]",
    stop: threading.Event,
) -> None:
    while not stop.is_set():
        try:
            task = waiting.get_nowait()
        except queue.Empty:
            return grader.close()
        try:
            answers.put(grader.run(task, stop=stop))
        except Exception as error:  # raised again in the thread that collects the outcomes
            answers.put(error)
            return


def code_version() -> str:
    """Return a hash of cartlab's code and texts and of library versions.

    The hash changes whenever a grade might change.
    """
    root = Path(pipeline.__file__).parent
    computes_with = (f"{name} {version(name)}" for name in ("numpy", "scipy", "h5py"))
    versions = [pipeline.__version__, *computes_with]
    total = hashlib.sha256(" ".join(versions).encode())
    for path in (*sorted(root.rglob("*.py")), *sorted((TEMPLATES / "words").glob("*.toml"))):
        total.update(path.name.encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def _task(hand_in: HandIn, *, basis: tuple[str, str, bool], repairs: Mapping[str, Repair]) -> Task:
    """Return the task that grades a hand-in.

    The task's key is a hash of everything that affects the outcome.
    """
    files = digest(hand_in.sources)
    plain = asdict(hand_in) | {"sources": files}
    repaired = {key: asdict(repair) for key, repair in repairs.items()}
    plain |= {"repairs": repaired} if repaired else {}
    everything = json.dumps([*basis, plain], sort_keys=True)
    whole = hashlib.sha256(everything.encode("utf-8", "surrogateescape")).hexdigest()
    return Task(
        id=hand_in.id,
        key=f"{whole}-{files}",
        sources=tuple(str(source) for source in hand_in.sources),
        digest=files,
        owner=hand_in.owner,
        days_late=hand_in.days_late,
        repairs=repaired,
    )


def _shared(
    rows: Sequence[Member],
    book: Gradebook,
    *,
    rubric: Rubric,
    examples: Callable[[], Iterable[Example]],
) -> dict[str, Flag]:
    """Return a flag for each submission that shares recordings or tables with another one.

    The other submission may be in an earlier batch if it shares recordings.
    """
    batch = [row for row in rows if row.fingerprints]
    names = {prints.submission: prints for prints in batch}
    # Earlier submissions of the same recordings by the same authors are left out, because a team
    # may rename its submission.
    here = {(prints.authors, prints.fingerprints) for prints in batch}
    earlier = [
        prints
        for prints in book.fingerprints()
        if prints.fingerprints
        and (prints.authors, prints.fingerprints) not in here
        and not _is_earlier_version(prints, names.get(prints.submission))
    ]
    reported = {row.submission: _typed_numbers(row, book, rubric=rubric) for row in rows}
    found = find_copies(batch, earlier=earlier)
    tables = find_shared_tables(rows, reported)
    if (found or tables) and (handed_out := tuple(examples())):
        given = [one.fingerprints for one in handed_out]
        found = find_copies(batch, earlier=earlier, examples=given)
        numbers = frozenset[tuple[str, float]]().union(*(one.numbers for one in handed_out))
        tables = find_shared_tables(rows, reported, given=numbers)
    return {
        name: shared_flag(found.get(name, ()), tables.get(name, ()))
        for name in sorted({*found, *tables})
    }


def _typed_numbers(row: Member, book: Gradebook, *, rubric: Rubric) -> dict[Key, TypedNumber]:
    known = book.known(row.key, figures=False)
    return typed_numbers(read_grade(known.grade), rubric=rubric) if known else {}


def _is_earlier_version(earlier: Member, now: Member | None) -> bool:
    """Return whether `earlier` is an earlier version of the submission `now`.

    This is true if both are from the same team. Within one assignment, equal recordings are enough,
    because authors may have corrected their ids. An earlier version is not a copy.
    """
    if now is None:
        return False
    return same_team(earlier, now) or (earlier.of_class and same_recordings(earlier, now))
