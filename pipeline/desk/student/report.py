"""The report in the student's room: made, shown, its questions answered in `notes.md`."""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.responses import Response

from pipeline.desk.pages import served_file
from pipeline.desk.state import Ask
from pipeline.errors import SubmissionError
from pipeline.lock import turn_in
from pipeline.output import write_file
from pipeline.report.sections.answers import with_answer, written_answer
from pipeline.submission.edit import text_digest
from pipeline.submission.load import MAX_NOTES_BYTES, NAME, outside
from pipeline.submission.toml_file import read_text

_ASKED = "report/questions.json"
_MOST_ASKED = 1_000_000  # bytes
_NOTES = "notes.md"


def start_report(ask: Ask) -> Response:
    """Have the report made."""
    folder = ask.folder()
    ask.desk.jobs.start("report", title="The report", place=folder, folder=str(folder))
    return ask.back(ask.here + "#report")


def start_gap(ask: Ask) -> Response:
    """Have the data asked what the linear model leaves out."""
    folder = ask.folder()
    ask.desk.jobs.start("gap", title="The gap", place=folder, folder=str(folder))
    return ask.back(ask.here + "#report")


def stop(ask: Ask) -> Response:
    """Stop what is under way in the folder."""
    if job := ask.desk.jobs.of(ask.folder()):
        job.stop.set()
    return ask.back(ask.here + "#report")


def show(ask: Ask) -> Response:
    """Show the report with its questions, and claims beside what the data say."""
    return _page(ask)


def answer(ask: Ask) -> Response:
    """Write the answer to a question into `notes.md`; what cannot be is shown as typed."""
    folder, id_, words = ask.folder(), ask.text("id"), ask.text("answer")
    try:
        with turn_in(folder):
            notes = _notes(folder)
            if ask.text("seen") != text_digest(notes):
                return ask.page(
                    "outdated",
                    status=409,
                    title=f"{_NOTES} was changed meanwhile",
                    name=_NOTES,
                    text=notes,
                    changed=[(f"Answer to {id_}", words, "")],
                    had="You typed",
                    back=f"{ask.here}report",
                )
            if id_ not in [one["id"] for one in told(folder)["questions"]]:
                raise SubmissionError(f"the report asks nothing called {id_!r}")
            new = with_answer(notes, id_, words)
            if len(new.encode()) > MAX_NOTES_BYTES:
                raise SubmissionError(f"{_NOTES} would have more than {MAX_NOTES_BYTES:,} bytes")
            write_file(folder / _NOTES, new)
    except SubmissionError as error:
        return _page(ask, status=422, refused={id_: (words, str(error))})
    return ask.back(f"{ask.here}report#question-{id_}", "Written into notes.md.")


def report_file(ask: Ask) -> Response:
    """Return a file of the report, which runs no script but the report's own."""
    return served_file(ask.folder(), f"report/{ask.request.path_params['name']}")


def gap_file(ask: Ask) -> Response:
    """Return a file of the gap's page, likewise."""
    return served_file(ask.folder(), f"gap/{ask.request.path_params['name']}")


def told(folder: Path) -> dict[str, Any]:
    """Return what the last report said and asked, as far as its file can be read."""
    read: Any = {}
    if outside(folder, _ASKED) is None and (folder / _ASKED).stat().st_size < _MOST_ASKED:
        with suppress(ValueError, RecursionError):
            read = json.loads((folder / _ASKED).read_bytes())
    try:
        questions = [{"id": str(one["id"]), "text": str(one["text"])} for one in read["questions"]]
        failed = [str(one) for one in read["failed"]]
        return {"questions": questions, "failed": failed, "changes": str(read["changes"])}
    except (KeyError, TypeError):
        return {"questions": [], "failed": [], "changes": ""}


def unanswered(folder: Path) -> int:
    """Return how many questions of the last report have no answer yet."""
    try:
        notes = _notes(folder)
    except SubmissionError:  # the report's page says what is wrong with them
        notes = ""
    return sum(not written_answer(notes, one["id"]).strip() for one in told(folder)["questions"])


def state(folder: Path) -> str:
    """Return "none", "current", or "older" than what it is made of."""
    if outside(folder, "report/report.html") is not None:
        return "none"
    made = (folder / "report" / "report.html").stat().st_mtime_ns
    sources = [folder / NAME, folder / _NOTES, *(folder / "data").rglob("*")]
    newer = any(path.stat().st_mtime_ns > made for path in sources if path.is_file())
    return "older" if newer else "current"


def _page(ask: Ask, *, status: int = 200, refused: Mapping[str, tuple[str, str]] = {}) -> Response:
    """Show the report.

    Parameters
    ----------
    refused : by question, an answer as it was typed, and why it was not written.
    """
    folder = ask.folder()
    said = told(folder)
    problems, notes = [why for _, why in refused.values()], ""
    try:
        notes = _notes(folder)
    except SubmissionError as error:
        problems = [str(error)]
    questions, known = [], [one["id"] for one in said["questions"]]
    others = [{"id": id_, "text": f"Answer to {id_}"} for id_ in refused if id_ not in known]
    for one in [*said["questions"], *others]:
        words, why = refused.get(one["id"]) or (written_answer(notes, one["id"]), "")
        questions.append({**one, "answer": words, "wrong": why})
    return ask.page(
        "report",
        status=status,
        title=f"Report of {folder.name}",
        told=said,
        questions=questions,
        problems=problems,
        seen=text_digest(notes),
        there=outside(folder, "report/report.html") is None,
        said=ask.told(),
    )


def _notes(folder: Path) -> str:
    if not (folder / _NOTES).exists():
        return ""
    if problem := outside(folder, _NOTES):
        raise SubmissionError(problem)
    where = f"{folder.name}/{_NOTES}"
    return read_text(folder / _NOTES, where=where, limit=MAX_NOTES_BYTES, error=SubmissionError)
