"""Compile functions with numba, and choose the folder for the compiled code.

numba looks only at a function's own file to see whether stored code is out of date. But compiled
code also contains functions and constants from other files. So the folder is named after the
content of all files that may matter. After any change to them, a new folder replaces the old one.
"""

import hashlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config, event

ROOM = Path(__file__).parent
_PACKAGE = ROOM.parents[1]
_settings: Any = config  # its attributes appear when it is loaded
_OPTIONS: dict[str, Any] = {
    # Arrays are never made here, so reference counts are not needed. They took a quarter of a
    # search's time.
    "_nrt": False,
    "nogil": True,
    "fastmath": {"contract", "reassoc", "arcp", "nsz"},
    "error_model": "numpy",
}


def jit(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call; later processes load the result."""
    return _compiled(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into the functions that call it.

    Machine code is inlined, because inlining in Python would repeat the type analysis at every
    call.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: Callable[..., Any], **more: Any) -> Any:
    folder = kept_in(Path(function.__code__.co_filename).parent)
    users, _settings.CACHE_DIR = _settings.CACHE_DIR, str(folder or "")
    try:
        return numba.njit(**_OPTIONS, **more, cache=folder is not None)(function)
    finally:
        _settings.CACHE_DIR = users


@cache
def kept_in(room: Path) -> Path | None:
    """Return the folder for a package's compiled functions; None if no folder is writable.

    It is in cartlab's own `__pycache__` or, if that is not writable, in the user's cache.
    `NUMBA_CACHE_DIR` has priority.
    """
    name = f"{room.name}-{content_of(room)}"
    for root in _roots():
        with suppress(OSError, RuntimeError):  # RuntimeError: there is no home folder
            folder = root().expanduser() / name
            new = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                if new:
                    _remove_others(folder, room)
                return folder
    return None


def is_compiled(room: Path = ROOM, *, function: str = "_simulate") -> bool:
    """Return whether a function in a package's `kernel.py` is compiled already for this Python."""
    folder, python = kept_in(room), f"py{sys.version_info.major}{sys.version_info.minor}"
    return folder is not None and any(folder.rglob(f"kernel.{function}-*.{python}*.nbc"))


def content_of(room: Path) -> str:
    """Return a hash of all files that a package's compiled functions may contain."""
    digest = hashlib.sha256()
    for path in sorted({*ROOM.glob("*.py"), *room.glob("*.py")}):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _roots() -> Iterator[Callable[[], Path]]:
    mine = hashlib.sha256(os.fsencode(_PACKAGE)).hexdigest()[:16]  # differs between installations
    if _settings.CACHE_DIR:
        yield lambda: Path(_settings.CACHE_DIR) / f"cartlab-{mine}"
    yield lambda: _PACKAGE / "__pycache__" / "compiled"
    yield lambda: _users_cache() / "cartlab" / f"compiled-{mine}"


def _users_cache() -> Path:
    defaults = {"win32": "~/AppData/Local", "darwin": "~/Library/Caches"}
    return Path(os.environ.get("XDG_CACHE_HOME") or defaults.get(sys.platform, "~/.cache"))


def _remove_others(folder: Path, room: Path) -> None:
    for old in folder.parent.glob(f"{room.name}-*"):
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)


class _Word(event.Listener):
    """Explains once, on stderr, why the first simulation takes long."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if not self._said and function.__module__.startswith("pipeline."):
            self._said = True
            once = "once on this computer" if kept_in(ROOM) else "as it cannot be stored"
            sys.stderr.write(f"compiling the simulator, {once}: this takes about 20 s\n")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Word())
