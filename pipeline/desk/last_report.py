"""The last report: its questions and assumptions, and whether its sources have changed since."""

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from pipeline.errors import SubmissionError
from pipeline.output import write_file
from pipeline.results import ReportStatus
from pipeline.submission.load import MAX_NOTES_BYTES, NAME, file_problem, list_experiments
from pipeline.submission.toml import find_deep_key, read_text

# A file next to the report: its questions, assumptions, findings, and state of its sources.
FINDINGS = "questions.json"
NOTES = "notes.md"
NO_FINDINGS: Mapping[str, Any] = {
    "questions": [], "assumed": [], "contradicted": [], "failed": [], "changes": "", "turned": {},
    "status": None,
}  # fmt: skip
PDF = "report/report.pdf"
PLOTS = "report/compare.html"
PLOTS_OF = "report/plots.json"  # state of the sources of the plots


def stat_sources(folder: Path) -> dict[str, list[int]]:
    """Return time and size of every file from which a report is made; only workers call this.

    The result also changes if a file is deleted or replaced by an older one.
    """
    named = (str(table.get("file", "")) for table in list_experiments(_read_document(folder)))
    return stat_files(folder, named)


def stat_files(folder: Path, named: Iterable[str]) -> dict[str, list[int]]:
    """Return time and size of the sources of a report; [] for each file that is missing.

    Parameters
    ----------
    named : files that `submission.toml` names. A later change of these names changes the time of
        `submission.toml`, so an earlier list is enough to notice it.
    """
    data = (path.relative_to(folder).as_posix() for path in (folder / "data").rglob("*"))
    found = {}
    for name in sorted({NAME, NOTES, "gap/gap.json", *data, *named}):
        found[name] = []
        if file_problem(folder, name) is None:
            info = (folder / name).stat()
            found[name] = [info.st_mtime_ns, info.st_size]
    return found


def is_unchanged(folder: Path, made_of: object, *, except_for: str = "") -> bool:
    """Return whether the sources are those of an earlier `stat_sources`."""
    if not isinstance(made_of, dict):
        return False
    now = stat_files(folder, made_of)
    names = (now.keys() | made_of.keys()) - {except_for}
    return all((now.get(name) or []) == (made_of.get(name) or []) for name in names)


def find_state(folder: Path) -> str:
    """Return the state of the report: "none", "current", "answered" or "older".

    "answered" means that only the answers in `notes.md` have changed; no number depends on them.
    "older" means that other sources have changed.
    """
    if file_problem(folder, "report/report.html") is not None:
        return "none"
    made_of = _read_findings_file(folder).get("made_of")
    if is_unchanged(folder, made_of):
        return "current"
    return "answered" if is_unchanged(folder, made_of, except_for=NOTES) else "older"


def plots_are_current(folder: Path) -> bool:
    """Return whether there are plots and their sources have not changed."""
    if file_problem(folder, PLOTS) is not None:
        return False
    return is_unchanged(folder, _read_small(folder, PLOTS_OF).get("made_of"))


def read_findings(folder: Path) -> dict[str, Any]:
    """Return what the last report assumed, asked and found wrong, if its file can be read."""
    read = _read_findings_file(folder)
    status = read.get("status")
    try:
        return {
            "questions": _pick_texts(read["questions"], ("id", "section", "text")),
            "assumed": _pick_assumptions(read.get("assumed", [])),
            "contradicted": _pick_assumptions(read.get("contradicted", [])),
            "failed": [str(one) for one in read["failed"]],
            # An earlier version wrote no status.
            "status": status and TypeAdapter(ReportStatus).validate_python(status),
            "changes": str(read["changes"]),
            "turned": {str(run): int(sign) for run, sign in read.get("turned", {}).items()},
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        return dict(NO_FINDINGS)


def write_findings(
    findings: Mapping[str, Any], out: Path, *, made_of: Mapping[str, Sequence[int]]
) -> dict[str, Any]:
    """Write what a report assumed, asked and found wrong next to it; return it.

    Parameters
    ----------
    made_of : the sources, as `stat_sources` found them before they were read.
    """
    told = {**findings, "made_of": made_of}
    write_file(out / FINDINGS, json.dumps(told, ensure_ascii=False))
    return told


def _pick_assumptions(found: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the texts and the `value` of each assumption about the bench."""
    texts = _pick_texts(found, ("key", "about", "support", "taken", "why"))
    return [{**one, "value": raw.get("value")} for one, raw in zip(texts, found, strict=True)]


def _pick_texts(found: Iterable[Mapping[str, Any]], keys: Sequence[str]) -> list[dict[str, str]]:
    return [{key: str(one.get(key, "")) for key in keys} for one in found]


def read_notes(folder: Path) -> str:
    """Return the text of `notes.md`, "" if the file is missing.

    Raises
    ------
    SubmissionError : `notes.md` cannot be read.
    """
    if not (folder / NOTES).exists():
        return ""
    if problem := file_problem(folder, NOTES):
        raise SubmissionError(problem)
    where = f"{folder.name}/{NOTES}"
    return read_text(folder / NOTES, where=where, limit=MAX_NOTES_BYTES, error=SubmissionError)


def _read_findings_file(folder: Path) -> dict[str, Any]:
    return _read_small(folder, f"report/{FINDINGS}")


def _read_small(folder: Path, name: str) -> dict[str, Any]:
    """Return the content of a small JSON file that cartlab wrote; {} if it cannot be read."""
    if file_problem(folder, name) is None and (folder / name).stat().st_size <= 1_000_000:
        with suppress(ValueError, RecursionError):
            read = json.loads((folder / name).read_bytes())
            return read if isinstance(read, dict) else {}
    return {}


def _read_document(folder: Path) -> dict[str, Any]:
    if file_problem(folder, NAME) is None:
        with suppress(ValueError, RecursionError):  # the page shows what is wrong
            text = (folder / NAME).read_bytes().decode()
            return {} if find_deep_key(text) else tomllib.loads(text)
    return {}
