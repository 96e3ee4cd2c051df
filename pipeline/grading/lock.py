"""One run at a time in an `--out` folder, each with a scratch of its own."""

import os
import re
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import psutil

from pipeline.errors import ConfigError
from pipeline.output import own_folder

_LOCK = ".lock"
_SCRATCH = re.compile(r"\.scratch(-(?P<process>\d+))?")


@contextmanager
def alone_in(out: Path) -> Iterator[None]:
    """Make a folder and keep other runs out of it; it goes again where nothing came of it.

    The lock is SQLite's: it works on every system, and is gone with its process however that ends.

    Raises
    ------
    ConfigError : another run is under way in it.
    """
    new, lock = not out.exists(), out / _LOCK
    out.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(lock):
            yield
    finally:
        if new and list(out.iterdir()) == [lock]:
            lock.unlink()
            out.rmdir()


@contextmanager
def _locked(lock: Path) -> Iterator[None]:
    out = lock.parent
    with closing(sqlite3.connect(lock, timeout=0, isolation_level=None)) as connection:
        try:
            connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise ConfigError(f"{lock}: {error}") from None
            running = [pid for _, pid in _scratches(out) if pid and psutil.pid_exists(pid)]
            who = f" (process {running[0]})" if running else ""
            raise ConfigError(
                f"{out}: another cartlab{who} writes there; wait for it, or name another folder"
            ) from None
        yield


@contextmanager
def scratch_in(out: Path) -> Iterator[Path]:
    """Make a scratch folder that is removed at the end; only whoever is alone there may ask.

    What is left of runs that were stopped is removed first.
    """
    for left, _ in _scratches(out):
        shutil.rmtree(left, ignore_errors=True)
    scratch = own_folder(out, f".scratch-{os.getpid()}")
    scratch.mkdir(exist_ok=True)
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _scratches(out: Path) -> list[tuple[Path, int]]:
    """Return the scratch folders in a folder, and the processes they are of."""
    named = ((path, _SCRATCH.fullmatch(path.name)) for path in sorted(out.iterdir()))
    return [
        (path, int(name["process"] or 0))
        for path, name in named
        if name and path.is_dir() and not path.is_symlink()
    ]
