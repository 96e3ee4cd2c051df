"""The report in the student's room, and its questions, which are answered in `notes.md`."""

from collections.abc import Mapping

from starlette.responses import Response

from pipeline.desk.last_report import NOTES, read_findings
from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.form import sign_fields
from pipeline.desk.student.submission_view import SubmissionView, read_room
from pipeline.processes import Failed
from pipeline.submission.load import file_problem, list_experiments
from pipeline.words.numbers import join_names


def show(ask: PageRequest) -> Response:
    """Show the report in a window below the steps."""
    folder = ask.folder()
    return ask.page(
        "report",
        title=f"Report of {folder.name}",
        room=read_room(ask),
        there=file_problem(folder, "report/report.html") is None,
    )


def show_questions(ask: PageRequest) -> Response:
    """Show the questions of the report with the answers so far."""
    return _show_questions(ask)


def answer(ask: PageRequest) -> Response:
    """Write the answer to a question into `notes.md`; if it is refused, show it again as typed."""
    folder, id_, words = ask.folder(), ask.text("id"), ask.text("answer")
    try:
        notes = ask.desk.workers.do(
            "answer_question", folder=str(folder), id_=id_, words=words, seen=ask.text("seen")
        )
    except Failed as error:
        return _show_questions(ask, status=422, refused={id_: (words, str(error))})
    if notes is not None:
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
    place = f"question-{id_}"
    return ask.back(f"{ask.here}questions#{place}", "Written into notes.md.", place=place)


def state_signs(ask: PageRequest) -> Response:
    """Write the sign of the input into the tables of runs whose sign the report reversed."""
    folder = ask.folder()
    found = ask.desk.workers.do(
        "edit_file",
        folder=str(folder),
        seen=ask.text("seen"),
        signs=read_findings(folder)["turned"],
    )
    if "fault" in found:
        status = 409 if "outdated" in found else 422
        return _show_questions(ask, status=status, sign_error=found["fault"]["text"])
    return ask.back(f"{ask.here}questions#question-sign", "Saved.", place="question-sign")


def _show_questions(
    ask: PageRequest,
    *,
    status: int = 200,
    refused: Mapping[str, tuple[str, str]] = {},
    sign_error: str = "",
) -> Response:
    """Show the questions.

    Parameters
    ----------
    refused : by question, the typed answer and why it was refused.
    sign_error : why a sign was not written.
    """
    folder, room = ask.folder(), read_room(ask)
    findings = read_findings(folder)
    found = ask.desk.workers.do("read_questions", folder=str(folder), ids=list(refused))
    problems = [why for _, why in refused.values()] + [sign_error] * bool(sign_error)
    if found["problem"]:
        problems = [found["problem"]]
    questions, known = [], [one["id"] for one in findings["questions"]]
    others = [
        {"id": id_, "section": "", "text": f"Answer to {id_}"}
        for id_ in refused
        if id_ not in known
    ]
    for one in [*findings["questions"], *others]:
        words, why = refused.get(one["id"]) or (found["answers"][one["id"]], "")
        questions.append({**one, "answer": words, "wrong": why})
    return ask.page(
        "questions",
        status=status,
        title=f"Questions about {folder.name}",
        room=room,
        questions=questions,
        signs=_list_signs(room),
        problems=problems,
        seen=found["seen"],
    )


def _list_signs(room: SubmissionView) -> str:
    """Return, as text, the signs that one click writes and their runs; "" for no signs."""
    document, signs = room.document, room.findings["turned"]
    tables = list_experiments(document)
    open_: dict[str, list[str]] = {}
    for field in sign_fields(document, signs):
        open_.setdefault(field.value, []).append(tables[int(field.path.split(".")[1])]["id"])
    return "; ".join(f"{sign} in {join_names(runs)}" for sign, runs in open_.items())
