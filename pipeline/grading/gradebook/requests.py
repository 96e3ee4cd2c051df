"""Requests to review a criterion. Each is a series of events, and the newest sets its state."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Literal

from sqlalchemy import Connection, Row, Select, func, select

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.schema import (
    entries,
    gradings,
    releases,
    request_events,
    submissions,
)
from pipeline.grading.gradings import same_people
from pipeline.words.text import clean

MOST_LETTERS = 1_000  # characters of a reason or an answer: about one paragraph
MOST_OPEN = 4  # waiting requests per submission; a team with more doubts should talk to a TA


class RequestRefused(ConfigError):
    """A request or an answer is refused; the message explains why to the person who wrote it."""


@dataclass(frozen=True, kw_only=True)
class RequestEvent:
    """One event of a request.

    Attributes
    ----------
    text : reason for the request, or the answer; "" for `reopened`.
    points : points given with an answer; None if unchanged.
    at : time in ISO 8601, UTC.
    authors : authors of the submission at that time, to whom the request belongs.
    """

    criterion: str
    what: Literal["asked", "answered", "reopened"]
    text: str
    points: float | None = None
    by: str
    at: str = ""
    authors: tuple[str, ...] = ()


EVENT = [request_events.c[f.name] for f in fields(RequestEvent)]


@dataclass(frozen=True, kw_only=True)
class Request:
    """All questions and answers about one criterion of a submission, oldest first.

    Attributes
    ----------
    number : number of the newest event in the gradebook, which an answer must name.
    """

    criterion: str
    events: tuple[RequestEvent, ...]
    number: int

    @property
    def state(self) -> Literal["asked", "answered", "reopened"]:
        """Kind of the last event; a request in the state `asked` waits for an answer.

        After `reopened` the team may ask again.
        """
        return self.events[-1].what


def read_requests(
    connection: Connection, submission: int, authors: tuple[str, ...]
) -> dict[str, Request]:
    """Return the requests of a submission's current authors, by criterion."""
    return read_all_requests(connection, {submission: authors})[submission]


def read_all_requests(
    connection: Connection, authors: Mapping[int, tuple[str, ...]]
) -> dict[int, dict[str, Request]]:
    """Return the requests of the current authors, by submission number and criterion."""
    mine = select(request_events.c.id, request_events.c.submission_id, *EVENT)
    mine = mine.where(request_events.c.submission_id.in_(authors))
    found: dict[int, dict[str, Request]] = {submission: {} for submission in authors}
    for row in connection.execute(mine.order_by(request_events.c.id)):
        event = RequestEvent(**{column.name: row._mapping[column.name] for column in EVENT})
        if same_people(event.authors, authors[row.submission_id]):
            theirs = found[row.submission_id]
            known = theirs.get(event.criterion)
            theirs[event.criterion] = Request(
                criterion=event.criterion,
                events=(*(known.events if known else ()), event),
                number=row.id,
            )
    return found


def find_requests(connection: Connection, batch: Row) -> tuple[list[Row], list[Row]]:
    """Return the newest event of each request in a class, in two lists: waiting and settled.

    Each row has its number `id`, the `criterion`, and the `submission_id` and `position` of its
    submission. Waiting requests come oldest first, settled ones newest first.
    """
    of = request_events.c.submission_id
    newest = select(func.max(request_events.c.id)).group_by(of, request_events.c.criterion)
    found = connection.execute(
        _in_class(batch).where(request_events.c.id.in_(newest)).order_by(request_events.c.id)
    ).all()
    theirs = [row for row in found if same_people(row.asked_by, row.authors)]
    waiting = [row for row in theirs if row.what == "asked"]
    return waiting, [row for row in reversed(theirs) if row.what != "asked"]


def _in_class(batch: Row) -> Select:
    """Return the query for all request events of the submissions in a class list."""
    joined = (
        request_events.join(entries, entries.c.submission_id == request_events.c.submission_id)
        .join(gradings, gradings.c.id == entries.c.grading_id)
        .join(submissions, submissions.c.id == entries.c.submission_id)
    )
    return (
        select(
            request_events.c.id,
            request_events.c.submission_id,
            request_events.c.criterion,
            request_events.c.what,
            request_events.c.authors.label("asked_by"),
            entries.c.position,
            gradings.c.authors,
            submissions.c.name,
        )
        .select_from(joined)
        .where(entries.c.batch_id == batch.id)
    )


def hide_people(text: str, people: Iterable[str]) -> str:
    """Return a text in which the names in `people` are replaced."""
    known = "|".join(re.escape(one) for one in people if one)
    return re.sub(rf"(?<!\w)(?:{known})(?!\w)", "…", text, flags=re.IGNORECASE) if known else text


def is_released(connection: Connection, assignment: str) -> bool:
    """Return whether students may read the feedback of an assignment."""
    mine = select(releases.c.released).where(releases.c.assignment == assignment)
    return bool(connection.scalar(mine.order_by(releases.c.id.desc()).limit(1)))


def read_words(text: str, *, wanted: str) -> str:
    """Return a typed text without characters that cannot be displayed.

    Raises
    ------
    RequestRefused : the text is too long or empty; if it is empty, the message is `wanted`.
    """
    text = clean(text).strip()
    if not text:
        raise RequestRefused(wanted)
    if len(text) > MOST_LETTERS:
        raise RequestRefused(
            f"write at most {MOST_LETTERS:,} characters, found {len(text):,}: keep the main point"
        )
    return text
