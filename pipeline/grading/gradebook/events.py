"""What people do to a submission, as events in order, and their fold: its entry as it stands now.

Nothing else is stored of what people do. The grade, the requests and the review all follow from it.
"""

import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from pipeline.grading.grade import Adjustment, Criterion, Grade, GradeOverride
from pipeline.grading.gradings import same_people
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.rubric import Rubric, find_remarks
from pipeline.grading.total import with_total

# The place of an adjustment in the gradebook. No criterion can have this id. All adjustments count;
# of the points for a criterion only the newest do.
TOTAL = "(total)"
POINTS = ("override", "comment", "adjusted")
REQUESTS = ("asked", "answered", "reopened")
HOLDS = ("held", "let_go")


@dataclass(frozen=True, kw_only=True)
class Event:
    """One event in the history of a submission.

    People make these: `override` gives points by hand, or removes them if `points` is None.
    `comment` leaves the automatic points. `adjusted` adds points to the total; they may be
    negative. `asked`, `answered` and `reopened` belong to a student's request to review a
    criterion. `reviewed` marks a grading as reviewed, and `unreviewed` takes the mark back.
    `held` holds the grade of one submission back from students and exports, and `let_go` ends
    this; without a submission, they are about a criterion of the whole class. `released` lets
    students read the feedback of the class, and `hidden` hides it.

    The history also has events of the grader. `graded` is a grading by the rubric alone. `listed`
    is a new or changed line of a class list, with shared data and points by hand. `removed` is the
    removal from the class list. `dropped` and `restored` say that points by hand no longer count,
    or count again, because the authors changed.

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
        "unreviewed", "held", "let_go", "released", "hidden", "graded", "listed", "removed",
        "dropped", "restored",
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


# The name of an archive at the beginning of a reason.
_ARCHIVE = re.compile(r"^.*?\.zip\W?: ", re.IGNORECASE)


def hide_people(text: str, people: Iterable[str]) -> str:
    """Return a text in which the names in `people` are replaced."""
    known = "|".join(re.escape(one) for one in people if one)
    return re.sub(rf"(?<!\w)(?:{known})(?!\w)", "…", text, flags=re.IGNORECASE) if known else text


def hidden_reason(reason: str, submission: str, own: str) -> str:
    """Return the reason why a submission could not be graded, with `own` in place of its name."""
    if not reason:
        return ""
    name = re.escape(submission)
    path = re.compile(rf"^{name}(?=:)|(?<![^\s'\"(]){name}(?=[/\\])", re.MULTILINE)
    return path.sub(own, _ARCHIVE.sub("the archive: ", reason))


def with_comments(grade: Grade, comments: Mapping[str, Event]) -> Grade:
    """Return the grade with each comment added at the end of its criterion's message."""
    criteria = (
        _with_comment(own, comments[own.id].text) if own.id in comments else own
        for own in grade.criteria
    )
    return grade.model_copy(update={"criteria": tuple(criteria)})


def with_overrides(
    grade: Grade,
    overrides: Mapping[str, Event],
    *,
    rubric: Rubric,
    adjustments: Iterable[Event] = (),
) -> Grade:
    """Return the grade with points given by hand, adjustments and the deduction for lateness.

    If the submission could not be graded, it has no criteria; the criteria with points given
    by hand are added.
    """
    given = {key: o.points for key, o in overrides.items() if o.points is not None}
    added = tuple(Adjustment(points=a.points or 0.0, why=a.text) for a in adjustments)
    if not given and not added:
        return grade
    judged = {criterion.id: criterion for criterion in grade.criteria}
    criteria = []
    for asked in rubric.criteria:
        own = judged.get(asked.id)
        if asked.id in given:
            own = own or Criterion(
                id=asked.id, title=asked.title, outcome="skip", points=0.0, out_of=asked.points,
                message="Not graded automatically.", expected={}, found={},
            )  # fmt: skip
            why, manual = overrides[asked.id].text, asked.check == "manual"
            own = _by_hand(own, given[asked.id], why=why, manual=manual)
        if own is not None:
            criteria.append(own)
    changed = {
        "adjustments": added,
        "overrides": tuple(
            GradeOverride(criterion=key, points=points, why=overrides[key].text)
            for key, points in sorted(given.items())
        ),
    }
    return with_total(grade.model_copy(update=changed), criteria, rubric=rubric)


def _with_comment(criterion: Criterion, why: str) -> Criterion:
    return criterion.model_copy(update={"message": f"{criterion.message} {why}"})


def _by_hand(criterion: Criterion, points: float, *, why: str, manual: bool) -> Criterion:
    points = min(points, criterion.out_of)  # an earlier rubric may have given more points
    if points == criterion.points and not manual:
        return _with_comment(criterion, why)
    by_hand = f"Set by hand from {criterion.points:g} to {points:g} of {criterion.out_of:g}: {why}"
    # Of a criterion that passed, the grader says that all is right. The person disagrees.
    message = by_hand if criterion.outcome == "pass" else f"{criterion.message} {by_hand}"
    changed = {
        "points": points,
        "outcome": "pass" if points >= criterion.out_of else "partial" if points > 0 else "fail",
        "message": why if manual else message,
    }
    return criterion.model_copy(update=changed)


@dataclass(frozen=True)
class Entry:
    """A line of the class list; what it says now follows from its grading and its events.

    Attributes
    ----------
    rubric : the rubric of the class list.
    graded : grade by the rubric alone, with the flag for shared data.
    authors : the current authors; events of other people do not count.
    events : everything that people did to the submission, oldest first.
    owner : account on the learning platform that submitted the files, or "".
    key : hash of everything that affects the grade.
    grading : number of the grading in the gradebook.
    first_key : key of the first version under this name; strangers cannot guess it.
    held : criteria that are held back, so neither the rubric nor the grade has them.
    """

    submission: str
    rubric: Rubric
    graded: Grade
    authors: tuple[str, ...]
    events: tuple[Event, ...]
    owner: str
    key: str
    grading: int
    first_key: str
    held: tuple[Asked, ...] = ()

    @cached_property
    def grade(self) -> Grade:
        """The grade with points given by hand, and the deduction for lateness."""
        return with_overrides(
            with_comments(self.graded, self.comments),
            self.overrides,
            rubric=self.rubric,
            adjustments=self.adjustments,
        )

    @cached_property
    def automatic(self) -> Mapping[str, float]:
        """The automatic points, by criterion."""
        return {criterion.id: criterion.points for criterion in self.graded.criteria}

    @cached_property
    def given(self) -> Mapping[str, Event]:
        """The last change by hand of each criterion, and of the total under `TOTAL`."""
        return {event.criterion: event for event in self._theirs if event.what in POINTS}

    @cached_property
    def overrides(self) -> Mapping[str, Event]:
        """The current points given by hand, by criterion."""
        last = self.given.items()
        return {id_: own for id_, own in last if own.what == "override" and own.points is not None}

    @cached_property
    def comments(self) -> Mapping[str, Event]:
        """The current comments, by criterion."""
        return {id_: own for id_, own in self.given.items() if own.what == "comment"}

    @cached_property
    def adjustments(self) -> tuple[Event, ...]:
        """All changes of the total, oldest first."""
        return tuple(event for event in self._theirs if event.what == "adjusted")

    @cached_property
    def requests(self) -> Mapping[str, Request]:
        """The requests for a review, by criterion."""
        asked: dict[str, list[Event]] = {}
        for event in self._theirs:
            if event.what in REQUESTS:
                asked.setdefault(event.criterion, []).append(event)
        return {id_: Request(criterion=id_, events=tuple(own)) for id_, own in asked.items()}

    @property
    def hold(self) -> Event | None:
        """The event that holds the grade back; None if nothing does."""
        last = next((event for event in reversed(self.events) if event.what in HOLDS), None)
        return last if last and last.what == "held" else None

    @property
    def has_open_case(self) -> bool:
        """Whether recordings are shared, and nobody reviewed this or decided on the grade."""
        decided = self.reviewed_by or any(event.what in HOLDS for event in self.events)
        return "shared_data" in self.graded.codes and not decided

    @property
    def reviewed_by(self) -> str:
        """Name of the person who marked the grading as reviewed, or ""."""
        marks = [event for event in self.events if event.grading == self.grading]
        return marks[-1].by if marks and marks[-1].what == "reviewed" else ""

    def without(self, held: Container[str]) -> "Entry":
        """Return the entry as if the rubric did not have the criteria that are held back.

        The total, the deduction for lateness, flags, points by hand and requests are those of the
        other criteria. So nothing in it depends on the points of these.
        """
        back = tuple(asked for asked in self.rubric.criteria if asked.id in held)
        if not back:
            return self
        rubric = self.rubric.without(held)
        flags = [flag for asked in back for flag in find_remarks(self.graded, asked, self.rubric)]
        left = {"flags": tuple(f for f in self.graded.flags if f not in flags), "notes": ()}
        return replace(
            self,
            rubric=rubric,
            graded=with_total(
                self.graded.model_copy(update=left),
                [own for own in self.graded.criteria if own.id not in held],
                rubric=rubric,
            ),
            events=tuple(event for event in self.events if event.criterion not in held),
            held=back,
        )

    def changes(self, criterion: str) -> list[Event]:
        """Return all changes by hand of a criterion, oldest first."""
        return [e for e in self._theirs if e.what in POINTS and e.criterion == criterion]

    def version(self, criterion: str) -> str:
        """Return the version of a criterion's points; a change must name the one it is based on."""
        newest = self.given.get(criterion)
        return f"{self.grading}.{newest.id if newest else 0}"

    @property
    def whole_version(self) -> str:
        """Version of all that is known of the submission.

        It changes with every event, and when recordings are found to be shared.
        """
        newest = max((event.id for event in self.events), default=0)
        return f"{self.grading}.{newest}.{int('shared_data' in self.graded.codes)}"

    def request_version(self, criterion: str) -> str:
        """Return the version of a request, which an answer must name."""
        return f"{self.version(criterion)}.{self.requests[criterion].number}"

    def after(self, *events: Event) -> "Entry":
        """Return the entry as it would be after more events."""
        return replace(self, events=(*self.events, *events))

    @cached_property
    def _theirs(self) -> tuple[Event, ...]:
        return tuple(event for event in self.events if event.concerns(self.authors))
