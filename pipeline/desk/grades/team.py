"""A team at the desk: its points beside the evidence, and what a person decides about them."""

from itertools import count
from typing import Any
from urllib.parse import urlencode

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.books import Class, Team
from pipeline.desk.grades.filters import Filter
from pipeline.desk.grades.room import a_class, a_team, drawing_response, news_of, signature
from pipeline.desk.state import Ask
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.history import event_words, to_the_second
from pipeline.grading.gradebook.open_book import Conflict, TeamNow
from pipeline.grading.gradebook.override import read_points
from pipeline.grading.publish.anonymous import anonymise, renamed_events
from pipeline.grading.publish.class_page import feedback_link
from pipeline.grading.publish.feedback import (
    TONES,
    alternative,
    evidence_table,
    numbers_table,
    sentence,
)
from pipeline.grading.publish.feedback_figures import is_response, numbers_in
from pipeline.grading.words import WORDS, points_text
from pipeline.report.document import paragraph
from pipeline.report.figures.svg import plain_svg
from pipeline.report.numbers import NOTHING
from pipeline.report.render.html import render_blocks, render_drawing
from pipeline.report.words import rich, with_symbols
from pipeline.schemas.base import Units
from pipeline.schemas.grade import Criterion, Flag, Grade

_MOST_REASONS = 30


def show(ask: Ask) -> Response:
    """Show a team."""
    return _page(ask)


def act(ask: Ask) -> Response:
    """Do what a button says: sign, accept, take the mark back, change points, undo."""
    shown = a_class(ask)
    team = a_team(ask, shown)
    book, name, what = ask.desk.books.book(ask.grades()), team.submission, ask.text("do")
    by = signed(ask)
    if what in ("accept", "unsee"):
        book.mark(name, by=by, seen=what == "accept")
    if what in ("sign", "unsee"):
        return ask.back(_address(ask, team.line.name))
    if what == "accept":
        wanted = Filter.read(ask.request.query_params)
        after = wanted.beside(shown, team.line.name)[1]
        return ask.back(_address(ask, after) if after else f"{ask.here}?{wanted.query}")
    criterion, seen = ask.text("criterion"), ask.text("seen")
    try:
        if what == "undo":
            book.undo(name, criterion, by=by, seen=seen)
        elif what == "change":
            points = read_points(ask.text("points"))
            book.change(name, criterion, points, why=ask.text("why"), by=by, seen=seen)
        else:
            raise HTTPException(400, "there is no such button")
    except Conflict as conflict:
        return _conflict(ask, shown, team, conflict)
    except ConfigError as error:
        text = str(error).replace(" (--why)", "").replace(" (--by)", "")
        return _page(ask, wrong={criterion: text}, status=422)
    return ask.back(_address(ask, team.line.name) + f"#criterion-{criterion}", "Noted.")


def figure(ask: Ask) -> Response:
    """Show one of a team's figures."""
    team = a_team(ask, a_class(ask))
    book = ask.desk.books.book(ask.grades())
    drawn = dict(book.figures(book.entry(team.submission)))
    name = ask.request.query_params.get("figure", "")
    if name not in drawn:
        raise HTTPException(404, "there is no such figure")
    return drawing_response(render_drawing(plain_svg(drawn[name])))


def _page(ask: Ask, *, wrong: dict[str, str] | None = None, status: int = 200) -> Response:
    shown = a_class(ask)
    team = a_team(ask, shown)
    book, name = ask.desk.books.book(ask.grades()), team.line.name
    now = book.team(team.submission)
    grade = now.entry.grade if shown.names is None else anonymise(now.entry.grade, shown.names)
    events = now.events
    if shown.names is not None:
        events = renamed_events(events, team.submission, name)
    before, after = Filter.read(ask.request.query_params).beside(shown, name)
    reasons = book.reasons()
    criteria = _criteria(grade, now, wrong=wrong or {}, ask=ask)
    left = []
    for file, svg in book.figures(now.entry):
        address = f"{ask.here}figure?{urlencode({'of': name, 'figure': file})}"
        about = [criterion for criterion in criteria if _shows(file, criterion)]
        # Of several, those who lost points by what it shows look there.
        beside = min(about, key=lambda criterion: not criterion["lost"], default=None)
        place = left if beside is None else beside["figures"]
        place.append({"address": address, "alt": alternative(svg)})
    return ask.page(
        "team",
        status=status,
        title=name,
        back=f"{ask.here}?{Filter.read(ask.request.query_params).query}",
        own=_address(ask, name),
        before=_address(ask, before) if before else "",
        after=_address(ask, after) if after else "",
        feedback=ask.here + feedback_link(name),
        grade=grade,
        points=points_text,
        seen=now.seen,
        criteria=criteria,
        flags=[_flag(ask, flag, shown, grade.units) for flag in grade.flags],
        figures=left,
        reasons={c: found[:_MOST_REASONS] for c, found in reasons.items()},
        events=[(to_the_second(event.at), event_words(event)) for event in reversed(events)],
        news=news_of(ask, shown, since=shown.state[1]),
        signature=signature(ask),
        wrong=(wrong or {}).get("", ""),
        said=ask.told(),
    )


def _criteria(
    grade: Grade, now: TeamNow, *, wrong: dict[str, str], ask: Ask
) -> list[dict[str, Any]]:
    """Return every criterion of the rubric, those that were never judged too."""
    judged = {criterion.id: criterion for criterion in grade.criteria}
    found = []
    for asked in now.rubric.criteria:
        own = judged.get(asked.id)
        given = now.entry.overrides.get(asked.id)
        failed = asked.id in wrong
        found.append(
            {
                "id": asked.id,
                "title": asked.title or asked.id,
                "points": points_text(own.points) if own else NOTHING,
                "out_of": points_text(asked.points),
                "outcome": WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
                "tone": TONES[own.outcome] if own else "quiet",
                "lost": own is not None and own.outcome in ("partial", "fail"),
                "evidence": _evidence(own, asked.check, grade.units) if own else "",
                "check": asked.check,
                "numbers": frozenset(own.found if own else ()),
                "figures": [],
                "version": now.versions[asked.id],
                "changed": asked.id in now.changed,
                "by_hand": f"by hand, {given.by}: {given.why}" if given else "",
                "typed": ask.text("points") if failed else points_text(own.points) if own else "",
                "why": ask.text("why") if failed else "",
                "wrong": wrong.get(asked.id, ""),
            }
        )
    return found


def _shows(file: str, criterion: dict[str, Any]) -> bool:
    """Tell whether a figure belongs beside a criterion: records by the numbers in them."""
    if numbers := numbers_in(file):
        return criterion["check"] == "initial" and not numbers.isdisjoint(criterion["numbers"])
    return is_response(file) and criterion["check"] == "final"


def _evidence(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return what was said and the numbers, theirs beside ours."""
    table = numbers_table(criterion, check=check, units=units, numbers=count(0))
    said = paragraph(rich(sentence(criterion.message)))
    return render_blocks([said, *([table] if table else [])])


def _flag(ask: Ask, flag: Flag, shown: Class, units: Units | None) -> dict[str, Any]:
    """Return a remark with its evidence; who shares a recording is a team to look at."""
    others = flag.evidence.get("submissions", ()) if flag.code == "shared_data" else ()
    table = evidence_table(flag, units=units, numbers=count(0))
    return {
        "title": WORDS.text(f"title_{flag.code}"),
        "text": with_symbols(sentence(flag.message)),
        "numbers": render_blocks([table]) if table else "",
        "others": [(name, _address(ask, name) if name in shown.teams else "") for name in others],
    }


def _conflict(ask: Ask, shown: Class, team: Team, conflict: Conflict) -> Response:
    """Show what somebody typed beside what it is now; nothing was changed."""
    now = ask.desk.books.book(ask.grades()).team(team.submission)
    criterion = ask.text("criterion")
    own = next((c for c in now.entry.grade.criteria if c.id == criterion), None)
    undoing = ask.text("do") == "undo"
    return ask.page(
        "conflict",
        status=409,
        title=f"{team.line.name}: {criterion}",
        typed={
            "points": "undo" if undoing else ask.text("points"),
            "why": ask.text("why"),
            "by": signature(ask),
        },
        now={
            "points": points_text(own.points) if own else "not judged",
            "why": conflict.now.why if conflict.now else "as graded",
            "by": conflict.now.by if conflict.now else "cartlab",
        },
        back=_address(ask, team.line.name),  # with a fragment it would be this page, not loaded
    )


def signed(ask: Ask) -> str:
    """Return who changes something: whom the proxy names, else what is typed, once."""
    if ask.user.name:
        return ask.user.name
    typed = ask.text("by") or ask.desk.books.signed
    if not typed:
        raise ConfigError("say who you are first: what is changed by hand has a name to it")
    ask.desk.books.signed = typed
    return typed


def _address(ask: Ask, name: str) -> str:
    """Return the address of a team, from which next and previous go on as before."""
    wanted = Filter.read(ask.request.query_params).query
    return f"{ask.here}team?{urlencode({'of': name})}" + (f"&{wanted}" if wanted else "")
