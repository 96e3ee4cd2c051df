"""Rows of a gradebook as what they stand for."""

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import ValidationError
from sqlalchemy import Connection, Row, Select, Table, insert, select

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.override import Override, with_overrides
from pipeline.grading.gradebook.schema import (
    entries,
    figures,
    gradings,
    overrides,
    submissions,
)
from pipeline.grading.gradings import Grading
from pipeline.grading.rubric import Rubric
from pipeline.schemas.grade import Flag, Grade, read_grade


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A line of the class list, as it counts now.

    Attributes
    ----------
    grade : with shared data flagged, points given by hand, and lateness off those.
    overrides : by criterion, those in force.
    owner : who handed it in, as the learning platform calls them, or "".
    key : of all that it depends on, as handed in.
    grading : its number in the gradebook.
    first_key : of what was first handed in under this name: unknown to who has not seen it.
    """

    submission: str
    grade: Grade
    overrides: Mapping[str, Override]
    owner: str
    key: str
    grading: int
    first_key: str


def add_row(connection: Connection, table: Table, values: dict) -> int:
    """Add a row and return its number."""
    key = connection.execute(insert(table).values(values)).inserted_primary_key
    assert key is not None
    return key[0]


def put_figures(connection: Connection, grading: int, drawn: tuple[tuple[str, str], ...]) -> None:
    """Add the figures of a grading."""
    pictures = [
        {"grading_id": grading, "position": i, "name": storable(name),
         "svg": zlib.compress(svg.encode())}
        for i, (name, svg) in enumerate(drawn)
    ]  # fmt: skip
    if pictures:
        connection.execute(insert(figures), pictures)


def read_figures(connection: Connection, grading: int) -> tuple[tuple[str, str], ...]:
    """Return the figures of a grading: file names and SVG."""
    mine = select(figures.c.name, figures.c.svg).where(figures.c.grading_id == grading)
    rows = connection.execute(mine.order_by(figures.c.position))
    return tuple((name, zlib.decompress(svg).decode()) for name, svg in rows)


def known_grading(
    connection: Connection, key: str, *, assignment: str, figures: bool
) -> Grading | None:
    """Return the newest outcome of a key, None where there is none; or without its figures."""
    newest = select(gradings, submissions.c.name).join(submissions)
    newest = newest.where(gradings.c.key == key, submissions.c.assignment == assignment)
    row = connection.execute(newest.order_by(gradings.c.id.desc()).limit(1)).one_or_none()
    if row is None:
        return None
    return Grading(
        submission=row.name,
        authors=tuple(json.loads(row.authors)),
        key=row.key,
        status=row.status,
        reason=row.reason,
        settled=row.settled,
        days_late=row.days_late,
        grade=row.grade,
        fingerprints=row.fingerprints,
        figures=read_figures(connection, row.id) if figures else (),
        owner=row.owner,
        detail=row.detail,
    )


_COLUMNS = (
    gradings.c.id,
    gradings.c.submission_id,
    gradings.c.key,
    gradings.c.authors,
    gradings.c.owner,
    gradings.c.grade,
    submissions.c.name,
)


def newest_of(connection: Connection, key: str, *, assignment: str) -> Row:
    """Return the newest grading of a key; two assignments may have rubrics of one text.

    Raises
    ------
    KeyError : there is none.
    """
    newest = select(*_COLUMNS).join(submissions)
    newest = newest.where(gradings.c.key == key, submissions.c.assignment == assignment)
    row = connection.execute(newest.order_by(gradings.c.id.desc()).limit(1)).one_or_none()
    if row is None:
        raise KeyError(key)
    return row


def class_list(*, detail: bool = True) -> Select:
    """Return the query for the lines of class lists, in order; grades only with `detail`."""
    joined = entries.join(gradings, entries.c.grading_id == gradings.c.id).join(
        submissions, entries.c.submission_id == submissions.c.id
    )
    columns = _COLUMNS if detail else (submissions.c.name, gradings.c.authors)
    chosen = select(*columns, entries.c.position, entries.c.shared)
    return chosen.select_from(joined).order_by(entries.c.position)


def final_entry(connection: Connection, row: Row, *, shared: Flag | None, rubric: Rubric) -> Entry:
    """Return the grade as it counts: shared data flagged, points given by hand."""
    authors = tuple(json.loads(row.authors))
    given = {}
    mine = select(overrides).where(overrides.c.submission_id == row.submission_id)
    for o in connection.execute(mine.order_by(overrides.c.id)):
        override = Override(
            criterion=o.criterion,
            points=o.points,
            why=o.why,
            by=o.by,
            at=o.at,
            authors=tuple(json.loads(o.authors)),
        )
        if override.concerns(authors):
            given[o.criterion] = override
    given = {key: override for key, override in given.items() if override.points is not None}
    first = select(gradings.c.key).where(gradings.c.submission_id == row.submission_id)
    grade = read_grade(row.grade)
    grade = grade.with_flags(shared) if shared else grade
    return Entry(
        submission=row.name,
        grade=with_overrides(grade, given, rubric=rubric),
        overrides=given,
        owner=row.owner,
        key=row.key,
        grading=row.id,
        first_key=connection.scalar(first.order_by(gradings.c.id).limit(1)) or "",
    )


def last_named(connection: Connection, submission: int) -> str:
    """Return the authors that a submission named last, as JSON: a broken one names nobody."""
    named = select(gradings.c.authors).where(
        gradings.c.submission_id == submission, gradings.c.authors != "[]"
    )
    return connection.scalar(named.order_by(gradings.c.id.desc()).limit(1)) or "[]"


def carry_overrides(connection: Connection, moved: Mapping[str, str], *, assignment: str) -> None:
    """Put in, for who goes on under another name, what was given by hand under the old one.

    All that is not there yet, so that it stays right when the name changes back.
    """
    columns = [column for column in overrides.c if column.name not in ("id", "submission_id")]
    named = select(submissions.c.name, submissions.c.id).where(
        submissions.c.assignment == assignment,
        submissions.c.name.in_([*moved, *moved.values()]),
    )
    numbers = {row.name: row.id for row in connection.execute(named)}
    given = {}
    for name, number in numbers.items():
        mine = select(*columns).where(overrides.c.submission_id == number).order_by(overrides.c.id)
        given[name] = [dict(row) for row in connection.execute(mine).mappings()]
    for old, new in moved.items():
        for values in given[old]:
            if values not in given[new]:
                add_row(connection, overrides, {**values, "submission_id": numbers[new]})


def read_flag(text: str) -> Flag | None:
    """Return the flag for shared data of a line of the class list, None where there is none."""
    return Flag.model_validate_json(text) if text else None


def read_rubric(batch: Row) -> Rubric:
    """Return the rubric of a batch.

    Raises
    ------
    ConfigError : another version of cartlab put it there.
    """
    try:
        return Rubric.model_validate_json(batch.rubric)
    except ValidationError:
        raise ConfigError(
            "the gradebook's rubric is of another version of cartlab: run cartlab grade again"
        ) from None


def storable(text: str) -> str:
    """Return text that every database takes: no NUL, no half of a character."""
    return text.replace("\0", "�").encode("utf-8", "replace").decode() if text else text
