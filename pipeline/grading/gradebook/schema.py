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

import sqlalchemy as sa
from sqlalchemy import event

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.events import TOTAL

_VERSION = "2"
_TURN = 0x6361_7274  # number of PostgreSQL's advisory lock, chosen so that no other program uses it
_V1 = ("overrides", "looks", "request_events", "releases")  # tables whose rows are now events
_KEPT = "v1_{}"  # name of such a table after its rows were copied


class Words(sa.TypeDecorator):
    """Text that every database accepts, without NUL characters and unpaired surrogates."""

    impl, cache_ok = sa.Text, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the text to store."""
        return value.replace("\0", "�").encode("utf-8", "replace").decode() if value else value


class Names(sa.TypeDecorator):
    """A list of texts, stored as JSON."""

    impl, cache_ok = sa.Text, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the JSON to store."""
        return json.dumps(value)

    def process_result_value(self, value: Any, dialect: object) -> Any:
        """Return the list of texts from the stored JSON."""
        return tuple(json.loads(value))


class Deflated(sa.TypeDecorator):
    """Long text, stored compressed."""

    impl, cache_ok = sa.LargeBinary, True

    def process_bind_param(self, value: Any, dialect: object) -> Any:
        """Return the compressed text to store."""
        return zlib.compress(value.encode())

    def process_result_value(self, value: Any, dialect: object) -> Any:
        """Return the text from its compressed form."""
        return zlib.decompress(value).decode()


metadata = sa.MetaData()

settings = sa.Table(
    "settings",
    metadata,
    sa.Column("name", sa.String(60), primary_key=True),
    sa.Column("value", sa.Text, nullable=False),
)

submissions = sa.Table(
    "submissions",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("assignment", sa.String(255), nullable=False),
    sa.Column("name", sa.String(510), nullable=False),  # long enough for two folder names
    sa.UniqueConstraint("assignment", "name"),
)

# One row for each grading of a submission; `key` is a hash of everything that affects the grade.
gradings = sa.Table(
    "gradings",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("submission_id", sa.ForeignKey("submissions.id"), nullable=False),
    sa.Column("at", sa.Text, nullable=False),
    sa.Column("key", sa.String(255), nullable=False),
    sa.Column("status", sa.Text, nullable=False),
    sa.Column("reason", Words, nullable=False),
    sa.Column("settled", sa.Boolean, nullable=False),
    sa.Column("points", sa.Float, nullable=False),
    sa.Column("out_of", sa.Float, nullable=False),
    sa.Column("days_late", sa.Float, nullable=False),
    sa.Column("deducted", sa.Float, nullable=False),
    sa.Column("authors", Names, nullable=False),
    sa.Column("owner", Words, nullable=False),
    sa.Column("detail", Words, nullable=False),
    sa.Column("grade", Words, nullable=False),
    sa.Column("fingerprints", sa.LargeBinary, nullable=False),
    sa.Index("gradings_by_key", "key"),
    sa.Index("gradings_by_submission", "submission_id"),
    sqlite_autoincrement=True,  # no number is given twice, even after an erasure
)

figures = sa.Table(
    "figures",
    metadata,
    sa.Column("grading_id", sa.ForeignKey("gradings.id"), primary_key=True),
    sa.Column("position", sa.Integer, primary_key=True),
    sa.Column("name", Words, nullable=False),
    sa.Column("svg", Deflated, nullable=False),
)

# Results of the checks in a grading. From them, points under a changed rubric are computed without
# grading again.
findings = sa.Table(
    "findings",
    metadata,
    sa.Column("grading_id", sa.ForeignKey("gradings.id"), primary_key=True),
    sa.Column("found", Deflated, nullable=False),
)

# A complete batch and its class list. For each submission, the list has the grading that counts,
# the flag for shared data, and the points at that time.
batches = sa.Table(
    "batches",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("assignment", sa.Text, nullable=False),
    sa.Column("at", sa.Text, nullable=False),
    sa.Column("rubric", sa.Text, nullable=False),
)

entries = sa.Table(
    "entries",
    metadata,
    sa.Column("batch_id", sa.ForeignKey("batches.id"), primary_key=True),
    sa.Column("position", sa.Integer, primary_key=True),
    sa.Column("submission_id", sa.ForeignKey("submissions.id"), nullable=False),
    sa.Column("grading_id", sa.ForeignKey("gradings.id"), nullable=False),
    sa.Column("shared", sa.Text, nullable=False),
    sa.Column("points", sa.Float, nullable=False),
    sa.Column("out_of", sa.Float, nullable=False),
    sa.Index("entries_by_submission", "submission_id"),
)

# What people do: points, comments, reviews, requests and releases, as `events.Event` says. An event
# without a submission is about the whole class.
events = sa.Table(
    "events",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("assignment", sa.String(255), nullable=False),
    sa.Column("submission_id", sa.ForeignKey("submissions.id")),
    sa.Column("grading_id", sa.ForeignKey("gradings.id")),
    sa.Column("at", sa.Text, nullable=False),
    sa.Column("what", sa.String(20), nullable=False),
    sa.Column("criterion", sa.Text, nullable=False),
    sa.Column("points", sa.Float),
    sa.Column("text", Words, nullable=False),
    sa.Column("by", Words, nullable=False),
    sa.Column("authors", Names, nullable=False),
    sa.Index("events_by_submission", "submission_id"),
    sa.Index("events_by_assignment", "assignment"),
    sqlite_autoincrement=True,  # no number is given twice, even after an erasure
)

_REFUSE = "entries of a gradebook cannot be changed"
event.listen(
    metadata,
    "before_create",
    sa.DDL(
        "CREATE OR REPLACE FUNCTION cartlab_append_only() RETURNS trigger LANGUAGE plpgsql AS "
        f"$$ BEGIN RAISE EXCEPTION '{_REFUSE}'; END $$"
    ).execute_if(dialect="postgresql"),
)


def _locks(table: sa.Table, dialect: str) -> list[tuple[str, str]]:
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
            event.listen(_table, "after_create", sa.DDL(_lock).execute_if(dialect=_dialect))


@contextmanager
def unlocked(connection: sa.Connection) -> Iterator[None]:
    """Allow changes of rows, within this transaction."""
    locks = [
        both for one in metadata.sorted_tables for both in _locks(one, connection.dialect.name)
    ]
    for _, undo in locks:
        connection.execute(sa.DDL(undo))
    yield
    for lock, _ in locks:
        connection.execute(sa.DDL(lock))


def take_turns(connection: sa.Connection) -> None:
    """Wait until nobody else writes."""
    if connection.dialect.name == "postgresql":  # SQLite already holds its write lock here
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_TURN)))


def is_whole(connection: sa.Connection, *, name: str) -> bool:
    """Return whether all tables are there, in the form of this version.

    Parameters
    ----------
    name : the gradebook's name for messages.

    Raises
    ------
    ConfigError : a newer cartlab wrote the gradebook.
    """
    if not sa.inspect(connection).has_table(settings.name):
        return False
    found = connection.scalar(sa.select(settings.c.value).where(settings.c.name == "schema"))
    if found is not None and found != _VERSION and found not in _MIGRATIONS:
        raise ConfigError(
            f"{name}: is a gradebook of version {found}, and this cartlab uses {_VERSION}: grade "
            f"into another folder, or use the cartlab that wrote it"
        )
    there = set(sa.inspect(connection).get_table_names())
    return found == _VERSION and metadata.tables.keys() <= there


def create_tables(connection: sa.Connection, *, name: str) -> None:
    """Create missing tables, and copy an older gradebook into their form.

    Two processes may do this at the same time. A complete gradebook is left alone, because the user
    may lack the right to create tables.
    """
    take_turns(connection)
    if is_whole(connection, name=name):
        return
    metadata.create_all(connection)
    version = connection.scalar(sa.select(settings.c.value).where(settings.c.name == "schema"))
    if version is None:
        connection.execute(sa.insert(settings).values(name="schema", value=_VERSION))
    elif version in _MIGRATIONS:
        _MIGRATIONS[version](connection)
        with unlocked(connection):
            connection.execute(sa.update(settings).values(value=_VERSION))


def _copy_to_events(connection: sa.Connection) -> None:
    """Copy what people did from the tables of version 1, which are kept beside under other names.

    Version 1 had a table each for points, reviews (`looks`), requests and releases; the oldest
    gradebooks lack some. The rows of a table keep their order, even if the clocks of the computers
    that wrote them differed, because the newest row counts.
    """
    there = set(sa.inspect(connection).get_table_names())
    names = [name for name in _V1 if name in there]
    old = sa.MetaData()
    old.reflect(connection, only=names)
    number = submissions.c.id, submissions.c.assignment
    classes = {row.id: row.assignment for row in connection.execute(sa.select(*number))}
    teams = {row.id: row.submission_id for row in connection.execute(
        sa.select(gradings.c.id, gradings.c.submission_id))}  # fmt: skip
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for name in names:
        for row in connection.execute(sa.select(old.tables[name]).order_by("id")).mappings():
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
        connection.execute(sa.insert(events), merged)
    for name in names:
        connection.execute(sa.DDL(f"ALTER TABLE {name} RENAME TO {_KEPT.format(name)}"))


def drop_copied(connection: sa.Connection) -> None:
    """Drop the tables of version 1 that were kept, because they name the same people."""
    for name in _V1:
        connection.execute(sa.DDL(f"DROP TABLE IF EXISTS {_KEPT.format(name)}"))


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
