"""The recordings of a submission as rows grouped by kind, and what a person must check."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.desk.page_request import NOTHING_KNOWN, PageRequest
from pipeline.desk.student.form import ask_held, count_carts, fill_experiment, is_marked, is_of_loop
from pipeline.desk.toml_form import Answer, Field
from pipeline.ingest.inspect import NO_CLOCK
from pipeline.submission.edit import text_digest
from pipeline.submission.load import list_experiments, posix, stated_columns
from pipeline.submission.models import MOST_EXPERIMENTS
from pipeline.words.numbers import group_messages

# In the order of work at a bench. Files without a table come first, so that they are seen.
_KINDS = (
    ("", "Not understood"),
    ("decay", "Decays"),
    ("step", "Steps"),
    ("sine", "Sine dwells"),
    ("sweep", "Sweeps"),
    ("closed_loop", "Closed loop"),
    ("bode", "Tables of ratios"),
)

# By type of controller: the keys of its gains, and the request for them.
_GAINS = {
    "pid": (("kp", "ki", "kd"), "state kp, ki or kd of the controller"),
    "state_feedback": (("gains",), "state the gains of the controller"),
}

# The numbers in which otherwise equal remarks differ.
_MEASURED = re.compile(r"\d+(?:\.\d+)?(?= (?:ms|pieces)\b)")


@dataclass(frozen=True, kw_only=True)
class RecordingRow:
    """A data file, or a table whose file is missing.

    Attributes
    ----------
    look : what the file contains; see `tasks.describe_file`.
    index : index of the table in submission.toml; None if the file has no table.
    problems : why a person must look at the row.
    """

    file: str
    look: Mapping[str, Any]
    index: int | None
    id: str = ""
    fields: tuple[Field, ...] = ()
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """What identifies the row on a page: the index of its table, or else its file."""
        return str(self.index) if self.index is not None else text_digest(ascii(self.file))[:12]

    @property
    def kind(self) -> str:
        """The kind stated in the table; "" without a valid kind."""
        kind = next((f.value for f in self.fields if f.path.endswith(".kind")), "")
        return kind if kind in dict(_KINDS) else ""

    @property
    def frequency(self) -> str:
        """The frequency of a dwell in Hz: as stated, or else as found in the data."""
        stated = next((f.value for f in self.fields if f.path.endswith(".frequency")), "")
        found = self.look["frequency"]
        return stated or (f"{found:.3g}" if found and self.kind == "sine" else "")

    @property
    def of_loop(self) -> list[Field]:
        """The fields that describe the controller."""
        return [field for field in self.fields if is_of_loop(field)]

    @property
    def lacks_controller(self) -> bool:
        """Whether this is a closed loop without a stated controller."""
        return _lacks_controller(self.fields)

    @property
    def is_recording(self) -> bool:
        """Whether the file is a recording, and not, for example, a text or an empty file."""
        return self.index is not None or bool(self.look["format"])

    @property
    def needs_a_person(self) -> bool:
        """Whether a person must look at the row."""
        return bool(self.problems) or any(f.wrong or f.asked for f in self.fields)


@dataclass(frozen=True, kw_only=True)
class FileGroup:
    """The recordings of one kind."""

    key: str
    title: str
    rows: tuple[RecordingRow, ...]

    @property
    def to_look_at(self) -> int:
        """The number of rows that a person must look at."""
        return sum(row.needs_a_person for row in self.rows)

    @property
    def common(self) -> list[tuple[Field, list[int]]]:
        """The questions that several recordings share, with the indices of their tables."""
        same: dict[tuple[str, tuple[Answer, ...]], tuple[Field, list[int]]] = {}
        for row in self.rows:
            for field in row.fields:
                if field.answers and row.index is not None:
                    question = same.setdefault((field.asked, field.answers), (field, []))
                    question[1].append(row.index)
        return [question for question in same.values() if len(question[1]) > 1]


def group_rows(rows: Sequence[RecordingRow]) -> list[FileGroup]:
    """Return the rows grouped by kind."""
    groups = [
        FileGroup(key=kind or "unknown", title=title, rows=tuple(r for r in rows if r.kind == kind))
        for kind, title in _KINDS
    ]
    return [group for group in groups if group.rows]


def list_rows(
    ask: PageRequest, folder: Path, document: Mapping[str, Any], *, doubts: Sequence[Sequence[str]]
) -> list[RecordingRow]:
    """Return a row for every data file, and for every table whose file is missing.

    Parameters
    ----------
    doubts : for each table, the texts of the doubts that are marked in it.
    """
    # Further tables are not shown; their number is a problem that the page reports.
    listed = list_experiments(document)[:MOST_EXPERIMENTS]
    places: dict[str, list[int]] = {}
    for index, table in enumerate(listed):
        places.setdefault(posix(str(table.get("file", ""))), []).append(index)
    rows = []
    for file, look in describe_all(ask, folder, document).items():
        for index in places.pop(file, []) or [None]:
            if index is None:
                rows.append(_describe_unknown(file, look))
            else:
                marked = doubts[index] if index < len(doubts) else ()
                rows.append(_describe(document, file, look, index=index, marked=marked))
    for file, indices in places.items():
        for index in indices:
            row = _describe(document, file, NOTHING_KNOWN, index=index, marked=())
            rows.append(replace(row, problems=("there is no such file", *row.problems[1:])))
    return rows


def describe_all(
    ask: PageRequest, folder: Path, document: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return what each data file contains, by name."""
    known = {**document, "experiments": list_experiments(document)[:MOST_EXPERIMENTS]}
    return ask.desk.describe_files(folder, lambda file: stated_columns(known, file))


def _describe_unknown(file: str, look: Mapping[str, Any]) -> RecordingRow:
    """Return the row of a file that has no table."""
    if not look["format"]:
        what = "it cannot be read; fix it, or set it aside"
    elif look["kind"]:
        what = f"a {look['kind'].replace('_', ' ')} that is not in submission.toml"
    else:
        what = "its content is not clear; state its columns in the set-up"
    return RecordingRow(file=file, look=look, index=None, problems=(what, *look["remarks"]))


def _describe(
    document: Mapping[str, Any],
    file: str,
    look: Mapping[str, Any],
    *,
    index: int,
    marked: Sequence[str],
) -> RecordingRow:
    table = list_experiments(document)[index]
    carts = _free_carts(document, table)
    fields = tuple(
        _question(field, table, look, carts=carts, marked=marked)
        for field in fill_experiment(document, index)
    )
    problems = [*look["unusable"]] if look["format"] else ["it cannot be read"]
    problems += [f"state {need} below" for need in look["needs"] if need not in table]
    if _lacks_controller(fields):
        problems.append("state the controller that ran")
    if missing := _missing_gains(fields):
        problems.append(missing)
    known = {remark for cart, remark in look["still"].items() if int(cart) not in carts}
    known.update(problems)
    if "sample_rate" in table:
        known.add(NO_CLOCK)
    return RecordingRow(
        file=file,
        look=look,
        index=index,
        id=str(table.get("id", "")),
        fields=fields,
        problems=tuple(problems),
        remarks=tuple(one for one in look["remarks"] if one not in known),
    )


def _lacks_controller(fields: Sequence[Field]) -> bool:
    return any(field.path.endswith("controller.type") and not field.value for field in fields)


def _missing_gains(fields: Sequence[Field]) -> str:
    """Return the gains that a controller lacks, as a request; "" if it lacks none."""
    stated = {field.path.rpartition("controller.")[2]: field.value for field in fields}
    keys, request = _GAINS.get(stated.get("type", ""), ((), ""))
    return "" if any(stated.get(key) for key in keys) else request


def _free_carts(document: Mapping[str, Any], table: Mapping[str, Any]) -> list[int]:
    """Return the free carts that a table states; all carts if it states none."""
    stated = table.get("carts")
    if isinstance(stated, list):
        return [cart for cart in stated if isinstance(cart, int)]
    return list(range(1, count_carts(document) + 1))


def _question(
    field: Field,
    table: Mapping[str, Any],
    look: Mapping[str, Any],
    *,
    carts: Sequence[int],
    marked: Sequence[str],
) -> Field:
    """Return a field; if it lists the free carts and one hardly moves, add a question.

    The question disappears when the table states the free carts and marks no doubt about them.
    """
    if not field.path.endswith(".carts"):
        return field
    open_ = "carts" not in table or any(is_marked(remark, marked) for remark in look["unsure"])
    hardly = [cart for cart in look["hardly"] if cart in carts]
    return ask_held(field, hardly, carts) if open_ and hardly else field


def gather_remarks(rows: Sequence[RecordingRow]) -> dict[str, str]:
    """Return each remark that many files have, with a sentence that names these files.

    Remarks that differ only in durations in ms or in counts are combined, with the range of each
    number.
    """
    remarks = [(row.file.removeprefix("data/"), remark) for row in rows for remark in row.remarks]
    times = Counter(_MEASURED.sub("#", remark) for _, remark in remarks)
    sentences = {}
    for pattern in (one for one, number in times.items() if number >= 3):
        alike = [
            (file, remark) for file, remark in remarks if _MEASURED.sub("#", remark) == pattern
        ]
        whole = _span_numbers([remark for _, remark in alike])
        (sentence,) = group_messages((file, whole) for file, _ in alike)
        sentences |= {remark: sentence for _, remark in alike}
    return sentences


def _span_numbers(remarks: Sequence[str]) -> str:
    """Combine remarks that differ only in numbers, with the range of each number."""
    columns = zip(*(_MEASURED.findall(one) for one in remarks), strict=True)
    ends = [(min(column, key=float), max(column, key=float)) for column in columns]
    spans = iter([low if low == high else f"{low} to {high}" for low, high in ends])
    return _MEASURED.sub(lambda _: next(spans), remarks[0])
