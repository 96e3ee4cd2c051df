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
from pipeline.ingest.channels import little_motion, never_changes
from pipeline.ingest.columns import is_count, is_known, position_units
from pipeline.ingest.files import (
    ENDINGS,
    NotRead,
    choose_run,
    data_files_in,
    files_not_read,
    not_read_notes,
    read_tables,
    recordings_beside,
    refused,
)
from pipeline.ingest.inspect import NO_CLOCK, Inspection, inspect_runs
from pipeline.ingest.table import FEW_NAMED
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

    def to_dict(self) -> dict[str, Any]:
        """Return the findings as plain values for JSON."""
        return asdict(self)


def data_files(folder: Path) -> list[str]:
    """Return the recordings in `data/`, as paths for `submission.toml`."""
    found = data_files_in(folder / "data")
    names = [path.relative_to(folder).as_posix() for path in found]
    return [name for name in names if file_problem(folder, name) is None]


def passed_over(folder: Path, *, named: Collection[str] = ()) -> list[Found]:
    """Return the files of a submission that are not inspected.

    The files in `named` are left out, because they have a table.
    """
    if problem := path_problem(folder, "data"):  # `data` is a link that leads out of the submission
        return [Found(file="data", state="refused", remarks=(problem,))]
    names = [path.relative_to(folder).as_posix() for path in data_files_in(folder / "data")]
    closed = [one for name in names if name not in named and (one := refused(folder, name))]
    others = [
        *files_not_read(folder / "data", root=folder),
        *recordings_beside(folder, named=named),
    ]
    listed: list[tuple[State, list[NotRead]]] = [("refused", closed), ("not_read", others)]
    return [
        Found(file=one.file, state=state, remarks=(one.reason,), advice=one.advice)
        for state, ones in listed
        for one in ones
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
    return [_found(file, inspection) for inspection in runs]


def _found(file: str, inspection: Inspection) -> Found:
    carts, unsure = free_carts(inspection)
    return Found(
        file=file,
        state="unknown",
        kind=inspection.kind,
        carts=carts,
        inspection=inspection,
        remarks=(*inspection.problems, *filter(None, [inspection.ranges])),
        unsure=unsure,
    )


def free_carts(inspection: Inspection) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the carts that move in a file, and questions about them.

    () means all carts. It is also returned for a table of ratios, and if no cart moves: that does
    not prove that any cart was held.
    """
    carts = _moving(inspection)
    little = hardly_moving(inspection)
    if not little:
        return carts, ()
    others = [cart for cart in carts if cart not in little]
    which = " and ".join(map(str, little))
    return carts, (f"cart {which} hardly moves; if it was held: carts = {others}",)


def hardly_moving(inspection: Inspection) -> tuple[int, ...]:
    """Return the carts that move so little that they may have been held."""
    if inspection.kind == "sine":  # near a null, a free cart hardly moves
        return ()
    ranges, carts = _ranges(inspection), _moving(inspection)
    return tuple(cart for cart in little_motion(ranges) if cart in carts)


def _moving(inspection: Inspection) -> tuple[int, ...]:
    if inspection.kind == "bode":
        return ()
    step = max((column.step or 0.0 for column in inspection.positions.values()), default=0.0)
    # A free cart moves more than two encoder steps over a whole record.
    return tuple(cart for cart, travel in _ranges(inspection).items() if travel > 2.0 * step)


def _ranges(inspection: Inspection) -> dict[int, float]:
    return {cart: column.high - column.low for cart, column in inspection.positions.items()}


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
        what = "; ".join(_not_looked_into(passed_over(folder)))
        what = what or f"copy yours there ({', '.join(ENDINGS)})"
        raise ConfigError(f"{folder / 'data'}: contains no recordings; {what}")
    if new:
        write_templates(folder, carts=_carts_seen(looked))
    found: list[Found] = []

    def change(document: tomlkit.TOMLDocument) -> None:
        if new:
            _state_units(document, looked)
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
        self._inspections = {
            (one.file, one.run): one.inspection for one in looked if one.inspection
        }
        system: Any = document.get("system", {})
        self._n = system.get("carts", 1)

    @property
    def _tables(self) -> list[Any]:
        return [table for table in self._document.get("experiments", ()) if "file" in table]

    def add(self, found: Found) -> Found:
        """Add the table of one file, or complete the existing one; return what was done."""
        if found.inspection is None:
            return found
        for table in self._tables:
            if _place(table) in ((found.file, found.run), (found.file, "")):
                return self._complete(table, found, found.inspection)
        if (same := self._same(found)) is not None:
            remark = f"is a copy of {same}; one entry is enough"
            return replace(found, state="copy", remarks=(remark,))
        if found.kind is None:
            self._say_unknown(found)
            return found
        taken = [str(table.get("id", "")) for table in self._tables]
        name = free_id(" ".join((PurePosixPath(found.file).stem, found.run)).strip(), taken)
        entry = experiment_entry(
            found.inspection,
            name=name,
            kind=found.kind,
            file=found.file,
            carts=found.carts,
            n=self._n,
        )
        if len(self._tables) >= MOST_EXPERIMENTS:
            full = f"not added: at most {MOST_EXPERIMENTS} experiments are allowed"
            return replace(found, remarks=(*found.remarks, full))
        unsure = (*found.unsure, *_unsure(found, self._n))
        append_experiment(self._document, entry, remarks=[UNSURE + one for one in unsure])
        carts = found.carts or range(1, self._n + 1)
        held = [
            f"{column.name!r} never changes, so cart {cart} is written as held"
            for cart, column in found.inspection.positions.items()
            if cart <= self._n and cart not in carts and column.low == column.high
        ]
        remarks = (*_beside_held(found, carts), *held)
        return replace(found, state="new", experiment=name, remarks=remarks, unsure=unsure)

    def _complete(self, table: Any, found: Found, inspection: Inspection) -> Found:
        """Add the missing keys of a table that can be found from its file."""
        before = len(table)
        if "id" not in table:
            taken = [str(one.get("id", "")) for one in self._tables]
            table["id"] = free_id(PurePosixPath(found.file).stem, taken)
        if "kind" not in table and found.kind is not None:
            table["kind"] = found.kind
        if "columns" not in table and inspection.guessed:
            table["columns"] = toml_item(inspection.guessed)
        if "run" not in table and found.run:
            table["run"] = found.run
        carts = tuple(table.get("carts", range(1, self._n + 1)))
        known = {NO_CLOCK} if "sample_rate" in table else set()  # already stated in the table
        if "columns" in table and not inspection.guessed:
            known.add(inspection.ranges)
        return replace(
            found,
            state="completed" if len(table) > before else "there",
            experiment=str(table["id"]),
            kind=table.get("kind"),
            carts=carts,
            remarks=tuple(one for one in _beside_held(found, carts) if one not in known),
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
        here = (found.file, found.run)
        for there in map(_place, self._tables):
            name, run = there
            if name == found.file and run != found.run:
                continue
            other = self._folder / name
            if other.is_file() and not run and filecmp.cmp(other, self._folder / found.file, False):
                return name
            if self._same_ranges(there, here) and self._signals(there) == self._signals(here):
                return name
        return None

    def _same_ranges(self, *places: tuple[str, str]) -> bool:
        """Return whether files may hold the same samples, judged by the ranges of their columns."""
        seen = [
            one and {c.role: (one.samples, c.low, c.high) for c in one.columns if c.role}
            for one in map(self._inspections.get, places)
        ]
        return bool(seen[0]) and seen[0] == seen[1]

    def _signals(self, place: tuple[str, str]) -> dict[str, bytes]:
        """Return the samples of each column that has a role."""
        tables, _ = read_tables(self._folder, place[0], shown=place[0])
        table, columns = choose_run(tables, place[1] or None), self._inspections[place].columns
        return {c.role: table.values[i].tobytes() for i, c in enumerate(columns) if c.role}

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


def _beside_held(found: Found, carts: Collection[int]) -> tuple[str, ...]:
    """Return the remarks except those on carts that are declared as held."""
    assert found.inspection is not None
    positions = found.inspection.positions.items()
    known = {never_changes(column.name) for cart, column in positions if cart not in carts}
    return tuple(remark for remark in found.remarks if remark not in known)


def has_fractions(found: Found) -> bool:
    """Whether a position has values that are not whole numbers, unlike counts."""
    if found.inspection is None or found.kind == "bode":
        return False
    return not all(column.whole for column in found.inspection.positions.values())


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


def mark_system(folder: Path, key: str, *, doubt: str, value: "Value | None" = None) -> None:
    """Write a value into `[system]`, followed by a doubt or a reason as a comment."""

    def change(document: tomlkit.TOMLDocument) -> None:
        system: Any = document["system"]
        if value is not None:
            system[key] = toml_item(value)
        system[key].comment(comment_text(doubt))

    edit_submission(folder, change)


def unsure(doubt: str) -> str:
    """Return a comment that marks a doubt; a person who knows the answer removes it."""
    return UNSURE + doubt


def _marked(table: Any) -> tuple[str, ...]:
    """Return the doubts marked directly below a table."""
    own = table.as_string().partition("\n\n")[0]
    lines = [line.strip().removeprefix("# ") for line in own.splitlines()]
    return tuple(line.removeprefix(UNSURE) for line in lines if line.startswith(UNSURE))


def _unsure(found: Found, n: int) -> Iterator[str]:
    """Yield questions on facts that a person knows but no file shows."""
    assert found.inspection is not None
    if found.inspection.guessed:
        yield from (f"columns: {doubt}" for doubt in found.inspection.doubts)
    if found.kind == "closed_loop":
        yield "which controller ran? controller = { type = … }" + (
            ", controlled_cart = …" if n > 1 else ""
        )
    positions = found.inspection.positions
    for cart in (cart for cart in found.carts if cart > n):
        renamed = ", or columns = { x1 = … }" if n == 1 else ""
        yield f"{positions[cart].name!r} moves, but carts = {n}: more carts{renamed}?"
    if n > 1 and list(positions) == [1] and not re.search(r"\d", positions[1].name):
        yield "does it measure cart 1? If not, columns = { x2 = … }"


def _carts_seen(looked: Sequence[Found]) -> int:
    """Return the highest number of a cart that moves in any file.

    Exports may also have columns for carts that the bench lacks.
    """
    carts = [
        cart for one in looked if one.inspection for cart in one.carts or one.inspection.positions
    ]
    return max((cart for cart in carts if cart <= MOST_CARTS), default=1)


def _headed_units(looked: Sequence[Found]) -> dict[str, Counter[str]]:
    """Return for "position" and "input" how many recordings state which unit; "" for none.

    Counts are a matter of each file, so they are not listed.
    """
    stated: dict[str, Counter[str]] = {"position": Counter(), "input": Counter()}
    for inspection in (one.inspection for one in looked if one.inspection):
        units = {
            (key, column.unit or "")
            for column in inspection.columns
            for key, begins in (("position", "x"), ("input", "input"))
            if (column.role or "").startswith(begins)
        }
        for key, unit in units:
            if not unit.startswith("count"):
                stated[key][unit] += 1
    return stated


def _state_units(document: tomlkit.TOMLDocument, looked: Sequence[Found]) -> None:
    """Write the units stated by most headings into a new document, except counts."""
    system: Any = document["system"]
    for key, stated in _headed_units(looked).items():
        units = [unit for unit, _ in stated.most_common() if unit]
        if units:
            system[key]["unit"] = units[0]


def heading_doubts(found: Sequence[Found]) -> dict[str, str]:
    """Return why units from headings are doubtful, by key of `[system]`."""
    doubts: dict[str, str] = {}
    for key, stated in _headed_units(found).items():
        units = [unit for unit, _ in stated.most_common() if unit]
        if len(units) > 1:
            said = first_few([f"{unit} ({stated[unit]})" for unit in units], FEW_NAMED)
            doubts[key] = f"headings state different units, {said}: is {units[0]} right?"
        elif units and stated[""] > stated[units[0]]:
            doubts[key] = (
                f"only {stated[units[0]]} of {stated.total()} recordings state the unit "
                f"{units[0]}, the others none: is it right?"
            )
    return doubts


def format_found(found: Sequence[Found]) -> str:
    """Return a table with one line per file, and the faults and doubts below it.

    Unread files are left out.
    """
    found = [one for one in found if one.state != "not_read"]
    rows = [
        (one.file, one.state, one.kind or "?", _carts_words(one), one.experiment or "-")
        for one in found
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    remarks = group_messages(
        (one.file, remark)
        for one in found
        for remark in (
            *one.remarks,
            *filter(None, [one.advice]),
            *(UNSURE + unsure for unsure in one.unsure),
        )
    )
    return "\n".join([*lines, *(f"! {remark}" for remark in remarks)])


def format_passed_over(found: Iterable[Found]) -> list[str]:
    """Return a line for each reason why files are not read, with advice."""
    return _not_looked_into([one for one in found if one.state == "not_read"])


def _not_looked_into(found: Iterable[Found]) -> list[str]:
    return not_read_notes((one.file, one.remarks[0], one.advice) for one in found)


def _carts_words(found: Found) -> str:
    if found.inspection is None:
        return "-"
    if not found.carts:
        return "all carts"
    return f"cart{'s' if len(found.carts) > 1 else ''} {', '.join(map(str, found.carts))}"
