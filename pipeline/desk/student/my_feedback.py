"""A student's own feedback at the desk, and their requests for a review."""

from typing import Any

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_own_page
from pipeline.desk.shown_criterion import describe_steps, show_evidence
from pipeline.desk.users import REFUSED, OwnGrade
from pipeline.errors import ConfigError
from pipeline.grading.grade import Criterion
from pipeline.grading.gradebook.decisions import MOST_LETTERS, RequestRefused, points_lost
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.publish.feedback import TONES, feedback_page, sentence
from pipeline.grading.publish.view import GradeView, view
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.words import WORDS, points_text, waiting_text
from pipeline.report.document import paragraph
from pipeline.report.html import render_blocks
from pipeline.words.numbers import NOTHING
from pipeline.words.text import capital, rich


def send(ask: PageRequest) -> Response:
    """Ask for a review of a criterion; a reason that is refused is shown again as typed."""
    own, criterion, why = _find_own(ask), ask.text("criterion"), ask.text("why")
    try:
        book = _open_book(ask)
        book.ask(own.submission, criterion, why=why, by=ask.user.name, assignment=own.assignment)
    except RequestRefused as refused:
        return show(ask, refused={criterion: (why, str(refused))}, status=422)
    except ConfigError:
        raise ConfigError(_UNREADABLE) from None
    return ask.back(f"{ask.here}#criterion-{criterion}", "Sent. The answer will be on this page.")


def show_whole(ask: PageRequest) -> Response:
    """Show the complete feedback page of the team, with its figures."""
    own, found = _find_own(ask), _read(ask)
    if found is None:
        raise HTTPException(404, "your grades are not published yet")
    seen = view(found, "team", see=ask.user.see)
    if seen.hides_numbers:
        raise HTTPException(403, REFUSED)
    figures = _open_book(ask).figures(found)
    return show_own_page(feedback_page(seen, figures=figures, name=own.submission))


_UNREADABLE = "your grade cannot be read at the moment; tell your instructor"


def _find_own(ask: PageRequest) -> OwnGrade:
    """Return the grade that the URL names, if it belongs to the user."""
    number = ask.request.path_params["n"]
    if number >= len(ask.user.grades):
        raise HTTPException(404, "you have no access to anything here")
    return ask.user.grades[number]


def _open_book(ask: PageRequest) -> Gradebook:
    return ask.desk.gradebooks.gradebook(_find_own(ask).gradebook)


def _read(ask: PageRequest) -> Entry | None:
    """Return the feedback; None before it is released.

    Raises
    ------
    ConfigError : the feedback cannot be read. The message gives no reason, because the reason may
        contain paths of the server.
    """
    own = _find_own(ask)
    try:
        return _open_book(ask).own_feedback(own.submission, assignment=own.assignment)
    except ConfigError:
        raise ConfigError(_UNREADABLE) from None


def show(
    ask: PageRequest, *, refused: dict[str, tuple[str, str]] | None = None, status: int = 200
) -> Response:
    """Show the points, then each criterion with its requests."""
    own, found = _find_own(ask), _read(ask)
    if found is None:
        shown = {"found": None, "submission": own.submission}
        return ask.page("feedback", status=status, title="Feedback", **shown)
    seen = view(found, "team", see=ask.user.see)
    grade = seen.grade
    criteria = _describe_criteria(found, seen, refused=refused or {})
    if grade.awaits_grading:
        criteria = []
    states = [request.state for request in found.requests.values()]
    return ask.page(
        "feedback",
        status=status,
        title=found.rubric.title or "Feedback",
        submission=own.submission,
        found=found,
        grade=grade,  # as its students see it
        n_waiting=states.count("asked"),
        n_answered=states.count("answered"),
        waits=waiting_text(grade) if grade.awaits_grading else "",
        lost=[one for one in criteria if one["lost"]],
        kept=[one for one in criteria if not one["lost"] and one["id"] not in grade.open],
        waiting=[one for one in criteria if not one["lost"] and one["id"] in grade.open],
        by_person=seen.person_lines(),
        hidden=seen.hides_numbers,
        most=MOST_LETTERS,
    )


def _describe_criteria(
    found: Entry, seen: GradeView, *, refused: dict[str, tuple[str, str]]
) -> list[dict[str, Any]]:
    """Return every criterion of the rubric, including those that were never judged.

    Parameters
    ----------
    refused : by criterion, the typed reason and why it was refused.
    """
    grade = seen.grade
    judged = {own.id: own for own in grade.criteria if own.id not in grade.open}
    lost = points_lost(grade, found.rubric)
    described = []
    for asked in found.rubric.criteria:
        request = found.requests.get(asked.id)
        typed, wrong = refused.get(asked.id, ("", ""))
        described.append(
            {
                "id": asked.id,
                "title": capital(asked.title or asked.id),
                "out_of": points_text(asked.points),
                **_describe_judged(judged.get(asked.id)),
                "evidence": _show_why(asked, seen),
                "lost": asked.id in lost or request is not None,
                "request": request,
                "steps": describe_steps(request.events if request else ()),
                "may_ask": asked.id in lost and (request is None or request.state == "reopened"),
                "typed": typed,
                "wrong": wrong,
            }
        )
    return described


def _describe_judged(own: Criterion | None) -> dict[str, Any]:
    if own is None:
        return {"points": NOTHING, "outcome": "not judged", "tone": "quiet"}
    return {
        "points": points_text(own.points),
        "outcome": WORDS.text(f"outcome_{own.outcome}"),
        "tone": TONES[own.outcome],
    }


def _show_why(asked: Asked, seen: GradeView) -> str:
    """Return the evidence for a criterion as HTML."""
    own = seen.grade.criterion(asked.id)
    if own is None:
        return ""
    if not seen.hides_numbers:
        return show_evidence(own, asked.check, seen.grade.units)
    told = [paragraph(rich(sentence(one))) for one in seen.reasons(own)]
    return render_blocks(told)
