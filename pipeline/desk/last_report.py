"""The last report: what it said and asked, and whether anything changed since it was made."""

import json
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.errors import SubmissionError
from pipeline.report.sections.answers import written_answer
from pipeline.submission.load import MAX_NOTES_BYTES, NAME, outside, spring_names
from pipeline.submission.models import MOST_CARTS, Input, Position
from pipeline.submission.toml_file import read_text

ASKED = "questions.json"  # beside the report: what it asks, said in one line, and is made of
NOTES = "notes.md"
_RESULTS = "report/results.json"
_MOST_ASKED, _MOST_RESULTS = 1_000_000, 30_000_000  # bytes


def sources(folder: Path) -> dict[str, list[int]]:
    """Return the time and the size of every file that a report is made of.

    With all of them kept, a file that is gone, or was replaced by an older one, shows too.
    """
    data = (path.relative_to(folder).as_posix() for path in (folder / "data").rglob("*"))
    named = (str(table.get("file", "")) for table in _experiments(_document(folder)))
    names = sorted({NAME, NOTES, "gap/gap.json", *data, *named})
    there = [name for name in names if outside(folder, name) is None]
    infos = {name: (folder / name).stat() for name in there}
    return {name: [info.st_mtime_ns, info.st_size] for name, info in infos.items()}


def state(folder: Path) -> str:
    """Return "none", "current", or "older" than what it is made of."""
    if outside(folder, "report/report.html") is not None:
        return "none"
    return "current" if _read_asked(folder).get("made_of") == sources(folder) else "older"


def told(folder: Path) -> dict[str, Any]:
    """Return what the last report said and asked, as far as its file can be read."""
    read = _read_asked(folder)
    try:
        questions = [{"id": str(one["id"]), "text": str(one["text"])} for one in read["questions"]]
        failed = [str(one) for one in read["failed"]]
        return {"questions": questions, "failed": failed, "changes": str(read["changes"])}
    except (KeyError, TypeError):
        return {"questions": [], "failed": [], "changes": ""}


def unanswered(folder: Path) -> list[dict[str, str]]:
    """Return the questions of the last report that have no answer yet."""
    try:
        notes = written_notes(folder)
    except SubmissionError:  # the report's page says what is wrong with them
        notes = ""
    return [
        one for one in told(folder)["questions"] if not written_answer(notes, one["id"]).strip()
    ]


def written_notes(folder: Path) -> str:
    """Return the text of `notes.md`, "" if the file is missing.

    Raises
    ------
    SubmissionError : it cannot be read.
    """
    if not (folder / NOTES).exists():
        return ""
    if problem := outside(folder, NOTES):
        raise SubmissionError(problem)
    where = f"{folder.name}/{NOTES}"
    return read_text(folder / NOTES, where=where, limit=MAX_NOTES_BYTES, error=SubmissionError)


def assumed(folder: Path) -> list[dict[str, str]]:
    """Return what is taken of the bench without being stated: key, about what, taken as, why.

    As the results of the last report list it; without a list there, what `submission.toml` lacks.
    """
    with suppress(ValueError, RecursionError, KeyError, TypeError, AttributeError):
        listed = _read_json(folder, _RESULTS, most=_MOST_RESULTS)["assumptions"]
        return [
            {
                "key": str(one["key"]),
                "about": str(one["about"]),
                "taken": _taken(one["value"]),
                "why": str(one["reason"]),
            }
            for one in listed
            if one["origin"] != "stated"
        ]
    return list(_not_stated(_document(folder)))


def _not_stated(document: Mapping[str, Any]) -> Iterator[dict[str, str]]:
    system = document.get("system")
    if not isinstance(system, dict):
        return
    carts = system.get("carts")
    if "springs" not in system and isinstance(carts, int) and 1 <= carts <= MOST_CARTS:
        for name in spring_names(carts):
            yield {"key": "system.springs", "about": name, "taken": "there", "why": ""}
    for key, unit in (("position", Position().unit), ("input", Input().unit)):
        table = system.get(key)
        if not isinstance(table, dict) or "unit" not in table:
            yield {"key": f"system.{key}.unit", "about": "", "taken": unit, "why": ""}
    table = system.get("input")
    if not isinstance(table, dict) or "sign" not in table:
        taken = "found from the data"
        yield {"key": "system.input.sign", "about": "", "taken": taken, "why": ""}


def _taken(value: object) -> str:
    if isinstance(value, bool):
        return "there" if value else "not there"
    if isinstance(value, list):
        return f"free: {', '.join(map(str, value))}"
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def _read_asked(folder: Path) -> dict[str, Any]:
    with suppress(ValueError, RecursionError):
        read = _read_json(folder, f"report/{ASKED}", most=_MOST_ASKED)
        return read if isinstance(read, dict) else {}
    return {}


def _read_json(folder: Path, name: str, *, most: int) -> Any:
    if outside(folder, name) is not None or (folder / name).stat().st_size > most:
        return {}
    return json.loads((folder / name).read_bytes())


def _document(folder: Path) -> dict[str, Any]:
    if outside(folder, NAME) is None:
        with suppress(ValueError, RecursionError):  # the page says what is wrong with it
            return tomllib.loads((folder / NAME).read_bytes().decode())
    return {}


def _experiments(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    tables = document.get("experiments")
    return [t for t in tables if isinstance(t, dict)] if isinstance(tables, list) else []
