"""What the desk made of a submission: the report and its questions, the plots, and the check."""

from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from starlette.responses import Response

from pipeline.desk.last_report import NOTES, PDF, PLOTS, plots_are_current, read_findings
from pipeline.desk.page_request import Message, PageRequest
from pipeline.desk.student.form import sign_fields
from pipeline.desk.student.submission_view import SubmissionView, read_room, show_stale
from pipeline.processes import Failed
from pipeline.submission.load import NAME, file_problem, list_experiments
from pipeline.words.numbers import join_names


def show_report(ask: PageRequest) -> Response:
    """Show the report in a window below the steps."""
    folder = ask.folder()
    there = file_problem(folder, "report/report.html") is None
    pdf = file_problem(folder, PDF) is None
    title = f"Report of {folder.name}"
    return ask.page("report", title=title, room=read_room(ask), there=there, pdf=pdf)


def answer(ask: PageRequest) -> Response:
    """Write the answer to a question into `notes.md`; if it is refused, show it again as typed."""
    id_, words = ask.text("id"), ask.text("answer")
    try:
        found = ask.do("answer_question", id_=id_, words=words, seen=ask.text("seen"))
    except Failed as error:
        return show_questions(ask, status=422, refused={id_: (words, str(error))})
    label, place = f"Answer to {id_}", f"question-{id_}"
    return _show_written(ask, found, label=label, words=words, place=place)


def write_discussion(ask: PageRequest) -> Response:
    """Write the discussion into `notes.md`; if it is refused, show it again as typed."""
    words = ask.text("discussion")
    try:
        found = ask.do("write_discussion", words=words, seen=ask.text("seen"))
    except Failed as error:
        return show_questions(ask, status=422, discussion=(words, str(error)))
    return _show_written(ask, found, label="Discussion", words=words, place="discussion")


def _show_written(
    ask: PageRequest, found: Mapping[str, Any], *, label: str, words: str, place: str
) -> Response:
    """Return to the form that wrote into `notes.md`, or show both versions of a changed file."""
    if "stale" in found:
        changed = [(label, words, "")]
        return show_stale(ask, NOTES, found["stale"], changed=changed, back=f"{ask.here}questions")
    messages = [Message("Written into notes.md.")]
    messages += [Message(line, "refused") for line in found["as_typed"]]
    return ask.back(f"{ask.here}questions#{place}", *messages, place=place)


def state_signs(ask: PageRequest) -> Response:
    """Write the sign of the input into the tables of runs whose sign the report reversed."""
    signs = read_findings(ask.folder())["turned"]
    found = ask.do("edit_file", seen=ask.text("seen"), signs=signs)
    if "stale" in found:
        return show_stale(ask, NAME, found["stale"], changed=(), back=f"{ask.here}questions")
    if "fault" in found:
        return show_questions(ask, status=422, sign_error=found["fault"]["text"])
    return ask.back(f"{ask.here}questions#question-sign", "Saved.", place="question-sign")


def show_questions(
    ask: PageRequest,
    *,
    status: int = 200,
    refused: Mapping[str, tuple[str, str]] = {},
    discussion: tuple[str, str] | None = None,
    sign_error: str = "",
) -> Response:
    """Show the questions of the report with the answers so far.

    Parameters
    ----------
    refused : by question, the typed answer and why it was refused.
    discussion : the typed discussion and why it was refused.
    sign_error : why a sign was not written.
    """
    folder, room = ask.folder(), read_room(ask)
    findings = read_findings(folder)
    found = ask.do("read_questions", ids=list(refused))
    wrong = [*refused.values(), *([discussion] if discussion else [])]
    problems = [why for _, why in wrong] + [sign_error] * bool(sign_error)
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
        title=f"Discussion of {folder.name}",
        room=room,
        questions=questions,
        discussion=discussion or (found["discussion"], ""),
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


# -------------------------------------------------------------------------------- the plots

_PLOTS = "make_plots"


def show_plots(ask: PageRequest) -> Response:
    """Show the plots; if they are missing or out of date, show the job or a button to start it."""
    room, chosen = read_room(ask), _choose(ask)
    again = f"{ask.here}compare{chosen and '?' + chosen}"
    # Read the job before the plots. If it ends in between, the page shows it as running, and asks
    # again.
    job, busy = ask.desk.jobs.of(ask.folder()), _is_busy(ask)
    there = not busy and plots_are_current(ask.folder())
    if there and ask.request.headers.get("hx-request"):
        return ask.go(again)  # plots need a page of another width
    return ask.page(
        "plots",
        title=f"Plots of {ask.folder().name}",
        room=room,
        busy=busy,
        plots=f"{ask.here}{PLOTS}{chosen and '#' + chosen}" if there else "",
        again=again,
        failed=job is not None and job.task[0] == _PLOTS and job.state in ("failed", "stopped"),
    )


def make_plots(ask: PageRequest) -> Response:
    """Start the task that makes the plots, unless they are up to date."""
    if not _is_busy(ask) and not plots_are_current(ask.folder()):
        ask.start(_PLOTS, title="The plots")
    chosen = _choose(ask)
    return ask.back(f"{ask.here}compare{chosen and '?' + chosen}")


def _choose(ask: PageRequest) -> str:
    """Return the recording that the URL names, as part of a URL; "" if it names none."""
    run = ask.query("run")
    return urlencode({"run": run}) if run else ""


def _is_busy(ask: PageRequest) -> bool:
    job = ask.desk.jobs.of(ask.folder())
    return job is not None and not job.over


# -------------------------------------------------------------------------------- the check


def show_check(ask: PageRequest) -> Response:
    """Show the last answer, and what the student can ask next."""
    # Read the job before the answers. If a check ends in between, the page then shows it as running
    # and asks again, instead of showing earlier answers as the result.
    busy = _is_busy(ask)
    found = ask.do("describe_check")
    title = f"Check of {ask.folder().name}"
    return ask.page("check", title=title, room=read_room(ask), busy=busy, **found)


def begin_check(ask: PageRequest) -> Response:
    """Start a check of all numbers, or ask where to look for one number."""
    number, rubric = ask.text("number"), ask.user.rubric
    ask.start(
        "check_numbers",
        title="The check",
        rubric=str(rubric) if rubric else "",
        where=[number] if number else [],
    )
    return ask.back(f"{ask.here}check")
