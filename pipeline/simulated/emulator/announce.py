"""Announce the virtual benches that run on this computer, each by a file."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

from pipeline.output import OWNERS_FOLDER


@dataclass(frozen=True, kw_only=True)
class RunningBench:
    """A virtual bench of the same user."""

    name: str
    address: str


@contextmanager
def announced(bench: RunningBench) -> Iterator[None]:
    """Announce a running bench to this user's desks; remove the file at the end."""
    folder, pid = _find_folder(), os.getpid()
    path = folder / f"{pid}.json"
    entry = {"name": bench.name, "address": bench.address, "began": _began(pid)}
    with suppress(OSError):  # without a folder, the bench's address can still be typed
        folder.mkdir(OWNERS_FOLDER, exist_ok=True)
        if _is_own(folder):
            _clear_stale(folder)
            path.write_text(json.dumps(entry), encoding="utf-8")
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def running_benches() -> list[RunningBench]:
    """Return the virtual benches that are running now."""
    folder = _find_folder()
    if not _is_own(folder):
        return []
    found = [_read(path) for path in sorted(folder.glob("*.json"))]
    return [bench for bench in found if bench is not None]


def _find_folder() -> Path:
    """Return the path of the folder for the files; each user has a separate folder."""
    own = str(os.getuid()) if hasattr(os, "getuid") else "user"
    root = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    return Path(root) / f"cartlab-benches-{own}"


def _is_own(folder: Path) -> bool:
    """Return whether the folder exists and belongs to this user alone."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    info = folder.stat()
    return os.name != "posix" or (info.st_uid == os.getuid() and not info.st_mode & 0o022)


def _read(path: Path) -> RunningBench | None:
    """Return the bench that a file announces; None if its process has ended."""
    try:
        entry = json.loads(path.read_text(encoding="utf-8"))
        if entry["began"] != _began(int(path.stem)):
            return None
        return RunningBench(name=str(entry["name"]), address=str(entry["address"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _began(pid: int) -> float:
    """Return when a process began, s; 0 if there is no such process.

    If the system reuses the number for a new process, the time is different.
    """
    try:
        return psutil.Process(pid).create_time()
    except psutil.Error:
        return 0.0


def _clear_stale(folder: Path) -> None:
    for path in folder.glob("*.json"):
        if _read(path) is None:
            path.unlink(missing_ok=True)
