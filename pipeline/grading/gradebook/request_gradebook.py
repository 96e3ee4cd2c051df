"""A gradebook in which students can ask for a review once their feedback is released."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

from sqlalchemy import Connection, Row

from pipeline.errors import ConfigError
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.override import WantedPoints
from pipeline.grading.gradebook.requests import (
    MOST_OPEN,
    Request,
    RequestEvent,
    RequestRefused,
    find_requests,
    is_released,
    read_all_requests,
    read_requests,
    read_words,
)
from pipeline.grading.gradebook.rows import (
    Entry,
    add_row,
    class_list,
    final_entries,
    final_entry,
    last_named,
    read_flag,
    read_rubric,
)
from pipeline.grading.gradebook.schema import entries, releases, request_events
from pipeline.grading.gradebook.shared_gradebook import (
    Conflict,
    SharedGradebook,
    find_version,
    is_unchanged,
    name_version,
    newest_overrides,
)
from pipeline.grading.rubric import Rubric

_MOST_SHOWN = 50  # requests of each kind on one page


@dataclass(frozen=True, kw_only=True)
class OwnFeedback:
    """A submission as its authors may see it: the grade, and the requests by criterion."""

    rubric: Rubric
    entry: Entry
    requests: Mapping[str, Request]


@dataclass(frozen=True, kw_only=True)
class Queued:
    """A request as teaching assistants see it; an answer must name its `version`."""

    entry: Entry
    request: Request
    version: str


@dataclass(frozen=True, kw_only=True)
class Queue:
    """The requests of a class: waiting ones oldest first, settled ones newest first.

    Attributes
    ----------
    n_waiting, n_settled : total numbers of requests; `waiting` and `settled` hold only one page.
    """

    rubric: Rubric
    waiting: Sequence[Queued]
    settled: Sequence[Queued]
    n_waiting: int
    n_settled: int


class RequestGradebook(SharedGradebook):
    """A gradebook whose students can read their feedback and ask for a review."""

    @property
    def released(self) -> bool:
        """Whether students may read the feedback of the class."""
        with self._database.reading() as connection:
            return is_released(connection, self._last(connection).assignment)

    def release(self, released: bool, *, by: str) -> None:
        """Let students read the feedback of the class, or hide it again."""
        with self._database.writing() as connection:
            assignment = self._last(connection).assignment
            values = {"assignment": assignment, "at": self._at(), "by": by, "released": released}
            add_row(connection, releases, values)

    def n_waiting(self) -> int:
        """Return the number of requests of the class that wait for an answer."""
        with self._database.reading() as connection:
            last = self._newest(connection)
            return 0 if last is None else len(find_requests(connection, last)[0])

    def queue(self, of: str = "") -> Queue:
        """Return the requests of the class, or only those of the submission `of`."""
        with self._database.reading() as connection:
            last = self._last(connection)
            rubric = read_rubric(last)
            waiting, settled = (
                [row for row in rows if not of or row.name == of]
                for rows in find_requests(connection, last)
            )
            shown = [*waiting[:_MOST_SHOWN], *settled[:_MOST_SHOWN]]
            queued = _read_queued(connection, last, shown)
            return Queue(
                rubric=rubric,
                waiting=queued[: len(waiting[:_MOST_SHOWN])],
                settled=queued[len(waiting[:_MOST_SHOWN]) :],
                n_waiting=len(waiting),
                n_settled=len(settled),
            )

    def request_states(self, team: str) -> dict[str, str]:
        """Return the state of each request of a submission, by criterion."""
        with self._database.reading() as connection:
            _, row = self._find(connection, team)
            requests = read_requests(connection, row.submission_id, row.authors)
        return {criterion: request.state for criterion, request in requests.items()}

    # ----------------------------------------------------------------- for students

    def own_feedback(self, submission: str, *, assignment: str = "") -> OwnFeedback | None:
        """Return what the authors of a submission may read; None until the feedback is released.

        Parameters
        ----------
        submission : exact name of the submission; the name of an author is not accepted.
        assignment : expected assignment of the class list, or "" for any; if the class list has
            another assignment, the result is None.

        Raises
        ------
        ConfigError : the class list has no such submission.
        """
        with self._database.reading() as connection:
            found = self._find_released(connection, submission, assignment)
            if found is None:
                return None
            last, row = found
            return OwnFeedback(
                rubric=read_rubric(last),
                entry=_entry(connection, last, row),
                requests=read_requests(connection, row.submission_id, row.authors),
            )

    def ask(
        self, submission: str, criterion: str, *, why: str, by: str, assignment: str = ""
    ) -> None:
        """Ask for a review of a criterion that lost points.

        Students can ask once, and again whenever a teaching assistant reopens the request.

        Raises
        ------
        RequestRefused : no request is possible for this criterion now, or `why` is empty or too
            long.
        """
        why = read_words(why, wanted="write what was judged wrongly, and why")
        with self._database.changing() as connection:
            found = self._find_released(connection, submission, assignment)
            if found is None:
                raise RequestRefused("the feedback is not released to students")
            last, row = found
            requests = read_requests(connection, row.submission_id, row.authors)
            known = requests.get(criterion)
            if known is not None and known.state != "reopened":
                raise RequestRefused("you asked for another look at this criterion already")
            if criterion not in points_lost(_entry(connection, last, row).grade, read_rubric(last)):
                raise RequestRefused("you can ask only where points were lost")
            if sum(one.state == "asked" for one in requests.values()) >= MOST_OPEN:
                raise RequestRefused(
                    f"{MOST_OPEN} of your requests are waiting: ask again after an answer"
                )
            asked = RequestEvent(criterion=criterion, what="asked", text=why, by=by)
            self._add(connection, row, asked)

    # ---------------------------------------------------------------------- for TAs

    def answer(
        self,
        submission: str,
        criterion: str,
        points: float | None,
        *,
        text: str,
        by: str,
        version: str,
    ) -> None:
        """Answer a request and, if the points change, set them by hand in the same transaction.

        Parameters
        ----------
        points : new points; None or the current points change nothing.
        text : answer for the students; also stored as the reason for new points.
        version : version of the request that the person saw, from `Queued.version`.

        Raises
        ------
        Conflict : somebody else answered or changed the points, or the submission was graded again.
        RequestRefused : the answer is empty or too long, or the request is not waiting.
        ConfigError : the criterion cannot have these points.
        """
        text = read_words(text, wanted="write an answer for the students")
        with self._database.changing() as connection:
            last, row, request = self._find_request(
                connection, submission, criterion, version=version
            )
            if request.state != "asked":
                raise RequestRefused(
                    "this request has an answer already; reopen it to answer again"
                )
            if is_unchanged(points, _entry(connection, last, row).grade, criterion):
                points = None
            if points is not None:
                wish = WantedPoints(
                    submission=submission, criterion=criterion, points=points, why=text
                )
                self._give(connection, row, wish, by=by, rubric=read_rubric(last))
            answered = RequestEvent(
                criterion=criterion, what="answered", text=text, points=points, by=by
            )
            self._add(connection, row, answered)

    def reopen(self, submission: str, criterion: str, *, by: str, version: str) -> None:
        """Let the students ask once more about a criterion that was answered.

        Raises
        ------
        Conflict : see `answer`.
        RequestRefused : the request has no answer yet, or is already reopened.
        """
        with self._database.changing() as connection:
            _, row, request = self._find_request(connection, submission, criterion, version=version)
            if request.state != "answered":
                raise RequestRefused("only an answered request can be reopened")
            reopened = RequestEvent(criterion=criterion, what="reopened", text="", by=by)
            self._add(connection, row, reopened)

    # ---------------------------------------------------------------------- helpers

    def _find_released(
        self, connection: Connection, submission: str, assignment: str
    ) -> tuple[Row, Row] | None:
        """Return the class list and a submission's line; None if feedback is not released."""
        last = self._newest(connection)
        if last is None or assignment not in ("", last.assignment):
            return None
        if not is_released(connection, last.assignment):
            return None
        _, row = self._find(connection, submission)
        if row.name != submission:  # `row` was found by an author's name, which does not count here
            raise ConfigError(f"{submission}: is not the name of a submission")
        return last, row

    def _find_request(
        self, connection: Connection, submission: str, criterion: str, *, version: str
    ) -> tuple[Row, Row, Request]:
        """Return the class list, the submission's line and the request.

        Raises
        ------
        ConfigError : nobody asked about this criterion.
        Conflict : the request or the points have changed since this `version`.
        """
        last, row = self._find(connection, submission)
        request = read_requests(connection, row.submission_id, row.authors).get(criterion)
        if request is None:
            raise ConfigError(f"{criterion}: nobody asked for another look")
        current, given = find_version(connection, row, criterion)
        if version != _name_version(current, request):
            raise Conflict(f"{criterion}: was changed after this page was shown", now=given)
        return last, row, request

    def _add(self, connection: Connection, row: Row, draft: RequestEvent) -> None:
        """Store an event of a request, with the current time and authors."""
        if not draft.by.strip():
            raise RequestRefused("enter your name: requests and answers are signed")
        authors = last_named(connection, row.submission_id)
        event = replace(draft, at=self._at(), authors=authors)
        add_row(connection, request_events, {**asdict(event), "submission_id": row.submission_id})


def points_lost(grade: Grade, rubric: Rubric) -> frozenset[str]:
    """Return the criteria without full points, including those that were not judged.

    A criterion that a person has yet to grade has lost nothing yet.
    """
    points = {criterion.id: criterion.points for criterion in grade.criteria}
    lost = (c.id for c in rubric.criteria if points.get(c.id, 0.0) < c.points)
    return frozenset(lost).difference(grade.open)


def _read_queued(connection: Connection, last: Row, events: Sequence[Row]) -> list[Queued]:
    """Return the requests whose newest events are given; five queries are enough for any number."""
    positions = {event.position for event in events}
    rows = connection.execute(class_list(last).where(entries.c.position.in_(positions))).all()
    read = [(row, read_flag(row.shared)) for row in rows]
    final = final_entries(connection, read, rubric=read_rubric(last))
    newest = newest_overrides(connection, [row.submission_id for row in rows])
    requests = read_all_requests(connection, {row.submission_id: row.authors for row in rows})
    lines = {row.submission_id: (row, entry) for row, entry in zip(rows, final, strict=True)}
    queued = []
    for event in events:
        row, entry = lines[event.submission_id]
        request = requests[event.submission_id][event.criterion]
        points = name_version(row, newest[event.submission_id].get(event.criterion))
        version = _name_version(points, request)
        queued.append(Queued(entry=entry, request=request, version=version))
    return queued


def _name_version(points: str, request: Request) -> str:
    """Return the version of a request, which an answer must name."""
    return f"{points}.{request.number}"


def _entry(connection: Connection, last: Row, row: Row) -> Entry:
    return final_entry(connection, row, shared=read_flag(row.shared), rubric=read_rubric(last))
