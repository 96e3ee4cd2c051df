"""The page of a team: its points with the evidence, and the decisions of a person."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.desk import served_files
from pipeline.desk.gradebooks import ClassView
from pipeline.desk.grades.class_page import list_news, may_release
from pipeline.desk.grades.grading_form import start_grading
from pipeline.desk.grades.review_order import Filter
from pipeline.desk.jobs import Busy
from pipeline.desk.last_report import PLOTS, PLOTS_OF
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import show_drawing
from pipeline.desk.shown_criterion import show_message, show_numbers
from pipeline.errors import ConfigError
from pipeline.grading.grade import Criterion, Flag, Grade
from pipeline.grading.gradebook.decisions import Conflict, read_points
from pipeline.grading.gradebook.events import TOTAL, Entry, Event
from pipeline.grading.gradebook.history import event_words, to_the_second
from pipeline.grading.intake.files import digest
from pipeline.grading.intake.repairs import (
    FOLDER,
    Repair,
    read_original,
    read_repairs,
    read_run,
    save_repair,
    text_key,
)
from pipeline.grading.publish.class_page import feedback_link
from pipeline.grading.publish.feedback import TONES, alternative, evidence_table, sentence
from pipeline.grading.publish.feedback_figures import is_response, numbers_in
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.rubric import Rubric, find_remarks, is_about
from pipeline.grading.total import list_steps
from pipeline.grading.words import WORDS, person_lines, points_text, slip_of
from pipeline.names import read_name
from pipeline.output import LOCK
from pipeline.processes import Failed
from pipeline.report.html import render_blocks, render_drawing
from pipeline.setup import Units
from pipeline.submission.load import NAME, file_problem
from pipeline.words.numbers import NOTHING
from pipeline.words.text import capital, name_span, with_symbols

_POINTS = "points"  # part of the page where points are changed
_TOTAL = "total"  # part of the page where the total is changed
# Files that making the plots adds to a folder.
_ADDED = (PLOTS, PLOTS_OF, f"{Path(PLOTS).parent.name}/{LOCK}")
_MOST_PAPERS = 20  # PDF files listed


@dataclass(frozen=True, kw_only=True)
class Item:
    """A row in the list on a team's page: a criterion, or a flag that concerns no criterion.

    Attributes
    ----------
    id : id of the criterion, or code of the flag.
    lost : points lost in the automatic grading. Points given by hand do not count, so the row
        stays in its place.
    doubt : whether a person should look or has looked: points were lost, the criterion was not
        judged, or there is a flag or points given by hand.
    """

    id: str
    is_remark: bool = False
    title: str
    points: str = ""
    outcome: str = ""
    tone: str = ""
    lost: float = 0.0
    doubt: bool = True
    by_hand: bool = False


def may_remove(ask: PageRequest, team: Entry) -> bool:
    """Return whether the person may take a submission off the class list: one without a grade."""
    return team.grade.status == "failed" and may_release(ask)


def act(ask: PageRequest) -> Response:
    """Do what the pressed button says: sign, accept, unmark, change points, or undo."""
    shown, team = ask.class_view, ask.team
    book, name, what = ask.gradebook, team.submission, ask.text("do")
    by = ask.sign()
    if what == "unsee":
        book.set_reviewed(name, by=by, reviewed=False)
    if what == "remove" and may_remove(ask, team):
        book.remove([name])
        text = f"{team.grade.submission}: no longer in the class. Its history stays."
        return ask.back(ask.here, text)
    try:
        if what == "hold":
            book.hold(name, why=ask.text("why"), by=by)
        if what == "let_go" and may_release(ask):
            book.let_go(name, by=by)
    except ConfigError as error:
        return ask.back(write_address(ask, team.grade.submission), f"{capital(str(error))}.")
    if what in ("sign", "unsee", "hold", "let_go"):
        return ask.back(write_address(ask, team.grade.submission))
    if what == "accept":
        seen = ask.text("version") or team.whole_version
        if book.accept_all({name: seen}, by=by).kept:
            text = f"{team.grade.submission}: changed since this page was shown. Look again."
            return ask.back(write_address(ask, team.grade.submission), text)
        wanted = Filter.read(ask.request.query_params)
        after = _find_next(shown, wanted, team)
        to = write_address(ask, after) if after else f"{ask.here}?{wanted.query}"
        return ask.back(to, f"{team.grade.submission}: accepted.")
    criterion, seen = TOTAL if what == "adjust" else ask.text("criterion"), ask.text("seen")
    if what == "repair":
        return _repair(ask, team, by=by)
    try:
        if what == "adjust":
            points = read_points(ask.text("points"))
            book.change(name, TOTAL, points, why=ask.text("why"), by=by, version=seen)
        elif what == "undo" and criterion != TOTAL:
            book.undo(name, criterion, by=by, version=seen)
        elif what == "change":
            points = read_points(ask.text("other") or ask.text("points"))
            book.change(name, criterion, points, why=ask.text("why"), by=by, version=seen)
        else:
            raise HTTPException(400, "there is no such button")
    except Conflict as conflict:
        return _show_conflict(ask, team.grade.submission, conflict)
    except ConfigError as error:
        text = str(error).replace(" (--why)", "").replace(" (--by)", "")
        return show(ask, wrong=text, status=422)
    if what == "adjust":
        return ask.back(
            f"{write_address(ask, team.grade.submission)}#total", "Saved.", place=_TOTAL
        )
    wanted = Filter.read(ask.request.query_params)
    if what == "change" and criterion == wanted.by:
        after = wanted.beside(shown, team.grade.submission)[1]
        to = write_address(ask, after) if after else f"{ask.here}?{wanted.query}"
        return ask.back(to, f"{team.grade.submission}: saved.")
    to = write_address(ask, team.grade.submission, criterion=criterion)
    done = "Undone." if what == "undo" else "Saved."
    return ask.back(f"{to}#chosen", done, place=_POINTS)


def _find_next(shown: ClassView, wanted: Filter, team: Entry) -> str:
    """Return the team to review after this one: the next that is left, or the first; "" if none."""
    left = wanted if wanted.seen else replace(wanted, seen="no")
    after = left.beside(shown, team.grade.submission)[1]
    return after or next((o.grade.submission for o in left.chosen(shown) if o != team), "")


def _repair(ask: PageRequest, team: Entry, *, by: str) -> Response:
    """Save a repaired `submission.toml` of a team if it is valid, and grade the class again."""
    place, text = ask.place_or_404(), ask.text("text").replace("\r\n", "\n")
    if not isinstance(place, Path) or team.rubric.anonymous:
        raise HTTPException(404, "this file cannot be repaired here")
    repair = Repair(text=text, by=by, why=ask.text("why"))
    try:
        repairs = str(place / FOLDER / team.submission)
        ask.desk.workers.do("check_repair", folder=repairs, text=text)
        save_repair(place, team.submission, repair, of=ask.text("of_text"))
    except (ConfigError, Failed) as error:
        return show(ask, wrong_repair=str(error), status=422)
    message = "Saved. It counts when the class is graded again."
    if run := read_run(place):
        with suppress(Busy):  # another job is running in this folder
            start_grading(ask, run, place)
            message = "Saved. The team is being graded again: load this page again in a moment."
    return ask.back(write_address(ask, team.grade.submission), message)


def _show_repair(ask: PageRequest, team: Entry, *, wrong: str) -> dict[str, str] | None:
    """Return what the form for the repair of `submission.toml` shows; None if it is not offered."""
    place = ask.place_or_404()
    if not isinstance(place, Path) or team.rubric.anonymous:
        return None
    original = read_original(place, team.submission)
    if original is None:
        return None
    key = text_key(original)
    known = read_repairs(place, team.submission).get(key)
    typed = {"text": ask.text("text"), "why": ask.text("why")} if wrong else {}
    return {
        "of_text": key,
        "original": original if known else "",
        "text": known.text if known else original,
        "why": known.why if known else "",
        "wrong": wrong,
        **typed,
    }


def show_figure(ask: PageRequest) -> Response:
    """Show one of a team's figures."""
    drawn = dict(ask.gradebook.figures(ask.team))
    name = ask.query("figure")
    if name not in drawn:
        raise HTTPException(404, "there is no such figure")
    return show_drawing(render_drawing(drawn[name]))


def send_paper(ask: PageRequest) -> Response:
    """Send a PDF that a team submitted."""
    folder, name = _find_recordings(ask, ask.team), ask.query("file")
    if folder is None or name not in _list_papers(folder):
        raise HTTPException(404, "there is no such file")
    return served_files.send_paper(folder, name)


def show(
    ask: PageRequest, *, wrong: str = "", wrong_repair: str = "", status: int = 200
) -> Response:
    """Show a team, and why a form was refused."""
    shown, team = ask.class_view, ask.team
    grade, name = team.grade, team.grade.submission
    hidden = name if team.rubric.anonymous else ""
    _, events = ask.gradebook.history(team.submission, shown_as=hidden)
    wanted = Filter.read(ask.request.query_params)
    before, after = wanted.beside(shown, name)
    items = list_items(team)
    chosen = _find_chosen(ask, items, team.rubric)
    folder, repair = _find_recordings(ask, team), _show_repair(ask, team, wrong=wrong_repair)
    return ask.page(
        "team",
        status=status,
        title=name,
        back=f"{ask.here}?{wanted.query}",
        own=write_address(ask, name),
        before=write_address(ask, before) if before else "",
        after=write_address(ask, after) if after else "",
        feedback=ask.here + feedback_link(name),
        grade=grade,
        person_lines=person_lines(grade),
        total=_describe_total(ask, team, wrong=wrong),
        seen=team.reviewed_by,
        whole_version=team.whole_version,
        may_remove=may_remove(ask, team),
        hold=team.hold,
        may_let_go=may_release(ask),
        by=wanted.by,
        items=_link_items(ask, name, items, chosen),
        doubts=sum(item.doubt for item in items),
        events=[(to_the_second(event.at), event_words(event)) for event in reversed(events)],
        news=list_news(ask, shown, since=shown.state[1]),
        repair=repair,
        requests={criterion: request.state for criterion, request in team.requests.items()},
        recordings=folder,
        # A worker makes the HTML, because the desk parses no file of a team.
        notes=Markup(ask.desk.workers.do("render_notes", folder=str(folder))) if folder else "",
        papers=[
            (paper, f"{ask.here}paper?{urlencode({'of': name, 'file': paper})}")
            for paper in (_list_papers(folder) if folder else ())
        ],
        requests_at=f"{ask.here}requests?{urlencode({'of': name})}",
        **_show_chosen(ask, shown, team, chosen=chosen, wrong=wrong),
    )


def _describe_total(ask: PageRequest, team: Entry, *, wrong: str) -> dict[str, str]:
    """Return what the form for an adjustment shows; a refused one is shown as it was typed."""
    refused = bool(wrong) and ask.text("do") == "adjust"
    return {
        "version": team.version(TOTAL),
        "points": ask.text("points") if refused else "",
        "why": ask.text("why") if refused else "",
        "wrong": wrong if refused else "",
    }


def _find_chosen(ask: PageRequest, items: Sequence[Item], rubric: Rubric) -> Item:
    """Return the criterion or flag that the URL or the form names.

    Without a name, return the first row that is in doubt or has a figure.
    """
    criterion = ask.text("criterion") or ask.query("criterion")
    criterion = criterion or ("" if ask.query("remark") else ask.query("by"))
    for wanted, is_remark in ((criterion, False), (ask.query("remark"), True)):
        for item in items:
            if wanted == item.id and is_remark == item.is_remark:
                return item
    shown = {asked.id for asked in rubric.criteria if asked.check == "final"}
    first = [item for item in items if item.id in shown or item.doubt]
    return first[0] if first else items[0]


def _link_items(
    ask: PageRequest, name: str, items: Sequence[Item], chosen: Item
) -> list[tuple[Item, str, str]]:
    """Return each row of the list with its address, and the key that opens it."""
    at = items.index(chosen)
    keys = {at - 1: "k", at + 1: "j"}
    return [
        (item, write_address(ask, name, **{"remark" if item.is_remark else "criterion": item.id}),
         keys.get(number, ""))
        for number, item in enumerate(items)
    ]  # fmt: skip


def _show_chosen(
    ask: PageRequest, shown: ClassView, team: Entry, *, chosen: Item, wrong: str
) -> dict[str, Any]:
    """Return what is shown next to the list: the chosen criterion or flag, with its evidence."""
    grade, drawn = team.grade, ask.gradebook.figures(team)
    name, asked = grade.submission, team.rubric.criterion(chosen.id)
    if chosen.is_remark or asked is None:
        asked, one, flags = None, None, [flag for flag in grade.flags if flag.code == chosen.id]
    else:
        own = bool(wrong) and ask.text("do") != "adjust"
        typed = {key: ask.text(key) for key in ("points", "other", "why")} if own else {}
        one = describe_criterion(asked, team, typed=typed | ({"wrong": wrong} if own else {}))
        flags = find_remarks(grade, asked, team.rubric)
    own = grade.criterion(asked.id) if asked else None
    figures = show_figures(drawn, asked, own, first=ask.query("figure")) if asked else []
    reasons = ask.gradebook.reasons().get(asked.id, [])[:30] if asked else []
    return {
        "one": one,
        "chosen": chosen,
        "flags": [
            describe_flag(flag, grade.units) | {"others": _link_others(ask, shown, flag)}
            for flag in flags
        ],
        "bulk_changes": _link_bulk_changes(ask, shown, grade, one, flags) if one else [],
        "figures": _link_figures(ask, name, figures, chosen),
        "others": _link_figures(ask, name, show_figures(drawn, None, None), chosen),
        "reasons": reasons,
        "usual": (one and one["own_reason"]) or next(iter(reasons), ""),
    }


def _link_figures(
    ask: PageRequest, name: str, figures: Sequence[dict[str, str]], chosen: Item
) -> list[dict[str, str]]:
    """Add two addresses to each figure: its own, and that of the page that shows it first."""
    found = []
    for figure in figures:
        own = {"of": name, "figure": figure["file"]}
        choose = write_address(ask, name, criterion=chosen.id, figure=figure["file"])
        address = f"{ask.here}figure?{urlencode(own)}"
        found.append(figure | {"address": address, "choose": choose})
    return found


def _link_others(ask: PageRequest, shown: ClassView, flag: Flag) -> list[tuple[str, str]]:
    """Return the submissions that share a recording, with addresses for those in the class."""
    names = flag.evidence.get("submissions", ()) if flag.code == "shared_data" else ()
    return [(name, write_address(ask, name) if name in shown.teams else "") for name in names]


def _link_bulk_changes(
    ask: PageRequest, shown: ClassView, grade: Grade, one: dict[str, Any], flags: Sequence[Flag]
) -> list[tuple[str, str]]:
    """Return links, with their text, to apply the same points to all teams with the same flag."""
    lost = one["id"] if one["lost"] else ""
    sets = list(dict.fromkeys(_same_slip(shown, flag, lost=lost) for flag in flags))
    if lost and not sets:
        sets = [(Filter(lost=lost), "points lost here")]
    found = []
    for wanted, title in sets:
        many = len(wanted.chosen(shown))
        if many > 1:
            about = {"criterion": one["id"], "of": grade.submission}
            if one["by_hand"]:  # the decision for this team is offered for all
                points = "same" if one["is_comment"] else one["points"]
                about |= {"points": points, "why": one["own_reason"]}
            address = f"{ask.here}bulk-change?{urlencode(about)}&{wanted.query}"
            found.append((address, f"Apply to the {many} teams with {title}"))
    return found


def _same_slip(shown: ClassView, flag: Flag, *, lost: str) -> tuple[Filter, str]:
    """Return the filter for the teams with the same kind of mistake, and its name.

    Teams with the same flag may have made other mistakes, and one decision is not right for all.
    """
    every, title = Filter(flag=flag.code, lost=lost), WORDS.text(f"title_{flag.code}")
    slip = slip_of(flag.evidence)
    same = replace(every, slip=slip)
    if len(same.chosen(shown)) == len(every.chosen(shown)):
        return every, title
    return same, f"{title}: {'of no known kind' if slip == '-' else slip}"


def _show_conflict(ask: PageRequest, name: str, conflict: Conflict) -> Response:
    """Show what a person typed next to the current state; nothing was changed."""
    now = ask.class_view.team(name)
    criterion = ask.text("criterion")
    own = now.grade.criterion(criterion)
    undoing = ask.text("do") == "undo"
    return ask.page(
        "conflict",
        status=409,
        title=f"{name}: {capital(now.rubric.titles.get(criterion, criterion))}",
        typed={
            "points": "undo" if undoing else ask.text("other") or ask.text("points"),
            "why": ask.text("why"),
            "by": ask.signature,
        },
        now={
            "points": points_text(own.points) if own else "not judged",
            "why": conflict.now.text if conflict.now else "as graded",
            "by": conflict.now.by if conflict.now else "cartlab",
        },
        # With a fragment, the browser would stay on this page without loading it again.
        back=write_address(ask, name, criterion=criterion),
    )


def write_address(ask: PageRequest, name: str, **more: str) -> str:
    """Return the URL of a team's page; it keeps the filter, so that next and previous work."""
    asked = ask.request.query_params
    kept = {key: asked[key].strip() for key in Filter.__dataclass_fields__ if key in asked}
    wanted = {key: value for key, value in kept.items() if value}
    return f"{ask.here}team?{urlencode({'of': name, **more, **wanted})}"


# ------------------------------------------------------- criteria and flags


def list_items(team: Entry) -> list[Item]:
    """Return the rows: those in doubt first, flags before criteria, then by points lost."""
    grade, rubric = team.grade, team.rubric
    items = [
        Item(id=flag.code, is_remark=True, title=capital(WORDS.text(f"title_{flag.code}")))
        for flag in grade.flags
        if not any(is_about(flag, asked, rubric) for asked in rubric.criteria)
    ]
    for asked in rubric.criteria:
        own = grade.criterion(asked.id)
        flagged = any(is_about(flag, asked, rubric) for flag in grade.flags)
        earned = points_text(own.points) if own and own.id not in grade.open else NOTHING
        by_hand = asked.id in team.overrides
        items.append(
            Item(
                id=asked.id,
                title=capital(asked.title or asked.id),
                points=f"{earned} / {points_text(asked.points)}",
                outcome=WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
                tone=TONES[own.outcome] if own else "quiet",
                lost=asked.points - team.automatic.get(asked.id, asked.points),
                doubt=own is None or own.outcome != "pass" or flagged or by_hand,
                by_hand=by_hand,
            )
        )
    return sorted(items, key=lambda item: (not item.doubt, not item.is_remark, -item.lost))


def describe_criterion(asked: Asked, team: Entry, *, typed: Mapping[str, str]) -> dict[str, Any]:
    """Return what the page shows of a criterion, even if it was never judged.

    Parameters
    ----------
    typed : fields of a refused form (points, other, why), and why it was refused (wrong).
    """
    grade, own = team.grade, team.grade.criterion(asked.id)
    by_hand = team.overrides.get(asked.id) or team.comments.get(asked.id)
    points = points_text(own.points) if own and own.id not in grade.open else ""
    steps = list_steps(asked.points, team.rubric)
    chosen = typed.get("points") or points
    other = typed.get("other", "") or ("" if chosen in steps else chosen)
    return {
        "id": asked.id,
        "title": capital(asked.title or asked.id),
        "is_manual": asked.check == "manual",
        "points": points or NOTHING,
        "out_of": points_text(asked.points),
        "outcome": WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
        "tone": TONES[own.outcome] if own else "quiet",
        "lost": asked.id in grade.lost,
        "text": show_message(own) if own else "",
        "numbers": show_numbers(own, asked.check, grade.units) if own else "",
        "steps": steps,
        "chosen": "" if other else chosen,
        "other": other,
        "why": typed.get("why", ""),
        "wrong": typed.get("wrong", ""),
        "version": team.version(asked.id),
        "changed": asked.id in team.given,
        "by_hand": _describe_by_hand(by_hand) if by_hand else "",
        "is_comment": by_hand is not None and by_hand.what == "comment",
        "own_reason": by_hand.text if by_hand else "",
    }


def _describe_by_hand(by_hand: Event) -> str:
    what = "Comment by" if by_hand.what == "comment" else "Points by hand,"
    return f"{what} {by_hand.by}: {by_hand.text}"


def describe_flag(flag: Flag, units: Units | None) -> dict[str, Any]:
    """Return a flag as text, with the numbers that support it."""
    table = evidence_table(flag, units=units, numbers=count(0))
    return {
        "code": flag.code,
        "name": WORDS.text(f"title_{flag.code}"),
        "title": capital(WORDS.text(f"title_{flag.code}")),
        "text": with_symbols(sentence(flag.message)),
        "numbers": render_blocks([table]) if table else "",
    }


def show_figures(
    drawn: Sequence[tuple[str, str]], asked: Asked | None, own: Criterion | None, *, first: str = ""
) -> list[dict[str, str]]:
    """Return the figures of a criterion; the one with the largest relative error comes first.

    Without a criterion, the figures that belong to no criterion are returned.

    Parameters
    ----------
    drawn : file name and SVG of each figure.
    own : the criterion as judged; None if it was not judged.
    first : file that the person wants to see first.
    """
    worst = _find_worst(own) if own else ""
    about = [(file, svg) for file, svg in drawn if _belongs(file, asked, own)]
    about.sort(key=lambda one: (one[0] != first, not _shows(one[0], worst)))
    return [{"file": file, "short": _shorten(file), "alt": alternative(svg)} for file, svg in about]


def _belongs(file: str, asked: Asked | None, own: Criterion | None) -> bool:
    """Return whether a figure belongs to a criterion."""
    numbers = numbers_in(file)
    if asked is None:
        return not numbers and not is_response(file)
    if numbers:
        about = asked.check in ("initial", "initial_final")
        return about and own is not None and not numbers.isdisjoint(own.found)
    return is_response(file) and asked.check == "final"


def _shorten(file: str) -> str:
    """Return the text of the button for a figure."""
    if is_response(file):
        return f"cart {file.removesuffix('.svg').rpartition('-')[2]}"
    return ", ".join(name_span(name).text for name in sorted(numbers_in(file))) or file


def _find_worst(own: Criterion) -> str:
    """Return the number with the largest relative error; "" if none can be compared."""
    ratios = {}
    for name, expected in own.expected.items():
        found = own.found.get(name)
        if _is_positive(found) and _is_positive(expected):
            ratios[name] = max(found / expected, expected / found)
    return max(ratios, key=lambda name: ratios[name], default="")


def _is_positive(value: Any) -> bool:
    return isinstance(value, float | int) and value > 0


def _shows(file: str, name: str) -> bool:
    """Return whether a figure shows the recording of a number, or the response of its cart."""
    if is_response(file):
        return bool(name) and file.endswith(f"-{read_name(name).cart}.svg")
    return name in numbers_in(file)


# ------------------------------------------------------- the folder that was graded


def _list_papers(folder: Path) -> list[str]:
    """Return the PDF files in a submission's folder, by their paths in it."""
    files = (file for file in folder.rglob("*") if file.suffix.lower() == ".pdf")
    names = sorted(file.relative_to(folder).as_posix() for file in files)
    return list(islice((n for n in names if file_problem(folder, n) is None), _MOST_PAPERS))


def _find_recordings(ask: PageRequest, team: Entry) -> Path | None:
    """Return the folder that was graded; None if it is not found or not allowed.

    A gradebook stores no folder, so the folder is looked for on this computer. Its
    files must be those that were graded, because a later version would show other
    recordings. Plots that were added since do not matter.
    """
    if not ask.user.owns or team.rubric.anonymous:
        return None
    graded = team.key.rpartition("-")[2]
    for folder in dict.fromkeys(_list_candidates(ask, team.submission)):
        if (folder / NAME).is_file():
            if graded in (digest([folder], without=added) for added in ((), _ADDED)):
                return folder
    return None


def _list_candidates(ask: PageRequest, name: str) -> Iterator[Path]:
    """Yield folders that may be the submission: open ones, graded ones, or near the gradebook."""
    place = ask.place_or_404()
    yield from (folder for folder in ask.user.folders if folder.name == name)
    if isinstance(place, Path):
        run = read_run(place)
        for path in run.paths if run else ():
            yield from (Path(path), Path(path) / name)
        yield place.parent / name
        yield from (beside / name for beside in sorted(place.parent.iterdir()))
