"""Give several teams the same points or comment: preview first, then change all or none."""

from functools import partial
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk.gradebooks import ClassView
from pipeline.desk.grades.review_order import Filter
from pipeline.desk.grades.team_page import write_address
from pipeline.desk.page_request import PageRequest
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import Conflict, WantedPoints, read_points
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.publish.feedback import sentence
from pipeline.grading.publish.pseudonyms import STRANGER
from pipeline.grading.rubric import Criterion
from pipeline.grading.total import list_steps
from pipeline.grading.words import WORDS, points_text
from pipeline.words.numbers import count
from pipeline.words.text import capital, with_symbols

_SAME = "same"  # value of the choice to leave points unchanged and only comment
_DONE = "bulk_change"  # part of a page where the result is reported


def apply(ask: PageRequest) -> Response:
    """Change all ticked teams, or undo a set of changes."""
    if ask.text("do") == "undo":
        return _undo(ask)
    shown, by = ask.class_view, ask.sign()
    asked = _find_criterion(ask, shown)
    ticked = ask.form.getlist("team")
    try:
        if not ticked:
            raise ConfigError("tick at least one team")
        typed = _read_typed(ask)
        wishes = [_wish(ask, shown, asked, str(name), typed=typed) for name in ticked]
        done = ask.gradebook.change_all(wishes, by=by)
    except Conflict:
        text = "Some of these teams have changed since this list was shown. Nothing was changed."
        return show(ask, wrong=text, status=409)
    except ConfigError as error:
        text = capital(str(error).replace(" (--why)", "").replace(" (--by)", ""))
        return show(ask, wrong=f"{text}. Nothing was changed.", status=422)
    message = f"{count(done.teams, 'team')} changed in “{capital(asked.title or asked.id)}”."
    if unchanged := len(wishes) - done.teams:
        message += f" {unchanged} had these points already."
    return ask.back(_address(ask, done=done.at if done.teams else ""), message, place=_DONE)


def _undo(ask: PageRequest) -> Response:
    """Undo a set of changes. Teams that were changed again since keep theirs and are named."""
    shown, book = ask.class_view, ask.gradebook
    if ask.text("set") not in [one.at for one in book.changed_together(least=1)]:
        raise HTTPException(404, "there is no such change in this class")
    undone = book.undo_all(ask.text("set"), by=ask.sign())
    message = f"{count(undone.teams, 'team')} undone."
    if undone.kept:
        names = {team.submission: name for name, team in shown.teams.items()}
        kept = ", ".join(sorted(names.get(one, STRANGER) for one in undone.kept))
        message += f" Kept, because they changed since: {kept}."
    if not ask.query("criterion"):  # the button was in the list on the class page
        return ask.back(f"{ask.here}#sets", message, place=_DONE)
    return ask.back(_address(ask, done=undone.at if undone.teams else ""), message, place=_DONE)


def _address(ask: PageRequest, *, done: str) -> str:
    """Return the URL of the page after a change; the page then offers to undo it.

    Parameters
    ----------
    done : time that identifies the set of changes.
    """
    kept = {key: ask.query(key) for key in ("criterion", "of")} | {"done": done}
    wanted = Filter.read(ask.request.query_params).query
    return f"{ask.here}bulk-change?{urlencode({k: v for k, v in kept.items() if v})}&{wanted}"


def _find_criterion(ask: PageRequest, shown: ClassView) -> Criterion:
    """Return the criterion that the URL names."""
    asked = shown.rubric.criterion(ask.query("criterion"))
    if asked is None:
        raise HTTPException(404, "the rubric has no such criterion")
    return asked


def _read_typed(ask: PageRequest) -> str:
    """Return the points that were typed or chosen, as text."""
    return ask.text("other") or ask.text("points") or _SAME


def _wish(
    ask: PageRequest, shown: ClassView, asked: Criterion, name: str, *, typed: str
) -> WantedPoints:
    """Return the change that the form requests for one team.

    Raises
    ------
    ConfigError : the team is not in the class, or cannot have these points.
    """
    if name not in shown.teams:
        raise ConfigError("a team is no longer in the class")
    team = shown.teams[name]
    points = None if typed == _SAME else read_points(typed)
    if typed == _SAME and asked.id not in team.grade.judged:
        raise ConfigError(f"{name}: has no points here yet; give points with the comment")
    if points is not None and not 0 <= points <= asked.points:
        raise ConfigError(f"expected 0 to {asked.points:g} points, found {points:g}")
    return WantedPoints(
        submission=team.submission,
        criterion=asked.id,
        points=points,
        why=ask.text("why"),
        comment=typed == _SAME,
        version=ask.text(f"seen.{name}"),
    )


def show(ask: PageRequest, *, wrong: str = "", status: int = 200) -> Response:
    """Show the teams with their points before and after the change."""
    shown = ask.class_view
    asked = _find_criterion(ask, shown)
    wanted = Filter.read(ask.request.query_params)
    typed = _read_typed(ask)
    try:
        rows = _list_rows(ask, shown, asked, typed=typed)
    except ConfigError as error:
        wrong, status = wrong or f"{capital(str(error))}.", 422
        rows = _list_rows(ask, shown, asked, typed=_SAME)
    steps = list_steps(asked.points, shown.rubric)
    versions = {name: now.version(asked.id) for name, now, _ in rows}
    team, sent = ask.query("of"), ask.sent.getlist("team")
    team_at = f"team?{urlencode({'of': team, 'criterion': asked.id})}"
    return ask.page(
        "bulk_change",
        status=status,
        title=_name_set(wanted),
        action=_address(ask, done=""),
        asked_for=parse_qsl(urlsplit(_address(ask, done="")).query),
        done=ask.query("done"),
        criterion=capital(asked.title or asked.id),
        out_of=points_text(asked.points),
        steps=steps,
        chosen=typed if typed in (*steps, _SAME) else "",
        other="" if typed in (*steps, _SAME) else typed,
        why=ask.text("why"),
        usual=next(iter(ask.gradebook.reasons().get(asked.id, [])), ""),
        rows=rows,
        earned=partial(_earned, asked),
        message=partial(_message, asked),
        versions=versions,
        ticked=[name for name in versions if name in sent or ask.text("listed") != "1"],
        # Teams whose points somebody has changed since the list was shown.
        moved=[
            name
            for name, now in versions.items()
            if ask.request.method == "POST" and ask.text(f"seen.{name}") not in ("", now)
        ],
        address=partial(write_address, ask, criterion=asked.id),
        wrong=wrong,
        back=ask.here + (team_at if team in shown.teams else f"?{wanted.query}"),
        team=team if team in shown.teams else "",
        wider=_widen(ask, shown, wanted),
    )


def _earned(asked: Criterion, entry: Entry) -> str:
    """Return the points of a criterion as text."""
    own = entry.grade.criterion(asked.id)
    return points_text(own.points) if own else "not judged"


def _message(asked: Criterion, entry: Entry) -> str:
    """Return the message of a criterion to the team."""
    own = entry.grade.criterion(asked.id)
    return with_symbols(sentence(own.message)) if own else ""


def _name_set(wanted: Filter) -> str:
    """Return the title of the page, from its filter."""
    if wanted.flag:
        slip = f": {wanted.slip}" if wanted.slip not in ("", "-") else ""
        return capital(WORDS.text(f"title_{wanted.flag}")) + slip
    return "Points lost" if wanted.lost else "Several teams"


def _widen(ask: PageRequest, shown: ClassView, wanted: Filter) -> tuple[str, int] | None:
    """Return a link to all teams with the flag, and their number.

    Returns None if the page already shows all teams with the flag.
    """
    if not (wanted.flag and wanted.lost):
        return None
    wide = Filter(flag=wanted.flag, slip=wanted.slip)
    many = len(wide.chosen(shown))
    if many == len(wanted.chosen(shown)):
        return None
    about = {key: ask.query(key) for key in ("criterion", "of") if ask.query(key)}
    return f"{ask.here}bulk-change?{urlencode(about)}&{wide.query}", many


def _list_rows(
    ask: PageRequest, shown: ClassView, asked: Criterion, *, typed: str
) -> list[tuple[str, Entry, Entry]]:
    """Return the teams that pass the filter or were in the form, before and after the change."""
    sent = ask.sent.getlist("team")
    names = [team.grade.submission for team in Filter.read(ask.request.query_params).chosen(shown)]
    names += [str(name) for name in sent if name in shown.teams and name not in names]
    if ask.query("done"):  # the change is done, so nothing is left to preview
        names = []
    if typed == _SAME:  # a criterion that was never judged has no points to keep
        names = [name for name in names if asked.id in shown.teams[name].grade.judged]
    wishes = [_wish(ask, shown, asked, name, typed=typed) for name in names]
    tried = {both[0].submission: both for both in ask.gradebook.preview_all(wishes)}
    own = ((name, tried.get(shown.teams[name].submission)) for name in names)
    return [(name, *both) for name, both in own if both]
