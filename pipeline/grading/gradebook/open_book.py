"""A gradebook that several people look at and change at the same time."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Row, Select, func, insert, select

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradebook.class_lines import Line
from pipeline.grading.gradebook.history import Event, read_events
from pipeline.grading.gradebook.override import Override, Wish
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
    briefs,
    entries,
    gradings,
    looks,
    overrides,
    submissions,
)
from pipeline.grading.rubric import Rubric
from pipeline.schemas.grade import Flag

State = tuple[int, int, int]


class Conflict(ConfigError):
    """A change rests on what is no longer so; `now` is what somebody else gave, if anything."""

    def __init__(self, text: str, *, now: Override | None) -> None:
        super().__init__(text)
        self.now = now


@dataclass(frozen=True, kw_only=True)
class Listing:
    """A line of the class list as it counts.

    Attributes
    ----------
    shared : the flag for recordings that stand in other submissions too.
    first_key : of what was first handed in under this name.
    made_of : what the line was worked out from.
    """

    line: Line
    grading: int
    shared: Flag | None
    first_key: str
    made_of: tuple[Any, ...]


@dataclass(frozen=True, kw_only=True)
class ClassNow:
    """The class list as it counts.

    Attributes
    ----------
    seen : who marked a grading as looked at, by its number.
    """

    rubric: Rubric
    listings: tuple[Listing, ...]
    seen: Mapping[int, str]


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
            known = before.listings if before and before.rubric == rubric else ()
            made = {listing.made_of: listing for listing in known}
            columns = gradings.c.id, gradings.c.submission_id, briefs.c.grade.label("brief")
            rows = [
                (row, (row.id, row.shared, *given.get(row.submission_id, ())))
                for row in connection.execute(class_list(last, *columns))
            ]
            # Few have points by hand, and those need all of the grade.
            by_hand = {row.submission_id for row, of in rows if of not in made} & given.keys()
            whole = class_list(last).where(entries.c.submission_id.in_(by_hand))
            entry_of = {
                row.submission_id: as_it_counts(
                    row,
                    given[row.submission_id].values(),
                    shared=read_flag(row.shared),
                    rubric=rubric,
                )
                for row in connection.execute(whole)
            }
            listings = []
            for row, made_of in rows:
                if (listing := made.get(made_of)) is None:
                    shared, entry = read_flag(row.shared), entry_of.get(row.submission_id)
                    listing = Listing(
                        line=Line.of(entry.grade)
                        if entry
                        else Line.read(row.brief, shared=shared is not None),
                        grading=row.id,
                        shared=shared,
                        first_key=first_keys[row.submission_id],
                        made_of=made_of,
                    )
                listings.append(listing)
            return ClassNow(rubric=rubric, listings=tuple(listings), seen=_seen(connection, last))

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
    ) -> Override:
        """Give points by hand as `override` does, where nobody else did since.

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
            return self._give(
                connection, row, criterion, points, why=why, by=by, rubric=read_rubric(last)
            )

    def undo(self, team: str, criterion: str, *, by: str, seen: str) -> Override:
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
            before = rows[-2] if len(rows) > 1 and rows[-2].points is not None else None
            return self._give(
                connection,
                row,
                criterion,
                before.points if before else None,
                why=before.why if before else "taken back",
                by=by,
                rubric=read_rubric(last),
            )

    def change_all(self, wishes: Sequence[Wish], *, by: str) -> int:
        """Give points by hand, all of them or, where one cannot be, none; say how many were new.

        Raises
        ------
        ConfigError : with the line of the table.
        """
        new = 0
        with self._database.changing() as connection:
            last = self._last(connection)
            rubric = read_rubric(last)
            columns = submissions.c.name, gradings.c.submission_id
            named = {row.name: row for row in connection.execute(class_list(last, *columns))}
            for wish in wishes:
                row = named.get(wish.submission)
                if row is None:
                    raise ConfigError(f"line {wish.line}: no such submission is in the class")
                newest = _newest_overrides(connection, row.submission_id).get(wish.criterion)
                if newest is not None and (newest.points, newest.why) == (wish.points, wish.why):
                    continue
                try:
                    self._give(
                        connection, row, wish.criterion, wish.points, why=wish.why, by=by,
                        rubric=rubric,
                    )  # fmt: skip
                except ConfigError as error:
                    raise ConfigError(f"line {wish.line}: {error}") from None
                new += 1
        return new

    def mark(self, team: str, *, by: str, seen: bool) -> None:
        """Say that somebody looked at a submission as it is graded now, or did not."""
        with self._database.writing() as connection:
            _, row = self._find(connection, team)
            values = {"grading_id": row.id, "at": self._at(), "by": by, "seen": seen}
            connection.execute(insert(looks).values(values))

    def changes_since(self, number: int) -> list[tuple[str, Override]]:
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
                    overrides.c.points.is_not(None),
                )
                .group_by(overrides.c.criterion, overrides.c.why)
                .order_by(func.count().desc(), overrides.c.why)
            )
            found: dict[str, list[str]] = defaultdict(list)
            for criterion, why in connection.execute(mine):
                found[criterion].append(why)
        return dict(found)


def _given(connection: Connection, batch: Row) -> dict[int, dict[int, Override]]:
    """Return all that was ever given by hand in a class: by submission, by its own number."""
    of_class = select(entries.c.submission_id).where(entries.c.batch_id == batch.id)
    given: dict[int, dict[int, Override]] = defaultdict(dict)
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


def _read_override(row: Row) -> Override:
    """Return what a row of that says."""
    return Override(**{column.name: row._mapping[column.name] for column in OVERRIDE})


def _newest_overrides(connection: Connection, submission: int) -> dict[str, Row]:
    rows = connection.execute(_overrides().where(overrides.c.submission_id == submission))
    return {row.criterion: row for row in rows}


def _version(row: Row, newest: Row | None) -> str:
    return f"{row.id}.{newest.id if newest is not None else 0}"


def _check_seen(connection: Connection, row: Row, criterion: str, seen: str) -> None:
    newest = _newest_overrides(connection, row.submission_id).get(criterion)
    if seen != _version(row, newest):
        raise Conflict(
            f"{criterion}: was changed, or graded anew, after this page was shown",
            now=_read_override(newest) if newest is not None else None,
        )
