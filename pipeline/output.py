"""Write result files whole or not at all, and never through a link in a submission.

Tables are written so that a spreadsheet does not run any formula that a student wrote.
"""

import os
import re
import secrets
import sys
import time
import zipfile
from collections.abc import Container, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from numbers import Real
from pathlib import Path

from pipeline.errors import ConfigError

OWNER_ONLY, OWNERS_FOLDER = 0o600, 0o700  # modes of files and folders with students' names
LOCK, TURN = ".lock", ".turn"  # lock files, see `pipeline.lock`
# On Windows these names are devices, with any ending: what is written to `aux.txt` is lost.
DEVICE = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
_PAUSES = (0.02, 0.05, 0.1, 0.2, 0.4)  # s between attempts to replace a file that is being read
# Not a formula although it begins like one: a number, or the dash for a missing value.
_PLAIN = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|-", re.ASCII)
# Characters that start a formula, wide and small forms included, at the start of a cell or after a
# semicolon. With decimal commas, a spreadsheet starts a new cell at a semicolon, even inside
# quotes.
_FORMULA = re.compile(r"(^|;)(?=[ \"']*[=+\-@＝＋－＠﹦﹢﹣﹫])")


def check_folder(out: Path) -> Path:
    """Return an output folder, which may exist or not.

    Raises
    ------
    ConfigError : the path is taken by something that is not a folder.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give a folder with --out")
    return out


def named_folder(out: Path) -> Path:
    """Return an output folder that a person named, which may exist or not.

    Raises
    ------
    ConfigError : the path is taken by something that is not a folder, or its ending is that of a
        file.
    """
    files = (".html", ".pdf", ".json", ".csv", ".xlsx", ".zip", ".db", ".sqlite")
    if not out.is_dir() and out.suffix.lower() in files:
        raise ConfigError(f"{out}: this writes several files; give a folder with --out")
    return check_folder(out)


def new_folder(out: Path) -> Path:
    """Return an output folder that does not exist yet, or is empty except for lock files.

    Raises
    ------
    ConfigError : the folder contains files already.
    """
    if named_folder(out).is_dir() and any(path.name not in (LOCK, TURN) for path in out.iterdir()):
        raise ConfigError(f"{out}: is not empty; choose a new folder with --out")
    return out


def own_folder(parent: Path, name: str) -> Path:
    """Return a folder of cartlab's own inside another folder; it may exist or not.

    Raises
    ------
    ConfigError : the path is taken by a file or a link. A link could lead to anybody's files.
    """
    folder = parent / name
    if folder.is_symlink():
        raise ConfigError(f"{folder}: is a link; choose another folder with --out")
    return check_folder(folder)


def write_file(path: Path, content: str | bytes, *, private: bool = False) -> None:
    """Write a file whole or not at all; replace a link at its path instead of following it.

    The first write into a folder also removes partial files of a program that was killed.

    Parameters
    ----------
    private : whether only its owner may read the file, if the system supports owners.
    """
    raw = content.encode() if isinstance(content, str) else content
    _clear_left_over(path.parent)
    part = path.with_name(f".{secrets.token_hex(8)}.part")  # a unique name
    try:
        with open(part, "xb", opener=_for_the_owner if private else None) as file:
            file.write(raw)
        _move_over(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _move_over(part: Path, path: Path) -> None:
    """Replace a file; Windows refuses this while another program has it open, so try again."""
    for pause in _PAUSES if sys.platform == "win32" else ():
        with suppress(PermissionError):
            part.replace(path)
            return
        time.sleep(pause)
    part.replace(path)


def _for_the_owner(path: str, flags: int) -> int:
    return os.open(path, flags, OWNER_ONLY)


# This runs once per folder, because searching thousands of files takes as long as writing one.
@lru_cache(maxsize=1000)
def _clear_left_over(folder: Path) -> None:
    an_hour_ago = time.time() - 3600.0  # longer than any write takes, and more than clocks differ
    for part in folder.glob(".*.part"):
        with suppress(OSError):  # another process has just removed it
            ours = re.fullmatch(r"\.[0-9a-f]{16}\.part", part.name)
            if ours and part.stat().st_mtime < an_hour_ago:
                part.unlink()


def clear_files(folder: Path, pattern: str) -> None:
    """Remove the files of an earlier run that match a pattern."""
    for path in folder.glob(pattern):
        if path.is_file() or path.is_symlink():
            path.unlink()


def zip_bytes(files: Iterable[tuple[str, bytes]], *, programs: Container[str] = ()) -> bytes:
    """Return files by name as one zip archive; the same files give the same bytes.

    Parameters
    ----------
    programs : names of the files that Unix may run.
    """
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files):
            info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))  # the time is fixed
            info.external_attr = (0o100755 if name in programs else 0o100644) << 16
            info.create_system = 3  # Unix, so that the file modes above apply
            archive.writestr(info, content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV: commas, line feeds, every text quoted; NaN and None are empty."""
    return "".join(",".join(map(_cell, row)) + "\n" for row in (head, *rows))


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, Real):
        return "" if value != value else f"{float(value):.10g}"
    return '"{}"'.format(escape_formula(str(value)).replace('"', '""'))


def escape_formula(text: str) -> str:
    """Return text that no spreadsheet runs: an apostrophe comes before any start of a formula.

    Control characters, special blanks and invisible characters become plain blanks. So they cannot
    end a row or hide a formula from this function.
    """
    text = "".join(c if c.isprintable() else " " for c in text)
    return text if _PLAIN.fullmatch(text) else _FORMULA.sub(r"\1'", text)
