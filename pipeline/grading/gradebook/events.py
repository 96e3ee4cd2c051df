"""Events of a submission: what people did, in order. Nothing else is stored of it."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from pipeline.grading.gradings import same_people

# The place of an adjustment in the gradebook. No criterion can have this id. All adjustments count;
# of the points for a criterion only the newest do.
TOTAL = "(total)"
POINTS = ("override", "comment", "adjusted")
REQUESTS = ("asked", "answered", "reopened")


@dataclass(frozen=True, kw_only=True)
class Event:
    """One event in the history of a submission.

    People make these: `override` gives points by hand, or removes them if `points` is None.
    `comment` leaves the automatic points. `adjusted` adds points to the total; they may be
    negative. `asked`, `answered` and `reopened` belong to a student's request to review a
    criterion. `reviewed` marks a grading as reviewed, and `unreviewed` takes the mark back.
    `released` lets students read the feedback of the class, and `hidden` hides it.

    The history also has events of the grader. `graded` is a grading by the rubric alone. `listed`
    is a new or changed line of a class list, with shared data and points by hand. `removed` is the
    removal from the class list.

    Attributes
    ----------
    points : points of the criterion or, for an event without one, of the submission; None if the
        event sets no points. An answer has points only if it changed them.
    text : a reason, a comment or an answer, which the team reads; or codes of flags and changes.
    by : name of the person who acted; "" if nobody did, or if a student stays anonymous.
    at : time in ISO 8601, UTC, to the microsecond. Points given together have the same time.
    authors : authors of the submission at that time, to whom points and requests belong.
    out_of : full points of the submission, for `graded` and `listed`.
    grading : number of the grading that was reviewed.
    id : number of the event in the gradebook; 0 for an event of the grader.
    """

    what: Literal[
        "override", "comment", "adjusted", "asked", "answered", "reopened", "reviewed",
        "unreviewed", "released", "hidden", "graded", "listed", "removed",
    ]  # fmt: skip
    criterion: str = ""
    points: float | None = None
    text: str = ""
    by: str = ""
    at: str = ""
    authors: tuple[str, ...] = ()
    out_of: float | None = None
    grading: int | None = None
    id: int = 0

    def concerns(self, authors: tuple[str, ...]) -> bool:
        """Return whether the event applies to a submission of these authors."""
        return same_people(self.authors, authors)


@dataclass(frozen=True, kw_only=True)
class Request:
    """All questions and answers about one criterion of a submission, oldest first."""

    criterion: str
    events: tuple[Event, ...]

    @property
    def number(self) -> int:
        """Number of the newest event, which an answer must name."""
        return self.events[-1].id

    @property
    def state(self) -> str:
        """Kind of the last event; a request in the state `asked` waits for an answer.

        After `reopened` the team may ask again.
        """
        return self.events[-1].what


def newest_points(events: Iterable[Event]) -> dict[str, Event]:
    """Return the last points, comment or adjustment given by hand, by criterion."""
    return {event.criterion: event for event in events if event.what in POINTS}


def requests_of(events: Iterable[Event]) -> dict[str, Request]:
    """Return the requests among the events, by criterion."""
    asked: dict[str, list[Event]] = {}
    for event in events:
        if event.what in REQUESTS:
            asked.setdefault(event.criterion, []).append(event)
    return {id_: Request(criterion=id_, events=tuple(own)) for id_, own in asked.items()}


def reviewer(events: Iterable[Event], grading: int) -> str:
    """Return the name of the person who marked a grading as reviewed, or ""."""
    marks = [event for event in events if event.grading == grading]
    return marks[-1].by if marks and marks[-1].what == "reviewed" else ""


def hide_people(text: str, people: Iterable[str]) -> str:
    """Return a text in which the names in `people` are replaced."""
    known = "|".join(re.escape(one) for one in people if one)
    return re.sub(rf"(?<!\w)(?:{known})(?!\w)", "…", text, flags=re.IGNORECASE) if known else text
