"""The fingerprints in a gradebook, read some at a time."""

import hashlib
import json
from collections.abc import Iterator, Sequence

from sqlalchemy import select

from pipeline.grading.gradebook.schema import Database, gradings, submissions
from pipeline.grading.gradings import Listed, Prints

_PAGE = 100  # rows read at a time: memory stays flat, and a writer need not wait long

_PRINTS = (
    select(
        submissions.c.assignment,
        submissions.c.name,
        gradings.c.authors,
        gradings.c.owner,
        gradings.c.fingerprints,
    )
    .join(submissions)
    .order_by(gradings.c.id)
)


def read_prints(database: Database, *, assignment: str) -> Iterator[Prints]:
    """Yield all fingerprints that differ, of every submission under its authors."""
    with database.reading() as connection:
        numbers = sorted(connection.scalars(select(gradings.c.id)))
    seen = set()
    for page in pages(numbers):
        with database.reading() as connection:
            wanted = _PRINTS.where(gradings.c.id.in_(page), gradings.c.fingerprints != b"")
            rows = connection.execute(wanted).all()
        for row in rows:
            own = row.assignment, row.name, row.authors, hashlib.sha256(row.fingerprints).digest()
            if own not in seen:
                seen.add(own)
                yield _prints(row, of_class=row.assignment == assignment)


def read_listed(database: Database, numbers: Sequence[int]) -> Iterator[Listed]:
    """Yield the gradings of these numbers as lines of a class list."""
    columns = gradings.c.id, gradings.c.key, gradings.c.authors, gradings.c.owner
    lines = select(submissions.c.name, *columns).join(submissions).order_by(gradings.c.id)
    for page in pages(numbers):
        with database.reading() as connection:
            rows = connection.execute(lines.where(gradings.c.id.in_(page))).all()
        for row in rows:
            authors = tuple(json.loads(row.authors))
            yield Listed(
                submission=row.name, authors=authors, owner=row.owner, key=row.key, grading=row.id
            )


def read_prints_of(database: Database, numbers: Sequence[int]) -> list[Prints]:
    """Return the fingerprints of the gradings of these numbers."""
    found = []
    for page in pages(numbers):
        with database.reading() as connection:
            rows = connection.execute(_PRINTS.where(gradings.c.id.in_(page))).all()
        found += [_prints(row, of_class=True) for row in rows]
    return found


def pages(numbers: Sequence[int]) -> Iterator[Sequence[int]]:
    """Return numbers of rows as many at a time as are read at once."""
    return (numbers[i : i + _PAGE] for i in range(0, len(numbers), _PAGE))


def _prints(row, *, of_class: bool) -> Prints:
    return Prints(
        submission=row.name,
        authors=tuple(json.loads(row.authors)),
        fingerprints=row.fingerprints,
        owner=row.owner,
        of_class=of_class,
    )
