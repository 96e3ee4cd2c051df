"""Repairs of `submission.toml` by a person, kept in the folder of a class beside the originals.

A repair belongs to the exact text that was handed in. So it counts again whenever the same text is
graded, and not if the team hands in another version.
"""

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from pipeline.errors import ConfigError
from pipeline.output import own_folder, write_file
from pipeline.submission.load import MAX_TOML_BYTES, NAME

FOLDER = "repairs"
_LATEST, _ORIGINAL, _REPAIR, _RUN = "latest", "original.toml", "repair.json", "run.json"
_DAMAGED = OSError, ValueError, TypeError


@dataclass(frozen=True, kw_only=True)
class Repair:
    """A repaired text of `submission.toml`, with the person who wrote it and the reason."""

    text: str
    by: str
    why: str


@dataclass(frozen=True, kw_only=True)
class Run:
    """What was graded last: the paths, the rubric's file, and the file of days late or "".

    `options` are the other options of `grade_class.Options` that decide the result.
    """

    paths: tuple[str, ...]
    rubric: str
    lateness: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)


def text_key(text: str) -> str:
    """Return the key by which a text that was handed in is found."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_repairs(out: Path, name: str) -> dict[str, Repair]:
    """Return the repairs of a submission, by the key of the text that each one replaces."""
    found = {}
    for path in sorted((out / FOLDER / name).glob(f"*/{_REPAIR}")):
        with suppress(*_DAMAGED):
            found[path.parent.name] = Repair(**json.loads(path.read_text("utf-8")))
    return found


def keep_original(out: Path, name: str, text: str) -> None:
    """Keep the text that was handed in, so that it can be repaired; "" if nothing needs it."""
    folder = own_folder(out, FOLDER) / name
    if text:
        _write(folder / text_key(text) / _ORIGINAL, text)
        _write(folder / _LATEST, text_key(text))
    else:
        (folder / _LATEST).unlink(missing_ok=True)


def read_original(out: Path, name: str) -> str | None:
    """Return the text that was graded last, if it has a mistake or a repair; otherwise None."""
    folder = out / FOLDER / name
    try:
        key = (folder / _LATEST).read_text("utf-8")
        return (folder / key / _ORIGINAL).read_bytes().decode()
    except (OSError, ValueError):
        return None


def save_repair(out: Path, name: str, repair: Repair, *, of: str) -> None:
    """Save a repair of the text with the key `of`.

    Raises
    ------
    ConfigError : the text is too long, there is no reason, or another version was handed in.
    """
    original = read_original(out, name)
    if original is None or text_key(original) != of:
        raise ConfigError(f"{NAME}: was handed in again meanwhile; load the page again")
    if len(repair.text.encode()) > MAX_TOML_BYTES:
        raise ConfigError(f"{NAME}: would exceed {MAX_TOML_BYTES:,} bytes")
    if not repair.why.strip():
        raise ConfigError("enter a reason: the team reads what was repaired, and why")
    _write(out / FOLDER / name / of / _REPAIR, json.dumps(asdict(repair), ensure_ascii=False))


def save_run(out: Path, run: Run) -> None:
    """Save what was graded, so that the class can be graded again at the desk."""
    _write(out / _RUN, json.dumps(asdict(run), ensure_ascii=False))
    if (old := out / FOLDER / _RUN).is_file():  # its place was among the submissions' folders
        old.unlink()


def read_run(out: Path) -> Run | None:
    """Return what was graded last; None if this is not known or cannot be read."""
    for file in (out / _RUN, out / FOLDER / _RUN):
        with suppress(*_DAMAGED):
            return TypeAdapter(Run).validate_json(file.read_bytes())
    return None


def forget_repairs(out: Path, names: Iterable[str]) -> None:
    """Delete all that is kept about repairs of some submissions, and the paths that name them."""
    gone = set(names)
    for name in gone:
        shutil.rmtree(out / FOLDER / name, ignore_errors=True)
    if run := read_run(out):
        last = {Path(name).name for name in gone}
        paths = tuple(
            path for path in run.paths if last.isdisjoint((Path(path).stem, Path(path).name))
        )
        save_run(out, replace(run, paths=paths))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, text.encode(), private=True)  # bytes, so that line ends stay as they are
