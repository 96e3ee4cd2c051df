"""What the desk asks about a student's folder; only worker processes run this and read its files.

The desk's own process answers everybody, so it parses nothing that a student wrote.
"""

import tomllib
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomlkit

from pipeline.desk import last_report
from pipeline.desk.last_report import NOTES, read_findings, read_notes
from pipeline.desk.student import files
from pipeline.desk.student.files import list_held, list_missing
from pipeline.desk.student.form import (
    Fault,
    clear_marks,
    remove_experiment,
    sign_fields,
    write_fields,
)
from pipeline.desk.toml_form import Field
from pipeline.errors import SubmissionError
from pipeline.grading.self_check.answers import (
    CheckAnswer,
    asked_words,
    find_basis,
    hint_words,
    number_words,
    read_answers,
    result_words,
)
from pipeline.identify.springs import find_springs
from pipeline.ingest.fill import UNSURE, data_files, experiment_doubts, system_doubts
from pipeline.lock import lock_when_free
from pipeline.output import write_file
from pipeline.report.sections.notes import (
    formula_problems,
    with_answer,
    with_discussion,
    written_answer,
    written_discussion,
)
from pipeline.submission import Submission, load_submission
from pipeline.submission.edit import (
    NOTES_TEMPLATE,
    Stale,
    edit_submission,
    require_version,
    submission_text,
    text_digest,
)
from pipeline.submission.load import (
    MAX_NOTES_BYTES,
    NAME,
    list_experiments,
    parse_submission,
    posix,
)
from pipeline.submission.toml import TomlSlip, find_deep_key, read_apart
from pipeline.words.progress import Progress, silent

_DEEPEST = 50  # tables and lists inside each other that a form can show
_LARGEST = 10_000  # bits of a whole number that is shown in decimal digits


def read_document(text: str, *, folder: str = "", progress: Progress = silent) -> dict[str, Any]:
    """Return the tables of a file with numbers as typed text; {} if it is not valid TOML.

    A mistake in `[reported]` costs only the number or table there.
    """
    if find_deep_key(text):
        return {}
    try:
        return _plain(tomllib.loads(text, parse_float=str))  # type: ignore[arg-type]
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        pass
    try:
        return _plain(read_apart(text, "reported")[0])
    except (TomlSlip, RecursionError):
        return {}


def _plain(value: Any, depth: int = 0) -> Any:
    """Return a value without dates and without numbers that JSON cannot carry."""
    if depth > _DEEPEST:
        raise RecursionError
    if isinstance(value, dict):
        return {key: _plain(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item, depth + 1) for item in value]
    if isinstance(value, int) and value.bit_length() > _LARGEST:
        return hex(value)  # it can only have been typed so
    return value if isinstance(value, str | int) else str(value)


def students_see(folder: str, *, progress: Progress) -> str:
    """Return what `[students] see` of `submission.toml` states; "" if it states nothing."""
    try:
        document, _ = read_apart(submission_text(Path(folder)), "reported")
    except (SubmissionError, TomlSlip, OSError):  # the page says what is wrong
        return ""
    students = document.get("students")
    return str(students.get("see", "")) if isinstance(students, dict) else ""


def read_folder(folder: str, check: bool, *, progress: Progress) -> dict[str, Any]:
    """Return the state of a folder, as `SubmissionView` shows it.

    The keys are the `text` of `submission.toml`, the `document` in it, and its `fault` (None for a
    valid file). `doubts` are marked in it; `keeps` says why the folder cannot be handed in.
    Questions without an answer are `unanswered`, and `checked` is the state of the check.

    Parameters
    ----------
    check : whether the room shows the check instead of the report.
    """
    place, text, fault = Path(folder), "", None
    try:
        text = submission_text(place) if (place / NAME).exists() else ""
        if text:
            parse_submission(text, folder=place)
    except SubmissionError as error:
        fault = Fault.of(error)
    return {
        "text": text,
        "document": read_document(text),
        "fault": fault and asdict(fault),
        "doubts": _list_doubts(place) if UNSURE in text else None,
        "keeps": list_missing(place),
        "unanswered": [] if check else list_unanswered(place),
        "checked": _find_check_state(place) if check else None,
    }


def _list_doubts(folder: Path) -> dict[str, Any] | None:
    """Return what `submission.toml` marks as unsure, and springs that the data do not determine.

    The keys are `system` (the doubt about each key of `[system]`), `springs` (numbers of the
    springs, from 1) and `experiments` (the doubts in each table). The result is None if the file
    is not valid.
    """
    try:
        system = system_doubts(folder)
        asked = "springs" in system
        return {
            "system": {key: doubt.removeprefix(UNSURE) for key, doubt in system.items()},
            "springs": find_springs(load_submission(folder)).open if asked else (),
            "experiments": experiment_doubts(folder),
        }
    except SubmissionError:  # the page says what is wrong with the file
        return None


def list_unanswered(folder: Path) -> list[dict[str, str]]:
    """Return the questions of the last report that have no answer yet."""
    try:
        notes = read_notes(folder)
    except SubmissionError:  # the report's page says what is wrong
        notes = ""
    return [
        one
        for one in read_findings(folder)["questions"]
        if not written_answer(notes, one["id"]).strip()
    ]


def edit_file(
    folder: str,
    seen: str,
    fields: Sequence[Mapping[str, str]] = (),
    doubts: Sequence[tuple[int, Sequence[str]]] = (),
    signs: Mapping[str, int] = {},
    remove: int | None = None,
    *,
    progress: Progress,
) -> dict[str, Any]:
    """Change `submission.toml`; return {}, or why it was not changed.

    This is a `fault`, or the present text of a `stale` file.

    Parameters
    ----------
    seen : digest of the text for which the change was prepared.
    fields : path, kind and new value of each changed field.
    doubts : for each of some tables, its index and the doubts to clear.
    signs : sign of the input that is written into each of these experiments.
    remove : index of the table to remove.
    """

    def change(document: tomlkit.TOMLDocument) -> None:
        changed = [
            Field(path=one["path"], label="", kind=one["kind"], value=one["value"])
            for one in fields
        ]
        write_fields(document, [*changed, *sign_fields(document, signs)])
        for index, cleared in doubts:
            clear_marks(document, index, cleared)
        if remove is not None:
            remove_experiment(document, remove)

    try:
        edit_submission(Path(folder), change, version=seen or "nothing")
    except Stale as error:
        return {"stale": error.text}
    except SubmissionError as error:
        return {"fault": asdict(Fault.of(error))}
    return {}


def store_files(
    folder: str, names: Sequence[str], scratch: str, *, progress: Progress
) -> list[dict[str, str]]:
    """Store uploaded files in a folder; return the messages for the page.

    Parameters
    ----------
    names : the names as sent; the content of the first file is `0` in `scratch`, and so on.
    """
    return [asdict(line) for line in files.store(names, Path(scratch), Path(folder))]


def set_aside(folder: str, file: str, *, progress: Progress) -> str | None:
    """Move a recording that no table names out of `data/`; None if there is no such recording."""
    place = Path(folder)
    if file not in data_files(place):
        return None
    with lock_when_free(place):
        text = submission_text(place) if (place / NAME).exists() else ""
        tables = list_experiments(read_document(text))
        if any(posix(str(table.get("file", ""))) == file for table in tables):
            raise SubmissionError(f"{file}: {NAME} uses it; remove it there first")
        return files.put_aside(file, place)


def list_hand_in(folder: str, report: bool, *, progress: Progress) -> list[tuple[str, int]]:
    """Return name and size of each file that would be handed in; see `list_held`."""
    held = list_held(Path(folder), report=report)
    return [(name, (Path(folder) / name).stat().st_size) for name in held]


def pack_hand_in(
    folder: str, into: str, report: bool, *, progress: Progress
) -> dict[str, list[int]]:
    """Write the zip to hand in; return the state of the sources that it holds.

    Parameters
    ----------
    report : whether to include the report if it is up to date.

    Raises
    ------
    SubmissionError : the submission is not valid, or lacks a file that it names.
    """
    place = Path(folder)
    made_of = last_report.stat_sources(place)
    with zipfile.ZipFile(into, "x", zipfile.ZIP_DEFLATED) as archive:
        for name in list_held(place, report=report):
            # A fixed date, so that the same files give the same bytes.
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            info.file_size = (place / name).stat().st_size
            with (place / name).open("rb") as file, archive.open(info, "w") as packed:
                while chunk := file.read(1 << 20):
                    packed.write(chunk)
    return made_of


def read_questions(folder: str, ids: Sequence[str], *, progress: Progress) -> dict[str, Any]:
    """Return the answers by question and the discussion, as `notes.md` has them.

    The keys are `answers`, `discussion`, the digest of the file (`seen`), and what is wrong with it
    (`problem`).

    Parameters
    ----------
    ids : further questions, which the last report does not ask.
    """
    notes = problem = ""
    try:
        notes = read_notes(Path(folder))
    except SubmissionError as error:
        problem = str(error)
    known = _asked(Path(folder))
    discussion = written_discussion(notes, known)
    return {
        "answers": {id_: written_answer(notes, id_) for id_ in [*known, *ids]},
        "discussion": "" if discussion == NOTES_TEMPLATE.strip() else discussion,
        "seen": text_digest(notes),
        "problem": problem,
    }


def answer_question(
    folder: str, id_: str, words: str, seen: str, *, progress: Progress
) -> dict[str, Any]:
    """Write an answer into `notes.md`; see `_edit_notes`."""

    def change(notes: str, asked: Sequence[str]) -> str:
        if id_ not in asked:
            raise SubmissionError(f"the report has no question {id_!r}")
        return with_answer(notes, id_, words)

    return _edit_notes(Path(folder), words, seen, change)


def write_discussion(folder: str, words: str, seen: str, *, progress: Progress) -> dict[str, Any]:
    """Write the discussion into `notes.md`; see `_edit_notes`."""
    return _edit_notes(
        Path(folder), words, seen, lambda notes, asked: with_discussion(notes, asked, words)
    )


def _edit_notes(
    folder: Path, words: str, seen: str, change: Callable[[str, Sequence[str]], str]
) -> dict[str, Any]:
    """Change `notes.md`; return `as_typed` formulas, or the present text of a `stale` file.

    Parameters
    ----------
    words : what was typed.
    seen : digest of the text for which it was typed.
    change : returns the new text of a text with answers to these questions.
    """
    with lock_when_free(folder):
        notes = read_notes(folder)
        try:
            require_version(notes, seen, name=NOTES)
        except Stale as error:
            return {"stale": error.text}
        new = change(notes, _asked(folder))
        if len(new.encode()) > MAX_NOTES_BYTES:
            raise SubmissionError(f"{NOTES} would exceed {MAX_NOTES_BYTES:,} bytes")
        write_file(folder / NOTES, new)
    return {"as_typed": formula_problems(words)}


def _asked(folder: Path) -> list[str]:
    """Return the ids of the questions of the last report."""
    return [one["id"] for one in read_findings(folder)["questions"]]


# -------------------------------------------------------------------- the check of reported numbers


def _find_check_state(folder: Path) -> tuple[str, str]:
    """Return the state of the check (done, needs, old or none), and a word for it."""
    submission, problems = _load_if_sound(folder)
    try:
        answers = read_answers(folder)
    except SubmissionError:
        return "needs", "cannot be read"
    if problems or not answers or submission is None:
        return "none", "not run yet"
    last = answers[-1]
    if last.basis != find_basis(submission):
        return "old", "changed since"
    return ("needs", "some disagree") if last.disagree else ("done", "all agree")


def describe_check(folder: str, *, progress: Progress) -> dict[str, Any]:
    """Return the last answer, and what the student can ask next, as the page of the check shows it.

    An answer about earlier numbers or an earlier set-up is not shown, only that there is one.
    """
    place = Path(folder)
    submission, problems = _load_if_sound(place)
    answers: Sequence[CheckAnswer] = ()
    try:
        answers = read_answers(place)
    except SubmissionError as error:
        problems.append(str(error))
    last = answers[-1] if answers else None
    current = last if last and submission and last.basis == find_basis(submission) else None
    return {
        "problems": problems,
        "ready": submission is not None and submission.reported is not None,
        "last": last is not None,
        "result": result_words(current) if current else "",
        "rows": _describe_rows(current, answers, submission) if current and submission else [],
        "agree": [number_words(number) for number in current.agree] if current else [],
        "not_checked": [number_words(number) for number in current.not_checked] if current else [],
        "unread": list(current.unread) if current else [],
        "doubtful": list(current.doubtful) if current else [],
        "asked": asked_words(len(answers)) if answers else "",
    }


def _load_if_sound(folder: Path) -> tuple[Submission | None, list[str]]:
    """Return the submission, or None with what is wrong with it."""
    try:
        return load_submission(folder), []
    except SubmissionError as error:
        return None, [str(error)]


def _describe_rows(
    current: CheckAnswer, answers: Sequence[CheckAnswer], submission: Submission
) -> list[dict[str, Any]]:
    """Return a row for each number that disagrees, with its hint if there is one."""
    hints = {
        hint.number: asdict(hint_words(hint))
        for answer in answers
        if answer.basis == current.basis
        for hint in answer.hints
    }
    return [
        {
            "number": number,
            "name": number_words(number),
            "typed": _find_typed(number, submission),
            "hint": hints.get(number),
        }
        for number in current.disagree
    ]


def _find_typed(number: str, submission: Submission) -> str:
    """Return an initial or final estimate as typed; "" for any other number."""
    table, _, name = number.partition(".")
    typed = submission.typed.get(table, {}).get(name)
    return "" if typed is None else str(typed)


FOLDER_TASKS = (
    read_document, students_see, read_folder, edit_file, store_files, set_aside, list_hand_in,
    pack_hand_in, describe_check, read_questions, answer_question,
    write_discussion,
)  # fmt: skip
