"""The tables of a gradebook, and the connection to its database.

Rows are only added: on SQLite and PostgreSQL, triggers refuse to change or delete a row. If several
rows are about the same thing, the newest counts.
"""

import json
import os
import stat
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import (
    DDL,
    URL,
    Boolean,
    Column,
    Connection,
    Engine,
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
    create_engine,
    event,
    false,
    func,
    insert,
    inspect,
    make_url,
    select,
)
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    NoSuchModuleError,
    OperationalError,
    SQLAlchemyError,
)
from sqlalchemy.schema import CreateColumn

from pipeline.errors import ConfigError
from pipeline.output import OWNER_ONLY
from pipeline.submission.toml import quote
from pipeline.words.progress import silent

T = TypeVar("T")

FILE = "gradebook.sqlite"
_SUFFIXES = (".sqlite", ".sqlite3", ".db")  # suffixes of SQLite files; any other path is a folder
_VERSION = "1"
_TURN = 0x6361_7274  # number of PostgreSQL's advisory lock, chosen so that no other program uses it
_PATIENCE = 60.0  # s to wait for a lock of another process; a commit takes milliseconds
_PAUSE = 2.0  # s between two attempts to reach a server

# Errors that SQLAlchemy and the drivers raise for an address that makes no sense.
_SENSELESS = (ArgumentError, ValueError, TypeError)
_NO_ADDRESS = (
    "the gradebook's address is not a database URL: write postgresql://NAME@HOST/DATABASE or "
    f"sqlite:////FOLDER/{FILE}"
)


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

# Points and comments given by hand; the newest row of a criterion counts. A row without points
# means that the automatic points count: it is a comment, or it undoes earlier points.
overrides = Table(
    "overrides",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("submission_id", ForeignKey("submissions.id"), nullable=False),
    Column("at", Text, nullable=False),
    Column("criterion", Text, nullable=False),
    Column("points", Float),
    Column("why", Words, nullable=False),
    Column("by", Words, nullable=False),
    Column("authors", Names, nullable=False),
    Column("comment", Boolean, nullable=False, server_default=false()),
    Index("overrides_by_submission", "submission_id"),
)

# Marks of gradings as reviewed or not; the newest row counts, so a mark can be undone.
reviews = Table(
    "looks",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("grading_id", ForeignKey("gradings.id"), nullable=False),
    Column("at", Text, nullable=False),
    Column("by", Words, nullable=False),
    Column("seen", Boolean, nullable=False),
    Index("looks_by_grading", "grading_id"),
)

# Requests to review a criterion, as events `asked`, `answered` and `reopened`. The newest event
# sets the state; an answer has points only if it changed them.
request_events = Table(
    "request_events",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("submission_id", ForeignKey("submissions.id"), nullable=False),
    Column("at", Text, nullable=False),
    Column("criterion", Text, nullable=False),
    Column("what", Text, nullable=False),
    Column("text", Words, nullable=False),
    Column("points", Float),
    Column("by", Words, nullable=False),
    Column("authors", Names, nullable=False),
    Index("request_events_by_submission", "submission_id"),
)

# Whether students may read the feedback of an assignment; the newest row counts.
releases = Table(
    "releases",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("assignment", String(255), nullable=False),
    Column("at", Text, nullable=False),
    Column("by", Words, nullable=False),
    Column("released", Boolean, nullable=False),
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


def _locks(table: Table) -> dict[str, tuple[str, ...]]:
    """Return, for each kind of database, the SQL that makes a table append-only."""
    name = table.name
    return {
        "sqlite": tuple(
            f"CREATE TRIGGER {name}_no_{verb.lower()} BEFORE {verb} ON {name} "
            f"BEGIN SELECT RAISE(ABORT, '{_REFUSE}'); END"
            for verb in ("UPDATE", "DELETE")
        ),
        "postgresql": (
            f"CREATE TRIGGER {name}_append_only BEFORE UPDATE OR DELETE OR TRUNCATE "
            f"ON {name} EXECUTE FUNCTION cartlab_append_only()",
        ),
    }


for _table in metadata.sorted_tables:
    for _dialect, _made in _locks(_table).items():
        for _lock in _made:
            event.listen(_table, "after_create", DDL(_lock).execute_if(dialect=_dialect))


class Lost(ConfigError):
    """The server of the database does not answer, or its connection broke."""


class Database:
    """A database with the tables of a gradebook; each context manager below is one transaction.

    Parameters
    ----------
    place : a folder that holds `gradebook.sqlite`, an SQLite file, or any SQLAlchemy URL.
    create : whether to create missing tables; otherwise the gradebook must exist.
    patience : time in s to wait for a server that does not answer, for example during a restart.
    waiting : function that is called with a message while it waits.

    Raises
    ------
    ConfigError : the place cannot be reached, or contains no gradebook of this version.
    """

    def __init__(
        self,
        place: str | Path,
        *,
        create: bool,
        patience: float = 0.0,
        waiting: Callable[[str], None] = silent,
    ) -> None:
        self._patience, self._waiting = patience, waiting
        self._engine = _engine(place, create=create)
        self._writer = self._engine.execution_options(writes=True)
        try:
            whole = self.repeat(lambda: self._open(create=create))
        except _SENSELESS as error:  # some drivers read the address only when they connect
            raise ConfigError(_NO_ADDRESS) from error
        if not whole:  # an older version wrote it, with fewer tables or columns
            with self.writing() as connection:
                _create(connection)

    def _open(self, *, create: bool) -> bool:
        """Check the tables, or create them; return whether all are there."""
        opened = self._writer if create else self._engine
        with self._translated(), opened.begin() as connection:
            if create:
                _create(connection)
            elif not self._engine.dialect.has_table(connection, settings.name):
                raise ConfigError(f"{self.name}: holds no gradebook")
            _check_version(connection, name=self.name)
            return _is_whole(connection)

    @property
    def name(self) -> str:
        """The file or URL to show in messages, without any password."""
        url = self._engine.url
        if url.get_backend_name() == "sqlite":
            return url.database or ""
        return url.render_as_string(hide_password=True)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Read in one transaction; keep it short, because writers wait for it."""
        with self._transaction(self._engine) as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Write all changes or none; at the end they are on disk."""
        with self._transaction(self._writer) as connection:
            yield connection

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        """Read and write while nobody else can write, so that the data just read stay valid."""
        with self.writing() as connection:
            _take_turns(connection)
            yield connection

    @contextmanager
    def erasing(self) -> Iterator[Connection]:
        """Delete and update while nobody else can write.

        At the end, the database is rewritten without the erased data.
        """
        with self.changing() as connection:
            sqlite = connection.dialect.name == "sqlite"
            for table in metadata.sorted_tables:
                for lock in _locks(table)[connection.dialect.name]:
                    name = lock.split()[2]
                    of = "" if sqlite else f" ON {table.name}"
                    connection.execute(DDL(f"DROP TRIGGER IF EXISTS {name}{of}"))
            yield connection
            for table in metadata.sorted_tables:
                for lock in _locks(table)[connection.dialect.name]:
                    connection.execute(DDL(lock))
        tables = ", ".join(table.name for table in metadata.sorted_tables)
        alone = self._engine.execution_options(isolation_level="AUTOCOMMIT")
        with self._translated(), alone.connect() as connection:
            connection.exec_driver_sql("VACUUM" if sqlite else f"VACUUM FULL {tables}")

    def close(self) -> None:
        """Close the connections."""
        self._engine.dispose()

    def repeat(self, work: Callable[[], T]) -> T:
        """Return the result of `work`, which is done again if the server is lost meanwhile.

        `work` must do no harm if it is done again after it was done.
        """
        end = time.monotonic() + self._patience
        while True:
            try:
                return work()
            except Lost as error:
                if time.monotonic() > end:
                    raise
                self._wait(error, end=end)

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Connection]:
        """Open a transaction; wait for a server that does not answer."""
        connection = self._connect(engine)
        with self._translated(), connection, connection.begin():
            yield connection

    def _connect(self, engine: Engine) -> Connection:
        def connect() -> Connection:
            with self._translated():
                return engine.connect()

        return self.repeat(connect)

    def _wait(self, error: "Lost", *, end: float) -> None:
        left = max(end - time.monotonic(), 0.0)
        self._waiting(f"{error}; trying again for {left:.0f} s")
        time.sleep(min(_PAUSE, left))

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except SQLAlchemyError as error:
            cause = str(getattr(error, "orig", None) or error).strip().splitlines()
            is_lost = isinstance(error, OperationalError | InterfaceError) or (
                isinstance(error, DBAPIError) and error.connection_invalidated
            )
            is_server = self._engine.url.get_backend_name() != "sqlite"
            kind = Lost if is_lost and is_server else ConfigError
            raise kind(f"{self.name}: {cause[0] if cause else error}") from error


def _create(connection: Connection) -> None:
    """Create missing tables; two processes may do this at the same time."""
    _take_turns(connection)
    # A complete gradebook is left alone, because the user may lack the right to create tables.
    if not _is_whole(connection):
        metadata.create_all(connection)
        if _lacks_comments(connection):
            column = CreateColumn(overrides.c.comment).compile(dialect=connection.dialect)
            connection.execute(DDL(f"ALTER TABLE {overrides.name} ADD COLUMN {column}"))


def _is_whole(connection: Connection) -> bool:
    there = set(inspect(connection).get_table_names())
    return metadata.tables.keys() <= there and not _lacks_comments(connection)


def _lacks_comments(connection: Connection) -> bool:
    columns = inspect(connection).get_columns(overrides.name)
    return overrides.c.comment.name not in [column["name"] for column in columns]


def _take_turns(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":  # SQLite already holds its write lock here
        connection.execute(select(func.pg_advisory_xact_lock(_TURN)))


def _engine(place: str | Path, *, create: bool) -> Engine:
    if isinstance(place, Path) or "://" not in place:
        is_file = Path(place).suffix in _SUFFIXES and not Path(place).is_dir()
        file = Path(place) if is_file else Path(place) / FILE
        if not create and not file.is_file():
            raise ConfigError(f"{place}: holds no {FILE}; give the --out folder of cartlab grade")
        address = URL.create("sqlite", database=str(file))
    else:
        address = place
    try:
        url = make_url(address)
    except _SENSELESS as error:
        raise ConfigError(_NO_ADDRESS) from error
    try:
        if url.drivername == "postgresql":  # SQLAlchemy versions differ in their default driver
            url = url.set(drivername="postgresql+psycopg")
        if url.get_backend_name() != "sqlite":
            return create_engine(url, pool_pre_ping=True)
        file = url.database or ""
        if not (create or file.startswith((":memory:", "file:")) or Path(file).is_file()):
            # Without this check, SQLite would create the file.
            raise ConfigError(f"{quote(file)}: there is no such gradebook")
        if create and file and not file.startswith((":memory:", "file:")):
            _keep_private(Path(file))
        engine = create_engine(url, connect_args={"timeout": _PATIENCE})
    except (NoSuchModuleError, ModuleNotFoundError) as error:
        shown = url.render_as_string(hide_password=True)
        raise ConfigError(f"{shown}: no driver for it is installed ({error})") from error
    except _SENSELESS as error:
        raise ConfigError(_NO_ADDRESS) from error
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _keep_private(file: Path) -> None:
    """Let only the owner read a new gradebook file.

    An existing file keeps its group permissions, but all other users lose access. SQLite gives the
    same permissions to the temporary files next to it.
    """
    with suppress(OSError):  # the file may belong to another user
        os.close(os.open(file, os.O_RDWR | os.O_CREAT, OWNER_ONLY))
        mode = file.stat().st_mode
        if mode & stat.S_IRWXO:
            file.chmod(stat.S_IMODE(mode) & ~stat.S_IRWXO)


def _prepare_sqlite(connection, _record) -> None:
    connection.isolation_level = None  # cartlab starts each transaction itself, also for DDL
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA secure_delete = ON")  # overwrites erased data
    connection.execute("PRAGMA synchronous = FULL")  # committed data survive a power cut


def _begin_sqlite(connection: Connection) -> None:
    """Begin a transaction.

    A writing transaction takes the write lock at once: two readers that later wanted to write would
    deadlock.
    """
    options = connection.get_execution_options()
    if options.get("isolation_level") == "AUTOCOMMIT":
        return
    writes = options.get("writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def _check_version(connection: Connection, *, name: str) -> None:
    found = connection.scalar(select(settings.c.value).where(settings.c.name == "schema"))
    if found is None:
        connection.execute(insert(settings).values(name="schema", value=_VERSION))
    elif found != _VERSION:
        raise ConfigError(
            f"{name}: is a gradebook of version {found}, and this cartlab uses {_VERSION}: grade "
            f"into another folder, or use the cartlab that wrote it"
        )
