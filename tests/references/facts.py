"""Turn output files into facts, and compare the facts of two versions of the program.

A fact is a number, a word or a truth value with a path, such as `grade/team-3/points`. Sentences
are no facts: they may be worded differently at any time.
"""

import csv
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from tests.references.hook.sitecustomize import summary

Facts = dict[str, Any]
# Keys of what differs from run to run or from version to version, and of sentences.
_LEFT_OUT = frozenset({
    "provenance", "version", "schema", "at", "key", "submitted",
    "message", "reason", "note", "notes", "warnings", "title", "advice", "problems", "doubts",
    "next_experiment", "comment", "remarks", "sentence", "needs", "unusable", "what_to_do",
})  # fmt: skip
_WITH_PATHS = "run.json"  # what a grading was called with
_NAMES = ("id", "code", "name", "key", "experiment", "run", "cart", "effect", "number")
_LONGEST = 6  # words of a name; a longer text is a sentence
_ROUNDING = 1e-12  # a smaller number is the rounding error of a computer
_ALIGNED = re.compile(r"[-−+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)


def read_facts(folder: Path) -> Facts:
    """Return the facts of all JSON files, tables and pages with tables in a folder."""
    found: Facts = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name == _WITH_PATHS:
            continue
        if path.suffix == ".json" and not path.name.startswith("."):
            found[name] = tree(json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix == ".csv":
            with path.open(encoding="utf-8-sig", newline="") as file:
                found[name] = {row[0]: [_cell(c) for c in row[1:]] for row in csv.reader(file)}
        elif path.name in ("solution.html", "feedback.html"):
            found[name] = {"numbers in tables": numbers_shown(path.read_text(encoding="utf-8"))}
    return {name: one for name, one in found.items() if one not in ({}, [], None)}


def tree(value: Any) -> Any:
    """Return JSON without sentences; tables by the names of their rows; long lists in summary."""
    if isinstance(value, Mapping):
        kept = {k: tree(v) for k, v in value.items() if k not in _LEFT_OUT}
        return {k: v for k, v in kept.items() if v is not None and v not in ({}, [])}
    if isinstance(value, list):
        if value and all(isinstance(one, Mapping) for one in value):
            names = _names(value)
            if all(names):
                return {name: tree(one) for name, one in zip(names, value, strict=True)}
        if value and all(isinstance(one, int | float) for one in value):
            return summary(value)
        return [tree(one) for one in value]
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return value
    if isinstance(value, str):
        sentence = value.endswith(".") or len(value.split()) > _LONGEST
        return None if sentence else value
    return float(f"{value:.8g}")


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a name for each row of a table; rows of one name are numbered."""
    found: Counter[str] = Counter()
    names = []
    for row in rows:
        parts = [str(row[k]) for k in _NAMES if isinstance(row.get(k), str | int)]
        name = " ".join(parts)
        found[name] += 1 if name else 0
        names.append(name if found[name] < 2 else f"{name} #{found[name]}")
    return names


def _cell(text: str) -> Any:
    try:
        return float(f"{float(text):.8g}")
    except ValueError:
        return tree(text)


class _Cells(HTMLParser):
    """Collect the text of table cells and formulas."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self._inside = 0

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag in ("td", "math"):
            self._inside += 1
            self.texts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside -= tag in ("td", "math")

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.texts[-1] += data


def numbers_shown(page: str) -> list[str]:
    """Return all numbers in the tables and formulas of a page, as written, in order of size.

    Numbers inside sentences are left out, like sentences.
    """
    cells = _Cells()
    cells.feed(page)
    texts = [text for text in cells.texts if not text.rstrip().endswith(".")]
    shown = [one for text in texts for one in _ALIGNED.findall(text.replace("−", "-"))]
    return sorted((one for one in shown if "." in one), key=lambda one: (float(one), one))


# -------------------------------------------------------------------------------- comparison


def rounded(facts: Any, *, digits: int) -> Any:
    """Return the facts with numbers of fewer digits; 0 for the rounding errors of a computer."""
    if isinstance(facts, Mapping):
        return {name: rounded(one, digits=digits) for name, one in facts.items()}
    if isinstance(facts, list):
        return [rounded(one, digits=digits) for one in facts]
    if not isinstance(facts, float):
        return facts
    return float(f"{facts:.{digits}g}") if abs(facts) > _ROUNDING else 0.0


def flat(facts: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every fact with its path; a list of numbers is one fact."""
    if isinstance(facts, Mapping):
        for name, one in facts.items():
            yield from flat(one, f"{path}/{name}" if path else str(name))
    elif isinstance(facts, list) and not all(isinstance(one, str | int | float) for one in facts):
        for number, one in enumerate(facts):
            yield from flat(one, f"{path}/{number}")
    else:
        yield path, facts


def differences(old: Any, new: Any, *, within: float) -> Iterator[str]:
    """Yield a line for each fact that is gone, new or different.

    Numbers may differ by the share `within` of the largest in their list. A number as written on a
    page may differ by one in its last digit.
    """
    before, after = dict(flat(old)), dict(flat(new))
    for path in sorted(before.keys() | after.keys()):
        if path not in after:
            yield f"{path}: gone (was {_short(before[path])})"
        elif path not in before:
            yield f"{path}: new, {_short(after[path])}"
        elif path.endswith("numbers in tables"):
            yield from (f"{path}: {line}" for line in _numbers_moved(before[path], after[path]))
        elif not _alike(before[path], after[path], within=within):
            yield f"{path}: {_short(before[path])} → {_short(after[path])}"


def _alike(old: Any, new: Any, *, within: float) -> bool:
    if _is_number(old) and _is_number(new):
        old, new = [old], [new]
    if not (isinstance(old, list) and isinstance(new, list) and len(old) == len(new)):
        return old == new
    numbers = [abs(one) for one in (*old, *new) if _is_number(one)]
    most = within * max(numbers, default=0.0)
    return all(
        abs(a - b) <= most if _is_number(a) and _is_number(b) else a == b
        for a, b in zip(old, new, strict=True)
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers_moved(old: Sequence[str], new: Sequence[str]) -> Iterator[str]:
    """Yield the numbers of a page that have no partner within one of their last digit."""
    gone, come = Counter(old) - Counter(new), Counter(new) - Counter(old)
    left = sorted(come.elements(), key=float)
    for one in sorted(gone.elements(), key=float):
        near = min(left, key=lambda other: abs(float(other) - float(one)), default=None)
        digit = 10.0 ** -len(re.split(r"e", one, flags=re.IGNORECASE)[0].partition(".")[2])
        if "e" in one.lower():
            digit *= 10.0 ** int(re.split(r"e", one, flags=re.IGNORECASE)[1])
        if near is not None and abs(float(near) - float(one)) <= 1.01 * digit:
            left.remove(near)
        else:
            yield f"{one} is gone"
    yield from (f"{one} is new" for one in left)


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 200 else f"{text[:200]}…"
