"""The connection to the database of a gradebook: transactions, waiting, errors."""

import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    NoSuchModuleError,
    OperationalError,
    SQLAlchemyError,
)

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.schema import (
    create_tables,
    is_whole,
    metadata,
    settings,
    take_turns,
    unlocked,
)
from pipeline.output import OWNER_ONLY
from pipeline.submission.toml import quote
from pipeline.words.progress import silent

T = TypeVar("T")

FILE = "gradebook.sqlite"
_SUFFIXES = (".sqlite", ".sqlite3", ".db")  # suffixes of SQLite files; any other path is a folder
_PATIENCE = 60.0  # s to wait for a lock of another process; a commit takes milliseconds
_PAUSE = 2.0  # s between two attempts to reach a server

# Errors that SQLAlchemy and the drivers raise for an address that makes no sense.
_SENSELESS = (ArgumentError, ValueError, TypeError)
_NO_ADDRESS = (
    "the gradebook's address is not a database URL: write postgresql://NAME@HOST/DATABASE or "
    f"sqlite:////FOLDER/{FILE}"
)


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
        self._reader = self._engine
        if self._engine.dialect.name == "postgresql":  # SQLite reads like this anyway
            self._reader = self._engine.execution_options(isolation_level="REPEATABLE READ")
        try:
            whole = self.repeat(lambda: self._open(create=create))
        except _SENSELESS as error:  # some drivers read the address only when they connect
            raise ConfigError(_NO_ADDRESS) from error
        if not whole:  # an older version wrote it
            with self.writing() as connection:
                create_tables(connection, name=self.name)

    def _open(self, *, create: bool) -> bool:
        """Check the tables, or create them; return whether all are there."""
        opened = self._writer if create else self._engine
        with self._translated(), opened.begin() as connection:
            if create:
                create_tables(connection, name=self.name)
            elif not self._engine.dialect.has_table(connection, settings.name):
                raise ConfigError(f"{self.name}: holds no gradebook")
            return is_whole(connection, name=self.name)

    @property
    def name(self) -> str:
        """The file or URL to show in messages, without any password."""
        url = self._engine.url
        if url.get_backend_name() == "sqlite":
            return url.database or ""
        return url.render_as_string(hide_password=True)

    def reading(self) -> AbstractContextManager[Connection]:
        """Read the data of one moment; keep it short, because writers wait for it."""
        return self._transaction(self._reader)

    def writing(self) -> AbstractContextManager[Connection]:
        """Write all changes or none; at the end they are on disk."""
        return self._transaction(self._writer)

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        """Read and write while nobody else can write, so that the data just read stay valid."""
        with self.writing() as connection:
            take_turns(connection)
            yield connection

    @contextmanager
    def erasing(self) -> Iterator[Connection]:
        """Delete and update while nobody else can write.

        At the end, the database is rewritten without the erased data.
        """
        with self.changing() as connection:
            with unlocked(connection):
                yield connection
            sqlite = connection.dialect.name == "sqlite"
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
                left = end - time.monotonic()
                if left < 0:
                    raise
                self._waiting(f"{error}; trying again for {left:.0f} s")
                time.sleep(min(_PAUSE, left))

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Connection]:
        """Open a transaction; wait for a server that does not answer."""

        def connect() -> Connection:
            with self._translated():
                return engine.connect()

        connection = self.repeat(connect)
        with self._translated(), connection, connection.begin():
            yield connection

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
