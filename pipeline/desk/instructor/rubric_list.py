"""The rubrics to start from: the shipped ones, and those in the instructor's folders."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.desk.browse import find_root
from pipeline.desk.users import User
from pipeline.errors import ConfigError
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import parse_rubric, rubric_source
from pipeline.resources import RUBRICS

_MOST = 40  # files listed
_LOOKED_AT = 2_000  # TOML files of a folder that are checked
_MARK = "[[criteria]]"
_START = 200_000  # a rubric contains _MARK within this many characters


@dataclass(frozen=True, kw_only=True)
class ListedRubric:
    """A rubric in the list.

    Attributes
    ----------
    rubric : content of the file; None if it has mistakes.
    """

    name: str
    path: Path
    rubric: Rubric | None


def shipped_names() -> list[str]:
    """Return the names of the shipped rubrics."""
    return sorted(path.stem for path in RUBRICS.glob("*.toml"))


def shipped_rubrics() -> list[ListedRubric]:
    """Return the shipped rubrics."""
    found = (_shelved(RUBRICS / f"{name}.toml", name) for name in shipped_names())
    return [one for one in found if one is not None]


def own_rubrics(user: User) -> list[ListedRubric]:
    """Return the rubrics in a user's workshop.

    The owner has no workshop. They get the rubrics near the open folders, and those in the folder
    in which the desk was started.
    """
    found: dict[Path, ListedRubric] = {}
    for root in _roots(user):
        for path in _toml_files(root):
            shelved = _shelved(path, path.relative_to(root).as_posix())
            if shelved is not None and len(found) < _MOST:
                found.setdefault(path.resolve(), shelved)
    return list(found.values())


def _roots(user: User) -> Sequence[Path]:
    if user.workshop:
        return (user.workshop,)
    places = (place for place in (*user.gradebooks, *user.folders) if isinstance(place, Path))
    return tuple(dict.fromkeys([find_root(), *(place.parent for place in places)]))


def _toml_files(root: Path) -> Iterator[Path]:
    """Yield the TOML files of a folder and of its direct subfolders."""
    for pattern in ("*.toml", "*/*.toml"):
        try:
            found = sorted(root.glob(pattern))[:_LOOKED_AT]
        except OSError:
            continue
        for path in found:
            hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
            shipped = path.resolve().parent == RUBRICS.resolve()
            if hidden or shipped or not path.is_file():
                continue
            if path.resolve().is_relative_to(root.resolve()):
                yield path


def _shelved(path: Path, name: str) -> ListedRubric | None:
    """Return a file as an entry of the list; None if it is not a rubric."""
    try:
        text = rubric_source(path)
    except ConfigError:
        return None
    if _MARK not in text[:_START]:
        return None
    try:
        rubric = parse_rubric(text, where=path.name)
    except ConfigError:
        rubric = None
    return ListedRubric(name=name, path=path, rubric=rubric)
