"""Run the whole of `cartlab grade`: intake, grading, gradebook and output files."""

import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError, PipelineError
from pipeline.grading.batch.runner import Executor, Progress, grade_batch, run_here, silent
from pipeline.grading.gradebook.database import Lost
from pipeline.grading.gradebook.events import hidden_reason
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch, Example, HandIn, Setup
from pipeline.grading.intake.find import find_hand_ins, read_late_table, settle_lateness
from pipeline.grading.intake.repairs import Run, save_run
from pipeline.grading.publish.class_page import wrong_springs
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.publish.pseudonyms import STRANGER, pseudonyms_in
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import find_rubric, load_rubric
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.lock import lock_or_refuse
from pipeline.output import OWNERS_FOLDER, named_folder, own_folder
from pipeline.resources import EXAMPLES, RUBRICS
from pipeline.results import Record
from pipeline.submission import Reported, Submission, load_submission
from pipeline.submission.load import NAME
from pipeline.submission.toml import quote
from pipeline.words.numbers import count, listing

_SCRATCH = re.compile(r"\.scratch(-\d+)?")
_PATIENCE = 60.0  # s to wait for the gradebook's server; a restart takes a few


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The counts and messages of a run of `cartlab grade`.

    Attributes
    ----------
    failed : name and reason for each submission that could not be graded.
    sharing : number of submissions that share recordings with another submission.
    unsettled : number of failed submissions that the next run grades again.
    disk_full : number of submissions that failed because the disk was full.
    changes : differences from the previous class list, one phrase each.
    """

    total: int
    failed: tuple[tuple[str, str], ...]
    sharing: int
    unsettled: int = 0
    disk_full: int = 0
    remarks: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()

    @property
    def counted(self) -> str:
        """The counts in words, such as `12 of 13 graded`."""
        shared = (
            f"; recordings or numbers of {self.sharing} are also in another submission"
            if self.sharing
            else ""
        )
        return f"{self.total - len(self.failed)} of {self.total} graded{shared}"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of `cartlab grade`.

    Attributes
    ----------
    jobs : number of grading processes on this machine.
    cluster : address of a Dask scheduler. If given, its cluster grades, not this machine.
    time_limit : time limit for one submission, in s.
    memory_limit : memory limit for one submission, in bytes.
    anonymous : whether to leave names out of all files; a rubric may also require this.
    gradebook : file or database URL of the gradebook; default: `gradebook.sqlite` in the output
        folder.
    lateness : path of a table with the days late of each submission.
    key : path of an answer key with the bench of each team, or "".
    """

    jobs: int = 1
    cluster: str | None = None
    time_limit: float = Setup.time_limit
    memory_limit: int = Setup.memory_limit
    figures: bool = True
    anonymous: bool = False
    gradebook: str | None = None
    lateness: Path | None = None
    key: str = ""

    def lasting(self) -> dict[str, Any]:
        """Return the options that decide the result, to grade the class again in the same way."""
        kept = ("time_limit", "memory_limit", "figures", "anonymous", "key")
        return {name: getattr(self, name) for name in kept}

    def setup(self, rubric: Rubric, *, scratch: Path) -> Setup:
        """Return the settings that are passed to the grading processes."""
        return Setup(
            rubric=rubric,
            scratch=scratch,
            out=None if self.gradebook else scratch.parent,
            time_limit=self.time_limit,
            memory_limit=self.memory_limit,
            figures=self.figures,
        )


def _as_run(paths: Sequence[Path], rubric_file: Path, options: Options) -> Run:
    """Return what is graded, with whole paths; a shipped rubric has only a name."""
    rubric = find_rubric(rubric_file).resolve()
    return Run(
        paths=tuple(str(Path(path).resolve()) for path in paths),
        rubric=rubric.stem if rubric.parent == RUBRICS.resolve() else str(rubric),
        lateness=str(options.lateness.resolve()) if options.lateness else "",
        options=options.lasting(),
    )


def grade_class(
    paths: Sequence[Path],
    *,
    rubric_file: Path,
    out: Path,
    options: Options,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda text: None,
) -> Summary:
    """Grade all submissions in `paths` and write the results into the folder `out`.

    Parameters
    ----------
    say : function that shows a message, such as that the gradebook's server does not answer.

    Raises
    ------
    ConfigError : the rubric, the late table, a path, the folder `out` or the cluster cannot be
        used; `out` holds another class; or another run is writing into `out`.
    """
    rubric = load_rubric(rubric_file)
    late_table = read_late_table(options.lateness) if options.lateness else {}
    hidden = rubric.anonymous or options.anonymous
    place = options.gradebook or out
    refuse_submission(named_folder(out))
    if options.gradebook is None:
        _refuse_another_class(out, assignment=rubric_file.stem)
    # The file name of the rubric identifies the assignment, because the title may change later.
    book_of = partial(
        Gradebook, place, assignment=rubric_file.stem, patience=_PATIENCE, waiting=say
    )
    _refuse_lost_gradebook(book_of, out=out)
    with lock_or_refuse(out, private=True), scratch_in(out) as scratch:
        known = _listed_names(book_of)
        passed: list[str] = []
        found = find_hand_ins(paths, scratch=scratch, skip=[out], known=known, say=passed.append)
        hand_ins, unknown = settle_lateness(found, late=rubric.late, table=late_table)
        lacking: Sequence[str] = ()
        if options.key:
            from pipeline.grading.true_bench import with_benches

            hand_ins, lacking = with_benches(hand_ins, Path(options.key))
        with book_of(create=True) as book:
            shown = _pseudonyms(book) if hidden else str
            run = _as_run(paths, rubric_file, options)
            if options.gradebook is None and not book.is_graded:
                save_run(out, run)  # so that a grading that does not end can be continued
            batch = grade_batch(
                hand_ins,
                setup=options.setup(rubric, scratch=scratch),
                book=book,
                execute=_executor(options),
                examples=lambda: list(_examples(rubric, folder=rubric_file.parent)),
                progress=_without_names(progress, hand_ins) if hidden else progress,
            )
            now = rubric.model_copy(update={"anonymous": hidden})
            late_before = book.days_late()
            changes = book.finish(batch, rubric=now, shown=shown)
            remarks = [
                *_intake_messages(
                    passed, unknown, lacking, late=options.lateness, hidden=hidden, shown=shown
                ),
                *_class_messages(batch, book, shown=shown),
                *_lateness_messages(
                    {batch.moved.get(name, name): days for name, days in late_before.items()},
                    [hand_in for hand_in in hand_ins if hand_in.id.casefold() not in late_table],
                    shown=shown,
                ),
            ]
            failed = [
                (shown(name), hidden_reason(reason, name, shown(name)) if hidden else reason)
                for name, reason in batch.failed
            ]
            total = len(hand_ins)
            if options.gradebook is None:
                save_run(out, run)
            repeated = write_outputs(book, out, progress=lambda what: progress(total, total, what))
    return Summary(
        total=total,
        failed=tuple(sorted(failed)),  # sorted, so that their order does not reveal hidden names
        sharing=len(batch.shared),
        unsettled=batch.unsettled,
        disk_full=batch.disk_full,
        remarks=(*remarks, *(f"{people}: see class.html" for people in repeated)),
        changes=tuple(changes),
    )


def refuse_submission(out: Path) -> None:
    """Raise a ConfigError if `out` is inside a submission, which the output would change."""
    for folder in (out.resolve(), *out.resolve().parents):
        if (folder / NAME).is_file():
            raise ConfigError(
                f"{out}: is inside a submission; choose a folder outside it with --out"
            )


def _refuse_another_class(out: Path, *, assignment: str) -> None:
    """Raise a ConfigError if `out` holds another class; points given by hand would be lost."""
    try:
        with Gradebook(out) as book:
            before = book.assignment
    except ConfigError:
        return  # the folder has no class yet
    if before != assignment:
        raise ConfigError(
            f"{out}: holds the class of {before}.toml, and a rubric with another name means "
            f"another class. To continue this class, name the rubric {before}.toml; else choose "
            "another --out"
        )


def _refuse_lost_gradebook(book_of: Callable[[], Gradebook], *, out: Path) -> None:
    """Raise a ConfigError if `out` holds feedback whose gradebook is missing or empty.

    Otherwise the feedback would be replaced without the points given by hand.
    """
    if not any(out.glob("feedback/*/grade.json")):
        return
    try:
        with book_of() as book:
            book.assignment  # noqa: B018  # raises an error if there is no class list
    except Lost:
        raise  # the server does not answer now
    except ConfigError as error:
        raise ConfigError(
            f"{out}: holds feedback of an earlier grading, but its gradebook, with all changes by "
            f"hand, is not there ({error}). Restore the gradebook from a backup; or choose another "
            "--out; or, to begin without the changes by hand, delete the folder feedback first"
        ) from None


def _pseudonyms(book: Gradebook) -> Callable[[str], str]:
    """Return a function that turns names into pseudonyms.

    The function reads the class list when it is first called, so the list must be stored by then.
    """
    names = cache(lambda: pseudonyms_in(book))
    return lambda name: names().get(name, STRANGER)


def _without_names(progress: Progress, hand_ins: Sequence[HandIn]) -> Progress:
    """Return a progress function that leaves out the names of submissions."""
    names = {hand_in.id for hand_in in hand_ins}
    return lambda done, total, last: progress(done, total, "" if last in names else last)


def _intake_messages(
    passed: Sequence[str],
    unknown: Sequence[str],
    lacking: Sequence[str],
    *,
    late: Path | None,
    hidden: bool,
    shown: Callable[[str], str],
) -> Iterator[str]:
    """Yield messages about skipped folders and about names in the answer key and late table."""
    if lacking:
        named = _names(sorted(map(shown, lacking)))
        yield f"not in the answer key, so judged by their own recordings: {named}"
    if not hidden:
        yield from passed
    elif passed:
        yield f"{count(len(passed), 'folder')} skipped: they look like results of a grading"
    if unknown and late:
        who = count(len(unknown), "name") if hidden else ", ".join(unknown)
        yield f"{late.name}: no such submission: {who}"


def _class_messages(batch: Batch, book: Gradebook, *, shown: Callable[[str], str]) -> Iterator[str]:
    """Yield messages about springs missing from the rubric and about changes to the class list."""
    grades = (entry.grade for entry in book.entries())
    if asked := wrong_springs(grade.springs for grade in grades if grade.status == "graded"):
        yield asked
    hidden = book.rubric.anonymous
    for before, now in batch.moved.items():
        yield f"{shown(before)} is now called {shown(now)}; its points given by hand are kept"
    for name, before, now in batch.taken_over:
        people = [listing([quote(author) for author in some]) for some in (now, before)]
        whose = "" if hidden else f", {' in place of '.join(people)}"
        events = book.history(batch.moved.get(name, name))[1]
        dropped = [e.text for e in events if e.what == "dropped" and e.at == events[-1].at]
        points = f"points by hand no longer count ({dropped[0]}); " if dropped else ""
        yield (
            f"{shown(name)} now has other authors{whose}: {points}if both submissions count, "
            f"rename one folder"
        )
    if not batch.kept:
        return
    kept = sorted(map(shown, batch.kept))
    yield (
        f"not in this run, kept as they were: {_names(kept)} (to take one off the list, use "
        "cartlab remove)"
    )
    if others := sorted(map(shown, set(book.by_other_rubrics()) & set(batch.kept))):
        yield f"graded with an earlier version of the rubric; grade them again: {_names(others)}"


def _lateness_messages(
    before: Mapping[str, float], hand_ins: Sequence[HandIn], *, shown: Callable[[str], str]
) -> Iterator[str]:
    """Yield a message if submissions that were late are no longer late.

    Parameters
    ----------
    before : days late by submission at the last grading.
    hand_ins : the submissions of this run that the late table does not name.
    """
    lost = [
        shown(hand_in.id)
        for hand_in in hand_ins
        if before.get(hand_in.id, 0.0) > 0 and hand_in.days_late == 0
    ]
    if lost:
        yield (
            f"late at the last grading, but not in this run: {_names(sorted(lost))} (if their "
            "days late should still count, grade again with --lateness FILE)"
        )


def _names(names: Sequence[str]) -> str:
    return listing(names, most=8)


def _listed_names(book_of: Callable[[], Gradebook]) -> list[str]:
    """Return the names on the current class list, or no names if there is no gradebook."""
    try:
        with book_of() as book:
            return [member.submission for member in book.listed()]
    except Lost:
        raise  # the server does not answer now
    except ConfigError:
        return []


def _executor(options: Options) -> Executor:
    if options.cluster is None:
        return run_here(jobs=options.jobs)
    try:
        from pipeline.grading.batch.cluster import run_on
    except ModuleNotFoundError as error:
        raise ConfigError(f"--cluster needs {error.name}: pip install 'cartlab[cluster]'") from None
    return run_on(options.cluster)


def _examples(rubric: Rubric, *, folder: Path) -> Iterator[Example]:
    """Yield the examples, whose recordings and numbers several teams may submit.

    These are the rubric's examples, and cartlab's examples with the same number of carts.

    Raises
    ------
    ConfigError : an example of the rubric cannot be read.
    """
    from pipeline.ingest.read import read_data  # imported late: it loads all file readers

    for example in rubric.examples:
        try:
            submission = load_submission(folder / example)
            data = read_data(submission)
        except PipelineError as error:
            raise ConfigError(f"the rubric's example {example}: {error}") from None
        for run, reason in data.unreadable.items():
            raise ConfigError(f"the rubric's example {example}: {run}: {reason}")
        yield _example(submission, data.records)
    for shipped in sorted(EXAMPLES.iterdir()):
        if (shipped / "submission.toml").is_file():
            submission = load_submission(shipped)
            if submission.system.carts == rubric.system.carts:
                yield _example(submission, read_data(submission).records)


def _example(submission: Submission, records: Sequence[Record]) -> Example:
    reported = submission.reported or Reported()
    tables = reported.initial, reported.final
    numbers = {(name, abs(float(n))) for table in tables for name, n in table.items()}
    return Example(fingerprints=fingerprint(records), numbers=frozenset(numbers))


@contextmanager
def scratch_in(out: Path) -> Iterator[Path]:
    """Make a scratch folder and remove it at the end; the caller must hold the lock of `out`.

    Scratch folders left over from interrupted runs are removed first.
    """
    for left in sorted(out.iterdir()):
        if _SCRATCH.fullmatch(left.name) and left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
    scratch = own_folder(out, f".scratch-{os.getpid()}")
    scratch.mkdir(OWNERS_FOLDER, exist_ok=True)
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
