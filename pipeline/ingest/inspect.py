"""Inspect the content of a data file before it is used."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.channels import (
    channel_problems,
    encoder_step,
    is_stepped,
    line_frequency,
    little_motion,
    mirrors,
)
from pipeline.ingest.clock import Clock, clock_notes, read_clock, time_stamps
from pipeline.ingest.columns import (
    Column,
    assign_columns,
    conversion,
    holds_counts,
    is_known_unit,
    parse_heading,
    plain_name,
    refuse_unknown_unit,
)
from pipeline.ingest.files import choose_run, read_tables
from pipeline.ingest.table import FileTable, Note, Variable
from pipeline.ingest.unnamed import Roles, find_roles
from pipeline.results import ExperimentKind
from pipeline.words.numbers import count, first_few, group_messages

# Words in headings of signals that drive nothing.
_NOT_INPUT = re.compile(
    r"^v ?\d?$|^w$|vel|speed|omega|acc|geschw|temp|^y\d?$|^z\d?$|angle|theta|phi|pos|^x|^a ?\d?$|"
    r"time|frame|index|count|enc|remark|comment|note|status"
)
NO_CLOCK = Note("no time column: state `sample_rate`", "no_clock")
_MOST_COLUMNS = 16  # most columns listed in a sentence
_COPIED = 0.999  # correlation above which a reference is the input itself


@dataclass(frozen=True, kw_only=True)
class ColumnInspection:
    """One column: its heading, its likely role, its range and the encoder step found.

    `whole` is true if the column holds only whole numbers, like an encoder's counts.
    """

    name: str
    role: str | None
    unit: str | None
    low: float
    high: float
    step: float | None
    whole: bool


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """A summary of a data file.

    Attributes
    ----------
    duration, interval, jitter : times in s. Jitter is the rms deviation of the sample interval.
    rate : sample rate in Hz. The rate and the times are None if the file has no time column.
    kind : kind of experiment that the file looks like.
    frequency : frequency in Hz if the file looks like a sine dwell.
    problems : points to check before using the file.
    unusable : the problems because of which a report would not use the file.
    needs : keys that the file's table in `submission.toml` must state, such as "sample_rate".
    variables : the variables of a binary file, read or not.
    guessed : column numbers by role, if the file has no headings but its signals reveal the roles.
    doubts : reasons to check the guessed numbers.
    cut_short : whether the file seems to end in the middle of a recording.
    digest : of the samples of all columns with a role, except the reference; "" if none has one.
    run : which of the file's recordings this is; "" if it holds only one.
    """

    file: str
    format: str
    columns: tuple[ColumnInspection, ...]
    samples: int
    duration: float | None
    rate: float | None
    interval: float | None
    jitter: float | None
    kind: ExperimentKind | None
    frequency: float | None
    problems: tuple[str, ...]
    unusable: tuple[str, ...]
    needs: tuple[str, ...]
    variables: tuple[Variable, ...]
    guessed: Mapping[str, int]
    doubts: tuple[str, ...]
    cut_short: bool
    digest: str
    run: str = ""

    @property
    def title(self) -> str:
        """The file's name, with the run if the file holds several."""
        return f"{self.file} run {self.run}" if self.run else self.file

    @property
    def positions(self) -> dict[int, ColumnInspection]:
        """The columns that hold a cart's position, by cart."""
        roles = {column.role: column for column in self.columns if column.role}
        return {int(role[1:]): roles[role] for role in sorted(roles) if role[0] == "x"}

    @property
    def moving(self) -> tuple[int, ...]:
        """The carts that move; () for a table of ratios."""
        if self.kind == "bode":
            return ()
        step = max((column.step or 0.0 for column in self.positions.values()), default=0.0)
        # A free cart moves more than two encoder steps over a whole record.
        return tuple(cart for cart, c in self.positions.items() if c.high - c.low > 2.0 * step)

    @property
    def hardly_moving(self) -> tuple[int, ...]:
        """The carts that move so little that they may have been held."""
        if self.kind == "sine":  # near a null, a free cart hardly moves
            return ()
        little = little_motion({cart: c.high - c.low for cart, c in self.positions.items()})
        return tuple(cart for cart in little if cart in self.moving)

    @property
    def ranges(self) -> str:
        """The range of each column if the columns have no names; "" if they have names."""
        if "columns" not in self.needs:
            return ""
        ranges = [f"{one.name} ({one.low:.4g} to {one.high:.4g})" for one in self.columns]
        return f"the columns and their ranges: {first_few(ranges, _MOST_COLUMNS)}"

    def to_dict(self) -> dict:
        """Return the inspection as plain values for JSON."""
        shown = asdict(self)
        del shown["cut_short"], shown["digest"]  # the first is already listed as a problem
        return {"state": "read", **shown, "advice": ""}


def inspect_file(
    path: Path, *, columns: Mapping[str, str | int] = {}, run: str | int | None = None
) -> Inspection:
    """Inspect one data file; anything that would stop a report is listed as a problem.

    Parameters
    ----------
    columns : columns by role, as stated; a column that the file lacks is ignored.
    run : which of several recordings in the file.

    Raises
    ------
    SubmissionError : the file is missing, of unknown format, or broken, or there is no such run;
        the path is as given.
    """
    return _inspect(choose_run(_tables(path), run), path, columns=columns)


def inspect_runs(path: Path, *, columns: Mapping[str, str | int] = {}) -> list[Inspection]:
    """Inspect each recording in a data file; otherwise as `inspect_file`."""
    tables = _tables(path)
    return [
        replace(_inspect(table, path, columns=columns), run=table.run if len(tables) > 1 else "")
        for table in tables
    ]


def _tables(path: Path) -> list[FileTable]:
    real = Path(path).resolve()  # a link on the command line is the user's own choice
    return read_tables(real.parent, real.name, shown=str(path))[0]


def _inspect(table: FileTable, path: Path, *, columns: Mapping[str, str | int]) -> Inspection:
    unusable = [table.cut_short] if table.cut_short else []
    problems = [*unusable]

    @contextmanager
    def noted(*lists: list[str]) -> Iterator[None]:
        """Add the message of an error to each of the lists."""
        try:
            yield
        except SubmissionError as error:
            message = str(error).removeprefix(table.source).lstrip(": ")
            for one in lists:
                one.append(message)

    assigned: dict[str, Column] = {}
    unused: tuple[str, ...] = ()
    with noted(problems, unusable):
        stated = {role: column for role, column in columns.items() if table.has(column)}
        assigned, unused = assign_columns(table, explicit=stated, free=(1,))
    unnamed = all(name.isdigit() for name in table.names)
    bare = not assigned and unnamed
    roles = find_roles(table) if bare else Roles()
    if bare:
        assigned, _ = assign_columns(table, explicit=roles.columns, free=(1,))
        problems.append(_name_them(roles))
    elif unused and not unnamed:
        names = ", ".join(unused)
        said = f"not used: {names}; name them in `columns` to use them"
        problems.append(Note(said, "unused", about=names))
    # If the columns have no names, the other problems follow from this.
    further = [] if bare and not roles.columns else problems
    clock = None
    with noted(further, unusable):
        clock = _clock(table, assigned, further) if "frequency" not in assigned else None
    kind, frequency = _guess(table, assigned, clock, further)
    for column in assigned.values() if kind != "bode" else ():
        # A submission may state another known unit, such as the V of a potentiometer.
        with noted(problems) if is_known_unit(column.unit or "") else noted(problems, unusable):
            refuse_unknown_unit(table, column)
    inputs = _possible_inputs(table, unused) if "input" not in assigned else []
    if kind == "decay" and inputs:  # without the input, a step looks like a decay
        kind = None
        said = (
            f"is {first_few([*map(repr, inputs)], 4)} the input? Say so in columns = {{ input = … "
            '}, or state kind = "decay"'
        )
        problems.append(Note(said, "perhaps_input", about=inputs[0]))
    problems += table.notes
    needs = {
        "columns": bare or not any(role[0] == "x" for role in assigned),
        "sample_rate": "time" not in assigned,
    }
    # A matrix without headings does not show which column is the reference.
    signals = {r: table.values[c.index] for r, c in sorted(assigned.items()) if r != "reference"}
    digests = [f"{role} {sha256(values.tobytes()).hexdigest()}" for role, values in signals.items()]
    return Inspection(
        file=str(path),
        format=table.format.title,
        columns=_inspect_columns(table, assigned),
        samples=table.values.shape[1],
        duration=float(clock.t[-1] - clock.t[0]) if clock else None,
        rate=1 / clock.mean_interval if clock else None,
        interval=clock.mean_interval if clock else None,
        jitter=clock.jitter if clock else None,
        kind=kind,
        frequency=frequency,
        problems=tuple(problems),
        unusable=tuple(unusable),
        needs=tuple(key for key, needed in needs.items() if needed and (bare or kind != "bode")),
        variables=table.variables,
        guessed=dict(roles.columns),
        doubts=roles.doubts,
        cut_short=bool(table.cut_short) or table.ends_broken,
        digest="\n".join(digests),
    )


def _possible_inputs(table: FileTable, unused: Sequence[str]) -> list[str]:
    """Return the columns without a role that may be the input: they change and are no speeds."""
    names = []
    for name in unused:
        heading, values = parse_heading(name), table.values[table.index(name)]
        is_other = heading.unit is not None and conversion(heading.unit, "V") is None
        is_speed = _NOT_INPUT.search(plain_name(name)) or re.fullmatch(r"\d+", name)
        if np.ptp(values) > 0 and not is_speed and not (is_other and heading.unit not in ("%",)):
            names.append(name)
    return names


def _inspect_columns(
    table: FileTable, assigned: Mapping[str, Column]
) -> tuple[ColumnInspection, ...]:
    roles = {column.index: role for role, column in assigned.items()}
    return tuple(
        ColumnInspection(
            name=name,
            role=roles.get(i),
            unit=assigned[roles[i]].unit if i in roles else None,
            low=float(values.min()) + 0.0,  # + 0.0 turns -0.0 into 0.0
            high=float(values.max()) + 0.0,
            step=encoder_step(values) or None if roles.get(i, " ")[0] == "x" else None,
            whole=bool(table.whole[i]),
        )
        for i, (name, values) in enumerate(zip(table.names, table.values, strict=True))
    )


def unread_entry(file: Path, state: str, problem: str, *, advice: str = "") -> dict[str, Any]:
    """Return the JSON entry of a file that is not inspected, with the keys of an inspected file.

    `state` is "broken" or "not_read"; `advice` says what to do.
    """
    nothing: dict[str, Any] = dict.fromkeys(field.name for field in fields(Inspection))
    lists = {name: [] for name in ("columns", "unusable", "needs", "variables", "doubts")}
    entry = {"file": str(file), "problems": [problem], "advice": advice}
    return {"state": state, **nothing, **lists, "samples": 0, "guessed": {}, **entry}


def _name_them(roles: Roles) -> Note:
    """Return advice on naming columns without headings, with the roles that signals suggest."""
    text = "the columns have no names: state their roles in submission.toml"
    line = ", ".join(f"{role} = {number}" for role, number in roles.columns.items())
    said = (
        f"{text}, by their numbers from 1: columns = {{ time = …, input = …, x1 = … }}; none looks "
        "like time: if there is none, state sample_rate = … (Hz) instead"
        + "".join(f"; {doubt}" for doubt in roles.doubts)
    )
    if line:
        said = f"{text}, perhaps columns = {{ {line} }}: {'; '.join(roles.doubts)}"
    if line and not roles.doubts:
        said = f"the columns have no names; their signals suggest columns = {{ {line} }}"
    return Note(said, "no_names")


def _clock(table: FileTable, columns: Mapping[str, Column], problems: list[str]) -> Clock | None:
    """Return the clock of the file, None without a time column; add its notes to `problems`.

    Raises
    ------
    SubmissionError : there are too few samples, or time stands still or goes back.
    """
    column = columns.get("time")
    if column is not None and conversion(column.unit, "s") is None:
        column = None
    stamps = time_stamps(table, column, sample_rate=1.0)
    if column is None:
        problems.append(NO_CLOCK)
        return None
    clock = read_clock(stamps)
    problems += clock_notes(table, column, clock, sample_rate=None)
    # Jitter above 1 % of the interval (rms) is worth mentioning.
    if not clock.pieces and clock.jitter > 0.01 * clock.mean_interval:
        said = (
            f"the sample interval varies by {clock.jitter / clock.mean_interval:.1%} (rms); "
            "times are used as they are"
        )
        problems.append(Note(said, "uneven", about=column.name))
    return clock


def _guess(
    table: FileTable, columns: Mapping[str, Column], clock: Clock | None, problems: list[str]
) -> tuple[ExperimentKind | None, float | None]:
    """Return the likely kind of experiment, and the frequency of a dwell."""
    if "frequency" in columns:
        return "bode", None
    signals = {role: table.values[column.index] for role, column in columns.items()}
    positions = {c.name: signals[role] for role, c in columns.items() if role[0] == "x"}
    if not positions:
        said = "no column is a cart's position: name them in `columns`"
        problems.append(Note(said, "no_position"))
        return None, None
    u, reference = signals.get("input"), signals.get("reference")
    t = clock.t if clock else np.arange(table.values.shape[1], dtype=np.float64)
    problems += channel_problems(t, u, positions)
    if reference is not None and "x1" in signals and holds_counts(table, columns["reference"]):
        reference = None if mirrors(reference, signals["x1"]) else reference
    if u is None or np.ptp(u) == 0.0:
        if u is not None and u[0] != 0.0 and _starts_at_rest(positions):
            return "step", None  # the log begins at the step
        if (
            table.format.inputs != "count"
            or table.lines is not None
            or reference is None
            or np.ptp(reference) == 0.0
        ):
            return "decay", None
        said = (
            f"the input never changes, yet {columns['reference'].name!r} does: was it saved as "
            "an unsigned integer, which cannot be negative?"
        )
        problems.append(Note(said, "unsigned", about=columns["input"].name))
        return "step", None
    if reference is not None and np.any(reference != 0) and not _follows(u, reference):
        return "closed_loop", None
    if is_stepped(u):
        return "step", None
    frequency = line_frequency(t, u)
    return ("sweep", None) if frequency is None else ("sine", frequency if clock else None)


def _starts_at_rest(positions: Mapping[str, Array]) -> bool:
    """Return whether all positions start at zero, and slowly."""
    return all(
        abs(x[0]) < 0.02 * np.ptp(x) and abs(x[2] - x[0]) < 0.1 * np.ptp(x)
        for x in positions.values()
        if np.ptp(x) > 0
    )


def _follows(u: Array, reference: Array) -> bool:
    """Return whether the reference is the commanded input itself, as in open loop.

    The reference may be rounded to counts, and logged up to one sample before or after the input.
    """
    if np.ptp(reference) == 0.0:
        return False
    if abs(np.corrcoef(u, reference)[0, 1]) > _COPIED:
        return True
    near = np.column_stack((reference[:-2], reference[1:-1], reference[2:], np.ones(u.size - 2)))
    weights = np.linalg.lstsq(near, u[1:-1])[0]
    left = np.var(u[1:-1] - near @ weights) / np.var(u)
    # Weights of opposite sign form a derivative, as in a controller's output.
    blend = np.abs(weights[:3]).sum() < 1.5 * abs(weights[:3].sum())
    return bool(blend and left < 1.0 - _COPIED**2)


def align_rows(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a line of text for each row, with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def format_inspections(inspections: Sequence[Inspection]) -> str:
    """Return a table with one line per file, and each fault once below it."""
    rows = [("file", "format", "samples", "s", "Hz", "looks like", "columns")]
    problems: list[tuple[str, str]] = []
    for one in inspections:
        times = ["" if number is None else f"{number:.4g}" for number in (one.duration, one.rate)]
        roles = " ".join(column.role or "-" for column in one.columns)
        rows.append(
            (one.title, one.format, str(one.samples), times[0], times[1], _describe(one), roles)
        )
        problems += [(one.title, said) for said in (*one.problems, one.ranges)]
    return "\n".join([*align_rows(rows), *(f"! {said}" for said in group_messages(problems))])


def _describe(inspection: Inspection) -> str:
    at = "" if inspection.frequency is None else f" at {inspection.frequency:.4g} Hz"
    return f"{inspection.kind or 'unknown'}{at}"


def format_inspection(inspection: Inspection) -> str:
    """Return the inspection as plain text."""
    samples = count(inspection.samples, "sample")
    if inspection.duration is not None and inspection.rate is not None:
        jitter = inspection.jitter or 0.0
        samples += f" over {inspection.duration:.4g} s, {inspection.rate:.5g} Hz, " + (
            f"jitter {1e3 * jitter:.3g} ms rms" if jitter > 1e-9 else "even"
        )
    width = max(len(column.name) for column in inspection.columns)
    read = [str(one) for one in inspection.variables if one.read]
    return "\n".join([
        inspection.title,
        f"  format    {inspection.format}",
        *([f"  read      {first_few(read, _MOST_COLUMNS)}"] if inspection.variables else []),
        f"  samples   {samples}",
        f"  looks like {_describe(inspection)}",
        *(
            f"  {column.name:<{width}}  {column.role or '-':<9}  {column.low:.6g} to "
            f"{column.high:.6g}{f', step {column.step:.4g}' if column.step else ''}"
            for column in inspection.columns
        ),
        *(f"  ! {problem}" for problem in inspection.problems),
    ])  # fmt: skip
