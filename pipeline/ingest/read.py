"""Read the files of a submission into records; all conversions of units happen here."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.bode_table import Points, frequency_responses, read_points
from pipeline.ingest.channels import channel_problems, encoder_step, mirrors
from pipeline.ingest.clock import FEWEST_SAMPLES, Clock, clock_notes, read_clock, time_stamps
from pipeline.ingest.columns import (
    Column,
    assign_columns,
    conversion,
    holds_counts,
    is_count,
    refuse_unknown_unit,
)
from pipeline.ingest.files import choose_run, read_tables
from pipeline.ingest.jumps import repair_positions
from pipeline.ingest.sign import Signs, with_signs
from pipeline.ingest.table import FileTable, Note, refuse_extreme
from pipeline.results import FrequencyResponse, HeadingUnit, Record
from pipeline.submission import Experiment, Submission, System
from pipeline.submission.load import NAME
from pipeline.words.numbers import count, first_few, listing

_FEW_COUNTS = 10  # counts; no motor moves with so few, so smaller whole numbers are volts
DUTY_COUNT = 5 / 4096  # V; the amplifier of the UCSD bench gives 5 V for 4096 counts
_NEED_INPUT = ("step", "sine", "sweep")


@dataclass(frozen=True, kw_only=True, eq=False)
class Ingested:
    """All data of a submission.

    Attributes
    ----------
    records : the time series, in the order of the submission.
    tables : frequency responses that the students computed, one for each cart.
    files : SHA-256 of each data file, sorted by path.
    unreadable : for each experiment whose file is not used, the reason: the file is missing,
        broken, or from another experiment.
    signs : the stated signs of the inputs, and the signs found in the data.
    misnamed : which columns of `[system] columns` no file has, or "".
    warnings : the warnings that concern more than one record.
    """

    records: tuple[Record, ...]
    tables: tuple[FrequencyResponse, ...]
    files: dict[str, str]
    unreadable: dict[str, str]
    signs: Signs
    misnamed: str = ""
    warnings: tuple[str, ...]


def read_data(submission: Submission) -> Ingested:
    """Read every experiment's file into a record in position and input units.

    If a file is missing, broken or unsuitable, only its experiment is affected.

    Raises
    ------
    SubmissionError : no file can be read; the message has one line.
    """
    if not submission.experiments:
        raise SubmissionError(
            f"{submission.folder.resolve().name}/submission.toml: it has no [[experiments]] "
            f"table yet; add one for each data file, as `cartlab fill` does"
        )
    experiments = submission.used
    system, taken = submission.system, {experiment.file for experiment in submission.experiments}
    tables: dict[str, tuple[list[FileTable], str]] = {}
    records: list[Record] = []
    points: Points = {}
    warnings: list[str] = []
    unreadable: dict[str, str] = {}
    tables_read: list[str] = []
    for experiment in experiments:
        with _noted(experiment, unreadable):
            if experiment.file not in tables:
                tables[experiment.file] = read_tables(
                    submission.folder, experiment.file, taken=taken
                )
            table = choose_run(tables[experiment.file][0], experiment.run)
            if experiment.kind == "bode" and len(experiment.carts) < system.carts:
                said = (
                    f"{experiment.id}: not used: a bode table needs all carts free, here only "
                    f"{list(experiment.carts)} are"
                )
                warnings.append(Note(said, "held", about=experiment.id))
                continue
            if table.cut_short:
                raise SubmissionError(f"{table.source} {table.cut_short}")
            if experiment.kind == "bode":
                warnings += _read_bode(table, experiment, points)
                tables_read.append(experiment.id)
            else:
                records.append(_Reading(table, experiment, system).record())
    misnamed = _misnamed_columns(system, [table for read, _ in tables.values() for table in read])
    if len(unreadable) == len(experiments):
        (name, reason), *others = unreadable.items()
        reason = f"{name}: {reason}{f' (and {len(others)} more)' if others else ''}"
        raise SubmissionError("; ".join(filter(None, [misnamed, reason])))
    per_count = system.input.per_count
    driven = [record for record in records if record.u is not None and np.any(record.u)]
    if per_count is not None and driven and all(r.input_scale != per_count for r in driven):
        said = (
            f"system.input.per_count = {per_count:g} is not used: no input holds counts (whole "
            f"numbers beyond ±{_FEW_COUNTS:g}); every input is read in {system.input.unit}"
        )
        warnings.append(Note(said, "per_count_unused"))
    first: dict[str, str] = {}
    warnings += [
        Note(
            f"{name} is a copy of {original}; a repeat must be recorded separately",
            "copy",
            about=name,
        )
        for name, (_, digest) in tables.items()
        if (original := first.setdefault(digest, name)) != name
    ]
    records, found, signs = with_signs(records, submission)
    responses, spread = frequency_responses(points, experiments=tables_read)
    return Ingested(
        records=tuple(records),
        tables=responses,
        files={name: digest for name, (_, digest) in sorted(tables.items())},
        unreadable=unreadable,
        signs=signs,
        misnamed=misnamed,
        warnings=(*warnings, *found, *((spread,) if responses else ())),
    )


def _misnamed_columns(system: System, tables: Sequence[FileTable]) -> str:
    """Return which columns of `[system] columns` no file has, or ""."""
    wrong = {
        role: column
        for role, column in system.columns.items()
        if tables and not any(table.has(column) for table in tables)
    }
    if not wrong:
        return ""
    names = list(dict.fromkeys(name for table in tables for name in table.names))
    most = max(len(table.names) for table in tables)
    stated = []
    for role, column in wrong.items():
        close = get_close_matches(column, names, n=1) if isinstance(column, str) else []
        meant = f" (did you mean {close[0]!r}?)" if close else ""
        stated.append(f"{role} = {column!r}{meant}")
    there = f"the files have at most {count(most, 'column')}: {first_few(names, 12)}"
    is_in = "is in no file" if len(wrong) == 1 else "are in no file"
    said = f"{NAME}: [system] columns: {listing(stated)} {is_in}; {there}"
    return Note(said, "no_column", about=", ".join(wrong))


@contextmanager
def _noted(experiment: Experiment, unreadable: dict[str, str]) -> Iterator[None]:
    """Note an error as the reason why the experiment's file is not used."""
    try:
        yield
    except SubmissionError as error:
        unreadable[experiment.id] = str(error)


def _read_bode(table: FileTable, experiment: Experiment, points: Points) -> list[str]:
    """Add the rows of a Bode table to `points`; return the warnings."""
    columns, unused = assign_columns(table, explicit=experiment.columns, free=experiment.carts)
    for cart, rows in read_points(table, columns, carts=experiment.carts).items():
        points.setdefault(cart, []).extend(rows)
    return [f"{experiment.id}: columns not used: {', '.join(unused)}"] if unused else []


# ------------------------------------------------------------------------------ one record


def _window(clock: Clock, experiment: Experiment) -> NDArray[np.bool_]:
    """Return which samples are inside the experiment's window; all if it has no window."""
    start, end = experiment.window or (-np.inf, np.inf)
    first, last = float(clock.t[0]), float(clock.t[-1])
    what = f"submission.toml: window = [{start:g}, {end:g}]"
    # 1 % of the length, since the end of the window is often rounded up.
    slack = max(0.01 * (last - first), 2 * clock.mean_interval)
    if experiment.window and (start < first - slack or end > last + slack):
        raise SubmissionError(
            f"{what} lies outside the data of {experiment.file}, which run from {first:.4g} s to "
            f"{last:.4g} s"
        )
    half = 0.5 * clock.rounding if clock.pieces else 1e-9
    inside = (clock.t >= start - half) & (clock.t <= end + half)
    if inside.sum() < FEWEST_SAMPLES:
        raise SubmissionError(
            f"{what} holds {inside.sum()} samples of {experiment.file}, {FEWEST_SAMPLES} are needed"
        )
    return inside


class _Reading:
    """One experiment's file on its way to a record.

    Attributes
    ----------
    columns : the column of each role.
    positions : the columns of positions, by cart.
    notes, headed : what is found: notes, and the units of headings.
    """

    def __init__(self, table: FileTable, experiment: Experiment, system: System) -> None:
        self.table, self.experiment, self.system = table, experiment, system
        self.headed: list[HeadingUnit] = []
        own, free = experiment.columns or {}, experiment.carts
        shared = {
            role: column
            for role, column in system.columns.items()
            if table.has(column) and column not in own.values()
        }
        columns, unused = assign_columns(table, explicit=shared | own, free=free)
        self.columns = columns
        # A column that the experiment needs may not have empty or broken cells.
        left_out = replace(
            table, names=tuple(table.partial), values=np.zeros((len(table.partial), 1))
        )
        needed = {"time", *(f"x{cart}" for cart in free)} - columns.keys()
        needed |= {"input"} - columns.keys() if experiment.kind in _NEED_INPUT else set()
        partial, _ = assign_columns(left_out, explicit=None, free=free)
        table.refuse_partial(column.name for role, column in partial.items() if role in needed)
        measured = {c.cart: c for role, c in columns.items() if role[0] == "x"}
        self.positions = [measured[cart] for cart in sorted(measured) if cart <= system.carts]
        if not self.positions:
            raise SubmissionError(
                f"{table.source}: no column is a cart's position; it has {table.headings()}; "
                f'say which: columns = {{ time = "…", input = "…", x{free[0]} = "…" }}'
            )
        if not {column.cart for column in self.positions} & set(free):
            raise SubmissionError(
                f"{table.source}: the free carts are {list(free)}, but the file measures "
                f"{[column.cart for column in self.positions]}; check `carts` and `file`"
            )
        self.notes = list(table.notes)
        extra = [column.name for column in measured.values() if column not in self.positions]
        if unused or extra:
            names = ", ".join([*unused, *extra])
            self.notes.append(Note(f"columns not used: {names}", "unused", about=names))

    def record(self) -> Record:
        """Return the record with the input's scale applied, but without an unknown sign."""
        table, experiment, columns = self.table, self.experiment, self.columns
        positions, time, rate = self.positions, columns.get("time"), experiment.sample_rate
        clock = read_clock(time_stamps(table, time, sample_rate=rate))
        t = clock.t
        if time is not None:
            self.notes += clock_notes(table, time, clock, sample_rate=rate)
        inside = _window(clock, experiment)
        scales = {c.name: self._position_scale(c) for c in positions}
        drive = columns.get("input")
        y, good, said = repair_positions(
            t,
            {c.name: table.values[c.index] * scales[c.name] for c in positions},
            None if drive is None else table.values[drive.index],
            unit=self.system.position.unit,
            scales=scales,
            wanted=experiment.repair.model_dump(),
        )
        self.notes += said
        keep = np.flatnonzero(good & inside)
        u, input_scale = self._input()
        reference = self._reference(keep)
        measured = {f"the position of cart {c.cart}": y[c.name] for c in positions}
        measured |= {"the input": u, "the reference": reference, "the time": t - t[0]}
        for what, values in measured.items():
            if values is not None:
                refuse_extreme(values, what=f"{table.source}: {what}")
        t, u = t[keep], None if u is None else u[keep]
        free = {c.name: y[c.name][keep] for c in positions if c.cart in experiment.carts}
        self.notes += channel_problems(t, u, free)
        return Record(
            id=experiment.id,
            kind=experiment.kind,
            t=t,
            u=u,
            y=np.array([y[c.name][keep] for c in positions]),
            carts=tuple(column.cart for column in positions),
            free=experiment.carts,
            reference=reference,
            omega=None if experiment.frequency is None else 2 * np.pi * experiment.frequency,
            resolution=np.array([
                scales[c.name] if holds_counts(table, c) else encoder_step(y[c.name])
                for c in positions
            ]),
            hold=experiment.hold,
            source=experiment.file,
            notes=tuple(self.notes),
            position_scale=scales[positions[0].name],
            input_scale=input_scale,
            heading_units=tuple(dict.fromkeys(self.headed)),
        )  # fmt: skip

    def _position_scale(self, column: Column) -> float:
        """Return position units per number in the file."""
        table, stated = self.table, self.system.position
        unit, per_count = stated.unit, stated.per_count
        if not holds_counts(table, column):
            return self._unit_scale(column, unit, "position")
        if per_count is not None:
            return per_count
        if is_count(unit) or not (table.format.positions == "count" or column.is_counted):
            return 1.0
        raise SubmissionError(
            f"{table.source}: {column.name!r} holds encoder counts; state how many {unit} one "
            f"count is: position = {{ unit = {unit!r}, per_count = … }}; or use counts: "
            "position = { unit = 'count' }"
        )

    def _unit_scale(self, column: Column, unit: str, role: Literal["position", "input"]) -> float:
        """Return the factor from the heading's unit to the submission's, and add a note."""
        refuse_unknown_unit(self.table, column, stated=unit)
        factor = conversion(column.unit, unit)
        if column.unit is not None:
            converts = factor is not None
            self.headed.append(
                HeadingUnit(role=role, heading=column.name, unit=column.unit, converts=converts)
            )
        if factor not in (None, 1.0):
            said = f"{column.name!r} was converted from {column.unit} to {unit}"
            self.notes.append(Note(said, "converted", about=column.name))
        return 1.0 if factor is None else factor

    def _input(self) -> tuple[Array | None, float]:
        """Return the input in input units and the scale used; an unknown sign is not applied."""
        table, experiment, stated = self.table, self.experiment, self.system.input
        column = self.columns.get("input")
        if column is None:
            if experiment.kind in _NEED_INPUT:
                raise SubmissionError(
                    f"{table.source}: a {experiment.kind} needs the input, and no column is one; "
                    f'it has {table.headings()}; say which: columns = {{ input = "…" }}'
                )
            return None, 1.0
        override = experiment.input
        values, per_count = table.values[column.index], stated.per_count
        in_counts = table.whole[column.index] and (
            table.format.inputs == "count"
            or column.is_duty
            or (per_count is not None and (table.format.inputs == "unknown" or column.is_counted))
        )
        if per_count is not None and column.unit is None:
            # Large whole numbers, such as "512.0", are counts, not volts.
            is_whole = bool(np.all(values == np.round(values)))
            in_counts = in_counts or (is_whole and np.abs(values).max() > _FEW_COUNTS)
        if override is not None and override.per_count is not None:
            scale = override.per_count
        elif in_counts:
            scale = per_count or DUTY_COUNT
            if per_count is None:
                said = f"{column.name!r} is taken as duty counts of 5/4096 {stated.unit}"
                self.notes.append(Note(said, "duty", about=column.name))
        else:
            scale = self._unit_scale(column, stated.unit, "input")
        return values * scale, scale

    def _reference(self, keep: NDArray[np.intp]) -> Array | None:
        """Return the set point of a closed loop, as the experiment states it or from its file."""
        table, experiment, columns = self.table, self.experiment, self.columns
        if experiment.kind != "closed_loop":
            return None
        if experiment.reference is not None:
            return np.full(keep.size, experiment.reference)
        if (column := columns.get("reference")) is None:
            return None
        values, first = table.values[column.index], columns.get("x1")
        if first and holds_counts(table, column) and mirrors(values, table.values[first.index]):
            said = f"{column.name!r} only copies {first.name!r}, so it is not a reference"
            self.notes.append(Note(said, "copied", about=column.name))
            return None
        return values[keep] * self._position_scale(column)
