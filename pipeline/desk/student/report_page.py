"""The report in the student's room, and its questions, which are answered in `notes.md`."""

from collections.abc import Mapping

import tomlkit
from starlette.responses import Response

from pipeline.desk.ask import Ask
from pipeline.desk.last_report import NOTES, read_findings, read_notes
from pipeline.desk.student.form import read_document, sign_fields, write_fields
from pipeline.desk.student.room import Room, read_room
from pipeline.errors import SubmissionError
from pipeline.lock import lock_when_free
from pipeline.output import write_file
from pipeline.report.sections.answers import with_answer, written_answer
from pipeline.submission.edit import Outdated, edit_submission, text_digest
from pipeline.submission.load import MAX_NOTES_BYTES, file_problem, list_experiments
from pipeline.words.numbers import abridge


def show(ask: Ask) -> Response:
    """Show the report in a window below the steps."""
    folder = ask.folder()
    return ask.page(
        "report",
        title=f"Report of {folder.name}",
        room=read_room(ask),
        there=file_problem(folder, "report/report.html") is None,
    )


def show_questions(ask: Ask) -> Response:
    """Show the questions of the report with the answers so far."""
    return _show_questions(ask)


def answer(ask: Ask) -> Response:
    """Write the answer to a question into `notes.md`; if it is refused, show it again as typed."""
    folder, id_, words = ask.folder(), ask.text("id"), ask.text("answer")
    try:
        with lock_when_free(folder):
            notes = read_notes(folder)
            if ask.text("seen") != text_digest(notes):
                return ask.page(
                    "outdated",
                    status=409,
                    title=f"{NOTES} was changed meanwhile",
                    name=NOTES,
                    text=notes,
                    changed=[(f"Answer to {id_}", words, "")],
                    had="You typed",
                    back=f"{ask.here}questions",
                )
            if id_ not in [one["id"] for one in read_findings(folder)["questions"]]:
                raise SubmissionError(f"the report has no question {id_!r}")
            new = with_answer(notes, id_, words)
            if len(new.encode()) > MAX_NOTES_BYTES:
                raise SubmissionError(f"{NOTES} would exceed {MAX_NOTES_BYTES:,} bytes")
            write_file(folder / NOTES, new)
    except SubmissionError as error:
        return _show_questions(ask, status=422, refused={id_: (words, str(error))})
    place = f"question-{id_}"
    return ask.back(f"{ask.here}questions#{place}", "Written into notes.md.", place=place)


def state_signs(ask: Ask) -> Response:
    """Write the sign of the input into the tables of runs whose sign the report reversed."""
    signs = read_findings(ask.folder())["turned"]

    def change(document: tomlkit.TOMLDocument) -> None:
        write_fields(document, sign_fields(document, signs))

    try:
        edit_submission(ask.folder(), change, seen=ask.text("seen") or "nothing")
    except SubmissionError as error:
        return _show_questions(
            ask, status=409 if isinstance(error, Outdated) else 422, sign_error=error
        )
    return ask.back(f"{ask.here}questions#question-sign", "Saved.", place="question-sign")


def _show_questions(
    ask: Ask,
    *,
    status: int = 200,
    refused: Mapping[str, tuple[str, str]] = {},
    sign_error: SubmissionError | None = None,
) -> Response:
    """Show the questions.

    Parameters
    ----------
    refused : by question, the typed answer and why it was refused.
    sign_error : why a sign was not written.
    """
    folder, room = ask.folder(), read_room(ask)
    findings = read_findings(folder)
    problems, notes = [why for _, why in refused.values()], ""
    if sign_error:
        problems.append(str(sign_error))
    try:
        notes = read_notes(folder)
    except SubmissionError as error:
        problems = [str(error)]
    questions, known = [], [one["id"] for one in findings["questions"]]
    others = [
        {"id": id_, "section": "", "text": f"Answer to {id_}"}
        for id_ in refused
        if id_ not in known
    ]
    for one in [*findings["questions"], *others]:
        words, why = refused.get(one["id"]) or (written_answer(notes, one["id"]), "")
        questions.append({**one, "answer": words, "wrong": why})
    return ask.page(
        "questions",
        status=status,
        title=f"Questions about {folder.name}",
        room=room,
        questions=questions,
        signs=_list_signs(room),
        problems=problems,
        seen=text_digest(notes),
    )


def _list_signs(room: Room) -> str:
    """Return, as text, the signs that one click writes and their runs; "" for no signs."""
    document, signs = read_document(room.text), room.findings["turned"]
    tables = list_experiments(document)
    open_: dict[str, list[str]] = {}
    for field in sign_fields(document, signs):
        open_.setdefault(field.value, []).append(tables[int(field.path.split(".")[1])]["id"])
    return "; ".join(f"{sign} in {abridge(runs)}" for sign, runs in open_.items())
