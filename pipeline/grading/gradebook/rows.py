"""Read and write the rows of a gradebook as objects."""

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import sqlalchemy as sa
from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.grading.grade import Flag, read_grade
from pipeline.grading.gradebook.database import Database
from pipeline.grading.gradebook.events import HOLDS, REQUESTS, Entry, Event
from pipeline.grading.gradebook.schema import (
    batches,
    drop_copied,
    entries,
    events,
    figures,
    findings,
    gradings,
    submissions,
)
from pipeline.grading.gradings import Grading, same_people
from pipeline.grading.rubric import Rubric

_PAGE = 100  # rows read at once; few, so that memory use stays flat and writers wait only briefly
# The attributes of a grading that are stored in a column of the same name.
GRADING = [f.name for f in fields(Grading) if f.name in gradings.c]
_EVENT = [
    events.c.grading_id.label("grading") if f.name == "grading" else events.c[f.name]
    for f in fields(Event)
    if f.name != "out_of"
]
_OF_GRADING = sa.select(submissions.c.name.label("submission"), *(gradings.c[x] for x in GRADING))
_BRIEF = (
    submissions.c.name.label("submission"),
    gradings.c.authors,
    gradings.c.owner,
    gradings.c.key,
    gradings.c.id.label("grading"),
)


def add_row(connection: sa.Connection, table: sa.Table, values: dict) -> int:
    """Add a row and return its number."""
    key = connection.execute(sa.insert(table).values(values)).inserted_primary_key
    assert key is not None
    return key[0]


def pages(numbers: Sequence[int]) -> Iterator[Sequence[int]]:
    """Yield the row numbers in pages."""
    return (numbers[i : i + _PAGE] for i in range(0, len(numbers), _PAGE))


def _newest(chosen: sa.Select, key: str, *, assignment: str) -> sa.Select:
    """Return the query for the newest grading with a key in an assignment.

    The key alone is not enough, because two assignments may have rubrics with the same text.
    """
    mine = chosen.where(gradings.c.key == key, submissions.c.assignment == assignment)
    return mine.order_by(gradings.c.id.desc()).limit(1)


# ------------------------------------------------------------------------ gradings


def known_grading(
    connection: sa.Connection, key: str, *, assignment: str, drawn: bool
) -> Grading | None:
    """Return the newest grading with this key, or None.

    The figures are read only if `drawn` is true.
    """
    newest = _newest(_OF_GRADING.join(submissions), key, assignment=assignment)
    row = connection.execute(newest.add_columns(gradings.c.id)).mappings().one_or_none()
    if row is None:
        return None
    own = {name: value for name, value in row.items() if name != "id"}
    return Grading(**own, figures=read_figures(connection, row["id"]) if drawn else ())


def read_figures(connection: sa.Connection, grading: int) -> tuple[tuple[str, str], ...]:
    """Return the figures of a grading, as pairs of file name and SVG text."""
    mine = sa.select(figures.c.name, figures.c.svg).where(figures.c.grading_id == grading)
    return tuple((name, svg) for name, svg in connection.execute(mine.order_by(figures.c.position)))


def read_gradings(database: Database, numbers: Sequence[int]) -> Iterator[Grading]:
    """Yield the gradings with these numbers, without texts and fingerprints."""
    lines = sa.select(*_BRIEF).join(submissions).order_by(gradings.c.id)
    for page in pages(numbers):
        with database.reading() as connection:
            rows = connection.execute(lines.where(gradings.c.id.in_(page))).mappings().all()
        yield from (Grading(**row, of_class=True) for row in rows)


def read_prints(
    database: Database, numbers: Sequence[int] | None = None, *, assignment: str
) -> Iterator[Grading]:
    """Yield all submissions with the fingerprints of their recordings, without repetitions.

    Parameters
    ----------
    numbers : numbers of the gradings to read; default: all gradings that have fingerprints.
    assignment : assignment whose submissions have `of_class` set.
    """
    chosen = sa.select(*_BRIEF, gradings.c.fingerprints, submissions.c.assignment)
    chosen = chosen.join(submissions).order_by(gradings.c.id)
    if numbers is None:
        chosen = chosen.where(gradings.c.fingerprints != b"")
        with database.reading() as connection:
            numbers = sorted(connection.scalars(sa.select(gradings.c.id)))
    seen = set()
    for page in pages(numbers):
        with database.reading() as connection:
            rows = connection.execute(chosen.where(gradings.c.id.in_(page))).mappings().all()
        for row in map(dict, rows):
            of = row.pop("assignment")
            one = Grading(**row, of_class=of == assignment)
            own = of, one.submission, one.authors, hashlib.sha256(one.fingerprints).digest()
            if own not in seen:
                seen.add(own)
                yield one


# ---------------------------------------------------------------------- class lists

_ENTRY = (
    gradings.c.id,
    gradings.c.submission_id,
    gradings.c.key,
    gradings.c.authors,
    gradings.c.owner,
    gradings.c.grade,
    submissions.c.name,
)


def newest_of(connection: sa.Connection, key: str, *, assignment: str) -> sa.Row:
    """Return the newest grading with a key in an assignment.

    Raises
    ------
    KeyError : the key has no grading.
    """
    newest = _newest(sa.select(*_ENTRY).join(submissions), key, assignment=assignment)
    row = connection.execute(newest).one_or_none()
    if row is None:
        raise KeyError(key)
    return row


def class_list(batch: sa.Row, *columns: sa.ColumnElement) -> sa.Select:
    """Return the query for the lines of a class list, in order.

    Parameters
    ----------
    columns : columns to read besides position and flag; default: those in `_ENTRY`.
    """
    joined = entries.join(gradings, entries.c.grading_id == gradings.c.id).join(
        submissions, entries.c.submission_id == submissions.c.id
    )
    chosen = sa.select(*(columns or _ENTRY), entries.c.position, entries.c.shared)
    mine = chosen.select_from(joined).where(entries.c.batch_id == batch.id)
    return mine.order_by(entries.c.position)


def read_entries(
    connection: sa.Connection, lines: Sequence[tuple[sa.Row, Flag | None]], *, rubric: Rubric
) -> list[Entry]:
    """Return lines of the class list as they stand now, in two queries.

    Parameters
    ----------
    lines : rows of a class list, each with its flag for shared data.
    """
    numbers = {row.submission_id for row, _ in lines}
    done = read_events(connection, events.c.submission_id.in_(numbers))
    keys = first_keys(connection, numbers)
    grades = [read_grade(row.grade) for row, _ in lines]
    return [
        Entry(
            submission=row.name,
            rubric=rubric,
            graded=grade.with_flags(shared) if shared else grade,
            authors=row.authors,
            events=tuple(done.get(row.submission_id, ())),
            owner=row.owner,
            key=row.key,
            grading=row.id,
            first_key=keys.get(row.submission_id, ""),
        )
        for (row, shared), grade in zip(lines, grades, strict=True)
    ]


def read_lines(
    connection: sa.Connection, chosen: sa.Select, *, rubric: Rubric
) -> list[tuple[sa.Row, Entry]]:
    """Return the lines that a query of `class_list` chooses, each as row and as entry."""
    found = connection.execute(chosen).all()
    lines = [(row, read_flag(row.shared)) for row in found]
    return list(zip(found, read_entries(connection, lines, rubric=rubric), strict=True))


@dataclass(frozen=True, kw_only=True)
class ClassNow:
    """The class list with current grades.

    Attributes
    ----------
    made_of : the entries in order, by the data that each was made from; an entry is valid until
        they change.
    """

    rubric: Rubric
    made_of: Mapping[tuple[Any, ...], Entry]

    @property
    def entries(self) -> list[Entry]:
        """The entries in the order of the class list."""
        return list(self.made_of.values())


def read_class(connection: sa.Connection, batch: sa.Row, before: ClassNow | None) -> ClassNow:
    """Return a class list with current grades, with the unchanged entries of an earlier result."""
    rubric, lines = read_rubric(batch), class_list(batch)
    done = read_events(connection, events.c.submission_id.in_(in_class(batch)))
    known = before.made_of if before and before.rubric == rubric else {}
    columns = gradings.c.id, gradings.c.at, gradings.c.submission_id
    made_of = {
        row.position: (
            (row.id, row.at), row.shared, *(e.id for e in done.get(row.submission_id, ()))
        )
        for row in connection.execute(class_list(batch, *columns))
    }  # fmt: skip
    listed = {at: known[of] for at, of in made_of.items() if of in known}
    for page in pages([at for at in made_of if at not in listed]):
        chosen = lines.where(entries.c.position.in_(page))
        found = read_lines(connection, chosen, rubric=rubric)
        listed |= {row.position: entry for row, entry in found}
    return ClassNow(rubric=rubric, made_of={of: listed[at] for at, of in made_of.items()})


def read_events(connection: sa.Connection, *where: sa.ColumnElement) -> dict[int, list[Event]]:
    """Return the events of submissions that meet the conditions, by submission, oldest first."""
    found: dict[int, list[Event]] = defaultdict(list)
    mine = sa.select(events.c.submission_id, *_EVENT).where(*where).order_by(events.c.id)
    for row in connection.execute(mine).mappings():
        values = dict(row)
        number = values.pop("submission_id")
        found[number].append(Event(**values))
    return found


def first_keys(connection: sa.Connection, submitted: Iterable[int] | sa.Select) -> dict[int, str]:
    """Return the key of each submission's first version, by submission number."""
    firsts = sa.select(sa.func.min(gradings.c.id)).where(gradings.c.submission_id.in_(submitted))
    firsts = firsts.group_by(gradings.c.submission_id)
    keys = sa.select(gradings.c.submission_id, gradings.c.key).where(gradings.c.id.in_(firsts))
    return {row.submission_id: row.key for row in connection.execute(keys)}


def find_requests(connection: sa.Connection, batch: sa.Row) -> tuple[list[sa.Row], list[sa.Row]]:
    """Return the newest event of each request in a class, in two lists: waiting and settled.

    Each row has its number `id`, the `criterion`, and the `submission_id` and `position` of its
    submission. Waiting requests come oldest first, settled ones newest first.
    """
    newest = sa.select(sa.func.max(events.c.id)).where(events.c.what.in_(REQUESTS))
    newest = newest.group_by(events.c.submission_id, events.c.criterion)
    joined = (
        events.join(entries, entries.c.submission_id == events.c.submission_id)
        .join(gradings, gradings.c.id == entries.c.grading_id)
        .join(submissions, submissions.c.id == entries.c.submission_id)
    )
    columns = (
        events.c.id,
        events.c.submission_id,
        events.c.criterion,
        events.c.what,
        events.c.authors.label("asked_by"),
        entries.c.position,
        gradings.c.authors,
        submissions.c.name,
    )
    mine = sa.select(*columns).select_from(joined).where(entries.c.batch_id == batch.id)
    found = connection.execute(mine.where(events.c.id.in_(newest)).order_by(events.c.id)).all()
    theirs = [row for row in found if same_people(row.asked_by, row.authors)]
    waiting = [row for row in theirs if row.what == "asked"]
    return waiting, [row for row in reversed(theirs) if row.what != "asked"]


def is_released(connection: sa.Connection, assignment: str) -> bool:
    """Return whether students may read the feedback of an assignment."""
    mine = sa.select(events.c.what).where(
        events.c.assignment == assignment, events.c.what.in_(("released", "hidden"))
    )
    return connection.scalar(mine.order_by(events.c.id.desc()).limit(1)) == "released"


def held_criteria(connection: sa.Connection, batch: sa.Row) -> tuple[str, ...]:
    """Return the criteria of a class list's rubric that are held back."""
    mine = sa.select(events.c.criterion, events.c.what).where(
        events.c.assignment == batch.assignment,
        events.c.submission_id.is_(None),
        events.c.what.in_(HOLDS),
    )
    last = {row.criterion: row.what for row in connection.execute(mine.order_by(events.c.id))}
    return tuple(id_ for id_ in read_rubric(batch).titles if last.get(id_) == "held")


def add_event(
    connection: sa.Connection, event: Event, *, assignment: str, submission: int | None = None
) -> Event:
    """Store an event; return it with its number."""
    values = asdict(event)
    del values["id"], values["out_of"]
    grading = values.pop("grading")
    place = {"assignment": assignment, "submission_id": submission, "grading_id": grading}
    return replace(event, id=add_row(connection, events, {**values, **place}))


def lines_of(connection: sa.Connection, batch: sa.Row) -> list[dict]:
    """Return the lines of a class list as dictionaries, ready for `add_list`."""
    columns = [column for column in entries.c if column.name != "batch_id"]
    mine = sa.select(*columns).where(entries.c.batch_id == batch.id).order_by(entries.c.position)
    return [dict(row._mapping) for row in connection.execute(mine)]


def points_of(connection: sa.Connection, batch: sa.Row) -> dict[str, float]:
    """Return the points of each submission in a class list."""
    rows = connection.execute(class_list(batch, submissions.c.name, entries.c.points))
    return {row.name: row.points for row in rows}


def add_list(
    connection: sa.Connection, lines: list[dict], *, assignment: str, at: str, rubric: str
) -> None:
    """Store a class list."""
    values = {"assignment": assignment, "at": at, "rubric": rubric}
    number = add_row(connection, batches, values)
    if lines:
        connection.execute(sa.insert(entries), [{**line, "batch_id": number} for line in lines])


def by_other_rubrics(connection: sa.Connection, batch: sa.Row) -> list[str]:
    """Return the submissions of a class list that were graded with a different rubric.

    A grading was made with the rubric of the first class list that contains it.
    """
    mine = sa.select(entries.c.grading_id).where(entries.c.batch_id == batch.id)
    first = (
        sa.select(entries.c.grading_id, sa.func.min(entries.c.batch_id).label("batch_id"))
        .where(entries.c.grading_id.in_(mine))
        .group_by(entries.c.grading_id)
        .subquery()
    )
    joined = (
        sa.select(submissions.c.name, batches.c.rubric)
        .select_from(first)
        .join(batches, batches.c.id == first.c.batch_id)
        .join(gradings, gradings.c.id == first.c.grading_id)
        .join(submissions, submissions.c.id == gradings.c.submission_id)
        .where(batches.c.rubric != batch.rubric)
    )
    rows = connection.execute(joined).all()
    now = _relevant_parts(batch.rubric)
    others = {text for text in {row.rubric for row in rows} if _relevant_parts(text) != now}
    return sorted(row.name for row in rows if row.rubric in others)


def _relevant_parts(rubric: str) -> dict:
    """Return a stored rubric without the title and the anonymity, which do not affect a grade."""
    return json.loads(rubric) | {"title": "", "anonymous": False}


def last_named(connection: sa.Connection, submission: int) -> tuple[str, ...]:
    """Return the last known authors of a submission; its newest version may name none."""
    named = sa.select(gradings.c.authors).where(
        gradings.c.submission_id == submission, gradings.c.authors != ()
    )
    return connection.scalar(named.order_by(gradings.c.id.desc()).limit(1)) or ()


def carry_over(connection: sa.Connection, moved: Mapping[str, str], *, assignment: str) -> None:
    """Copy what people did to renamed submissions to their new names.

    Rows that already exist under the new name are not copied again if a name changes back.
    """
    named = sa.select(submissions.c.name, submissions.c.id).where(
        submissions.c.assignment == assignment,
        submissions.c.name.in_([*moved, *moved.values()]),
    )
    numbers = {row.name: row.id for row in connection.execute(named)}
    columns = [column for column in events.c if column.name not in ("id", "submission_id")]
    there = {}
    for name, number in numbers.items():
        mine = sa.select(*columns).where(
            events.c.submission_id == number, events.c.grading_id.is_(None)
        )
        there[name] = [
            dict(row) for row in connection.execute(mine.order_by(events.c.id)).mappings()
        ]
    for old, new in moved.items():
        for values in there[old]:
            if values not in there[new]:
                add_row(connection, events, {**values, "submission_id": numbers[new]})


def in_class(batch: sa.Row) -> sa.Select:
    """Return the query for the numbers of the submissions on a class list."""
    return sa.select(entries.c.submission_id).where(entries.c.batch_id == batch.id)


def read_flag(text: str) -> Flag | None:
    """Return the flag for shared recordings that a class list stores for a submission, or None."""
    return Flag.model_validate_json(text) if text else None


def read_rubric(batch: sa.Row) -> Rubric:
    """Return the rubric of a batch.

    Raises
    ------
    ConfigError : another version of cartlab wrote the rubric.
    """
    try:
        return Rubric.model_validate_json(batch.rubric)
    except ValidationError:
        raise ConfigError(
            "the gradebook's rubric was written by another version of cartlab: run cartlab grade "
            "again"
        ) from None


# -------------------------------------------------------------------------- erasing

NOBODY = "an erased submission"


def erase_rows(connection: sa.Connection, gone: Mapping[int, str]) -> None:
    """Delete all rows about the submissions in `gone`, which maps their numbers to their names.

    Teams that shared recordings with an erased submission keep the flag, without the erased name.
    """
    numbers = list(gone)
    graded = sa.select(gradings.c.id).where(gradings.c.submission_id.in_(numbers))
    drop_copied(connection)
    for table in (figures, findings):
        connection.execute(sa.delete(table).where(table.c.grading_id.in_(graded)))
    for table in (entries, events, gradings):
        connection.execute(sa.delete(table).where(table.c.submission_id.in_(numbers)))
    connection.execute(sa.delete(submissions).where(submissions.c.id.in_(numbers)))
    flagged = sa.select(entries.c.batch_id, entries.c.position, entries.c.shared)
    names = "|".join(re.escape(json.dumps(name)[1:-1]) for name in gone.values())
    any_name = re.compile(rf"(?<![\w-])(?:{names})(?![\w-])")
    for row in connection.execute(flagged.where(entries.c.shared != "")).all():
        where = (entries.c.batch_id == row.batch_id) & (entries.c.position == row.position)
        erased = any_name.sub(NOBODY, row.shared)
        if erased != row.shared:
            connection.execute(sa.update(entries).where(where).values(shared=erased))
