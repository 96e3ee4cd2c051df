"""Find out what the files of a submission contain, and describe them in its `submission.toml`.

Every recording in `data/` without a table gets one, and an incomplete table is completed from its
file. Existing entries are never changed. Doubts become comments.
"""

import filecmp
import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import tomlkit

from pipeline.errors import ConfigError, SubmissionError
from pipeline.ingest.channels import never_changes
from pipeline.ingest.columns import is_count, is_known, position_units
from pipeline.ingest.files import (
    ENDINGS,
    NotRead,
    data_files_in,
    files_not_read,
    not_read_notes,
    recordings_beside,
    refused,
)
from pipeline.ingest.inspect import NO_CLOCK, Inspection, align_rows, inspect_runs
from pipeline.ingest.table import FEW_NAMED, Note
from pipeline.results import ExperimentKind
from pipeline.submission.edit import (
    append_experiment,
    comment_text,
    edit_submission,
    submission_text,
    toml_item,
    write_templates,
)
from pipeline.submission.load import NAME, file_problem, path_problem, posix, stated_columns
from pipeline.submission.models import MOST_CARTS, MOST_EXPERIMENTS
from pipeline.submission.toml import Value, parse_toml
from pipeline.words.numbers import first_few, group_messages

UNSURE = "unsure: "  # begins a comment below a table; a person who knows the answer removes it
_TO_STATE = {  # facts that a file does not show
    "columns": "columns = { }    # by name or number: time, input, x1, …",
    "sample_rate": "sample_rate = 0    # Hz",
}
_NO_NAME = re.compile(r"[^\w.-]+", re.ASCII)

State = Literal[
    "new", "completed", "there", "copy", "unknown", "broken", "missing", "refused", "not_read"
]


@dataclass(frozen=True, kw_only=True)
class Found:
    """A data file and its table in `submission.toml`.

    Attributes
    ----------
    file : path below the submission's folder.
    state : whether the table is new, was completed or was already complete; or why the file is not
        used. It may be a copy, unknown, broken, missing, refused because of its name, or not read.
    experiment : id of the file's table; empty if there is no table.
    carts : the carts that seem to be free, judged by the file; () means all.
    inspection : result of the inspection; None if the file cannot be read.
    remarks : faults found in the file.
    unsure : questions for a person.
    advice : what to do about a file that is not read; empty if nothing needs to be done.
    """

    file: str
    state: State
    experiment: str = ""
    kind: ExperimentKind | None = None
    carts: tuple[int, ...] = ()
    inspection: Inspection | None = None
    remarks: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()
    advice: str = ""

    @property
    def run(self) -> str:
        """The run in a file that holds several; "" in others."""
        return self.inspection.run if self.inspection else ""

    @property
    def has_fractions(self) -> bool:
        """Whether a position has values that are not whole numbers, unlike counts."""
        if self.inspection is None or self.kind == "bode":
            return False
        return not all(column.whole for column in self.inspection.positions.values())

    def to_dict(self) -> dict[str, Any]:
        """Return the findings as plain values for JSON."""
        shown = asdict(self)
        if self.inspection:
            del shown["inspection"]["digest"]
        return shown


def _in_data(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in data_files_in(folder / "data")]


def data_files(folder: Path) -> list[str]:
    """Return the recordings in `data/`, as paths for `submission.toml`."""
    return [name for name in _in_data(folder) if file_problem(folder, name) is None]


def passed_over(folder: Path, *, named: Collection[str] = ()) -> list[Found]:
    """Return the files of a submission that are not inspected.

    The files in `named` are left out, because they have a table.
    """
    if problem := path_problem(folder, "data"):  # `data` is a link that leads out of the submission
        return [Found(file="data", state="refused", remarks=(problem,))]
    closed = [refused(folder, name) for name in _in_data(folder) if name not in named]
    others = [
        *files_not_read(folder / "data", root=folder),
        *recordings_beside(folder, named=named),
    ]
    listed: dict[State, Sequence[NotRead | None]] = {"refused": closed, "not_read": others}
    return [
        Found(file=one.file, state=state, remarks=(one.reason,), advice=one.advice)
        for state, ones in listed.items()
        for one in filter(None, ones)
    ]


def examine_runs(folder: Path, file: str, *, columns: Mapping[str, str | int] = {}) -> list[Found]:
    """Return what each recording in a file contains; `state` is "broken" or, for now, "unknown".

    Parameters
    ----------
    columns : the columns that `submission.toml` states, by role.
    """
    try:
        runs = inspect_runs(folder / file, columns=columns)
    except SubmissionError as error:
        reason = str(error).removeprefix(str(folder / file)).lstrip(": ")
        return [Found(file=file, state="broken", remarks=(reason,))]
    return [
        Found(
            file=file,
            state="unknown",
            kind=one.kind,
            carts=one.moving,
            inspection=one,
            remarks=tuple(filter(None, (*one.problems, one.ranges))),
            unsure=tuple(_ask_held(one)),
        )
        for one in runs
    ]


def _ask_held(inspection: Inspection) -> Iterator[str]:
    """Yield a question if a cart moves so little that it may have been held."""
    if little := inspection.hardly_moving:
        others = [cart for cart in inspection.moving if cart not in little]
        which = " and ".join(map(str, little))
        yield f"cart {which} hardly moves; if it was held: carts = {others}"


def experiment_entry(
    inspection: Inspection,
    *,
    name: str,
    kind: ExperimentKind,
    file: str,
    carts: Sequence[int],
    n: int,
) -> dict[str, Value]:
    """Return the keys of a file's `[[experiments]]` table, in a system with `n` carts."""
    entry: dict[str, Value] = {"id": name, "kind": kind}
    known = [cart for cart in carts if cart <= n]
    if known and len(known) < n:
        entry["carts"] = known
    entry["file"] = file
    if inspection.run:
        entry["run"] = inspection.run
    if inspection.guessed:
        missing = {f"x{cart}" for cart in inspection.positions if cart > n}
        entry["columns"] = {k: v for k, v in inspection.guessed.items() if k not in missing}
    return entry


def free_id(stem: str, taken: Iterable[str]) -> str:
    """Return an unused id for an experiment, similar to its file's name."""
    base = _NO_NAME.sub("-", stem).strip("-.") or "record"
    names, number, name = set(taken), 1, base
    while name in names:
        number += 1
        name = f"{base}-{number}"
    return name


def fill_submission(folder: Path) -> tuple[Found, ...]:
    """Write the tables of the files in `data/`; make `submission.toml` if it does not exist.

    Raises
    ------
    ConfigError : there is no such folder, or no recording in its `data/`.
    SubmissionError : `submission.toml` is broken or cannot be edited by a program.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; copy your recordings into {folder / 'data'}")
    new = not (folder / NAME).exists()
    text = "" if new else submission_text(folder)
    document = parse_toml(text, where=f"{folder.resolve().name}/{NAME}", error=SubmissionError)
    looked = [
        one
        for file in data_files(folder)
        for one in examine_runs(folder, file, columns=stated_columns(document, file))
    ]
    if not looked:
        unread = [(one.file, one.remarks[0], one.advice) for one in passed_over(folder)]
        what = "; ".join(not_read_notes(unread)) or f"copy yours there ({', '.join(ENDINGS)})"
        raise ConfigError(f"{folder / 'data'}: contains no recordings; {what}")
    if new:
        # Exports may also have columns for carts that the bench lacks.
        carts = {cart for f in looked if (i := f.inspection) for cart in i.moving or i.positions}
        most = max((n for n in carts if n <= MOST_CARTS), default=1)
        write_templates(folder, carts=most, examples=False)
    found: list[Found] = []

    def change(document: tomlkit.TOMLDocument) -> None:
        system: Any = document.get("system", {})
        for key, units in _headed_units(looked).items() if new else ():
            if units[1]:
                system[key]["unit"] = units[1][0]
        filling = _Filling(document, folder, looked)
        # done first, so that a renamed file does not get a second table
        missing = list(filling.missing())
        found.extend(filling.add(one) for one in looked)
        found.extend(missing)

    edit_submission(folder, change)
    return (*found, *passed_over(folder, named=[one.file for one in found if one.experiment]))


class _Filling:
    """A document to which tables are added, file by file."""

    def __init__(
        self, document: tomlkit.TOMLDocument, folder: Path, looked: Sequence[Found]
    ) -> None:
        self._document, self._folder = document, folder
        self._digests = {(f.file, f.run): f.inspection.digest for f in looked if f.inspection}
        system: Any = document.get("system", {})
        self._n = system.get("carts", 1)

    @property
    def _tables(self) -> list[Any]:
        return [table for table in self._document.get("experiments", ()) if "file" in table]

    def _free_id(self, *words: str) -> str:
        taken = [str(table.get("id", "")) for table in self._tables]
        return free_id(" ".join(words).strip(), taken)

    def add(self, found: Found) -> Found:
        """Add the table of one file, or complete the existing one; return what was done."""
        if (inspection := found.inspection) is None:
            return found
        for table in self._tables:
            if _place(table) in ((found.file, found.run), (found.file, "")):
                return self._complete(table, found, inspection)
        if (same := self._same(found)) is not None:
            remark = f"is a copy of {same}; one entry is enough"
            return replace(found, state="copy", remarks=(remark,))
        if found.kind is None:
            self._say_unknown(found)
            return found
        name, n = self._free_id(PurePosixPath(found.file).stem, found.run), self._n
        entry = experiment_entry(
            inspection, name=name, kind=found.kind, file=found.file, carts=found.carts, n=n
        )
        if len(self._tables) >= MOST_EXPERIMENTS:
            full = f"not added: at most {MOST_EXPERIMENTS} experiments are allowed"
            return replace(found, remarks=(*found.remarks, full))
        unsure = (*found.unsure, *_ask(found, inspection, n))
        append_experiment(self._document, entry, remarks=[UNSURE + one for one in unsure])
        carts = found.carts or range(1, n + 1)
        held = [
            Note(
                f"{column.name!r} never changes, so cart {cart} is written as held",
                "written_as_held",
                about=column.name,
            )
            for cart, column in inspection.positions.items()
            if cart <= n and cart not in carts and column.low == column.high
        ]
        remarks = (*_beside_held(found, inspection, carts), *held)
        return replace(found, state="new", experiment=name, remarks=remarks, unsure=unsure)

    def _complete(self, table: Any, found: Found, inspection: Inspection) -> Found:
        """Add the missing keys of a table that can be found from its file."""
        before = len(table)
        own = {
            "id": self._free_id(PurePosixPath(found.file).stem),
            "kind": found.kind,
            "columns": inspection.guessed,
            "run": found.run,
        }
        for key, value in own.items():
            if key not in table and value:
                table[key] = toml_item(value)
        carts = tuple(table.get("carts", range(1, self._n + 1)))
        # what the table states already
        known: set[str] = {NO_CLOCK} if "sample_rate" in table else set()
        if "columns" in table and not inspection.guessed:
            known.add(inspection.ranges)
        remarks = _beside_held(found, inspection, carts)
        return replace(
            found,
            state="completed" if len(table) > before else "there",
            experiment=str(table["id"]),
            kind=table.get("kind"),
            carts=carts,
            remarks=tuple(one for one in remarks if one not in known),
            unsure=_marked(table),
        )

    def missing(self) -> Iterator[Found]:
        """Yield the files that have a table but do not exist, with files of similar names."""
        files = {posix(str(table["file"])): table for table in self._tables}
        for file, table in files.items():
            wrong = file_problem(self._folder, file, taken=files)
            if wrong is not None:
                name, kind = str(table.get("id", "")), table.get("kind")
                yield Found(
                    file=file, state="missing", experiment=name, kind=kind, remarks=(wrong,)
                )

    def _same(self, found: Found) -> str | None:
        """Return another file of the submission that has the same samples, in any format."""
        digest, here = self._digests[found.file, found.run], self._folder / found.file
        for place in map(_place, self._tables):
            name, run = place
            other = self._folder / name
            if name == found.file:
                continue
            if other.is_file() and not run and filecmp.cmp(other, here, shallow=False):
                return name
            if digest and self._digests.get(place) == digest:
                return name
        return None

    def _say_unknown(self, found: Found) -> None:
        """Add a table as a comment, unless it is there; a person can complete it."""
        line = f"file = {json.dumps(found.file, ensure_ascii=False)}"
        if f"# {line}" in tomlkit.dumps(self._document).splitlines():
            return
        why = "; ".join(found.remarks) or "its content is not clear"
        id_ = json.dumps(free_id(PurePosixPath(found.file).stem, ()))
        kind = 'kind = ""    # decay, step, sine, sweep, closed_loop or bode?'
        self._document.add(tomlkit.nl())
        needs = [_TO_STATE[key] for key in found.inspection.needs] if found.inspection else []
        for text in (UNSURE + why, "[[experiments]]", f"id = {id_}", kind, line, *needs):
            self._document.add(tomlkit.comment(comment_text(text)))


def _place(table: Any) -> tuple[str, str]:
    """Return the file and the run of a table of an experiment."""
    return posix(str(table["file"])), str(table.get("run", ""))


def _beside_held(found: Found, inspection: Inspection, carts: Collection[int]) -> list[str]:
    """Return the remarks except those on carts that are declared as held."""
    held = [column for cart, column in inspection.positions.items() if cart not in carts]
    known = {never_changes(column.name) for column in held}
    return [remark for remark in found.remarks if remark not in known]


def _ask(found: Found, inspection: Inspection, n: int) -> Iterator[str]:
    """Yield questions on facts that a person knows but no file shows."""
    if inspection.guessed:
        yield from (f"columns: {doubt}" for doubt in inspection.doubts)
    if found.kind == "closed_loop":
        yield "which controller ran? controller = { type = … }" + (
            ", controlled_cart = …" if n > 1 else ""
        )
    positions = inspection.positions
    for cart in (cart for cart in found.carts if cart > n):
        renamed = ", or columns = { x1 = … }" if n == 1 else ""
        yield f"{positions[cart].name!r} moves, but carts = {n}: more carts{renamed}?"
    if n > 1 and list(positions) == [1] and not re.search(r"\d", positions[1].name):
        yield "does it measure cart 1? If not, columns = { x2 = … }"


# ------------------------------------------------------------------------------------------- doubts


def unit_doubt(unit: str, *, fractions: Sequence[str]) -> str:
    """Return why a unit of the positions is doubtful; "" if it is not.

    Parameters
    ----------
    fractions : the files with values that are not whole numbers.
    """
    if not is_known(unit, position_units()):
        return f"the unit {unit!r} is not known: is it right?"
    if not is_count(unit) or not fractions:
        return ""
    have = "has" if len(fractions) == 1 else "have"
    return f"counts are whole numbers, but {first_few(fractions, 1)} {have} decimals: is it cm?"


def heading_doubts(found: Sequence[Found]) -> dict[str, str]:
    """Return why units from headings are doubtful, by key of `[system]`."""
    doubts: dict[str, str] = {}
    for key, (stated, units) in _headed_units(found).items():
        if len(units) > 1:
            said = first_few([f"{unit} ({stated[unit]})" for unit in units], FEW_NAMED)
            doubts[key] = f"headings state different units, {said}: is {units[0]} right?"
        elif units and stated[""] > stated[units[0]]:
            doubts[key] = (
                f"only {stated[units[0]]} of {stated.total()} recordings state the unit "
                f"{units[0]}, the others none: is it right?"
            )
    return doubts


def _headed_units(found: Sequence[Found]) -> dict[str, tuple[Counter[str], list[str]]]:
    """Return for "position" and "input" how many recordings state which unit, and the units.

    The unit is "" for none. Most recordings state the first unit. Counts are a matter of each file,
    so they are not listed.
    """
    stated: dict[str, Counter[str]] = {"position": Counter(), "input": Counter()}
    for inspection in (one.inspection for one in found if one.inspection):
        units = {
            ("input" if column.role == "input" else "position", column.unit or "")
            for column in inspection.columns
            if (column.role or "").startswith(("x", "input"))
        }
        for key, unit in units:
            stated[key][unit] += not unit.startswith("count")
    return {
        key: (units, [unit for unit, n in units.most_common() if unit and n])
        for key, units in stated.items()
    }


def system_doubts(folder: Path) -> dict[str, str]:
    """Return the doubts marked next to the keys of `[system]`, by key."""
    system: Any = _read(folder).get("system", {})
    comments = {key: item.trivia.comment.removeprefix("# ") for key, item in system.value.items()}
    return {key: doubt for key, doubt in comments.items() if doubt.startswith(UNSURE)}


def experiment_doubts(folder: Path) -> list[tuple[str, ...]]:
    """Return the doubts marked directly below each table of an experiment."""
    tables: Any = _read(folder).get("experiments", ())
    return [_marked(table) for table in tables]


def _read(folder: Path) -> tomlkit.TOMLDocument:
    return tomlkit.parse(submission_text(folder).replace("\r\n", "\n"))


def _marked(table: Any) -> tuple[str, ...]:
    """Return the doubts marked directly below a table."""
    own = table.as_string().partition("\n\n")[0]
    lines = [line.strip().removeprefix("# ") for line in own.splitlines()]
    return tuple(line.removeprefix(UNSURE) for line in lines if line.startswith(UNSURE))


def mark_system(folder: Path, key: str, *, doubt: str, value: "Value | None" = None) -> None:
    """Write a value into `[system]`, followed by a doubt or a reason as a comment."""

    def change(document: tomlkit.TOMLDocument) -> None:
        system: Any = document["system"]
        if value is not None:
            system[key] = toml_item(value)
        system[key].comment(comment_text(doubt))

    edit_submission(folder, change)


# --------------------------------------------------------------------------------------------- text


def format_found(found: Sequence[Found]) -> str:
    """Return a table with one line per file, and the faults and doubts below it.

    Unread files are left out.
    """
    found = [one for one in found if one.state != "not_read"]
    rows = [
        (one.file, one.state, one.kind or "?", _carts_words(one), one.experiment or "-")
        for one in found
    ]
    remarks = group_messages(
        (one.file, remark)
        for one in found
        for remark in (*one.remarks, one.advice, *(UNSURE + question for question in one.unsure))
    )
    return "\n".join([*align_rows(rows), *(f"! {remark}" for remark in remarks)])


def _carts_words(found: Found) -> str:
    if found.inspection is None or not found.carts:
        return "all carts" if found.inspection else "-"
    return f"cart{'s' if len(found.carts) > 1 else ''} {', '.join(map(str, found.carts))}"


def format_passed_over(found: Iterable[Found]) -> list[str]:
    """Return a line for each reason why files are not read, with advice."""
    return not_read_notes(
        (one.file, one.remarks[0], one.advice) for one in found if one.state == "not_read"
    )
