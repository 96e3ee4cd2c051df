"""The gradebook: all gradings, the current class list, and points given by hand.

Each grading is stored as soon as it is done, in its own transaction. A complete batch becomes the
class list. Grades contain no dates, but the gradebook does, and `cartlab history` shows them.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Self

from sqlalchemy import Connection, Row, select

from pipeline.errors import ConfigError
from pipeline.grading.grade import Grade, read_grade
from pipeline.grading.gradebook.changes import points_changes, rubric_changes
from pipeline.grading.gradebook.class_lines import GradeSummary, class_frame
from pipeline.grading.gradebook.erase import erase_rows
from pipeline.grading.gradebook.history import Event, read_events
from pipeline.grading.gradebook.override import TOTAL, HandPoints, WantedPoints, check_step
from pipeline.grading.gradebook.rows import (
    GRADING,
    Entry,
    add_list,
    add_row,
    by_other_rubrics,
    carry_over,
    class_list,
    final_entries,
    final_entry,
    known_grading,
    last_named,
    lines_of,
    newest_of,
    pages,
    points_of,
    read_figures,
    read_flag,
    read_members,
    read_prints,
    read_rubric,
)
from pipeline.grading.gradebook.schema import (
    Database,
    batches,
    entries,
    figures,
    findings,
    gradings,
    overrides,
    submissions,
)
from pipeline.grading.gradings import Batch, Grading, Member, person
from pipeline.grading.rubric import Rubric
from pipeline.submission.toml import nearest
from pipeline.words.progress import silent

if TYPE_CHECKING:
    import pandas as pd

_SUGGESTED = 4  # names of submissions in one suggestion


class Gradebook:
    """A database of all gradings and of the class lists made from them.

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
                return known_grading(connection, key, assignment=mine, drawn=figures)

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
            number = add_row(
                connection,
                gradings,
                {
                    **{name: getattr(grading, name) for name in GRADING},
                    "submission_id": mine,
                    "at": at,
                    "points": grade.points,
                    "out_of": grade.out_of,
                    "deducted": grade.deducted,
                },
            )
            for position, (name, svg) in enumerate(grading.figures):
                drawn = {"grading_id": number, "position": position, "name": name, "svg": svg}
                add_row(connection, figures, drawn)
            if grading.findings:
                kept = {"grading_id": number, "found": grading.findings}
                add_row(connection, findings, kept)

    def fingerprints(self, numbers: Sequence[int] | None = None) -> Iterator[Member]:
        """Return all submissions with the fingerprints of their recordings, without repetitions.

        Earlier versions of submissions are included, because their recordings may have been passed
        on to other teams.

        Parameters
        ----------
        numbers : numbers of the gradings to read, as in `Entry.grading`; default: all gradings that
            have fingerprints.
        """
        return read_prints(self._database, numbers, assignment=self._assignment or "")

    def listed(self) -> Iterator[Member]:
        """Yield the submissions of the current class list, without fingerprints.

        The list is empty until a batch is complete.
        """
        with self._database.reading() as connection:
            last = self._newest(connection)
            lines = [] if last is None else lines_of(connection, last)
        return read_members(self._database, [line["grading_id"] for line in lines])

    def days_late(self) -> dict[str, float]:
        """Return the days late of each submission on the current class list.

        The result is empty until a batch is complete.
        """
        with self._database.reading() as connection:
            last = self._newest(connection)
            if last is None:
                return {}
            rows = connection.execute(class_list(last, submissions.c.name, gradings.c.days_late))
            return {row.name: row.days_late for row in rows}

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
        listed, points, by_hand = [], {}, set()
        with self._database.writing() as connection:
            carry_over(connection, batch.moved, assignment=self._assignment or "")
            for position, key in enumerate(batch.keys):
                row = newest_of(connection, key, assignment=self._assignment or "")
                shared = batch.shared.get(row.name)
                entry = final_entry(connection, row, shared=shared, rubric=rubric)
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
            if last is not None and last.rubric == text and lines_of(connection, last) == listed:
                return []
            mine = self._assignment or ""
            add_list(connection, listed, assignment=mine, at=self._at(), rubric=text)
            if last is None:
                return []
            changes = [f"rubric: {change}" for change in rubric_changes(last.rubric, text)]
            before = points_of(connection, last)
            before = {batch.moved.get(name, name): had for name, had in before.items()}
        return changes + points_changes(before, points, by_hand=by_hand, shown=shown)

    # ---------------------------------------------------------------- current class list

    @property
    def assignment(self) -> str:
        """The assignment of the class list.

        Raises
        ------
        ConfigError : no batch is complete yet.
        """
        with self._database.reading() as connection:
            return self._last(connection).assignment

    @property
    def rubric(self) -> Rubric:
        """The rubric of the class list.

        Raises
        ------
        ConfigError : no batch is complete yet.
        """
        with self._database.reading() as connection:
            return read_rubric(self._last(connection))

    def entries(self) -> Iterator[Entry]:
        """Yield the entries of the class list in order.

        Only some of the entries are in memory at a time.
        """
        with self._database.reading() as connection:
            last = self._last(connection)
            of_batch = select(entries.c.position).where(entries.c.batch_id == last.id)
            positions = sorted(connection.scalars(of_batch))
        rubric, lines = read_rubric(last), class_list(last)
        for page in pages(positions):
            with self._database.reading() as connection:
                rows = connection.execute(lines.where(entries.c.position.in_(page))).all()
                read = [(row, read_flag(row.shared)) for row in rows]
                found = final_entries(connection, read, rubric=rubric)
            yield from found

    def entry(self, team: str) -> Entry:
        """Return the class-list entry of the submission whose id or author is `team`.

        Raises
        ------
        ConfigError : no submission matches, or several do.
        """
        with self._database.reading() as connection:
            last, row = self._find(connection, team)
            return final_entry(
                connection, row, shared=read_flag(row.shared), rubric=read_rubric(last)
            )

    def to_frame(self) -> "pd.DataFrame":
        """Return the class list, one row per submission and criterion; see `class_frame`."""
        lines = (GradeSummary.of(entry.grade) for entry in self.entries())
        return class_frame(lines, rubric=self.rubric)

    def by_other_rubrics(self) -> list[str]:
        """Return the submissions of the class list that were graded with another rubric."""
        with self._database.reading() as connection:
            return by_other_rubrics(connection, self._last(connection))

    def figures(self, entry: Entry) -> tuple[tuple[str, str], ...]:
        """Return the figures of a submission's feedback, as pairs of file name and SVG text."""
        with self._database.reading() as connection:
            return read_figures(connection, entry.grading)

    def findings(self, entry: Entry) -> str:
        """Return the stored results of a submission's checks; "" if they were not kept."""
        mine = select(findings.c.found).where(findings.c.grading_id == entry.grading)
        with self._database.reading() as connection:
            return connection.scalar(mine) or ""

    def history(self, team: str, *, named: bool = True) -> tuple[str, list[Event]]:
        """Return the id of a submission and all its events; see `read_events`.

        Raises
        ------
        ConfigError : no submission matches, or several do.
        """
        with self._database.reading() as connection:
            row = self._find_ever(connection, team)
            return row.name, read_events(connection, row.submission_id, named=named)

    def remove(self, teams: Sequence[str]) -> list[str]:
        """Remove submissions from the class list; return their names.

        Their history stays. If they are graded again, they return to the list.

        Raises
        ------
        ConfigError : a name matches no submission on the class list, or more than one.
        """
        with self._database.writing() as connection:
            found = [self._find(connection, team) for team in teams]
            gone = {row.submission_id: row.name for _, row in found}
            last = self._last(connection)
            left = [e for e in lines_of(connection, last) if e["submission_id"] not in gone]
            add_list(
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
            erase_rows(connection, gone)
        return list(gone.values())

    def override(
        self, team: str, criterion: str, points: float | None, *, why: str, by: str
    ) -> HandPoints:
        """Set a criterion's points by hand, also for later gradings; None: the automatic points.

        Raises
        ------
        ConfigError : the submission or criterion does not exist, the points are out of range, or
            `why` or `by` is empty.
        """
        with self._database.writing() as connection:
            last, row = self._find(connection, team)
            asked = WantedPoints(submission=team, criterion=criterion, points=points, why=why)
            return self._give(connection, row, asked, by=by, rubric=read_rubric(last))

    def adjust(self, team: str, points: float, *, why: str, by: str) -> HandPoints:
        """Add points to a submission's total, also for later gradings; negative points deduct.

        All adjustments of a submission are added up. The total never falls below 0.

        Raises
        ------
        ConfigError : the submission does not exist, the points are no number or 0, or `why` or
            `by` is empty.
        """
        return self.override(team, TOTAL, points, why=why, by=by)

    # ----------------------------------------------------------------------- helpers

    def _give(
        self, connection: Connection, row: Row, asked: WantedPoints, *, by: str, rubric: Rubric
    ) -> HandPoints:
        """Store points or a comment for a submission; `row` is the submission's class-list line."""
        criterion, points = asked.criterion, asked.points
        why, by = asked.why.strip(), by.strip()
        if not why or not by:
            raise ConfigError("a change of points needs a reason (--why) and a name (--by)")
        out_of = {c.id: c.points for c in rubric.criteria}
        if criterion == TOTAL:
            if points is None or not math.isfinite(points) or points == 0:
                raise ConfigError(f"expected points to add or deduct, such as -2, found {points}")
        elif criterion not in out_of:
            hint = nearest(criterion, list(out_of))
            raise ConfigError(f"{criterion}: the rubric has no such criterion{hint}")
        elif points is not None and not 0 <= points <= out_of[criterion]:
            raise ConfigError(
                f"{criterion}: expected 0 to {out_of[criterion]:g} points, found {points:g}; "
                "to deduct from the total, or to add to it, use cartlab adjust"
            )
        before = select(overrides.c.id).filter_by(
            submission_id=row.submission_id, criterion=criterion, points=points
        )
        new = connection.execute(before).first() is None
        if criterion != TOTAL and points is not None and new:
            # Points that were given once may be restored after a change of the rubric's step.
            check_step(points, out_of=out_of[criterion], step=rubric.step)
        given = HandPoints(
            criterion=criterion,
            points=points,
            why=why,
            by=by,
            comment=asked.comment,
            at=asked.at or self._at(),
            authors=last_named(connection, row.submission_id),
        )
        add_row(connection, overrides, {**asdict(given), "submission_id": row.submission_id})
        return given

    def _at(self) -> str:
        return self._now().astimezone(UTC).isoformat(timespec="microseconds")

    def _submission(self, connection: Connection, name: str) -> int:
        values = {"assignment": self._assignment or "", "name": name}
        mine = select(submissions.c.id).filter_by(**values)
        number = connection.scalar(mine)
        return add_row(connection, submissions, values) if number is None else number

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
        names = class_list(last, submissions.c.name, gradings.c.authors)
        rows = connection.execute(names).all()
        found = [row.position for row in _named(team, rows)]
        if len(found) != 1:
            hint = f"no such submission{_similar(team, [row.name for row in rows])}"
            raise ConfigError(
                f"{team}: {'is in several submissions: give the name of one' if found else hint}"
            )
        line = class_list(last).where(entries.c.position == found[0])
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
    return f"; did you mean {' or '.join(ends[:_SUGGESTED])}?" if ends else nearest(team, names)


def _named(team: str, rows: Sequence[Row]) -> list[Row]:
    """Return the rows named `team`; if no row is, those with `team` among the authors."""
    exact = [row for row in rows if row.name == team]
    return exact or [row for row in rows if person(team) in map(person, row.authors)]
