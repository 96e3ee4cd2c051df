"""A gradebook that several people can read and change at the same time."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Row, Select, func, insert, or_, select

from pipeline.errors import ConfigError
from pipeline.grading.grade import Flag, Grade
from pipeline.grading.gradebook.class_lines import GradeSummary
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import Event, read_events
from pipeline.grading.gradebook.override import TOTAL, HandPoints, WantedPoints
from pipeline.grading.gradebook.rows import (
    OVERRIDE,
    Entry,
    class_list,
    current_entry,
    final_entry,
    first_keys,
    read_flag,
    read_rubric,
)
from pipeline.grading.gradebook.schema import entries, gradings, overrides, reviews, submissions
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import points_text

State = tuple[int, int, int]


class Conflict(ConfigError):
    """A change is refused, because the criterion has changed in the meantime.

    `now` holds the last points given by hand, or None.
    """

    def __init__(self, text: str, *, now: HandPoints | None) -> None:
        super().__init__(text)
        self.now = now


@dataclass(frozen=True, kw_only=True)
class ClassRow:
    """A line of the class list with its current grade.

    Attributes
    ----------
    line : parts of the grade; on an anonymous page, its `submission` is a pseudonym.
    submission : name of the submission in the gradebook.
    grading : number of the grading in the gradebook.
    reviewed_by : name of the person who marked the grading as reviewed, or "".
    shared : the flag for recordings that other submissions also contain.
    first_key : key of the first version that was submitted under this name.
    made_of : data from which the line was computed; the line is valid until they change.
    """

    line: GradeSummary
    submission: str
    grading: int
    reviewed_by: str
    shared: Flag | None
    first_key: str
    made_of: tuple[Any, ...]


@dataclass(frozen=True, kw_only=True)
class ClassNow:
    """The class list with current grades."""

    rubric: Rubric
    rows: tuple[ClassRow, ...]


@dataclass(frozen=True, kw_only=True)
class TeamNow:
    """All data of one submission at one moment.

    Attributes
    ----------
    versions : version of the points, by criterion and for `TOTAL`; a change must name the version
        on which it is based.
    changed : criteria that have ever had points or a comment given by hand.
    reviewed_by : name of the person who marked the grading as reviewed, or "".
    """

    rubric: Rubric
    entry: Entry
    versions: Mapping[str, str]
    changed: frozenset[str]
    reviewed_by: str
    events: Sequence[Event]


@dataclass(frozen=True, kw_only=True)
class BulkChange:
    """Changes that a person made to several submissions at once.

    Attributes
    ----------
    at : time of all these changes, in ISO 8601, UTC, to the microsecond; it identifies them.
    criterion, why : a criterion and a reason from these changes, as examples.
    teams : number of submissions changed.
    """

    at: str
    by: str
    criterion: str = ""
    why: str = ""
    teams: int


@dataclass(frozen=True, kw_only=True)
class UndoResult:
    """The result of `SharedGradebook.undo_all`.

    Attributes
    ----------
    at : time at which the changes were undone; `undo_all` with this time restores them.
    back : number of changes undone.
    kept : submissions left unchanged, because somebody has changed them since.
    """

    at: str
    back: int
    kept: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Preview:
    """The grade of a submission without and with some points that have not been stored.

    Attributes
    ----------
    version : current version of the criterion's points, which a change must name.
    """

    submission: str
    now: Grade
    after: Grade
    version: str


class SharedGradebook(Gradebook):
    """A gradebook that several processes share.

    A person's change must name the version of the data that the person saw. If the data have
    changed since, the change is refused.
    """

    def state(self) -> State:
        """Return numbers that change whenever the content of the gradebook changes."""
        with self._database.reading() as connection:
            last = self._last(connection).id
            newest = (
                connection.scalar(select(func.max(t.c.id))) or 0 for t in (overrides, reviews)
            )
            return (last, *newest)  # type: ignore[return-value]

    def class_now(self, before: ClassNow | None = None) -> ClassNow:
        """Return the class with current grades.

        Parameters
        ----------
        before : an earlier result, whose unchanged lines are reused.
        """
        with self._database.reading() as connection:
            last = self._last(connection)
            rubric = read_rubric(last)
            given = _class_overrides(connection, last)
            keys = first_keys(connection, _in_class(last))
            seen = _reviewers(connection, last)
            known = before.rows if before and before.rubric == rubric else ()
            made = {listing.made_of: listing for listing in known}
            columns = gradings.c.id, gradings.c.submission_id
            rests_on = {
                row.position: (
                    row.id,
                    row.shared,
                    seen.get(row.id, ""),
                    *given.get(row.submission_id, ()),
                )
                for row in connection.execute(class_list(last, *columns))
            }
            listed = {at: made[of] for at, of in rests_on.items() if of in made}
            rows = class_list(last)
            if listed:
                new = [at for at in rests_on if at not in listed]
                rows = rows.where(entries.c.position.in_(new))
            for row in connection.execute(rows):
                listed[row.position] = ClassRow(
                    line=_line(row, given.get(row.submission_id), rubric=rubric),
                    submission=row.name,
                    grading=row.id,
                    reviewed_by=seen.get(row.id, ""),
                    shared=read_flag(row.shared),
                    first_key=keys[row.submission_id],
                    made_of=rests_on[row.position],
                )
            return ClassNow(rubric=rubric, rows=tuple(listed[at] for at in rests_on))

    def team(self, name: str) -> TeamNow:
        """Return all data of one submission.

        Raises
        ------
        ConfigError : no submission matches `name`, or several do.
        """
        with self._database.reading() as connection:
            last, row = self._find(connection, name)
            rubric = read_rubric(last)
            newest = newest_overrides(connection, [row.submission_id])[row.submission_id]
            marks = select(reviews).where(reviews.c.grading_id == row.id)
            mark = connection.execute(marks.order_by(reviews.c.id.desc()).limit(1)).one_or_none()
            return TeamNow(
                rubric=rubric,
                entry=final_entry(connection, row, shared=read_flag(row.shared), rubric=rubric),
                versions={
                    id_: name_version(row, newest.get(id_))
                    for id_ in (*(c.id for c in rubric.criteria), TOTAL)
                },
                changed=frozenset(newest),
                reviewed_by=mark.by if mark is not None and mark.seen else "",
                events=read_events(connection, row.submission_id, named=not rubric.anonymous),
            )

    def change(
        self,
        team: str,
        criterion: str,
        points: float | None,
        *,
        why: str,
        by: str,
        version: str,
    ) -> HandPoints:
        """Set the points of a criterion by hand, unless they have changed in the meantime.

        If the criterion already has these points, exactly or as `points_text` shows them, `why` is
        only added as a comment.

        Parameters
        ----------
        version : version of the points that the person saw, from `TeamNow.versions`.

        Raises
        ------
        Conflict : somebody else changed the points, or the submission was graded again.
        """
        with self._database.changing() as connection:
            last, row = self._find(connection, team)
            _check_version(connection, row, criterion, version)
            rubric = read_rubric(last)
            now = final_entry(connection, row, shared=read_flag(row.shared), rubric=rubric)
            same = is_unchanged(points, now.grade, criterion)
            asked = WantedPoints(
                submission=team,
                criterion=criterion,
                points=None if same else points,
                why=why,
                comment=same,
            ).beside(now.overrides.values())
            return self._give(connection, row, asked, by=by, rubric=rubric)

    def undo(self, team: str, criterion: str, *, by: str, version: str) -> HandPoints:
        """Undo the last change of a criterion; a second call redoes it.

        Raises
        ------
        Conflict : see `change`.
        """
        with self._database.changing() as connection:
            last, row = self._find(connection, team)
            _check_version(connection, row, criterion, version)
            own = overrides.c.submission_id == row.submission_id, overrides.c.criterion == criterion
            rows = connection.execute(_overrides().where(*own)).all()
            if not rows:
                raise ConfigError(f"{criterion}: nothing was changed by hand")
            asked = _restoring_change(rows[:-1], team, criterion)
            return self._give(connection, row, asked, by=by, rubric=read_rubric(last))

    def change_all(self, wishes: Sequence[WantedPoints], *, by: str) -> BulkChange:
        """Give points by hand to several submissions; if one change is refused, all are.

        Raises
        ------
        ConfigError : a change is not valid; the message names its line in the table, if any.
        Conflict : a change is based on an outdated version.
        """
        new = 0
        with self._database.changing() as connection:
            last = self._last(connection)
            rubric, at = read_rubric(last), self._at()
            columns = (
                submissions.c.name,
                gradings.c.id,
                gradings.c.submission_id,
                gradings.c.authors,
            )
            named = {row.name: row for row in connection.execute(class_list(last, *columns))}
            for wish in wishes:
                where = f"line {wish.line}: " if wish.line else ""
                row = named.get(wish.submission)
                if row is None:
                    raise ConfigError(f"{where}no such submission is in the class")
                if wish.version:
                    _check_version(connection, row, wish.criterion, wish.version)
                newest = newest_overrides(connection, [row.submission_id])[row.submission_id]
                ever = map(_read_override, newest.values())
                asked = wish.beside(one for one in ever if one.concerns(row.authors))
                if _is_same(asked, newest.get(asked.criterion)):
                    continue
                try:
                    self._give(connection, row, replace(asked, at=at), by=by, rubric=rubric)
                except ConfigError as error:
                    raise ConfigError(f"{where}{error}") from None
                new += 1
        return BulkChange(at=at, by=by, teams=new)

    def try_all(self, wishes: Sequence[WantedPoints]) -> list[Preview]:
        """Return each submission's grade without and with the requested points; store nothing.

        Submissions that are not in the class are left out.
        """
        wished = {wish.submission: wish for wish in wishes}
        with self._database.reading() as connection:
            last = self._last(connection)
            rubric = read_rubric(last)
            mine = class_list(last).where(submissions.c.name.in_(wished))
            return [
                _try(connection, row, wished[row.name], rubric=rubric)
                for row in connection.execute(mine).all()
            ]

    def undo_all(self, at: str, *, by: str) -> UndoResult:
        """Undo all changes that a person made at the same time.

        A criterion that has been changed since stays as it is.

        Parameters
        ----------
        at : time of the changes, from `BulkChange.at`.
        """
        back, kept = 0, []
        with self._database.changing() as connection:
            last = self._last(connection)
            rubric, now = read_rubric(last), self._at()
            for row in connection.execute(_changed_at(last, at)).all():
                ever = overrides.c.submission_id == row.submission_id
                own = _overrides().where(ever, overrides.c.criterion == row.criterion)
                *before, newest = connection.execute(own).all()
                if newest.id != row.id:
                    kept.append(row.name)
                    continue
                wish = replace(_restoring_change(before, row.name, row.criterion), at=now)
                self._give(connection, row, wish, by=by, rubric=rubric)
                back += 1
        return UndoResult(at=now, back=back, kept=tuple(kept))

    def changed_together(self, *, least: int = 2) -> list[BulkChange]:
        """Return the changes that were made to several submissions at once, newest first.

        Parameters
        ----------
        least : smallest number of submissions that counts as several.
        """
        with self._database.reading() as connection:
            last = self._last(connection)
            columns = overrides.c.at, overrides.c.by
            teams = func.count(overrides.c.submission_id.distinct())
            mine = select(*columns, func.min(overrides.c.criterion).label("criterion"),
                          func.max(overrides.c.why).label("why"), teams.label("teams"))  # fmt: skip
            mine = mine.where(overrides.c.submission_id.in_(_in_class(last))).group_by(*columns)
            mine = mine.having(teams >= least).order_by(func.max(overrides.c.id).desc())
            return [BulkChange(**row) for row in connection.execute(mine).mappings()]

    def set_reviewed(self, team: str, *, by: str, reviewed: bool) -> None:
        """Mark the current grading of a submission as reviewed, or as not reviewed."""
        with self._database.writing() as connection:
            _, row = self._find(connection, team)
            values = {"grading_id": row.id, "at": self._at(), "by": by, "seen": reviewed}
            connection.execute(insert(reviews).values(values))

    def changes_since(self, number: int) -> list[tuple[str, HandPoints]]:
        """Return the overrides numbered above `number`, each with the name of its submission."""
        with self._database.reading() as connection:
            mine = _overrides().where(
                overrides.c.id > number,
                submissions.c.assignment == self._last(connection).assignment,
            )
            rows = connection.execute(mine).all()
        return [(row.name, _read_override(row)) for row in rows]

    def reasons(self) -> dict[str, list[str]]:
        """Return the reasons for points and comments by criterion, the most common first."""
        with self._database.reading() as connection:
            mine = (
                select(overrides.c.criterion, overrides.c.why)
                .join(submissions)
                .where(
                    submissions.c.assignment == self._last(connection).assignment,
                    or_(overrides.c.points.is_not(None), overrides.c.comment),
                )
                .group_by(overrides.c.criterion, overrides.c.why)
                .order_by(func.count().desc(), overrides.c.why)
            )
            found: dict[str, list[str]] = defaultdict(list)
            for criterion, why in connection.execute(mine):
                found[criterion].append(why)
        return dict(found)


def _line(row: Row, given: Mapping[int, HandPoints] | None, *, rubric: Rubric) -> GradeSummary:
    """Return a line of the class list with its current grade.

    `given` holds the line's overrides, if it has any. The whole grade is read only if it has.
    """
    shared = read_flag(row.shared)
    if given:
        return GradeSummary.of(
            current_entry(row, given.values(), shared=shared, rubric=rubric).grade
        )
    line = GradeSummary.model_validate_json(row.grade)
    return line.sharing() if shared else line


def _in_class(batch: Row) -> Select:
    """Return the query for the numbers of the submissions on a class list."""
    return select(entries.c.submission_id).where(entries.c.batch_id == batch.id)


def _class_overrides(connection: Connection, batch: Row) -> dict[int, dict[int, HandPoints]]:
    """Return all overrides of a class, by submission number and override number."""
    given: dict[int, dict[int, HandPoints]] = defaultdict(dict)
    mine = _overrides().where(overrides.c.submission_id.in_(_in_class(batch)))
    for row in connection.execute(mine):
        given[row.submission_id][row.id] = _read_override(row)
    return given


def _reviewers(connection: Connection, batch: Row) -> dict[int, str]:
    """Return who marked each grading as reviewed, by grading number; the newest mark counts."""
    of_list = select(entries.c.grading_id).where(entries.c.batch_id == batch.id)
    mine = select(reviews).where(reviews.c.grading_id.in_(of_list)).order_by(reviews.c.id)
    marks = {row.grading_id: row for row in connection.execute(mine)}
    return {number: row.by for number, row in marks.items() if row.seen}


def _overrides() -> Select:
    """Return the query for all overrides, oldest first."""
    columns = overrides.c.id, overrides.c.submission_id, submissions.c.name
    return select(*columns, *OVERRIDE).join(submissions).order_by(overrides.c.id)


def _restoring_change(earlier: Sequence[Row], team: str, criterion: str) -> WantedPoints:
    """Return a change that restores a criterion to its state after the overrides `earlier`."""
    last = earlier[-1] if earlier else None
    if last is None or (last.points is None and not last.comment):
        return WantedPoints(submission=team, criterion=criterion, points=None, why="taken back")
    return WantedPoints(
        submission=team,
        criterion=criterion,
        points=last.points,
        why=last.why,
        comment=last.comment,
    )


def _is_same(asked: WantedPoints, newest: Row | None) -> bool:
    """Return whether a requested change only repeats the newest override."""
    if newest is None:
        return False
    given = newest.points, newest.comment, newest.why
    return given == (asked.points, asked.comment, asked.why)


def points_of(grade: Grade, criterion: str) -> float | None:
    """Return the points of a criterion; None if it was never judged."""
    return next((own.points for own in grade.criteria if own.id == criterion), None)


def is_unchanged(points: float | None, grade: Grade, criterion: str) -> bool:
    """Return whether typed points are those that a page shows for a criterion.

    A page shows at most two decimals, so 1.33 leaves points of 4/3 as they are.
    """
    now = None if criterion in grade.open else points_of(grade, criterion)
    return now is not None and points in (now, float(points_text(now)))


def _changed_at(batch: Row, at: str) -> Select:
    """Return the query for the overrides that were made in a class at the time `at`."""
    return _overrides().where(overrides.c.at == at, overrides.c.submission_id.in_(_in_class(batch)))


def _try(connection: Connection, row: Row, wish: WantedPoints, *, rubric: Rubric) -> Preview:
    """Return the grade of a submission without and with the requested points."""
    shared, own = read_flag(row.shared), overrides.c.submission_id == row.submission_id
    rows = connection.execute(_overrides().where(own)).all()
    ever = [_read_override(one) for one in rows]
    asked = wish.beside(one for one in ever if one.concerns(row.authors))
    given = {name: getattr(asked, name) for name in ("criterion", "points", "why", "comment")}
    new = HandPoints(**given, by="", at="")
    newest = {one.criterion: one for one in rows}.get(wish.criterion)
    return Preview(
        submission=row.name,
        now=current_entry(row, ever, shared=shared, rubric=rubric).grade,
        after=current_entry(row, [*ever, new], shared=shared, rubric=rubric).grade,
        version=name_version(row, newest),
    )


def _read_override(row: Row) -> HandPoints:
    """Return the override in a row of the query `_overrides`."""
    return HandPoints(**{column.name: row._mapping[column.name] for column in OVERRIDE})


def newest_overrides(connection: Connection, submitted: Iterable[int]) -> dict[int, dict[str, Row]]:
    """Return the last override of each criterion, by submission number and criterion."""
    rows = connection.execute(_overrides().where(overrides.c.submission_id.in_(set(submitted))))
    newest: dict[int, dict[str, Row]] = defaultdict(dict)
    for row in rows:
        newest[row.submission_id][row.criterion] = row
    return newest


def name_version(row: Row, newest: Row | None) -> str:
    """Return the version of a criterion's points: the numbers of its grading and last override."""
    return f"{row.id}.{newest.id if newest is not None else 0}"


def find_version(connection: Connection, row: Row, criterion: str) -> tuple[str, HandPoints | None]:
    """Return the version of a criterion's points, and the last points given by hand, or None."""
    newest = newest_overrides(connection, [row.submission_id])[row.submission_id].get(criterion)
    return name_version(row, newest), _read_override(newest) if newest is not None else None


def _check_version(connection: Connection, row: Row, criterion: str, version: str) -> None:
    current, given = find_version(connection, row, criterion)
    if version != current:
        raise Conflict(
            f"{criterion}: was changed or graded again after this page was shown", now=given
        )
