"""A gradebook that several people look at and change at the same time."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Row, Select, func, insert, or_, select

from pipeline.errors import ConfigError
from pipeline.grading.grade import Flag, Grade
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradebook.class_lines import Line
from pipeline.grading.gradebook.history import Event, read_events
from pipeline.grading.gradebook.override import HandPoints, WantedPoints
from pipeline.grading.gradebook.rows import (
    OVERRIDE,
    Entry,
    as_it_counts,
    class_list,
    final_entry,
    read_flag,
    read_rubric,
)
from pipeline.grading.gradebook.schema import (
    entries,
    gradings,
    looks,
    overrides,
    submissions,
)
from pipeline.grading.rubric import Rubric

State = tuple[int, int, int]


class Conflict(ConfigError):
    """A change rests on what is no longer so; `now` is what somebody else gave, if anything."""

    def __init__(self, text: str, *, now: HandPoints | None) -> None:
        super().__init__(text)
        self.now = now


@dataclass(frozen=True, kw_only=True)
class Listing:
    """A line of the class list as it counts.

    Attributes
    ----------
    line : under another name where a page is anonymous.
    submission : its name in the gradebook.
    seen : who marked the grading as looked at, or "".
    shared : the flag for recordings that stand in other submissions too.
    first_key : of what was first handed in under this name.
    made_of : what the line was worked out from.
    """

    line: Line
    submission: str
    grading: int
    seen: str
    shared: Flag | None
    first_key: str
    made_of: tuple[Any, ...]


@dataclass(frozen=True, kw_only=True)
class ClassNow:
    """The class list as it counts."""

    rubric: Rubric
    listings: tuple[Listing, ...]


@dataclass(frozen=True, kw_only=True)
class TeamNow:
    """All of one submission, at one moment.

    Attributes
    ----------
    versions : by criterion what its points rest on; to be sent along with a change of them.
    changed : criteria that were ever given points by hand.
    seen : who marked it as looked at, or "".
    """

    rubric: Rubric
    entry: Entry
    versions: Mapping[str, str]
    changed: frozenset[str]
    seen: str
    events: Sequence[Event]


@dataclass(frozen=True, kw_only=True)
class Together:
    """Points that a person gave several submissions in one go: all at the same moment.

    Attributes
    ----------
    at : ISO 8601, UTC, to the microsecond; by it they are found again.
    criterion, why : of one of them.
    teams : so many got something new.
    """

    at: str
    by: str
    criterion: str = ""
    why: str = ""
    teams: int


@dataclass(frozen=True, kw_only=True)
class Undone:
    """What was given back in one go; `kept` are submissions that somebody changed since."""

    at: str
    back: int
    kept: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Tried:
    """What points by hand would make of a submission.

    Attributes
    ----------
    version : of the criterion now; to be sent along with the change.
    """

    submission: str
    now: Grade
    after: Grade
    version: str


class OpenBook(Gradebook):
    """A gradebook of which several processes show the newest, and change no more than they saw."""

    def state(self) -> State:
        """Return numbers that change whenever something else is to be shown."""
        with self._database.reading() as connection:
            last = self._last(connection).id
            newest = (connection.scalar(select(func.max(t.c.id))) or 0 for t in (overrides, looks))
            return (last, *newest)  # type: ignore[return-value]

    def class_now(self, before: ClassNow | None = None) -> ClassNow:
        """Return the class; of what it was before, lines that rest on the same stay."""
        with self._database.reading() as connection:
            last = self._last(connection)
            rubric = read_rubric(last)
            given, first_keys = _given(connection, last), _first_keys(connection, last)
            seen = _seen(connection, last)
            known = before.listings if before and before.rubric == rubric else ()
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
                listed[row.position] = Listing(
                    line=_line(row, given.get(row.submission_id), rubric=rubric),
                    submission=row.name,
                    grading=row.id,
                    seen=seen.get(row.id, ""),
                    shared=read_flag(row.shared),
                    first_key=first_keys[row.submission_id],
                    made_of=rests_on[row.position],
                )
            return ClassNow(rubric=rubric, listings=tuple(listed[at] for at in rests_on))

    def team(self, name: str) -> TeamNow:
        """Return all of a submission.

        Raises
        ------
        ConfigError : there is none of this name.
        """
        with self._database.reading() as connection:
            last, row = self._find(connection, name)
            rubric = read_rubric(last)
            newest = _newest_overrides(connection, row.submission_id)
            marks = select(looks).where(looks.c.grading_id == row.id)
            mark = connection.execute(marks.order_by(looks.c.id.desc()).limit(1)).one_or_none()
            return TeamNow(
                rubric=rubric,
                entry=final_entry(connection, row, shared=read_flag(row.shared), rubric=rubric),
                versions={c.id: _version(row, newest.get(c.id)) for c in rubric.criteria},
                changed=frozenset(newest),
                seen=mark.by if mark is not None and mark.seen else "",
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
        seen: str,
    ) -> HandPoints:
        """Give points by hand as `override` does, where nobody else did since.

        The points that the criterion has already are not given: `why` is a comment beside them.

        Parameters
        ----------
        seen : what the change rests on, from `TeamNow.versions`.

        Raises
        ------
        Conflict : somebody else changed them, or the submission was graded anew.
        """
        with self._database.changing() as connection:
            last, row = self._find(connection, team)
            _check_seen(connection, row, criterion, seen)
            rubric = read_rubric(last)
            now = final_entry(connection, row, shared=read_flag(row.shared), rubric=rubric)
            same = points is not None and points == points_of(now.grade, criterion)
            asked = WantedPoints(
                submission=team,
                criterion=criterion,
                points=None if same else points,
                why=why,
                comment=same,
            ).beside(now.overrides.values())
            return self._give(connection, row, asked, by=by, rubric=rubric)

    def undo(self, team: str, criterion: str, *, by: str, seen: str) -> HandPoints:
        """Give a criterion what it had before its last change; twice: what it had after.

        Raises
        ------
        Conflict : see `change`.
        """
        with self._database.changing() as connection:
            last, row = self._find(connection, team)
            _check_seen(connection, row, criterion, seen)
            own = overrides.c.submission_id == row.submission_id, overrides.c.criterion == criterion
            rows = connection.execute(_overrides().where(*own)).all()
            if not rows:
                raise ConfigError(f"{criterion}: nothing was changed by hand")
            asked = _before(rows[:-1], team, criterion)
            return self._give(connection, row, asked, by=by, rubric=read_rubric(last))

    def change_all(self, wishes: Sequence[WantedPoints], *, by: str) -> Together:
        """Give points by hand, all of them or, where one cannot be, none.

        Raises
        ------
        ConfigError : with the line of the table, if they are from one.
        Conflict : one of them rests on what is no longer so.
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
                if wish.seen:
                    _check_seen(connection, row, wish.criterion, wish.seen)
                newest = _newest_overrides(connection, row.submission_id)
                ever = map(_read_override, newest.values())
                asked = wish.beside(one for one in ever if one.concerns(row.authors))
                if _is_same(asked, newest.get(asked.criterion)):
                    continue
                try:
                    self._give(connection, row, replace(asked, at=at), by=by, rubric=rubric)
                except ConfigError as error:
                    raise ConfigError(f"{where}{error}") from None
                new += 1
        return Together(at=at, by=by, teams=new)

    def try_all(self, wishes: Sequence[WantedPoints]) -> list[Tried]:
        """Return what points by hand would make of submissions, without giving them.

        Those that are not in the class are left out.
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

    def undo_all(self, at: str, *, by: str) -> Undone:
        """Give back what all criteria had that were changed in one go.

        What somebody changed since stays as it is now.
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
                wish = replace(_before(before, row.name, row.criterion), at=now)
                self._give(connection, row, wish, by=by, rubric=rubric)
                back += 1
        return Undone(at=now, back=back, kept=tuple(kept))

    def changed_together(self, *, least: int = 2) -> list[Together]:
        """Return what was given to at least so many submissions in one go, the newest first."""
        with self._database.reading() as connection:
            last = self._last(connection)
            of_class = select(entries.c.submission_id).where(entries.c.batch_id == last.id)
            columns = overrides.c.at, overrides.c.by
            teams = func.count(overrides.c.submission_id.distinct())
            mine = select(*columns, func.min(overrides.c.criterion).label("criterion"),
                          func.max(overrides.c.why).label("why"), teams.label("teams"))  # fmt: skip
            mine = mine.where(overrides.c.submission_id.in_(of_class)).group_by(*columns)
            mine = mine.having(teams >= least).order_by(func.max(overrides.c.id).desc())
            return [Together(**row) for row in connection.execute(mine).mappings()]

    def mark(self, team: str, *, by: str, seen: bool) -> None:
        """Say that somebody looked at a submission as it is graded now, or did not."""
        with self._database.writing() as connection:
            _, row = self._find(connection, team)
            values = {"grading_id": row.id, "at": self._at(), "by": by, "seen": seen}
            connection.execute(insert(looks).values(values))

    def changes_since(self, number: int) -> list[tuple[str, HandPoints]]:
        """Return the submission and content of each override after one of a number."""
        with self._database.reading() as connection:
            mine = _overrides().where(
                overrides.c.id > number,
                submissions.c.assignment == self._last(connection).assignment,
            )
            rows = connection.execute(mine).all()
        return [(row.name, _read_override(row)) for row in rows]

    def reasons(self) -> dict[str, list[str]]:
        """Return the reasons that overrides were given for, by criterion, the commonest first."""
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


def _line(row: Row, given: Mapping[int, HandPoints] | None, *, rubric: Rubric) -> Line:
    """Return a line of the class as it counts; few have points by hand, and need all of a grade."""
    shared = read_flag(row.shared)
    if given:
        return Line.of(as_it_counts(row, given.values(), shared=shared, rubric=rubric).grade)
    line = Line.model_validate_json(row.grade)
    return line.sharing() if shared else line


def _given(connection: Connection, batch: Row) -> dict[int, dict[int, HandPoints]]:
    """Return all that was ever given by hand in a class: by submission, by its own number."""
    of_class = select(entries.c.submission_id).where(entries.c.batch_id == batch.id)
    given: dict[int, dict[int, HandPoints]] = defaultdict(dict)
    mine = _overrides().where(overrides.c.submission_id.in_(of_class))
    for row in connection.execute(mine):
        given[row.submission_id][row.id] = _read_override(row)
    return given


def _first_keys(connection: Connection, batch: Row) -> dict[int, str]:
    """Return, by submission, the key of what was first handed in."""
    of_class = select(entries.c.submission_id).where(entries.c.batch_id == batch.id)
    firsts = select(func.min(gradings.c.id)).where(gradings.c.submission_id.in_(of_class))
    firsts = firsts.group_by(gradings.c.submission_id)
    keys = select(gradings.c.submission_id, gradings.c.key).where(gradings.c.id.in_(firsts))
    return {row.submission_id: row.key for row in connection.execute(keys)}


def _seen(connection: Connection, batch: Row) -> dict[int, str]:
    """Return who marked a grading as looked at, the newest mark of each."""
    of_list = select(entries.c.grading_id).where(entries.c.batch_id == batch.id)
    mine = select(looks).where(looks.c.grading_id.in_(of_list)).order_by(looks.c.id)
    marks = {row.grading_id: row for row in connection.execute(mine)}
    return {number: row.by for number, row in marks.items() if row.seen}


def _overrides() -> Select:
    """Return the query for all that was given by hand, in order."""
    columns = overrides.c.id, overrides.c.submission_id, submissions.c.name
    return select(*columns, *OVERRIDE).join(submissions).order_by(overrides.c.id)


def _before(earlier: Sequence[Row], team: str, criterion: str) -> WantedPoints:
    """Return what a criterion had by hand before its last change, of all that it ever had."""
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
    """Whether nothing is asked for but what was given last."""
    if newest is None:
        return False
    given = newest.points, newest.comment, newest.why
    return given == (asked.points, asked.comment, asked.why)


def points_of(grade: Grade, criterion: str) -> float | None:
    """Return the points of a criterion, None where it was never judged."""
    return next((own.points for own in grade.criteria if own.id == criterion), None)


def _changed_at(batch: Row, at: str) -> Select:
    """Return the query for all that a class was given by hand at one moment."""
    of_class = select(entries.c.submission_id).where(entries.c.batch_id == batch.id)
    return _overrides().where(overrides.c.at == at, overrides.c.submission_id.in_(of_class))


def _try(connection: Connection, row: Row, wish: WantedPoints, *, rubric: Rubric) -> Tried:
    """Return what a line of the class would be with points by hand."""
    shared, own = read_flag(row.shared), overrides.c.submission_id == row.submission_id
    rows = connection.execute(_overrides().where(own)).all()
    ever = [_read_override(one) for one in rows]
    asked = wish.beside(one for one in ever if one.concerns(row.authors))
    given = {name: getattr(asked, name) for name in ("criterion", "points", "why", "comment")}
    new = HandPoints(**given, by="", at="")
    newest = {one.criterion: one for one in rows}.get(wish.criterion)
    return Tried(
        submission=row.name,
        now=as_it_counts(row, ever, shared=shared, rubric=rubric).grade,
        after=as_it_counts(row, [*ever, new], shared=shared, rubric=rubric).grade,
        version=_version(row, newest),
    )


def _read_override(row: Row) -> HandPoints:
    """Return what a row of that says."""
    return HandPoints(**{column.name: row._mapping[column.name] for column in OVERRIDE})


def _newest_overrides(connection: Connection, submission: int) -> dict[str, Row]:
    rows = connection.execute(_overrides().where(overrides.c.submission_id == submission))
    return {row.criterion: row for row in rows}


def _version(row: Row, newest: Row | None) -> str:
    return f"{row.id}.{newest.id if newest is not None else 0}"


def find_version(connection: Connection, row: Row, criterion: str) -> tuple[str, HandPoints | None]:
    """Return what the points of a criterion rest on, and what was given by hand last."""
    newest = _newest_overrides(connection, row.submission_id).get(criterion)
    return _version(row, newest), _read_override(newest) if newest is not None else None


def _check_seen(connection: Connection, row: Row, criterion: str, seen: str) -> None:
    version, given = find_version(connection, row, criterion)
    if seen != version:
        raise Conflict(
            f"{criterion}: was changed, or graded anew, after this page was shown", now=given
        )
