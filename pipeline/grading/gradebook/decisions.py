"""What people want to change: tables of changes, and decisions about a submission.

Each function about a decision checks it and returns the events to store.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from math import floor
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.events import TOTAL, Entry, Event, Request
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import exact
from pipeline.grading.words import points_text
from pipeline.submission.toml import nearest
from pipeline.words.text import clean

_HEADS = ("submission", "criterion", "points", "why")  # columns of a table of requested changes


def read_points(text: str) -> float | None:
    """Return the points that a person typed, or None for "auto".

    Raises
    ------
    ConfigError : the text is neither points nor "auto".
    """
    if text.strip().casefold() == "auto":
        return None
    try:
        return float(text.replace(",", "."))
    except ValueError:
        raise ConfigError(f"{text}: expected a number of points, or auto") from None


def check_step(points: float, *, out_of: float, step: float) -> None:
    """Refuse points that are not a multiple of the rubric's step; all points are always allowed.

    Raises
    ------
    ConfigError : the message names the nearest points that are allowed.
    """
    steps = exact(points) / exact(step)
    if steps.denominator == 1 or points == out_of:
        return
    below = floor(steps) * exact(step)
    above = min(below + exact(step), exact(out_of))
    raise ConfigError(
        f"{points:g} points are not a multiple of the rubric's step, {step:g}: "
        f"give {float(below):g} or {float(above):g}"
    )


@dataclass(frozen=True, kw_only=True)
class WantedPoints:
    """A change that a person requests: points or a comment for one criterion of a submission.

    Attributes
    ----------
    points : requested points; None for the automatic points.
    comment : whether `why` is only a comment for the team.
    line : line number in the table that requests the change; 0 without a table.
    version : version of the points that the person saw, from `Entry.version`; "" to change any.
    """

    submission: str
    criterion: str
    points: float | None
    why: str
    comment: bool = False
    line: int = 0
    version: str = ""


def read_wishes(path: Path, *, why: str = "") -> list[WantedPoints]:
    """Read requested changes from a CSV file of one of two forms.

    Either each row is a change, with the columns submission, criterion, points and why; or each row
    is a submission, with a column for each criterion, in which an empty cell changes nothing. The
    column why is optional if `why` is given. The word "auto" stands for the automatic points.

    Parameters
    ----------
    why : the reason for changes without a reason of their own.

    Raises
    ------
    ConfigError : the table is not valid; the message names the line.
    """
    table = read_table(path, exact=True)
    by_row = {"criterion", "points"} <= set(table.columns)
    needed = [name for name in (_HEADS if by_row else ("submission", "why"))
              if name != "why" or not why]  # fmt: skip
    missing = [name for name in needed if name not in table.columns]
    if missing or not table.columns.is_unique:
        form = _HEADS if by_row else ("submission", "why", "one for each criterion")
        raise ConfigError(
            f"{path.name}: needs the columns {', '.join(form)}, each once"
            + (f"; it lacks {', '.join(missing)}" if missing else "")
        )
    criteria = [name for name in table.columns if name and name not in _HEADS]
    wishes: list[WantedPoints] = []
    seen: dict[tuple[str, str], int] = {}
    for line, row in table.iterrows():
        cells = {str(name): str(cell).strip() for name, cell in row.items()}
        asked = {name: cells[name] for name in criteria if cells[name]}
        if by_row:
            asked = {cells["criterion"]: cells["points"]}
        for criterion, points in asked.items():
            try:
                given = read_points(points)
            except ConfigError as error:
                at = "" if by_row else f", column {criterion}"
                raise ConfigError(f"{path.name} line {line}{at}: {error}") from None
            first = seen.setdefault((cells["submission"], criterion), int(str(line)))
            if first != int(str(line)):
                who = f"{cells['submission']}, {criterion}"
                raise ConfigError(f"{path.name} line {line}: {who} is already in line {first}")
            wishes.append(
                WantedPoints(
                    submission=cells["submission"],
                    criterion=criterion,
                    points=given,
                    why=cells.get("why") or why,
                    line=int(str(line)),
                )
            )
    return wishes


MOST_LETTERS = 1_000  # characters of a reason or an answer: about one paragraph
MOST_OPEN = 4  # waiting requests per submission; a team with more doubts should talk to a TA


class Conflict(ConfigError):
    """A change is refused, because the criterion has changed in the meantime.

    `now` holds the last points given by hand, or None.
    """

    def __init__(self, text: str, *, now: Event | None) -> None:
        super().__init__(text)
        self.now = now


class RequestRefused(ConfigError):
    """A request or an answer is refused; the message explains why to the person who wrote it."""


# ---------------------------------------------------------------------- points by hand


def check_version(entry: Entry, criterion: str, version: str) -> None:
    """Refuse a change that is based on another version of a criterion's points.

    Raises
    ------
    Conflict : somebody else changed the points, or the submission was graded again.
    """
    if version != entry.version(criterion):
        raise Conflict(
            f"{criterion}: was changed or graded again after this page was shown",
            now=entry.given.get(criterion),
        )


def give(entry: Entry, wanted: WantedPoints) -> Event:
    """Give points or a comment, or change the total.

    Raises
    ------
    ConfigError : the criterion does not exist, the points are out of range, or a reason is missing.
    """
    criterion, points, text = wanted.criterion, wanted.points, wanted.why.strip()
    if not text:
        raise ConfigError("a change of points needs a reason (--why) and a name (--by)")
    if criterion == TOTAL:
        if points is None or not math.isfinite(points) or points == 0:
            raise ConfigError(f"expected points to add or deduct, such as -2, found {points}")
        return Event(what="adjusted", criterion=TOTAL, points=points, text=text)
    out_of = {asked.id: asked.points for asked in entry.rubric.criteria}
    if criterion not in out_of:
        hint = nearest(criterion, list(out_of))
        raise ConfigError(f"{criterion}: the rubric has no such criterion{hint}")
    if points is not None:
        if not 0 <= points <= out_of[criterion]:
            raise ConfigError(
                f"{criterion}: expected 0 to {out_of[criterion]:g} points, found {points:g}; "
                "to deduct from the total, or to add to it, use cartlab adjust"
            )
        # Points that were given once may be restored after a change of the rubric's step.
        if not any((e.criterion, e.points) == (criterion, points) for e in entry.events):
            check_step(points, out_of=out_of[criterion], step=entry.rubric.step)
    return as_event(wanted, text=text)


def as_event(wanted: WantedPoints, *, text: str) -> Event:
    """Return the event of points, or of a comment, for a criterion."""
    what = "comment" if wanted.comment else "override"
    return Event(what=what, criterion=wanted.criterion, points=wanted.points, text=text)


def change(entry: Entry, wanted: WantedPoints) -> Event:
    """Set the points of a criterion; if it already has them, only add the reason as a comment.

    A comment on points given by hand keeps them and replaces their reason.
    """
    if not wanted.comment and is_unchanged(wanted.points, entry.grade, wanted.criterion):
        wanted = replace(wanted, points=None, comment=True)
    return give(entry, beside(entry, wanted))


def beside(entry: Entry, wanted: WantedPoints) -> WantedPoints:
    """Return the change to store: a comment keeps points given by hand, with the new reason."""
    given = entry.overrides.get(wanted.criterion)
    if not wanted.comment or given is None:
        return wanted
    return replace(wanted, points=given.points, comment=False)


def undo(entry: Entry, criterion: str) -> Event:
    """Undo the last change of a criterion; a second call redoes it.

    Raises
    ------
    ConfigError : nothing was changed by hand.
    """
    changes = entry.changes(criterion)
    if not changes:
        raise ConfigError(f"{criterion}: nothing was changed by hand")
    before = changes[-2] if len(changes) > 1 else None
    wanted = WantedPoints(submission=entry.submission, criterion=criterion, points=None, why="")
    if criterion == TOTAL:
        return give(entry, replace(wanted, points=-(changes[-1].points or 0.0), why="taken back"))
    if before is None or (before.points is None and before.what == "override"):
        return give(entry, replace(wanted, why="taken back"))
    comment = before.what == "comment"
    return give(entry, replace(wanted, points=before.points, why=before.text, comment=comment))


def hold(entry: Entry, held: bool, *, why: str = "") -> Event:
    """Hold a grade back, or no longer.

    Raises
    ------
    ConfigError : the reason is missing, or the grade is in this state already.
    """
    return _hold(held, bool(entry.hold), why=why)


def hold_criterion(
    criterion: str, held: bool, before: Collection[str], rubric: Rubric, *, why: str
) -> Event:
    """Hold a criterion back for the whole class, or no longer.

    Parameters
    ----------
    before : the criteria that are held back already.

    Raises
    ------
    ConfigError : the rubric has no such criterion or no other one to show, the reason is missing,
        or the criterion is in this state already.
    """
    if criterion not in rubric.titles:
        hint = nearest(criterion, [*rubric.titles])
        raise ConfigError(f"{criterion}: the rubric has no such criterion{hint}")
    if held and rubric.titles.keys() <= {*before, criterion}:
        raise ConfigError("no criterion would be left: do not publish the grades instead")
    return replace(_hold(held, criterion in before, why=why), criterion=criterion)


def _hold(held: bool, before: bool, *, why: str) -> Event:
    if held == before:
        raise ConfigError("it is held back already" if held else "it is not held back")
    if held and not why.strip():
        raise ConfigError("give a reason")
    return Event(what="held" if held else "let_go", text=why.strip())


def is_repeated(entry: Entry, event: Event) -> bool:
    """Return whether an event only repeats the last change of its criterion."""
    last = entry.given.get(event.criterion)
    same = ("what", "points", "text")
    return last is not None and all(getattr(last, key) == getattr(event, key) for key in same)


def is_unchanged(points: float | None, grade: Grade, criterion: str) -> bool:
    """Return whether typed points are those that a page shows for a criterion.

    A page shows at most two decimals, so 1.33 leaves points of 4/3 as they are.
    """
    own = grade.judged.get(criterion)
    return own is not None and points in (own.points, float(points_text(own.points)))


# ---------------------------------------------------------------------------- requests


def ask(entry: Entry, criterion: str, *, why: str) -> Event:
    """Ask for a review of a criterion that lost points.

    Students can ask once, and again whenever a teaching assistant reopens the request.

    Raises
    ------
    RequestRefused : no request is possible for this criterion now, or `why` is empty or too long.
    """
    text = _read_words(why, wanted="write what was judged wrongly, and why")
    known = entry.requests.get(criterion)
    if known is not None and known.state != "reopened":
        raise RequestRefused("you sent a regrade request for this criterion already")
    if criterion not in points_lost(entry.grade, entry.rubric):
        raise RequestRefused("you can ask only where points were lost")
    if sum(one.state == "asked" for one in entry.requests.values()) >= MOST_OPEN:
        raise RequestRefused(f"{MOST_OPEN} of your requests are waiting: ask again after an answer")
    return Event(what="asked", criterion=criterion, text=text)


def answer(
    entry: Entry, criterion: str, points: float | None, *, text: str, version: str
) -> list[Event]:
    """Answer a request and, if the points change, set them by hand.

    Parameters
    ----------
    points : new points; None or the current points change nothing.
    text : answer for the students; also the reason for new points.

    Raises
    ------
    RequestRefused : the answer is empty or too long, or the request is not waiting.
    ConfigError : the criterion cannot have these points.
    """
    request = _current_request(entry, criterion, version)
    text = _read_words(text, wanted="write an answer for the students")
    if request.state != "asked":
        raise RequestRefused("this request has an answer already; reopen it to answer again")
    answered = Event(what="answered", criterion=criterion, text=text)
    if points is None or is_unchanged(points, entry.grade, criterion):
        return [answered]
    wanted = WantedPoints(submission=entry.submission, criterion=criterion, points=points, why=text)
    return [give(entry, wanted), replace(answered, points=points)]


def reopen(entry: Entry, criterion: str, *, version: str) -> Event:
    """Let the students ask once more about a criterion that was answered.

    Raises
    ------
    RequestRefused : the request has no answer yet, or is already reopened.
    """
    if _current_request(entry, criterion, version).state != "answered":
        raise RequestRefused("only an answered request can be reopened")
    return Event(what="reopened", criterion=criterion)


def _current_request(entry: Entry, criterion: str, version: str) -> Request:
    if criterion not in entry.requests:
        raise ConfigError(f"{criterion}: nobody sent a regrade request")
    if version != entry.request_version(criterion):
        raise Conflict(
            f"{criterion}: was changed after this page was shown", now=entry.given.get(criterion)
        )
    return entry.requests[criterion]


def points_lost(grade: Grade, rubric: Rubric) -> frozenset[str]:
    """Return the criteria without full points, including those that were not judged.

    A criterion that a person has yet to grade has lost nothing yet.
    """
    points = {criterion.id: criterion.points for criterion in grade.criteria}
    lost = (c.id for c in rubric.criteria if points.get(c.id, 0.0) < c.points)
    return frozenset(lost).difference(grade.open)


def _read_words(text: str, *, wanted: str) -> str:
    """Return a typed text without characters that cannot be displayed; `wanted` if it is empty."""
    text = clean(text).strip()
    if not text:
        raise RequestRefused(wanted)
    if len(text) > MOST_LETTERS:
        raise RequestRefused(
            f"write at most {MOST_LETTERS:,} characters, found {len(text):,}: keep the main point"
        )
    return text
