"""Writing results: whole files or none, never through a link that a submission brought.

Tables are written so that a spreadsheet runs nothing that a student wrote.
"""

import os
import re
import secrets
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from numbers import Real
from pathlib import Path

from pipeline.errors import ConfigError

OWNER_ONLY, OWNERS_FOLDER = 0o600, 0o700  # modes of files with students' names
LOCK, TURN = ".lock", ".turn"  # of `pipeline.lock`
# Not a formula although it looks like one: a number, or the dash for a missing value.
_PLAIN = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|-", re.ASCII)
# What starts a formula, wide and small forms too, at the start of a cell or behind a semicolon,
# where a spreadsheet of a country with decimal commas begins another cell, quotes or not.
_FORMULA = re.compile(r"(^|;)(?=[ \"']*[=+\-@＝＋－＠﹦﹢﹣﹫])")


def check_folder(out: Path) -> Path:
    """Return the folder, there or not yet.

    Raises
    ------
    ConfigError : something else is in its place.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give a folder with --out")
    return out


def named_folder(out: Path) -> Path:
    """Return a folder that a person named, there or not yet.

    Raises
    ------
    ConfigError : something else is in its place, or its name is meant for a file: several are
        written.
    """
    files = (".html", ".pdf", ".json", ".csv", ".xlsx", ".zip", ".db", ".sqlite")
    if not out.is_dir() and out.suffix.lower() in files:
        raise ConfigError(f"{out}: this writes several files; give a folder with --out")
    return check_folder(out)


def new_folder(out: Path) -> Path:
    """Return the folder, not yet there or empty but for locks.

    Raises
    ------
    ConfigError : there is something in it, which a new submission would be mixed with.
    """
    if named_folder(out).is_dir() and any(path.name not in (LOCK, TURN) for path in out.iterdir()):
        raise ConfigError(f"{out}: is not empty; choose a new folder with --out")
    return out


def own_folder(parent: Path, name: str) -> Path:
    """Return a folder of ours inside another, there or not yet.

    Raises
    ------
    ConfigError : a file or a link is in its place; what a link points at may be anybody's.
    """
    folder = parent / name
    if folder.is_symlink():
        raise ConfigError(f"{folder}: is a link; choose another folder with --out")
    return check_folder(folder)


def write_file(path: Path, content: str | bytes, *, private: bool = False) -> None:
    """Write a file whole or not at all; a link in its place is replaced, not followed.

    Remains of a program that was killed while writing are removed, once per process.

    Parameters
    ----------
    private : only its owner may read it, if the system supports owners.
    """
    raw = content.encode() if isinstance(content, str) else content
    _clear_left_over(path.parent)
    part = path.with_name(f".{secrets.token_hex(8)}.part")  # of this write alone
    try:
        with open(part, "xb", opener=_for_the_owner if private else None) as file:
            file.write(raw)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _for_the_owner(path: str, flags: int) -> int:
    return os.open(path, flags, OWNER_ONLY)


# Once a folder: to look through thousands of files takes as long as to write one.
@lru_cache(maxsize=1000)
def _clear_left_over(folder: Path) -> None:
    an_hour_ago = time.time() - 3600.0  # no write takes so long; clocks are not so far apart
    for part in folder.glob(".*.part"):
        with suppress(OSError):  # another has just removed it
            ours = re.fullmatch(r"\.[0-9a-f]{16}\.part", part.name)
            if ours and part.stat().st_mtime < an_hour_ago:
                part.unlink()


def clear_files(folder: Path, pattern: str) -> None:
    """Remove files of an earlier run, so that no stale ones stay."""
    for path in folder.glob(pattern):
        if path.is_file() or path.is_symlink():
            path.unlink()


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV: commas, line feeds, every text quoted; NaN and None are empty."""
    return "".join(",".join(map(_cell, row)) + "\n" for row in (head, *rows))


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, Real):
        return "" if value != value else f"{float(value):.10g}"
    return '"{}"'.format(harmless(str(value)).replace('"', '""'))


def harmless(text: str) -> str:
    """Return text without control characters, an apostrophe before what starts a formula.

    Blanks of all sorts and marks that show as nothing become plain blanks: none ends a row, and
    none keeps a spreadsheet, but not us, from seeing a formula.
    """
    text = "".join(c if c.isprintable() else " " for c in text)
    return text if _PLAIN.fullmatch(text) else _FORMULA.sub(r"\1'", text)
