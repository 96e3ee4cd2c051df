"""The tables of a gradebook, and how an older gradebook comes into their form.

Rows are only added: on SQLite and PostgreSQL, triggers refuse to change or delete a row. If several
rows are about the same thing, the newest counts.
"""

import heapq
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import (
    DDL,
    Boolean,
    Column,
    Connection,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    event,
    func,
    insert,
    inspect,
    select,
    update,
)

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.events import TOTAL

_VERSION = "2"
_TURN = 0x6361_7274  # number of PostgreSQL's advisory lock, chosen so that no other program uses it
_V1 = ("overrides", "looks", "request_events", "releases")  # tables whose rows are now events
_KEPT = "v1_{}"  # name of such a table after its rows were copied


class Words(TypeDecorator):
    """Text that every database accepts, without NUL characters and unpaired surrogates."""

    impl, cache_ok = Text, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the text to store."""
        return value.replace("\0", "�").encode("utf-8", "replace").decode() if value else value


class Names(TypeDecorator):
    """A list of texts, stored as JSON."""

    impl, cache_ok = Text, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the JSON to store."""
        return json.dumps(value)

    def process_result_value(self, value: Any, dialect: object) -> Any:
        """Return the list of texts from the stored JSON."""
        return tuple(json.loads(value))


class Deflated(TypeDecorator):
    """Long text, stored compressed."""

    impl, cache_ok = LargeBinary, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the compressed text to store."""
        return zlib.compress(value.encode())

    def process_result_value(self, value: Any, dialect: object) -> Any:
        """Return the text from its compressed form."""
        return zlib.decompress(value).decode()


metadata = MetaData()

settings = Table(
    "settings",
    metadata,
    Column("name", String(60), primary_key=True),
    Column("value", Text, nullable=False),
)

submissions = Table(
    "submissions",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("assignment", String(255), nullable=False),
    Column("name", String(510), nullable=False),  # long enough for two folder names
    UniqueConstraint("assignment", "name"),
)

# One row for each grading of a submission; `key` is a hash of everything that affects the grade.
gradings = Table(
    "gradings",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("submission_id", ForeignKey("submissions.id"), nullable=False),
    Column("at", Text, nullable=False),
    Column("key", String(255), nullable=False),
    Column("status", Text, nullable=False),
    Column("reason", Words, nullable=False),
    Column("settled", Boolean, nullable=False),
    Column("points", Float, nullable=False),
    Column("out_of", Float, nullable=False),
    Column("days_late", Float, nullable=False),
    Column("deducted", Float, nullable=False),
    Column("authors", Names, nullable=False),
    Column("owner", Words, nullable=False),
    Column("detail", Words, nullable=False),
    Column("grade", Words, nullable=False),
    Column("fingerprints", LargeBinary, nullable=False),
    Index("gradings_by_key", "key"),
    Index("gradings_by_submission", "submission_id"),
    sqlite_autoincrement=True,  # no number is given twice, even after an erasure
)

figures = Table(
    "figures",
    metadata,
    Column("grading_id", ForeignKey("gradings.id"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("name", Words, nullable=False),
    Column("svg", Deflated, nullable=False),
)

# Results of the checks in a grading. From them, points under a changed rubric are computed without
# grading again.
findings = Table(
    "findings",
    metadata,
    Column("grading_id", ForeignKey("gradings.id"), primary_key=True),
    Column("found", Deflated, nullable=False),
)

# A complete batch and its class list. For each submission, the list has the grading that counts,
# the flag for shared data, and the points at that time.
batches = Table(
    "batches",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("assignment", Text, nullable=False),
    Column("at", Text, nullable=False),
    Column("rubric", Text, nullable=False),
)

entries = Table(
    "entries",
    metadata,
    Column("batch_id", ForeignKey("batches.id"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("submission_id", ForeignKey("submissions.id"), nullable=False),
    Column("grading_id", ForeignKey("gradings.id"), nullable=False),
    Column("shared", Text, nullable=False),
    Column("points", Float, nullable=False),
    Column("out_of", Float, nullable=False),
    Index("entries_by_submission", "submission_id"),
)

# What people do: points, comments, reviews, requests and releases, as `events.Event` says. An event
# without a submission is about the whole class.
events = Table(
    "events",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("assignment", String(255), nullable=False),
    Column("submission_id", ForeignKey("submissions.id")),
    Column("grading_id", ForeignKey("gradings.id")),
    Column("at", Text, nullable=False),
    Column("what", String(20), nullable=False),
    Column("criterion", Text, nullable=False),
    Column("points", Float),
    Column("text", Words, nullable=False),
    Column("by", Words, nullable=False),
    Column("authors", Names, nullable=False),
    Index("events_by_submission", "submission_id"),
    Index("events_by_assignment", "assignment"),
    sqlite_autoincrement=True,  # no number is given twice, even after an erasure
)

_REFUSE = "entries of a gradebook cannot be changed"
event.listen(
    metadata,
    "before_create",
    DDL(
        "CREATE OR REPLACE FUNCTION cartlab_append_only() RETURNS trigger LANGUAGE plpgsql AS "
        f"$$ BEGIN RAISE EXCEPTION '{_REFUSE}'; END $$"
    ).execute_if(dialect="postgresql"),
)


def _locks(table: Table, dialect: str) -> list[tuple[str, str]]:
    """Return the SQL that makes a table append-only, and that undoes it, for a kind of database."""
    name = table.name
    if dialect == "sqlite":
        return [
            (
                f"CREATE TRIGGER {name}_no_{verb.lower()} BEFORE {verb} ON {name} "
                f"BEGIN SELECT RAISE(ABORT, '{_REFUSE}'); END",
                f"DROP TRIGGER IF EXISTS {name}_no_{verb.lower()}",
            )
            for verb in ("UPDATE", "DELETE")
        ]
    lock = (
        f"CREATE TRIGGER {name}_append_only BEFORE UPDATE OR DELETE OR TRUNCATE "
        f"ON {name} EXECUTE FUNCTION cartlab_append_only()"
    )
    return [(lock, f"DROP TRIGGER IF EXISTS {name}_append_only ON {name}")]


for _table in metadata.sorted_tables:
    for _dialect in ("sqlite", "postgresql"):
        for _lock, _ in _locks(_table, _dialect):
            event.listen(_table, "after_create", DDL(_lock).execute_if(dialect=_dialect))


@contextmanager
def unlocked(connection: Connection) -> Iterator[None]:
    """Allow changes of rows, within this transaction."""
    locks = [
        both for one in metadata.sorted_tables for both in _locks(one, connection.dialect.name)
    ]
    for _, undo in locks:
        connection.execute(DDL(undo))
    yield
    for lock, _ in locks:
        connection.execute(DDL(lock))


def take_turns(connection: Connection) -> None:
    """Wait until nobody else writes."""
    if connection.dialect.name == "postgresql":  # SQLite already holds its write lock here
        connection.execute(select(func.pg_advisory_xact_lock(_TURN)))


def is_whole(connection: Connection, *, name: str) -> bool:
    """Return whether all tables are there, in the form of this version.

    Parameters
    ----------
    name : the gradebook's name for messages.

    Raises
    ------
    ConfigError : a newer cartlab wrote the gradebook.
    """
    if not inspect(connection).has_table(settings.name):
        return False
    found = connection.scalar(select(settings.c.value).where(settings.c.name == "schema"))
    if found is not None and found != _VERSION and found not in _MIGRATIONS:
        raise ConfigError(
            f"{name}: is a gradebook of version {found}, and this cartlab uses {_VERSION}: grade "
            f"into another folder, or use the cartlab that wrote it"
        )
    there = set(inspect(connection).get_table_names())
    return found == _VERSION and metadata.tables.keys() <= there


def create_tables(connection: Connection, *, name: str) -> None:
    """Create missing tables, and copy an older gradebook into their form.

    Two processes may do this at the same time. A complete gradebook is left alone, because the user
    may lack the right to create tables.
    """
    take_turns(connection)
    if is_whole(connection, name=name):
        return
    metadata.create_all(connection)
    version = connection.scalar(select(settings.c.value).where(settings.c.name == "schema"))
    if version is None:
        connection.execute(insert(settings).values(name="schema", value=_VERSION))
    elif version in _MIGRATIONS:
        _MIGRATIONS[version](connection)
        with unlocked(connection):
            connection.execute(update(settings).values(value=_VERSION))


def _copy_to_events(connection: Connection) -> None:
    """Copy what people did from the tables of version 1, which are kept beside under other names.

    Version 1 had a table each for points, reviews (`looks`), requests and releases; the oldest
    gradebooks lack some. The rows of a table keep their order, even if the clocks of the computers
    that wrote them differed, because the newest row counts.
    """
    there = set(inspect(connection).get_table_names())
    names = [name for name in _V1 if name in there]
    old = MetaData()
    old.reflect(connection, only=names)
    number = submissions.c.id, submissions.c.assignment
    classes = {row.id: row.assignment for row in connection.execute(select(*number))}
    teams = {row.id: row.submission_id for row in connection.execute(
        select(gradings.c.id, gradings.c.submission_id))}  # fmt: skip
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for name in names:
        for row in connection.execute(select(old.tables[name]).order_by("id")).mappings():
            team = row.get("submission_id", teams.get(row.get("grading_id")))
            found[name].append(
                {
                    "assignment": row.get("assignment", classes.get(team)),
                    "submission_id": team,
                    "grading_id": row.get("grading_id"),
                    "at": row["at"],
                    "what": _old_kind(name, row),
                    "criterion": row.get("criterion", ""),
                    "points": row.get("points"),
                    "text": row.get("text", row.get("why", "")),
                    "by": row["by"],
                    "authors": json.loads(row.get("authors", "[]")),
                }
            )
    if merged := list(heapq.merge(*found.values(), key=lambda row: row["at"])):
        connection.execute(insert(events), merged)
    for name in names:
        connection.execute(DDL(f"ALTER TABLE {name} RENAME TO {_KEPT.format(name)}"))


def drop_copied(connection: Connection) -> None:
    """Drop the tables of version 1 that were kept, because they name the same people."""
    for name in _V1:
        connection.execute(DDL(f"DROP TABLE IF EXISTS {_KEPT.format(name)}"))


def _old_kind(table: str, row: Any) -> str:
    """Return the kind of event that a row of version 1 is."""
    if table == "looks":
        return "reviewed" if row["seen"] else "unreviewed"
    if table == "releases":
        return "released" if row["released"] else "hidden"
    if table == "request_events":
        return row["what"]
    if row["criterion"] == TOTAL:
        return "adjusted"
    return "comment" if row.get("comment") else "override"


# What turns a gradebook of an older version into one of this version, by the older version.
_MIGRATIONS = {"1": _copy_to_events}
