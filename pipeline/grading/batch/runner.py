"""Grade a batch: find new submissions, send them to workers, compare all recordings."""

import hashlib
import json
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import pipeline
from pipeline.errors import ConfigError
from pipeline.grading.grade import Flag, read_grade
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import (
    OUT_OF_MEMORY,
    Batch,
    Example,
    Grading,
    HandIn,
    Setup,
    failed,
    read_grading,
)
from pipeline.grading.intake.files import digest
from pipeline.grading.intake.repairs import FOLDER, Repair, keep_original, read_repairs
from pipeline.grading.platforms import Account, same_number
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.copies import find_copies, same_recordings, same_team
from pipeline.grading.similarity.shared_flag import shared_flag
from pipeline.grading.similarity.tables import Key, TypedNumber, find_shared_tables, typed_numbers
from pipeline.processes import Ended, Failed, Supervisor
from pipeline.resources import TEMPLATES

Progress = Callable[[int, int, str], None]
Executor = Callable[[Sequence[HandIn], Setup], Iterator[Grading]]

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
    execute : function that grades the hand-ins: `run_here(jobs=…)` or `cluster.run_on(address)`.
    examples : function that returns the examples handed out with the assignment; it is called only
        if submissions share something.
    progress : function that is called with the number of submissions done, the total, and the last
        submission or step.
    """
    rows, new = _known_and_new(hand_ins, setup=setup, book=book)
    unsettled, no_room, total = 0, 0, len(hand_ins)
    progress(len(rows), total, "")
    for outcome in execute(new, setup) if new else ():
        book.put(outcome)
        rows[outcome.submission] = outcome.without_texts()
        if setup.out and (outcome.original or (setup.out / FOLDER).is_dir()):
            keep_original(setup.out, outcome.submission, outcome.original)
        unsettled += outcome.status == "failed" and not outcome.settled
        no_room += outcome.is_disk_full
        progress(len(rows), total, outcome.submission)
    progress(total, total, "comparing the recordings")
    before = find_class_changes(rows, book)
    rows |= before.kept
    in_order = [rows[name] for name in sorted(rows)]
    return Batch(
        keys=tuple(row.key for row in in_order),
        shared=_shared(in_order, book, rubric=setup.rubric, examples=examples),
        failed=tuple((row.submission, row.reason) for row in in_order if row.reason),
        unsettled=unsettled,
        disk_full=no_room,
        kept=tuple(before.kept),
        moved=before.moved,
        taken_over=before.taken_over,
    )


def _known_and_new(
    hand_ins: Sequence[HandIn], *, setup: Setup, book: Gradebook
) -> tuple[dict[str, Grading], list[HandIn]]:
    """Return the known outcomes by submission, and the hand-ins that must be graded.

    A hand-in that cannot be opened is stored as failed and counts as known.
    """
    basis = code_version(), setup.rubric.model_dump_json(), setup.figures
    rows, new = {}, []
    for submitted in hand_ins:
        repairs = read_repairs(setup.out, submitted.id) if setup.out else {}
        hand_in = _with_key(submitted, basis=basis, repairs=repairs)
        outcome = book.known(hand_in.key, figures=False)
        if outcome is None and hand_in.problem:
            outcome = failed(hand_in, hand_in.problem, out_of=setup.rubric.out_of)
            book.put(outcome)
        if outcome is None or not outcome.settled:
            new.append(hand_in)
        else:
            rows[hand_in.id] = outcome.without_texts()
    return rows, new


def run_here(*, jobs: int) -> Executor:
    """Return a function that grades hand-ins in `jobs` worker processes on this machine."""

    def execute(hand_ins: Sequence[HandIn], setup: Setup) -> Iterator[Grading]:
        waiting: queue.SimpleQueue[HandIn] = queue.SimpleQueue()
        for hand_in in hand_ins:
            waiting.put(hand_in)
        # With a short queue, workers wait until outcomes are stored, and memory use stays flat.
        answers: queue.Queue[Grading | Exception] = queue.Queue(maxsize=jobs)
        stop = threading.Event()
        graders = [Grader(setup) for _ in range(min(jobs, len(hand_ins)))]
        threads = [
            threading.Thread(target=_work, args=(grader, waiting, answers, stop), daemon=True)
            for grader in graders
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in hand_ins:
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

    def run(self, hand_in: HandIn, *, stop: threading.Event | None = None) -> Grading:
        """Grade a hand-in and return its outcome.

        Raises
        ------
        ConfigError : no grading process can be started on this machine.
        """
        too_large = f"needed more than {self._setup.memory_limit / 1e9:g} GB of memory"
        try:
            plain = self._process.do(
                ("grade", hand_in.plain()), limit=self._setup.time_limit, stop=stop
            )
        except Ended as end:
            if end.how == "start":
                last = end.stderr_end.strip().splitlines() or ["they gave no reason"]
                raise ConfigError(f"the grading processes do not start: {last[-1]}") from None
            reasons = {"memory": too_large, "crash": f"the grader crashed ({end.status})"}
            return self._failed(
                hand_in,
                reasons.get(end.how, str(end)),
                authors=() if end.how == "stopped" else self._authors(hand_in, stop),
                detail=end.stderr_end,
            )
        except Failed as error:
            self.close()  # after a failure, a new process is safer
            return self._failed(hand_in, str(error), authors=self._authors(hand_in, stop))
        outcome = read_grading(plain)
        if not outcome.settled:
            self.close()
        if outcome.reason == OUT_OF_MEMORY:
            return self._failed(hand_in, too_large, authors=outcome.authors)
        return outcome

    def close(self) -> None:
        """End the process; the next hand-in starts a new one."""
        self._process.close()

    def _authors(self, hand_in: HandIn, stop: threading.Event | None) -> Sequence[str]:
        """Return the authors of a submission whose grading was stopped; () if it hides them."""
        try:
            plain = self._process.do(("authors", hand_in.plain()), limit=_AUTHORS_LIMIT, stop=stop)
        except Failed:
            return ()
        return tuple(plain)

    def _failed(
        self, hand_in: HandIn, reason: str, *, authors: Sequence[str] = (), detail: str = ""
    ) -> Grading:
        return failed(
            hand_in,
            reason,
            authors=authors,
            out_of=self._setup.rubric.out_of,
            settled=False,
            detail=detail,
        )


def _work(
    grader: Grader,
    waiting: "queue.SimpleQueue[HandIn]",
    answers: "queue.Queue[Grading | Exception]",
    stop: threading.Event,
) -> None:
    while not stop.is_set():
        try:
            hand_in = waiting.get_nowait()
        except queue.Empty:
            return grader.close()
        try:
            answers.put(grader.run(hand_in, stop=stop))
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


def _with_key(
    hand_in: HandIn, *, basis: tuple[str, str, bool], repairs: Mapping[str, Repair]
) -> HandIn:
    """Return a hand-in with its repairs, and with the hash of all that affects the outcome."""
    files = digest(hand_in.sources)
    repaired = {key: asdict(repair) for key, repair in repairs.items()}
    ready = replace(hand_in, digest=files, repairs=repaired)
    everything = json.dumps([*basis, asdict(ready) | {"sources": files}], sort_keys=True)
    whole = hashlib.sha256(everything.encode("utf-8", "surrogateescape")).hexdigest()
    return replace(ready, key=f"{whole}-{files}")


def _shared(
    rows: Sequence[Grading],
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


def _typed_numbers(row: Grading, book: Gradebook, *, rubric: Rubric) -> dict[Key, TypedNumber]:
    known = book.known(row.key, figures=False)
    return typed_numbers(read_grade(known.grade), rubric=rubric) if known else {}


def _is_earlier_version(earlier: Grading, now: Grading | None) -> bool:
    """Return whether `earlier` is an earlier version of the submission `now`.

    This is true if both are from the same team. Within one assignment, equal recordings are enough,
    because authors may have corrected their ids. An earlier version is not a copy.
    """
    if now is None:
        return False
    return same_team(earlier, now) or (earlier.of_class and same_recordings(earlier, now))


@dataclass(frozen=True, kw_only=True)
class ClassChanges:
    """Changes to the current class list.

    Attributes
    ----------
    kept : submissions on the class list that are not in this run, by name.
    moved : new name of each renamed submission, by old name.
    taken_over : for each name that now belongs to other people: the name, the authors before, and
        the authors now. Points given by hand do not pass to the new authors.
    """

    kept: Mapping[str, Grading]
    moved: Mapping[str, str]
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]


def find_class_changes(rows: Mapping[str, Grading], book: Gradebook) -> ClassChanges:
    """Return how a run changes the current class list; `rows` are the run's submissions by name."""
    now = {name.casefold(): name for name in rows}
    left: dict[str, Grading] = {}
    new, moved = dict(rows), {}
    lines = list(book.listed())
    for line in lines:
        name = now.get(line.submission.casefold())
        if name is None or _is_other_team(line, rows[name]):
            left[line.submission] = line
        else:
            del new[name]
            if name != line.submission:  # the names differ only in upper and lower case
                moved[line.submission] = name
    before = {
        one.submission: one for one in book.fingerprints([one.grading for one in left.values()])
    }
    moved |= _match_renamed(before, new)
    return ClassChanges(
        kept={n: r for n, r in before.items() if n not in moved and n.casefold() not in now},
        moved=moved,
        taken_over=tuple(
            (line.submission, line.authors, rows[name].authors)
            for line in lines
            if (name := moved.get(line.submission) or now.get(line.submission.casefold()))
            and _has_only_new_authors(line, rows[name])
        ),
    )


def _is_other_team(before: Grading, now: Grading) -> bool:
    """Return whether a submission now has another team; False if authors are unknown."""
    return _has_only_new_authors(before, now) and not same_number(before.owner, now.owner)


def _has_only_new_authors(before: Grading, now: Grading) -> bool:
    return bool(before.people and now.people) and before.people.isdisjoint(now.people)


def _match_renamed(before: Mapping[str, Grading], now: Mapping[str, Grading]) -> dict[str, str]:
    """Return the new name of each renamed submission.

    The pairs with the strongest evidence are matched first.
    """
    pairs = [
        (evidence, old, new)
        for old in before
        for new in now
        if any(evidence := _evidence(before[old], now[new]))
    ]
    moved: dict[str, str] = {}
    for _, old, new in sorted(pairs, key=lambda pair: ([not e for e in pair[0]], *pair[1:])):
        if old not in moved and new not in moved.values():
            moved[old] = new
    return moved


def _evidence(before: Grading, now: Grading) -> tuple[bool, ...]:
    """Return, for each kind of evidence, whether it shows that both submissions are the same.

    The strongest kind comes first. The result is empty if the teams differ.
    """
    if _is_other_team(before, now):
        return ()
    both = before.people & now.people
    names = [f"-{row.submission}" for row in (before, now)]
    # Several teams without author ids may submit the same files, such as those of `cartlab new`. So
    # equal files count only if the submissions have a common author or similar names.
    kin = both or any(a.endswith(b) for a, b in (names, names[::-1]))
    prints = before.fingerprints and now.fingerprints
    was, is_ = (Account.read(row.owner) for row in (before, now))
    return (
        same_number(before.owner, now.owner),
        bool(kin) and before.content == now.content != "",
        bool(both and prints) and same_recordings(before, now),
        # Equal author ids are weak evidence, because anybody can type another person's id. They do
        # not count if the account numbers on the same platform differ.
        bool(both)
        and before.people == now.people
        and (was.platform != is_.platform or was.number == is_.number),
    )
