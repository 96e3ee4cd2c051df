"""The requests for a review in a class: first the waiting ones, with a form for the answer."""

from typing import Any
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.gradebooks import ClassView
from pipeline.desk.page_request import PageRequest
from pipeline.desk.shown_criterion import describe_steps
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import MOST_LETTERS, Conflict, RequestRefused, read_points
from pipeline.grading.gradebook.events import Entry, Request
from pipeline.grading.publish.feedback import sentence
from pipeline.grading.rubric import Rubric
from pipeline.grading.total import list_steps
from pipeline.grading.words import points_text
from pipeline.words.numbers import NOTHING
from pipeline.words.text import capital, with_symbols


def act(ask: PageRequest) -> Response:
    """Answer a request or reopen it; if somebody else has answered it, show that answer."""
    shown = ask.class_view
    team = shown.team(ask.text("team"))
    book, name, what = ask.gradebook, team.submission, ask.text("do")
    criterion, seen, by = ask.text("criterion"), ask.text("seen"), ask.sign()
    try:
        if what == "reopen":
            book.reopen(name, criterion, by=by, version=seen)
            message = "Reopened: the team may ask once more."
        elif what == "answer":
            points = _read_points(ask.text("points"))
            book.answer(name, criterion, points, text=ask.text("text"), by=by, version=seen)
            message = f"Answered: {team.grade.submission}, {_find_title(shown.rubric, criterion)}."
        else:
            raise HTTPException(400, "there is no such button")
    except Conflict as conflict:
        return _show_conflict(ask, shown, conflict)
    except ConfigError as error:
        return show(ask, wrong=str(error), status=422)
    return ask.back(_write_address(ask, ask.query("of")), message)


def _read_points(typed: str) -> float | None:
    """Return the typed points; None if the points stay as they are."""
    if not typed:
        return None
    points = read_points(typed)
    if points is None:
        raise RequestRefused("enter a number of points, or leave the field empty to keep them")
    return points


def show(ask: PageRequest, *, wrong: str = "", status: int = 200) -> Response:
    """Show the requests of the class or of one team."""
    shown, of = ask.class_view, ask.query("of")
    book = ask.gradebook
    queue = book.queue(shown.team(of).submission if of else "")
    called = {team.submission: name for name, team in shown.teams.items()}
    waiting, settled = (
        [
            _describe(ask, entry, request, shown, called[entry.submission], wrong=wrong)
            for entry, request in listed
        ]
        for listed in (queue.waiting, queue.settled)
    )
    return ask.page(
        "requests",
        status=status,
        title="Regrade requests",
        of=of,
        own=_write_address(ask, of),
        waiting=waiting,
        settled=settled,
        n_waiting=queue.n_waiting,
        n_settled=queue.n_settled,
        most=MOST_LETTERS,
        wrong="" if any(one["wrong"] for one in (*waiting, *settled)) else wrong,
    )


def _describe(
    ask: PageRequest, entry: Entry, request: Request, shown: ClassView, name: str, *, wrong: str
) -> dict[str, Any]:
    """Return a request as the page shows it.

    Parameters
    ----------
    wrong : why the answer was refused, or "".
    """
    rubric = shown.rubric
    asked, own = rubric.criterion(request.criterion), entry.grade.criterion(request.criterion)
    hidden = {} if shown.names is None else {"team": name, "submission": entry.submission}
    place = {"of": name, "criterion": request.criterion}
    failed = wrong and (ask.text("team"), ask.text("criterion")) == (name, request.criterion)
    return {
        "team": name,
        "criterion": request.criterion,
        "title": _find_title(rubric, request.criterion),
        "points": points_text(own.points) if own else NOTHING,
        "out_of": points_text(asked.points) if asked else NOTHING,
        "message": with_symbols(sentence(own.message)) if own else "",
        "address": f"{ask.here}team?{urlencode(place)}#chosen",
        "steps": describe_steps(request.events, **hidden),
        "state": request.state,
        "version": entry.request_version(request.criterion),
        "choices": list_steps(asked.points, rubric) if asked else None,
        "typed": ask.text("points") if failed else "",
        "text": ask.text("text") if failed else "",
        "wrong": wrong if failed else "",
    }


def _find_title(rubric: Rubric, criterion: str) -> str:
    """Return the title of a criterion; its id if the rubric no longer has it."""
    return capital(rubric.titles.get(criterion, criterion))


def _show_conflict(ask: PageRequest, shown: ClassView, conflict: Conflict) -> Response:
    """Show the typed answer next to the current state; nothing was changed."""
    name, criterion = ask.text("team"), ask.text("criterion")
    entry = ask.class_view.team(name)
    own = entry.grade.criterion(criterion)
    points, request = points_text(own.points) if own else NOTHING, entry.requests.get(criterion)
    answered = request is not None and request.state == "answered"
    last = request.events[-1] if request and answered else conflict.now
    why, by = (last.text, last.by) if last else ("as graded", "cartlab")
    typed = ask.text("points") or "unchanged"
    return ask.page(
        "conflict",
        status=409,
        title=f"{name}: {_find_title(shown.rubric, criterion)}",
        typed={"points": typed, "why": ask.text("text"), "by": ask.signature},
        now={"points": points, "why": why, "by": by},
        back=_write_address(ask, ask.query("of")),
    )


def _write_address(ask: PageRequest, of: str) -> str:
    """Return the URL of the requests of the class or of one team."""
    return f"{ask.here}requests" + (f"?{urlencode({'of': of})}" if of else "")
