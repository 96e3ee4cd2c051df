"""The list from which the person at this computer chooses a folder, one level at a time."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal

from pipeline.desk.form_input import read_path
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.database import FILE
from pipeline.submission.load import NAME

MOST = 200  # folders shown in a list
_LOOKED_AT = 20_000  # largest number of folders whose content is checked

FolderKind = Literal["submission", "grading", "empty", "folder"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """A folder in the list.

    Attributes
    ----------
    inside : path of the folder relative to the root; "." for the root itself.
    kind : "grading", "submission", "empty" (without visible entries), or "folder" for any other.
    """

    path: Path
    inside: str
    kind: FolderKind


@dataclass(frozen=True, kw_only=True)
class FolderList:
    """The folders inside one folder.

    Attributes
    ----------
    here : the folder whose content is listed.
    above : name and path relative to the root of each folder above it.
    left_off : whether there are more folders than listed.
    """

    here: Found
    above: tuple[tuple[str, str], ...]
    found: tuple[Found, ...]
    left_off: bool


def find_root() -> Path:
    """Return the root of the list: the folder in which the desk was started, or the home folder.

    The home folder is used if the desk was started at the top of the file system.
    """
    here = Path.cwd()
    return here if here != Path(here.anchor) else Path.home()


def is_taken(path: Path) -> bool:
    """Return whether something has this path, perhaps a link that leads nowhere."""
    return path.exists() or path.is_symlink()


def numbered(path: Path) -> Iterator[Path]:
    """Yield a path, then further paths with a number added to the name."""
    yield path
    yield from (path.with_name(f"{path.stem}-{n}{path.suffix}") for n in count(2))


def free_path(path: Path) -> Path:
    """Return the first of these paths that is not taken yet."""
    return next(one for one in numbered(path) if not is_taken(one))


def list_folders(root: Path, inside: str) -> FolderList:
    """Return the folders inside one folder; submissions and gradings come first.

    Hidden folders are left out, and so are links that lead out of the root or to a hidden folder.

    Parameters
    ----------
    inside : the folder, relative to the root.

    Raises
    ------
    ConfigError : `inside` is not a folder that the list may show.
    """
    root = root.resolve()
    folder = read_path(inside or ".", wanted="choose a folder", inside=root)
    if not folder.is_dir() or not _is_shown(folder, root):
        raise ConfigError(f"{inside}: not a folder in {root}, or a hidden one")
    names, more = _list_names(folder)
    paths = dict.fromkeys((folder / name).resolve() for name in names)
    kept = [path for path in paths if _is_shown(path, root)]
    found = [_describe(path, root) for path in kept]
    openable = ("submission", "grading")
    found.sort(key=lambda one: one.kind not in openable)
    parts = folder.relative_to(root).parts
    steps = ["/".join(parts[:depth]) for depth in range(len(parts))]
    return FolderList(
        here=_describe(folder, root),
        above=tuple((Path(step).name or root.name or str(root), step) for step in steps),
        found=tuple(found[:MOST]),
        left_off=more or len(found) > MOST,
    )


def _list_names(folder: Path) -> tuple[list[str], bool]:
    """Return the names of the first folders inside a folder, and whether there are more."""
    try:
        with os.scandir(folder) as entries:
            names = [e.name for e in entries if not _is_hidden(e.name) and _is_folder(e)]
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be opened ({error.strerror})") from None
    names.sort(key=str.casefold)
    return names[:_LOOKED_AT], len(names) > _LOOKED_AT


def _is_folder(entry: "os.DirEntry[str]") -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link that leads to itself
        return False


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or not name.isprintable()


def _is_shown(path: Path, root: Path) -> bool:
    """Return whether a resolved path is inside the root, and no part of the path is hidden."""
    return path.is_relative_to(root) and not any(map(_is_hidden, path.relative_to(root).parts))


def _describe(path: Path, root: Path) -> Found:
    return Found(path=path, inside=path.relative_to(root).as_posix(), kind=_find_kind(path))


def _find_kind(path: Path) -> FolderKind:
    try:
        if (path / FILE).is_file():
            return "grading"
        if (path / NAME).is_file():
            return "submission"
        return "folder" if any(_shown_entries(path)) else "empty"
    except OSError:  # the desk has no right to read it
        return "folder"


def _shown_entries(path: Path) -> Iterator[str]:
    with os.scandir(path) as entries:
        yield from (entry.name for entry in entries if not _is_hidden(entry.name))
