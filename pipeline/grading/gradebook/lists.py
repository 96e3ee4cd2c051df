"""The class lists of a gradebook: who is on one, and by which rubric they were graded."""

from collections.abc import Sequence
from difflib import get_close_matches

from pydantic import ValidationError
from sqlalchemy import Connection, Row, func, insert, select

from pipeline.grading.gradebook.rows import add_row, read_rubric
from pipeline.grading.gradebook.schema import batches, entries, gradings, submissions
from pipeline.grading.gradings import person
from pipeline.grading.rubric import Rubric

_NAMED = 8  # names of what there is, where none is near


def lines_of(connection: Connection, batch: Row) -> list[dict]:
    """Return a class list as it was put in."""
    columns = [column for column in entries.c if column.name != "batch_id"]
    mine = select(*columns).where(entries.c.batch_id == batch.id).order_by(entries.c.position)
    return [dict(row._mapping) for row in connection.execute(mine)]


def points_of(connection: Connection, batch: Row) -> dict[str, float]:
    """Return the points of a class list by submission."""
    both = select(submissions.c.name, entries.c.points).join(
        submissions, entries.c.submission_id == submissions.c.id
    )
    mine = both.where(entries.c.batch_id == batch.id).order_by(entries.c.position)
    return {row.name: row.points for row in connection.execute(mine)}


def add_list(
    connection: Connection, lines: list[dict], *, assignment: str, at: str, rubric: str
) -> None:
    """Add a class list."""
    values = {"assignment": assignment, "at": at, "rubric": rubric}
    number = add_row(connection, batches, values)
    if lines:
        connection.execute(insert(entries), [{**line, "batch_id": number} for line in lines])


def by_other_rubrics(connection: Connection, batch: Row) -> list[str]:
    """Return the submissions of a class list that were graded by another rubric than it has.

    A grading is by the rubric of the first list that it stands in.
    """
    mine = select(entries.c.grading_id).where(entries.c.batch_id == batch.id)
    first = (
        select(entries.c.grading_id, func.min(entries.c.batch_id).label("batch_id"))
        .where(entries.c.grading_id.in_(mine))
        .group_by(entries.c.grading_id)
        .subquery()
    )
    joined = (
        select(submissions.c.name, batches.c.rubric)
        .select_from(first)
        .join(batches, batches.c.id == first.c.batch_id)
        .join(gradings, gradings.c.id == first.c.grading_id)
        .join(submissions, submissions.c.id == gradings.c.submission_id)
        .where(batches.c.rubric != batch.rubric)
    )
    rows = connection.execute(joined).all()
    now = _asked(read_rubric(batch))
    others = {text for text in {row.rubric for row in rows} if _read(text) != now}
    return sorted(row.name for row in rows if row.rubric in others)


def is_of(authors: Sequence[str], team: str) -> bool:
    """Tell whether somebody is among authors, however they typed the id."""
    return person(team) in map(person, authors)


def nearest(word: str, words: list[str]) -> str:
    """Return what there is that was perhaps meant, in words."""
    near = get_close_matches(word, words, n=3, cutoff=0.4)
    more = f" and {len(words) - _NAMED} more" if not near and len(words) > _NAMED else ""
    near = near or words[:_NAMED]
    return f"there is {', '.join(near)}{more}" if near else "there is none at all"


def _asked(rubric: Rubric) -> Rubric:
    """Return what a rubric asks, without how it is shown."""
    return rubric.model_copy(update={"title": "", "anonymous": False})


def _read(text: str) -> Rubric | None:
    """Return what a kept rubric asks, None where it is of another version of cartlab."""
    try:
        return _asked(Rubric.model_validate_json(text))
    except ValidationError:
        return None
