"""One cartlab at a time writes into a folder: a run keeps others out, a change waits its turn."""

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.output import LOCK, OWNERS_FOLDER, TURN

_PATIENCE = 30.0  # s for a turn, which takes less than one
_AGAIN = 0.02  # s until who waits asks again

# Where a database keeps its user's number, by SQLite's file format; the lock keeps its process
# there, to be read by whoever the lock keeps out.
_PROCESS = slice(60, 64)


@contextmanager
def alone_in(out: Path, *, private: bool = False) -> Iterator[None]:
    """Make a folder and keep other runs out of it; it goes again where nothing came of it.

    The lock is SQLite's: it works on every system, and is gone with its process however that ends.

    Parameters
    ----------
    private : nobody but its owner may enter a folder that is made here.

    Raises
    ------
    ConfigError : another run is under way in it.
    """
    new, lock = not out.exists(), out / LOCK
    out.mkdir(OWNERS_FOLDER if private else 0o777, parents=True, exist_ok=True)
    try:
        with _locked(lock):
            yield
    finally:
        if new and list(out.iterdir()) == [lock]:
            lock.unlink()
            out.rmdir()


@contextmanager
def turn_in(folder: Path) -> Iterator[None]:
    """Wait until nobody else reads a file of a folder to write it again.

    It is a lock of its own: a session on a bench has the folder to itself for an hour, and changes
    its `submission.toml` all the while.

    Raises
    ------
    ConfigError : another has had its turn for half a minute, or nothing can be written there.
    """
    with _locked(folder / TURN, patience=_PATIENCE):
        yield


@contextmanager
def _locked(lock: Path, *, patience: float = 0.0) -> Iterator[None]:
    if lock.is_symlink():
        raise ConfigError(f"{lock}: is a link; remove it")
    end = time.monotonic() + patience
    while (connection := _taken(lock)) is None:
        if time.monotonic() >= end:
            process = int.from_bytes(lock.read_bytes()[_PROCESS], "big")
            who = f" (process {process})" if process else ""
            raise ConfigError(
                f"{lock.parent}: another cartlab{who} writes there; wait for it, or name another "
                "folder"
            )
        time.sleep(_AGAIN)
    with closing(connection):
        yield


def _taken(lock: Path) -> sqlite3.Connection | None:
    """Return the connection that holds the lock until it is closed; None where another has it.

    It is not waited for here: of several that wait within SQLite each keeps the others waiting.
    """
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(lock, timeout=0.0, isolation_level=None)
            stack.callback(connection.close)
            connection.execute("PRAGMA journal_mode = MEMORY")  # no further file
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")  # a commit keeps the lock
            connection.execute("BEGIN EXCLUSIVE")
            connection.execute(f"PRAGMA user_version = {os.getpid()}")
            connection.execute("COMMIT")
        except sqlite3.Error as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise ConfigError(f"{lock}: {error}; is the folder yours to write?") from None
            return None
        stack.pop_all()
        return connection
