"""The report in the student's room: made, shown, its questions answered in `notes.md`."""

from collections.abc import Mapping

from starlette.responses import Response

from pipeline.desk.last_report import NOTES, told, written_notes
from pipeline.desk.pages import served_file
from pipeline.desk.state import Ask
from pipeline.errors import SubmissionError
from pipeline.lock import turn_in
from pipeline.output import write_file
from pipeline.report.sections.answers import with_answer, written_answer
from pipeline.submission.edit import text_digest
from pipeline.submission.load import MAX_NOTES_BYTES, outside


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
            notes = written_notes(folder)
            if ask.text("seen") != text_digest(notes):
                return ask.page(
                    "outdated",
                    status=409,
                    title=f"{NOTES} was changed meanwhile",
                    name=NOTES,
                    text=notes,
                    changed=[(f"Answer to {id_}", words, "")],
                    had="You typed",
                    back=f"{ask.here}report",
                )
            if id_ not in [one["id"] for one in told(folder)["questions"]]:
                raise SubmissionError(f"the report asks nothing called {id_!r}")
            new = with_answer(notes, id_, words)
            if len(new.encode()) > MAX_NOTES_BYTES:
                raise SubmissionError(f"{NOTES} would have more than {MAX_NOTES_BYTES:,} bytes")
            write_file(folder / NOTES, new)
    except SubmissionError as error:
        return _page(ask, status=422, refused={id_: (words, str(error))})
    return ask.back(f"{ask.here}report#question-{id_}", "Written into notes.md.")


def report_file(ask: Ask) -> Response:
    """Return a file of the report, which runs no script but the report's own."""
    return served_file(ask.folder(), f"report/{ask.request.path_params['name']}")


def gap_file(ask: Ask) -> Response:
    """Return a file of the gap's page, likewise."""
    return served_file(ask.folder(), f"gap/{ask.request.path_params['name']}")


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
        notes = written_notes(folder)
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
