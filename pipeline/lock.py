"""One cartlab at a time writes into a folder: a run keeps others out, a change waits its turn."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.errors import ConfigError
from pipeline.output import LOCK, OWNERS_FOLDER, TURN

_PATIENCE = 30.0  # s for a turn, which takes less than one
_AGAIN = 0.02  # s until who waits asks again


@contextmanager
def alone_in(out: Path, *, private: bool = False) -> Iterator[None]:
    """Make a folder and keep other runs out of it; remove it if it stays empty.

    The lock is the system's: it is gone with its process however that ends.

    Parameters
    ----------
    private : only its owner may enter a folder that is made here.

    Raises
    ------
    ConfigError : another run is under way in it.
    """
    new, lock = not out.exists(), out / LOCK
    out.mkdir(OWNERS_FOLDER if private else 0o777, parents=True, exist_ok=True)
    try:
        with _locked(lock, patience=0.0):
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
def _locked(path: Path, *, patience: float) -> Iterator[None]:
    if path.is_symlink():
        raise ConfigError(f"{path}: is a link; remove it")
    lock = FileLock(path, on_acquired=_sign, fallback_to_soft=False)
    try:
        lock.acquire(timeout=patience, poll_interval=_AGAIN)
    except Timeout:
        raise ConfigError(
            f"{path.parent}: another cartlab{_holder(path)} is writing there; wait for it, or "
            f"choose another folder"
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror or error}; can you write to this folder?"
        ) from None
    try:
        yield
    finally:
        lock.release()


# The number of the process follows a blank, because on Windows only the holder of a lock can read
# its first byte.


def _sign(file: int) -> None:
    """Write this process's number into the acquired lock, for messages to others."""
    before = os.read(file, 32)
    # Up to version 0.2 a lock was a database.
    if before.strip() and not before.strip().isdigit() and not before.startswith(b"SQLite format"):
        raise OSError("is not a lock of cartlab")
    os.ftruncate(file, 0)
    os.lseek(file, 0, os.SEEK_SET)
    os.write(file, f" {os.getpid()}".encode())


def _holder(path: Path) -> str:
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(1)
            return f" (process {int(file.read(32))})"
    except (OSError, ValueError):
        return ""
