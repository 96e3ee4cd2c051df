"""The gradebook: all gradings, the current class list, and points given by hand.

Each grading is stored as soon as it is done, in its own transaction. A complete batch becomes the
class list. Grades contain no dates, but the gradebook does, and `cartlab history` shows them.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

from sqlalchemy import Connection, Row, func, select

from pipeline.errors import ConfigError
from pipeline.grading.grade import Grade, class_frame, read_grade
from pipeline.grading.gradebook import decisions, rows
from pipeline.grading.gradebook.database import Database
from pipeline.grading.gradebook.decisions import RequestRefused, WantedPoints
from pipeline.grading.gradebook.events import POINTS, TOTAL, Entry, Event, Request
from pipeline.grading.gradebook.history import points_changes, read_history, rubric_changes
from pipeline.grading.gradebook.schema import (
    batches,
    entries,
    events,
    figures,
    findings,
    gradings,
    submissions,
)
from pipeline.grading.gradings import Batch, Grading, person
from pipeline.grading.rubric import Rubric
from pipeline.submission.toml import nearest
from pipeline.words.progress import silent

if TYPE_CHECKING:
    import pandas as pd

T = TypeVar("T")
State = tuple[int, int, int]

_MOST_SHOWN = 50  # requests of each kind on one page
_OPEN_CASE = "recordings or numbers are shared with another team; nobody has reviewed this yet"


@dataclass(frozen=True, kw_only=True)
class BulkChange:
    """Changes that a person made to several submissions at once.

    Attributes
    ----------
    at : time of all these changes, in ISO 8601, UTC, to the microsecond; it identifies them.
    criterion, why : a criterion and a reason from these changes, as examples.
    teams : number of submissions changed.
    kept : submissions that were left unchanged, because somebody has changed them since.
    """

    at: str
    by: str
    criterion: str = ""
    why: str = ""
    teams: int
    kept: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Queue:
    """The requests of a class: waiting ones oldest first, settled ones newest first.

    Attributes
    ----------
    n_waiting, n_settled : total numbers of requests; `waiting` and `settled` hold only one page.
    """

    waiting: Sequence[tuple[Entry, Request]]
    settled: Sequence[tuple[Entry, Request]]
    n_waiting: int
    n_settled: int


class Gradebook:
    """A database of all gradings, of the class lists made from them, and of what people do.

    Several processes may share it. A person's change names the version of the data that the person
    saw, and is refused if the data have changed since.

    Parameters
    ----------
    place : a folder, a SQLite file or any SQLAlchemy URL.
    assignment : name of the assignment whose class list is used; default: the one graded last.
    patience, waiting : how long to wait for a lost server; see `Database`.
    now : function that returns the current time, which is stored with each entry.

    Raises
    ------
    ConfigError : the place cannot be reached or holds no gradebook.
    """

    def __init__(
        self,
        place: str | Path,
        *,
        assignment: str | None = None,
        create: bool = False,
        patience: float = 0.0,
        waiting: Callable[[str], None] = silent,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._database = Database(place, create=create, patience=patience, waiting=waiting)
        self._now = now
        self._assignment = assignment

    def close(self) -> None:
        """Close the database."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------ while grading

    def known(self, key: str, *, figures: bool = True) -> Grading | None:
        """Return the newest grading with this key, or None.

        The figures of the grading are read only if `figures` is true.
        """

        def read() -> Grading | None:
            with self._database.reading() as connection:
                mine = self._assignment or ""
                return rows.known_grading(connection, key, assignment=mine, drawn=figures)

        return self._database.repeat(read)

    def put(self, grading: Grading) -> None:
        """Store a grading; it is on disk when this method returns.

        Raises
        ------
        ValueError : `grading.grade` is not valid.
        """
        grade, at = read_grade(grading.grade), self._at()
        self._database.repeat(lambda: self._put(grading, grade, at=at))

    def _put(self, grading: Grading, grade: Grade, *, at: str) -> None:
        with self._database.writing() as connection:
            # The answer to the first attempt may have been lost after the grading was stored.
            mine = self._submission(connection, grading.submission)
            stored = select(gradings.c.id).where(
                gradings.c.key == grading.key, gradings.c.at == at, gradings.c.submission_id == mine
            )
            if connection.scalar(stored) is not None:
                return
            number = rows.add_row(
                connection,
                gradings,
                {
                    **{name: getattr(grading, name) for name in rows.GRADING},
                    "submission_id": mine,
                    "at": at,
                    "points": grade.points,
                    "out_of": grade.out_of,
                    "deducted": grade.deducted,
                },
            )
            for position, (name, svg) in enumerate(grading.figures):
                drawn = {"grading_id": number, "position": position, "name": name, "svg": svg}
                rows.add_row(connection, figures, drawn)
            if grading.findings:
                kept = {"grading_id": number, "found": grading.findings}
                rows.add_row(connection, findings, kept)

    def fingerprints(self, numbers: Sequence[int] | None = None) -> Iterator[Grading]:
        """Return all submissions with the fingerprints of their recordings, without repetitions.

        Earlier versions of submissions are included, because their recordings may have been passed
        on to other teams.

        Parameters
        ----------
        numbers : numbers of the gradings to read, as in `Entry.grading`; default: all gradings that
            have fingerprints.
        """
        return rows.read_prints(self._database, numbers, assignment=self._assignment or "")

    def listed(self) -> Iterator[Grading]:
        """Yield the submissions of the current class list, without fingerprints.

        The list is empty until a batch is complete.
        """
        with self._database.reading() as connection:
            last = self._newest(connection)
            lines = [] if last is None else rows.lines_of(connection, last)
        return rows.read_gradings(self._database, [line["grading_id"] for line in lines])

    def days_late(self) -> dict[str, float]:
        """Return the days late of each submission on the current class list.

        The result is empty until a batch is complete.
        """
        with self._database.reading() as connection:
            last = self._newest(connection)
            if last is None:
                return {}
            late = rows.class_list(last, submissions.c.name, gradings.c.days_late)
            return {row.name: row.days_late for row in connection.execute(late)}

    def finish(
        self, batch: Batch, *, rubric: Rubric, shown: Callable[[str], str] = str
    ) -> list[str]:
        """Store a complete batch as the new class list, unless nothing has changed.

        Returns the differences from the previous class list, one phrase each; changes to the rubric
        come first.

        Parameters
        ----------
        shown : function that returns the name to show for a submission; it is called after the new
            list is stored.

        Raises
        ------
        KeyError : a grading of the batch is not in the gradebook.
        """
        return self._database.repeat(lambda: self._finish(batch, rubric=rubric, shown=shown))

    def _finish(self, batch: Batch, *, rubric: Rubric, shown: Callable[[str], str]) -> list[str]:
        mine, listed, points, by_hand = self._assignment or "", [], {}, set()
        with self._database.changing() as connection:
            rows.carry_over(connection, batch.moved, assignment=mine)
            for position, key in enumerate(batch.keys):
                row = rows.newest_of(connection, key, assignment=mine)
                shared = batch.shared.get(row.name)
                (entry,) = rows.read_entries(connection, [(row, shared)], rubric=rubric)
                points[row.name] = entry.grade.points
                by_hand |= {row.name} if entry.overrides or entry.adjustments else set()
                listed.append(
                    {
                        "position": position,
                        "submission_id": row.submission_id,
                        "grading_id": row.id,
                        "shared": json.dumps(shared.model_dump()) if shared else "",
                        "points": entry.grade.points,
                        "out_of": entry.grade.out_of,
                    }
                )
            text, last = rubric.model_dump_json(), self._newest(connection)
            if last and last.rubric == text and rows.lines_of(connection, last) == listed:
                return []
            rows.add_list(connection, listed, assignment=mine, at=self._at(), rubric=text)
            if last is None:
                return []
            changes = [f"rubric: {change}" for change in rubric_changes(last.rubric, text)]
            before = rows.points_of(connection, last)
            before = {batch.moved.get(name, name): had for name, had in before.items()}
        return changes + points_changes(before, points, by_hand=by_hand, shown=shown)

    # ---------------------------------------------------------------- current class list

    @property
    def is_graded(self) -> bool:
        """Whether a batch is complete, so that there is a class list."""
        with self._database.reading() as connection:
            return self._newest(connection) is not None

    @property
    def assignment(self) -> str:
        """The assignment of the class list.

        Raises
        ------
        ConfigError : no batch is complete yet.
        """
        return self._read(lambda _, last: last.assignment)

    @property
    def rubric(self) -> Rubric:
        """The rubric of the class list.

        Raises
        ------
        ConfigError : no batch is complete yet.
        """
        return self._read(lambda _, last: rows.read_rubric(last))

    def entries(self) -> Iterator[Entry]:
        """Yield the entries of the class list in order.

        Only some of the entries are in memory at a time.
        """
        with self._database.reading() as connection:
            last = self._last(connection)
            of_batch = select(entries.c.position).where(entries.c.batch_id == last.id)
            positions = sorted(connection.scalars(of_batch))
        rubric, lines = rows.read_rubric(last), rows.class_list(last)
        for page in rows.pages(positions):
            with self._database.reading() as connection:
                found = rows.read_lines(
                    connection, lines.where(entries.c.position.in_(page)), rubric=rubric
                )
            yield from (entry for _, entry in found)

    def shown_entries(self) -> Iterator[Entry]:
        """Yield the entries as students may read them, without criteria that are held back."""
        held = self.held_criteria
        return (entry.without(held) for entry in self.entries())

    def entry(self, team: str) -> Entry:
        """Return the class-list entry of the submission whose id or author is `team`.

        Raises
        ------
        ConfigError : no submission matches, or several do.
        """
        with self._database.reading() as connection:
            return self._found(connection, team)[1]

    def to_frame(self) -> "pd.DataFrame":
        """Return the class list, one row per submission and criterion; see `class_frame`."""
        return class_frame((entry.grade for entry in self.entries()), rubric=self.rubric)

    def by_other_rubrics(self) -> list[str]:
        """Return the submissions of the class list that were graded with another rubric."""
        return self._read(rows.by_other_rubrics)

    def figures(self, entry: Entry) -> tuple[tuple[str, str], ...]:
        """Return the figures of a submission's feedback, as pairs of file name and SVG text."""
        with self._database.reading() as connection:
            return rows.read_figures(connection, entry.grading)

    def findings(self, entry: Entry) -> str:
        """Return the stored results of a submission's checks; "" if they were not kept."""
        mine = select(findings.c.found).where(findings.c.grading_id == entry.grading)
        with self._database.reading() as connection:
            return connection.scalar(mine) or ""

    def history(self, team: str, *, shown_as: str = "") -> tuple[str, list[Event]]:
        """Return the name of a submission and all its events; see `read_history`.

        Raises
        ------
        ConfigError : no submission matches, or several do.
        """
        with self._database.reading() as connection:
            row = self._find_ever(connection, team)
            name, number = row.name, row.submission_id
            return shown_as or name, read_history(connection, number, name, shown_as=shown_as)

    def remove(self, teams: Sequence[str]) -> list[str]:
        """Remove submissions from the class list; return their names.

        Their history stays. If they are graded again, they return to the list.

        Raises
        ------
        ConfigError : a name matches no submission on the class list, or more than one.
        """
        with self._database.changing() as connection:
            found = [self._find(connection, team) for team in teams]
            gone = {row.submission_id: row.name for _, row in found}
            last = self._last(connection)
            left = [e for e in rows.lines_of(connection, last) if e["submission_id"] not in gone]
            rows.add_list(
                connection,
                [{**line, "position": i} for i, line in enumerate(left)],
                assignment=last.assignment,
                at=self._at(),
                rubric=last.rubric,
            )
        return list(gone.values())

    def erase(self, teams: Sequence[str]) -> list[str]:
        """Delete submissions with their whole history; return their names.

        Raises
        ------
        ConfigError : a name matches no submission or several, or the database user has no right to
            delete.
        """
        with self._database.erasing() as connection:
            found = [self._find_ever(connection, team) for team in teams]
            gone = {row.submission_id: row.name for row in found}
            rows.erase_rows(connection, gone)
        return list(gone.values())

    def state(self) -> State:
        """Return numbers that change whenever the content of the gradebook changes."""
        with self._database.reading() as connection:
            last = self._last(connection).id
            mine = select(func.count()).where(entries.c.batch_id == last)  # fewer after an erasure
            newest = connection.scalar(select(func.max(events.c.id)))
            return last, newest or 0, connection.scalar(mine) or 0

    def class_now(self, before: rows.ClassNow | None = None) -> rows.ClassNow:
        """Return the class with current grades.

        Parameters
        ----------
        before : an earlier result, whose unchanged entries are reused.
        """
        return self._read(lambda connection, last: rows.read_class(connection, last, before))

    # ------------------------------------------------------------------ what people do

    def override(
        self, team: str, criterion: str, points: float | None, *, why: str, by: str
    ) -> Event:
        """Set a criterion's points by hand, also for later gradings; None: the automatic points.

        Raises
        ------
        ConfigError : the submission or criterion does not exist, the points are out of range, or
            `why` or `by` is empty.
        """
        wanted = WantedPoints(submission=team, criterion=criterion, points=points, why=why)
        return self._decide(team, lambda entry: [decisions.give(entry, wanted)], by=by)[0]

    def adjust(self, team: str, points: float, *, why: str, by: str) -> Event:
        """Add points to a submission's total, also for later gradings; negative points deduct.

        All adjustments of a submission are added up. The total never falls below 0.

        Raises
        ------
        ConfigError : the submission does not exist, the points are no number or 0, or `why` or
            `by` is empty.
        """
        return self.override(team, TOTAL, points, why=why, by=by)

    def change(
        self, team: str, criterion: str, points: float | None, *, why: str, by: str, version: str
    ) -> Event:
        """Set the points of a criterion by hand, unless they have changed in the meantime.

        If the criterion already has these points, exactly or as `points_text` shows them, `why` is
        only added as a comment.

        Parameters
        ----------
        version : version of the points that the person saw, from `Entry.version`.

        Raises
        ------
        Conflict : somebody else changed the points, or the submission was graded again.
        """
        wanted = WantedPoints(submission=team, criterion=criterion, points=points, why=why)

        def decide(entry: Entry) -> list[Event]:
            decisions.check_version(entry, criterion, version)
            return [decisions.change(entry, wanted)]

        return self._decide(team, decide, by=by)[0]

    def undo(self, team: str, criterion: str, *, by: str, version: str) -> Event:
        """Undo the last change of a criterion; a second call redoes it.

        Raises
        ------
        Conflict : see `change`.
        """

        def decide(entry: Entry) -> list[Event]:
            decisions.check_version(entry, criterion, version)
            return [decisions.undo(entry, criterion)]

        return self._decide(team, decide, by=by)[0]

    def change_all(self, wishes: Sequence[WantedPoints], *, by: str) -> BulkChange:
        """Give points by hand to several submissions; if one change is refused, all are.

        Raises
        ------
        ConfigError : a change is not valid; the message names its line in the table, if any.
        Conflict : a change is based on an outdated version.
        """
        at, new = self._at(), 0
        with self._database.changing() as connection:
            known = self._named(connection, [wish.submission for wish in wishes])
            for wish in wishes:
                where = f"line {wish.line}: " if wish.line else ""
                if wish.submission not in known:
                    raise ConfigError(f"{where}no such submission is in the class")
                row, entry = known[wish.submission]
                if wish.version:
                    decisions.check_version(entry, wish.criterion, wish.version)
                try:
                    event = decisions.give(entry, decisions.beside(entry, wish))
                    if decisions.is_repeated(entry, event):
                        continue
                    stored = self._store(connection, row, [event], by=by, at=at)
                except ConfigError as error:
                    raise ConfigError(f"{where}{error}") from None
                known[wish.submission] = row, entry.after(*stored)
                new += 1
        return BulkChange(at=at, by=by, teams=new)

    def preview_all(self, wishes: Sequence[WantedPoints]) -> list[tuple[Entry, Entry]]:
        """Return each submission without and with the requested points; store nothing.

        Submissions that are not in the class are left out.
        """
        with self._database.reading() as connection:
            known = self._named(connection, [wish.submission for wish in wishes])
        found = []
        for wish in wishes:
            if wish.submission in known:
                _, entry = known[wish.submission]
                asked = decisions.beside(entry, wish)
                found.append((entry, entry.after(decisions.as_event(asked, text=asked.why))))
        return found

    def undo_all(self, at: str, *, by: str) -> BulkChange:
        """Undo all changes that a person made at the same time.

        A criterion that has been changed since stays as it is. `undo_all` with the time of the
        result restores the changes.

        Parameters
        ----------
        at : time of the changes, from `BulkChange.at`.
        """
        now, back, kept = self._at(), 0, []
        with self._database.changing() as connection:
            members = rows.in_class(self._last(connection))
            mine = events.c.at == at, events.c.submission_id.in_(members), events.c.what.in_(POINTS)
            chosen = (
                select(submissions.c.name, events.c.id, events.c.criterion)
                .join(submissions, submissions.c.id == events.c.submission_id)
                .where(*mine)
                .order_by(events.c.id)
            )
            made = connection.execute(chosen).all()
            known = self._named(connection, [row.name for row in made])
            for name, number, criterion in made:
                row, entry = known[name]
                last = entry.given.get(criterion)
                if last is None or last.id != number:
                    kept.append(name)
                    continue
                self._store(connection, row, [decisions.undo(entry, criterion)], by=by, at=now)
                back += 1
        return BulkChange(at=now, by=by, teams=back, kept=tuple(kept))

    def changed_together(self, *, least: int = 2) -> list[BulkChange]:
        """Return the changes that were made to several submissions at once, newest first.

        Parameters
        ----------
        least : smallest number of submissions that counts as several.
        """
        with self._database.reading() as connection:
            members = rows.in_class(self._last(connection))
            columns = events.c.at, events.c.by
            teams = func.count(events.c.submission_id.distinct())
            mine = (
                select(
                    *columns,
                    func.min(events.c.criterion).label("criterion"),
                    func.max(events.c.text).label("why"),
                    teams.label("teams"),
                )
                .where(events.c.submission_id.in_(members), events.c.what.in_(POINTS))
                .group_by(*columns)
                .having(teams >= least)
                .order_by(func.max(events.c.id).desc())
            )
            return [BulkChange(**row) for row in connection.execute(mine).mappings()]

    def set_reviewed(self, team: str, *, by: str, reviewed: bool) -> None:
        """Mark the current grading of a submission as reviewed, or as not reviewed."""
        what = "reviewed" if reviewed else "unreviewed"
        self._decide(team, lambda entry: [Event(what=what, grading=entry.grading)], by=by)

    def accept_all(self, seen: Mapping[str, str], *, by: str) -> BulkChange:
        """Mark submissions as reviewed, except those that changed since a person saw them.

        Parameters
        ----------
        seen : version of each submission that the person saw, from `Entry.whole_version`.
        """
        at = self._at()
        with self._database.changing() as connection:
            known = self._named(connection, list(seen))
            same = [name for name, (_, entry) in known.items() if entry.whole_version == seen[name]]
            for name in same:
                row, entry = known[name]
                mark = Event(what="reviewed", grading=entry.grading)
                self._store(connection, row, [mark], by=by, at=at)
        kept = tuple(name for name in seen if name not in same)
        return BulkChange(at=at, by=by, teams=len(same), kept=kept)

    def changes_since(self, number: int) -> list[tuple[str, Event]]:
        """Return the points given by hand after the event `number`, with their submissions."""
        with self._database.reading() as connection:
            mine = events.c.assignment == self._last(connection).assignment
            given = events.c.id > number, events.c.what.in_(POINTS)
            found = rows.read_events(connection, mine, *given)
            named = select(submissions.c.id, submissions.c.name).where(submissions.c.id.in_(found))
            names = {row.id: row.name for row in connection.execute(named)}
        new = [(names[key], event) for key, own in found.items() for event in own]
        return sorted(new, key=lambda one: one[1].id)

    def reasons(self) -> dict[str, list[str]]:
        """Return the reasons for points and comments by criterion, the most common first."""
        with self._database.reading() as connection:
            mine = (
                select(events.c.criterion, events.c.text)
                .where(
                    events.c.assignment == self._last(connection).assignment,
                    events.c.what.in_(POINTS),
                    events.c.points.is_not(None) | (events.c.what == "comment"),
                )
                .group_by(events.c.criterion, events.c.text)
                .order_by(func.count().desc(), events.c.text)
            )
            found: dict[str, list[str]] = defaultdict(list)
            for criterion, why in connection.execute(mine):
                found[criterion].append(why)
        return dict(found)

    # ------------------------------------------------------- release and requests

    @property
    def released(self) -> bool:
        """Whether students may read the feedback of the class."""
        return self._read(lambda connection, last: rows.is_released(connection, last.assignment))

    def release(self, released: bool, *, by: str) -> list[str]:
        """Let students read the feedback of the class, or hide it again.

        A release holds back the submissions with an open case, and returns their names.
        """
        with self._database.changing() as connection:
            last, at = self._last(connection), self._at()
            class_now = rows.read_class(connection, last, None).entries if released else []
            open_ = [entry.submission for entry in class_now if entry.has_open_case]
            for row, _ in self._named(connection, open_).values():
                self._store(connection, row, [Event(what="held", text=_OPEN_CASE)], by=by, at=at)
            event = Event(what="released" if released else "hidden", by=by, at=at)
            rows.add_event(connection, event, assignment=last.assignment)
        return open_

    def hold(self, team: str, *, why: str, by: str) -> None:
        """Hold a submission's grade back: no student reads it, and no export has it.

        Raises
        ------
        ConfigError : there is no reason, or it is held back already.
        """
        self._decide(team, lambda entry: [decisions.hold(entry, True, why=why)], by=by)

    def let_go(self, team: str, *, by: str) -> None:
        """Hold a submission's grade back no longer.

        Raises
        ------
        ConfigError : it is not held back.
        """
        self._decide(team, lambda entry: [decisions.hold(entry, False)], by=by)

    @property
    def held_criteria(self) -> tuple[str, ...]:
        """The criteria of the rubric that are held back for the whole class."""
        return self._read(rows.held_criteria)

    def hold_criterion(self, criterion: str, held: bool, *, why: str = "", by: str) -> None:
        """Hold a criterion back for the whole class, or no longer.

        Students then read neither its points nor what follows from them, and no totals are
        exported.

        Raises
        ------
        ConfigError : see `decisions.hold_criterion`.
        """
        with self._database.changing() as connection:
            last = self._last(connection)
            before = rows.held_criteria(connection, last)
            event = decisions.hold_criterion(
                criterion, held, before, rows.read_rubric(last), why=why
            )
            event = replace(event, by=by.strip(), at=self._at())
            rows.add_event(connection, event, assignment=last.assignment)

    def n_waiting(self) -> int:
        """Return the number of requests of the class that wait for an answer."""
        with self._database.reading() as connection:
            last = self._newest(connection)
            return 0 if last is None else len(rows.find_requests(connection, last)[0])

    def queue(self, of: str = "") -> Queue:
        """Return the requests of the class, or only those of the submission `of`."""
        with self._database.reading() as connection:
            waiting, settled = (
                [row for row in every if not of or row.name == of]
                for every in rows.find_requests(connection, self._last(connection))
            )
            shown = waiting[:_MOST_SHOWN], settled[:_MOST_SHOWN]
            known = self._named(connection, [row.name for some in shown for row in some])
        first, last = (
            [(known[row.name][1], known[row.name][1].requests[row.criterion]) for row in some]
            for some in shown
        )
        return Queue(waiting=first, settled=last, n_waiting=len(waiting), n_settled=len(settled))

    def own_feedback(self, submission: str, *, assignment: str = "") -> Entry | None:
        """Return what the authors of a submission may read; None until the feedback is released.

        It is None too while the grade is held back. Criteria that are held back are left out.

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
            if not self._is_readable(connection, assignment):
                return None
            _, entry = self._found(connection, submission, exact=True)
            return None if entry.hold else entry

    def ask(
        self, submission: str, criterion: str, *, why: str, by: str, assignment: str = ""
    ) -> None:
        """Ask for a review of a criterion that lost points; see `decisions.ask`.

        Raises
        ------
        RequestRefused : no request is possible for this criterion now.
        """
        self._decide(
            submission,
            lambda entry: [decisions.ask(entry, criterion, why=why)],
            by=by,
            released=assignment,
        )

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
        """Answer a request; see `decisions.answer`.

        Parameters
        ----------
        version : version of the request that the person saw, from `Entry.request_version`.

        Raises
        ------
        Conflict : somebody else answered or changed the points, or the submission was graded again.
        """
        given = {"text": text, "version": version}
        self._decide(
            submission, lambda entry: decisions.answer(entry, criterion, points, **given), by=by
        )

    def reopen(self, submission: str, criterion: str, *, by: str, version: str) -> None:
        """Let the students ask once more about a criterion that was answered.

        Raises
        ------
        Conflict : see `answer`.
        """
        self._decide(
            submission, lambda entry: [decisions.reopen(entry, criterion, version=version)], by=by
        )

    # ----------------------------------------------------------------------- helpers

    def _decide(
        self,
        team: str,
        decide: Callable[[Entry], list[Event]],
        *,
        by: str,
        released: str | None = None,
    ) -> list[Event]:
        """Store what `decide` returns for a submission, while nobody else can write.

        Parameters
        ----------
        released : if not None, the feedback of this assignment ("" for any) must be released.
        """
        with self._database.changing() as connection:
            if released is not None and not self._is_readable(connection, released):
                raise RequestRefused("the feedback is not released to students")
            row, entry = self._found(connection, team, exact=released is not None)
            if released is not None and entry.hold:
                raise RequestRefused("the feedback is not released to students")
            return self._store(connection, row, decide(entry), by=by, at=self._at())

    def _store(
        self, connection: Connection, row: Row, decided: Sequence[Event], *, by: str, at: str
    ) -> list[Event]:
        """Store events of a submission, signed and with its authors; `row` is its line."""
        if not by.strip():
            if decided[0].what in POINTS:
                raise ConfigError("a change of points needs a reason (--why) and a name (--by)")
            raise RequestRefused("enter your name: requests, answers and reviews are signed")
        authors = row.authors or rows.last_named(connection, row.submission_id)
        signed = [replace(event, by=by.strip(), at=at, authors=authors) for event in decided]
        own = select(submissions.c.assignment).where(submissions.c.id == row.submission_id)
        place = {"assignment": connection.scalar(own) or "", "submission": row.submission_id}
        return [rows.add_event(connection, event, **place) for event in signed]

    def _is_readable(self, connection: Connection, assignment: str) -> bool:
        """Return whether students may read the class list, and it is of this assignment."""
        last = self._newest(connection)
        if last is None or assignment not in ("", last.assignment):
            return False
        return rows.is_released(connection, last.assignment)

    def _found(
        self, connection: Connection, team: str, *, exact: bool = False
    ) -> tuple[Row, Entry]:
        """Return a submission's line in the class list, and what it says now.

        Parameters
        ----------
        exact : whether only the submission's own name counts, and no author's. Students name their
            submission so, and read no criterion that is held back.
        """
        last, row = self._find(connection, team)
        if exact and row.name != team:
            raise ConfigError(f"{team}: is not the name of a submission")
        line = row, rows.read_flag(row.shared)
        (entry,) = rows.read_entries(connection, [line], rubric=rows.read_rubric(last))
        held = rows.held_criteria(connection, last) if exact else ()
        return row, entry.without(held)

    def _named(self, connection: Connection, names: Sequence[str]) -> dict[str, tuple[Row, Entry]]:
        """Return the lines of the class list with these names, and what they say now."""
        last = self._last(connection)
        mine = rows.class_list(last).where(submissions.c.name.in_(set(names)))
        found = rows.read_lines(connection, mine, rubric=rows.read_rubric(last))
        return {row.name: (row, entry) for row, entry in found}

    def _read(self, read: Callable[[Connection, Row], T]) -> T:
        """Return what `read` reads of the last complete batch."""
        with self._database.reading() as connection:
            return read(connection, self._last(connection))

    def _at(self) -> str:
        return self._now().astimezone(UTC).isoformat(timespec="microseconds")

    def _submission(self, connection: Connection, name: str) -> int:
        values = {"assignment": self._assignment or "", "name": name}
        mine = select(submissions.c.id).filter_by(**values)
        number = connection.scalar(mine)
        return rows.add_row(connection, submissions, values) if number is None else number

    def _last(self, connection: Connection) -> Row:
        row = self._newest(connection)
        if row is None:
            what = f"no grading of {self._assignment!r}" if self._assignment else "no grading"
            raise ConfigError(
                f"{self._database.name}: {what} is complete yet: run cartlab grade again"
            )
        return row

    def _find(self, connection: Connection, team: str) -> tuple[Row, Row]:
        """Return the last complete batch and, from its class list, the line of a team."""
        last = self._last(connection)
        names = rows.class_list(last, submissions.c.name, gradings.c.authors)
        listed = connection.execute(names).all()
        found = [row.position for row in _named(team, listed)]
        if len(found) != 1:
            hint = f"no such submission{_similar(team, [row.name for row in listed])}"
            raise ConfigError(
                f"{team}: {'is in several submissions: give the name of one' if found else hint}"
            )
        line = rows.class_list(last).where(entries.c.position == found[0])
        return last, connection.execute(line).one()

    def _find_ever(self, connection: Connection, team: str) -> Row:
        """Return a team's row in the class list or, if it was removed, a row from its gradings."""
        try:
            return self._find(connection, team)[1]
        except ConfigError:
            columns = gradings.c.submission_id, submissions.c.name, gradings.c.authors
            ever = select(*columns).join(submissions).order_by(gradings.c.id)
            if self._assignment is not None:
                ever = ever.where(submissions.c.assignment == self._assignment)
            found = {r.submission_id: r for r in _named(team, connection.execute(ever).all())}
            if len(found) != 1:
                raise
            return found.popitem()[1]

    def _newest(self, connection: Connection) -> Row | None:
        """Return the last complete batch of the assignment; without an assignment, the last of all.

        Returns None if there is no complete batch.
        """
        newest = select(batches).order_by(batches.c.id.desc()).limit(1)
        if self._assignment is not None:
            newest = newest.where(batches.c.assignment == self._assignment)
        return connection.execute(newest).one_or_none()


def _similar(team: str, names: Sequence[str]) -> str:
    """Return "; did you mean …?" with all names that end with the typed one, or the nearest."""
    ends = [repr(name) for name in names if person(name).endswith(person(team))]
    return f"; did you mean {' or '.join(ends[:4])}?" if ends else nearest(team, names)


def _named(team: str, listed: Sequence[Row]) -> list[Row]:
    """Return the rows named `team`; if no row is, those with `team` among the authors."""
    exact = [row for row in listed if row.name == team]
    return exact or [row for row in listed if person(team) in map(person, row.authors)]
