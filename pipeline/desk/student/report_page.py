"""The report in the student's room, and its questions, which are answered in `notes.md`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from starlette.responses import Response

from pipeline.desk.last_report import NOTES, read_findings
from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.form import sign_fields
from pipeline.desk.student.submission_view import StalePage, SubmissionView, read_room, show_stale
from pipeline.processes import Failed
from pipeline.submission.load import NAME, file_problem, list_experiments
from pipeline.words.numbers import join_names


@dataclass(frozen=True, kw_only=True)
class ReportPage:
    """The data of the report's page; `there` says whether there is a report."""

    room: SubmissionView
    there: bool


@dataclass(frozen=True, kw_only=True)
class QuestionsPage:
    """What the page of questions shows.

    Attributes
    ----------
    questions : id, section, text, answer, and why the answer was refused, for each question.
    signs : the signs of the input that one click writes, and their runs; "" for no signs.
    seen : digest of `notes.md`.
    """

    room: SubmissionView
    questions: Sequence[Mapping[str, str]]
    signs: str
    problems: Sequence[str]
    seen: str


def show(ask: PageRequest) -> Response:
    """Show the report in a window below the steps."""
    folder = ask.folder()
    there = file_problem(folder, "report/report.html") is None
    page = ReportPage(room=read_room(ask), there=there)
    return ask.page("report", title=f"Report of {folder.name}", page=page)


def show_questions(ask: PageRequest) -> Response:
    """Show the questions of the report with the answers so far."""
    return _show_questions(ask)


def answer(ask: PageRequest) -> Response:
    """Write the answer to a question into `notes.md`; if it is refused, show it again as typed."""
    folder, id_, words = ask.folder(), ask.text("id"), ask.text("answer")
    try:
        found = ask.desk.workers.do(
            "answer_question", folder=str(folder), id_=id_, words=words, seen=ask.text("seen")
        )
    except Failed as error:
        return _show_questions(ask, status=422, refused={id_: (words, str(error))})
    if "stale" in found:
        return _show_stale(ask, NOTES, found["stale"], changed=[(f"Answer to {id_}", words, "")])
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
    if "stale" in found:
        return _show_stale(ask, NAME, found["stale"])
    if "fault" in found:
        return _show_questions(ask, status=422, sign_error=found["fault"]["text"])
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
    page = QuestionsPage(
        room=room,
        questions=questions,
        signs=_list_signs(room),
        problems=problems,
        seen=found["seen"],
    )
    title = f"Questions about {folder.name}"
    return ask.page("questions", status=status, title=title, page=page)


def _show_stale(
    ask: PageRequest, name: str, text: str, *, changed: Sequence[tuple[str, str, str]] = ()
) -> Response:
    page = StalePage(name=name, text=text, changed=changed, back=f"{ask.here}questions")
    return show_stale(ask, page)


def _list_signs(room: SubmissionView) -> str:
    """Return, as text, the signs that one click writes and their runs; "" for no signs."""
    document, signs = room.document, room.findings["turned"]
    tables = list_experiments(document)
    open_: dict[str, list[str]] = {}
    for field in sign_fields(document, signs):
        open_.setdefault(field.value, []).append(tables[int(field.path.split(".")[1])]["id"])
    return "; ".join(f"{sign} in {join_names(runs)}" for sign, runs in open_.items())
