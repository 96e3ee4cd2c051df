"""The history of a submission: gradings, class lists, and what people did, in order.

Here is also how the rubric and the points differ between two class lists.
"""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from pydantic import ValidationError
from sqlalchemy import Connection, and_, select

from pipeline.grading.grade import read_grade
from pipeline.grading.gradebook.events import (
    HOLDS,
    POINTS,
    REQUESTS,
    TOTAL,
    Event,
    hidden_reason,
    hide_people,
)
from pipeline.grading.gradebook.rows import read_events
from pipeline.grading.gradebook.schema import batches, entries, events, gradings, submissions
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import on_one_line, points_text
from pipeline.submission.load import NAME

_FAILED = "could not be graded: "  # precedes the reason in the text of an event
_SHOWN = ("at", "what", "points", "out_of", "criterion", "text", "by")


def read_history(
    connection: Connection, submission: int, name: str, *, shown_as: str = ""
) -> list[Event]:
    """Return the events of one submission, oldest first.

    Parameters
    ----------
    shown_as : name that texts contain in place of the submission's `name`; they then contain no
        names of people and no other names of the submission. "" to show names.
    """
    named = not shown_as
    done = read_events(connection, events.c.submission_id == submission).get(submission, ())
    told = (*POINTS, *REQUESTS, *HOLDS)
    found = [
        *_graded(connection, submission),
        *(_shown(event, named=named) for event in done if event.what in told),
        *_listed(connection, submission, named=named),
        *_passed(connection, submission, [event for event in done if event.what in POINTS]),
    ]
    found = found if named else [_renamed(event, name, shown_as) for event in found]
    return sorted(found, key=lambda event: event.at)


def _renamed(event: Event, name: str, shown_as: str) -> Event:
    text = event.text
    if text.startswith(_FAILED):
        text = _FAILED + hidden_reason(text.removeprefix(_FAILED), name, shown_as)
    return replace(event, text=text.replace(name, shown_as))


def _shown(event: Event, *, named: bool) -> Event:
    """Return what a person did as the history shows it."""
    if event.criterion == TOTAL:
        return replace(event, criterion="")
    if named or event.what not in REQUESTS:
        return event
    asked = event.what == "asked"
    text = hide_people(event.text, (event.by * asked, *event.authors))
    return replace(event, text=text, by="" if asked else event.by)


def _graded(connection: Connection, submission: int) -> Iterator[Event]:
    mine = select(gradings).where(gradings.c.submission_id == submission)
    for row in connection.execute(mine.order_by(gradings.c.id)):
        grade = read_grade(row.grade)
        said = [f"{NAME} repaired {grade.repaired}"] if grade.repaired else []
        if row.status == "failed":
            text = "; ".join([_FAILED + on_one_line(row.reason), *said])
        else:
            text = ", ".join([*said, *(flag.code for flag in grade.flags)])
        yield Event(at=row.at, what="graded", points=row.points, out_of=row.out_of, text=text)


def _listed(connection: Connection, submission: int, *, named: bool) -> Iterator[Event]:
    """Yield the class lists in which the submission appears, changes or disappears."""
    own = and_(entries.c.batch_id == batches.c.id, entries.c.submission_id == submission)
    of_batch = batches.c.id, batches.c.at, batches.c.rubric
    columns = *of_batch, entries.c.points, entries.c.out_of, entries.c.shared
    of_class = select(submissions.c.assignment).where(submissions.c.id == submission)
    lists = select(*columns).select_from(batches.outerjoin(entries, own))
    lists = lists.where(batches.c.assignment == of_class.scalar_subquery())
    before, judged_by, last = None, "", None
    for batch, at, rubric, points, out_of, shared in connection.execute(
        lists.order_by(batches.c.id)
    ):
        previous, last = last, batch
        if points is None:
            if before is not None:
                now = _other_name(connection, submission, of=previous, among=batch)
                goes_on = f"continues as {now}" if named else "continues under another name"
                text = "removed from the class list" + (f": {goes_on}" if now else "")
                yield Event(at=at, what="removed", text=text)
            before = None
            continue
        notes = ["shared_data"] if shared else []
        if before is None and (
            then := _other_name(connection, submission, of=batch, among=previous)
        ):
            notes.append(f"was {then} before" if named else "was renamed")
        if judged_by and rubric != judged_by:
            notes += [f"rubric: {change}" for change in rubric_changes(judged_by, rubric)]
        if ((points, out_of, shared), rubric) != (before, judged_by):
            yield Event(at=at, what="listed", points=points, out_of=out_of, text="; ".join(notes))
        before, judged_by = (points, out_of, shared), rubric


def _passed(connection: Connection, submission: int, given: Sequence[Event]) -> Iterator[Event]:
    """Yield when points given by hand stop to count because the authors changed, or count again.

    Parameters
    ----------
    given : all changes by hand of the submission's points, oldest first.
    """
    lists = select(batches.c.at, gradings.c.authors)
    lists = lists.select_from(entries.join(batches).join(gradings))
    lists = lists.where(entries.c.submission_id == submission).order_by(batches.c.id)
    before: tuple[str, ...] = ()  # all that came with a team from its earlier name counted there
    for at, authors in connection.execute(lists):
        earlier = [event for event in given if event.at < at]
        counted, counts = _counted(earlier, before), _counted(earlier, authors)
        if gone := [event for event in counted if event not in counts]:
            yield Event(at=at, what="dropped", text=_points_words(gone))
        if back := [event for event in counts if event not in counted]:
            yield Event(at=at, what="restored", text=_points_words(back))
        before = authors


def _counted(given: Sequence[Event], authors: tuple[str, ...]) -> list[Event]:
    """Return the points by hand, comments and adjustments that count for these authors."""
    theirs = [event for event in given if event.concerns(authors)]
    last = {event.criterion: event for event in theirs if event.what != "adjusted"}
    counting = [e for e in last.values() if e.what == "comment" or e.points is not None]
    return [event for event in theirs if event.what == "adjusted" or event in counting]


def _points_words(given: Sequence[Event]) -> str:
    told = []
    for event in given:
        points = "" if event.points is None else f"{event.points:g}"
        if event.what == "adjusted":
            told.append(f"total {event.points:+g} by {event.by}")
        else:
            told.append(f"{event.criterion}: {points or 'comment'} by {event.by}")
    return "; ".join(told)


def _other_name(
    connection: Connection, submission: int, *, of: int | None, among: int | None
) -> str:
    """Return the name that a submission's authors have in another class list.

    Returns "" unless exactly one submission that is new in that list has the same authors.

    Parameters
    ----------
    of : number of the batch that lists the submission.
    among : number of the batch in which to look for the other name.
    """

    def listed(batch: int | None) -> dict[int, tuple[str, tuple[str, ...]]]:
        rows = select(submissions.c.id, submissions.c.name, gradings.c.authors)
        rows = rows.select_from(entries.join(submissions).join(gradings))
        rows = rows.where(entries.c.batch_id == batch)
        return {row.id: (row.name, row.authors) for row in connection.execute(rows)}

    here, there = listed(of), listed(among)
    people = here[submission][1]
    found = [name for i, (name, by) in there.items() if i not in here and by == people != ()]
    return found[0] if len(found) == 1 else ""


def history_dict(submission: str, found: Sequence[Event]) -> dict[str, Any]:
    """Return a history as a dictionary for JSON."""
    return {
        "schema": "cartlab-history/1",
        "submission": submission,
        "events": [{key: getattr(event, key) for key in _SHOWN} for event in found],
    }


def history_text(submission: str, found: Sequence[Event]) -> str:
    """Return a history as lines of text."""
    return "\n".join(
        [submission, *(f"{to_the_second(event.at)}  {event_words(event)}" for event in found)]
    )


def to_the_second(at: str) -> str:
    """Return a time for people to read, without fractions of a second."""
    return datetime.fromisoformat(at).strftime("%Y-%m-%d %H:%M:%S UTC")


_WORDS = {  # of events without points
    "adjusted": "total {points:+g} points, by {by}: {text}",
    "comment": "{criterion}: by {by}: {text}",
    "removed": "{text}",
    "dropped": "given to earlier authors, no longer counts: {text}",
    "restored": "given to these authors, counts again: {text}",
}


def event_words(event: Event) -> str:
    """Return an event as one line of text, with points, person and reason."""
    what, given = event.what, "" if event.points is None else f"{event.points:g} by hand"
    if what in _WORDS:
        said = _WORDS[what].format_map(vars(event))
    elif what == "override":
        points = given or "automatic points again"
        said = f"{event.criterion}: {points}, by {event.by}: {event.text}"
    elif what in HOLDS:
        what = "held back" if what == "held" else "let go"
        said = f"by {event.by}" + (f": {event.text}" if event.text else "")
    elif what in REQUESTS:
        points = f"{given}, " if given else ""
        text = " ".join(event.text.split())
        by = event.by or "the team"
        said = f"{event.criterion}: {points}by {by}" + (f": {text}" if text else "")
    else:
        said = f"{event.points:g} of {event.out_of:g}" + (f"  ({event.text})" if event.text else "")
    return f"{what:8}  {said}"


def rubric_changes(before: str, now: str) -> list[str]:
    """Return the differences between two rubrics, given as JSON, one phrase each."""
    if before == now:
        return []
    try:
        rubrics = [Rubric.model_validate_json(text) for text in (before, now)]
    except ValidationError:
        return ["the earlier rubric was written by another version of cartlab"]
    old, new = ({c.id: c for c in rubric.criteria} for rubric in rubrics)
    changes = [f"criterion {id_} was removed" for id_ in old if id_ not in new]
    for id_, criterion in new.items():
        if id_ not in old:
            changes.append(f"criterion {id_} is new")
        else:
            differing = _differing(old[id_].model_dump(), criterion.model_dump())
            changes += [f"{id_}: {change}" for change in differing]
    if not changes and list(old) != list(new):
        changes.append("the order of the criteria changed")
    old, new = (rubric.model_dump(exclude={"criteria"}) for rubric in rubrics)
    return changes + _differing(old, new)


def points_changes(
    before: Mapping[str, float],
    now: Mapping[str, float],
    *,
    by_hand: Container[str] = (),
    shown: Callable[[str], str] = str,
) -> list[str]:
    """Return a phrase for each submission that is new, was removed, or has other points.

    Parameters
    ----------
    before, now : points by submission in the previous and the new class list, respectively.
    by_hand : submissions with points given by hand; their phrases mention this.
    shown : function that returns the name to show for a submission.
    """
    in_order = sorted(now.items(), key=lambda one: shown(one[0]))
    changes = [
        f"{shown(name)}: {points_text(before[name])} → {points_text(points)}"
        + (" (with points given by hand)" if name in by_hand else "")
        for name, points in in_order
        if name in before and points != before[name]
    ]
    changes += [f"{shown(name)} is new" for name, _ in in_order if name not in before]
    return changes + [f"{shown(name)} was removed" for name in before if name not in now]


def _differing(before: Mapping[str, Any], now: Mapping[str, Any], at: str = "") -> list[str]:
    changes = []
    for key in {**before, **now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            changes += _differing(old, new, f"{at}{key}.")
        elif old != new:
            changes.append(f"{at}{key} {_value_text(old)} → {_value_text(new)}")
    return changes


def _value_text(value: Any) -> str:
    if isinstance(value, list | tuple | Mapping):
        return f"({len(value)})" if len(str(value)) > 40 else str(value)
    text = (
        "nothing" if value in (None, "") else f"{value:g}" if type(value) is float else f"{value}"
    )
    return text if len(text) <= 40 else f"{text[:39]}…"
