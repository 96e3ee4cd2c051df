"""Keep two cartlab programs from writing into one folder at the same time."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline.errors import ConfigError
from pipeline.output import LOCK, OWNERS_FOLDER, TURN

_PATIENCE = 30.0  # s to wait for another program, which needs less than 1 s
_AGAIN = 0.02  # s between attempts


@contextmanager
def lock_or_refuse(out: Path, *, private: bool = False) -> Iterator[None]:
    """Create a folder if needed, and keep other cartlab programs out of it.

    The operating system holds the lock and releases it when the process ends, however it ends. A
    new folder is removed again if it stays empty.

    Parameters
    ----------
    private : whether only the owner may enter a new folder.

    Raises
    ------
    ConfigError : another cartlab program is using the folder.
    """
    new, lock = not out.exists(), out / LOCK
    out.mkdir(OWNERS_FOLDER if private else 0o777, parents=True, exist_ok=True)
    try:
        with _locked(lock, patience=0.0):
            yield
    finally:
        if new and all(path == lock for path in out.iterdir()):
            lock.unlink(missing_ok=True)  # on Windows it is gone already
            out.rmdir()


@contextmanager
def lock_when_free(folder: Path) -> Iterator[None]:
    """Wait until no other program is changing files of this folder, then keep others out.

    This lock is separate from that of `lock_or_refuse`, which a bench session may hold for an hour
    while `submission.toml` changes.

    Raises
    ------
    ConfigError : another program has held the lock for half a minute, or the folder is not
        writable.
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


# In the lock file, a blank precedes the process number, because on Windows only the holder of the
# lock can read the first byte.


def _sign(file: int) -> None:
    """Write this process's number into the acquired lock file, for messages of other processes."""
    before = os.read(file, 32)
    # Up to version 0.2 a lock file was an SQLite database.
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
