"""The folders that the person at this computer chooses from: under one root, a level at a time."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.desk.typed import read_path
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.schema import FILE
from pipeline.submission.load import NAME

MOST = 200  # folders in a list
_LOOKED_AT = 20_000  # folders of one, in their order, that are looked into

Kind = Literal["submission", "grading", "empty", "folder"]


@dataclass(frozen=True, kw_only=True)
class Found:
    """A folder of the list.

    Attributes
    ----------
    inside : its path under the root, "." for the root itself.
    kind : "empty" holds nothing that shows; "folder" is any other folder.
    """

    path: Path
    inside: str
    kind: Kind


@dataclass(frozen=True, kw_only=True)
class FolderList:
    """The folders in one folder.

    Attributes
    ----------
    here : the folder itself.
    above : the name and the address under the root of each folder on the way to it.
    left_off : more folders are there than are listed.
    """

    here: Found
    above: tuple[tuple[str, str], ...]
    found: tuple[Found, ...]
    left_off: bool


def find_root() -> Path:
    """Return where lists begin: the folder that the desk was started in, else the home folder."""
    here = Path.cwd()
    return here if here != Path(here.anchor) else Path.home()


def list_folders(root: Path, inside: str) -> FolderList:
    """Return the folders in one under the root, what can be opened first.

    Hidden folders are left out, and links that lead out of the root or to a hidden folder.

    Raises
    ------
    ConfigError : it is no folder that a list of this root shows.
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
    """Return the first folders in a folder by name, and whether there are more."""
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
    """Whether a resolved path is the root or lies under it, with nothing hidden on the way."""
    return path.is_relative_to(root) and not any(map(_is_hidden, path.relative_to(root).parts))


def _describe(path: Path, root: Path) -> Found:
    return Found(path=path, inside=path.relative_to(root).as_posix(), kind=_find_kind(path))


def _find_kind(path: Path) -> Kind:
    try:
        if (path / FILE).is_file():
            return "grading"
        if (path / NAME).is_file():
            return "submission"
        return "folder" if any(_shown_entries(path)) else "empty"
    except OSError:  # the desk may not look into it
        return "folder"


def _shown_entries(path: Path) -> Iterator[str]:
    with os.scandir(path) as entries:
        yield from (entry.name for entry in entries if not _is_hidden(entry.name))
