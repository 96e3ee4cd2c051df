"""Read LabVIEW's measurement file (.lvm): a header, then segments with their own header and rows.

Layout: "Specification for the LabVIEW Measurement File (.lvm)", National Instruments.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.labview import even_times, with_unit
from pipeline.ingest.formats.table import FileTable
from pipeline.ingest.formats.text import (
    Rows,
    checked_names,
    decode,
    is_number,
    make_table,
    parse_rows,
)
from pipeline.words.numbers import first_few

_START = re.compile(rb"(\xef\xbb\xbf)?LabVIEW Measurement[\t,\r\n]")
_END, _SPECIAL, _END_OF_SPECIAL = "***End_of_Header***", "***Start_Special***", "***End_Special***"
_MOST_SEGMENTS = 10_000


def is_lvm(raw: bytes) -> bool:
    """Return whether the first line is that of a LabVIEW measurement file."""
    return _START.match(raw) is not None


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """A segment: its header's tags, its column names and their line, its rows and their lines."""

    header: dict[str, list[str]]
    names: list[str]
    line: int
    rows: list[str] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class _Dialect:
    """How a file is written; `x_columns` is "one", "multi" (one per channel) or "no"."""

    source: str
    separator: str
    decimal: str
    x_columns: str

    def fields(self, line: str) -> list[str]:
        """Return the text between the separators, without white space around it."""
        return [part.strip() for part in line.split(self.separator)]


def read_lvm(raw: bytes, *, source: str) -> FileTable:
    """Read the channels of a measurement; segments that continue in time are joined.

    Raises
    ------
    SubmissionError : the file is broken, or holds two measurements; the message names the line.
    """
    text = decode(raw, source=source).replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    separator = "," if re.search(r"^Separator,Comma", text[:4000], re.MULTILINE) else "\t"
    dialect = _Dialect(source=source, separator=separator, decimal=".", x_columns="one")
    about, at = _header(lines, 0, dialect)
    dialect = replace(
        dialect,
        decimal="," if about.get("Decimal_Separator", [""])[0].startswith(",") else ".",
        x_columns=about.get("X_Columns", ["One"])[0].casefold(),
    )
    if dialect.x_columns not in ("one", "multi", "no"):
        raise SubmissionError(f"{source}: X_Columns is {dialect.x_columns[:20]!r}")
    segments, special = _segments(lines, at, dialect)
    notes = ["a special block of LabVIEW is not read"] if special else []
    return _join([_read(one, dialect) for one in segments], notes=notes)


def _header(lines: Sequence[str], at: int, dialect: _Dialect) -> tuple[dict[str, list[str]], int]:
    """Return the tags of a header with their values, and the line (from 0) after it."""
    tags: dict[str, list[str]] = {}
    for i in range(at, len(lines)):
        tag, *values = dialect.fields(lines[i])
        if tag == _END:
            return tags, i + 1
        if is_number(tag):
            break
        tags[tag] = values or [""]
    raise SubmissionError(
        f"{dialect.source} line {at + 1}: the header that begins here has no {_END}; "
        "the file was cut short or edited"
    )


def _segments(lines: Sequence[str], at: int, dialect: _Dialect) -> tuple[list[_Segment], bool]:
    """Return the segments with rows, and whether the file has a special block."""
    segments: list[_Segment] = []
    special = False
    while at < len(lines):
        first = dialect.fields(lines[at])[0]
        if first == _SPECIAL:
            special = True
            ends = (i for i in range(at, len(lines)) if lines[i].startswith(_END_OF_SPECIAL))
            if (end := next(ends, None)) is None:
                raise SubmissionError(
                    f"{dialect.source} line {at + 1}: the special block that begins here has no "
                    f"{_END_OF_SPECIAL}; the file was cut short or edited"
                )
            at = end + 1
        elif not lines[at].strip():
            at += 1
        elif segments and (_is_row(lines[at], dialect) or segments[-1].lines[-1:] == [at]):
            # A line directly after a row is a row, because an empty line comes before every header.
            segments[-1].rows.append(lines[at])
            segments[-1].lines.append(at + 1)
            at += 1
        else:
            header, behind = _header(lines, at, dialect)
            if behind >= len(lines):
                raise SubmissionError(f"{dialect.source}: ends after the header of a segment")
            names = dialect.fields(lines[behind])
            segments.append(_Segment(header=header, names=names, line=behind + 1))
            at = behind + 1
        if len(segments) > _MOST_SEGMENTS:
            raise SubmissionError(f"{dialect.source}: holds more than {_MOST_SEGMENTS:,} segments")
    filled = [one for one in segments if one.rows]
    if not filled:
        raise SubmissionError(f"{dialect.source}: holds no rows of numbers")
    return filled, special


def _is_row(line: str, dialect: _Dialect) -> bool:
    """Return whether a line is a row of numbers, rather than the first tag of a header."""
    cells = [field for field in dialect.fields(line) if field]
    return bool(cells) and is_number(cells[0].replace(dialect.decimal, "."))


def _read(segment: _Segment, dialect: _Dialect) -> FileTable:
    """Return the table of one segment; comments are left out and noted."""
    names = segment.names
    has_comments = names[-1].casefold() == "comment"
    while names and not names[-1]:
        names = names[:-1]
    width = len(names) - has_comments
    skipped = dialect.x_columns == "no" and names[0] == "X_Value"  # this column is empty
    comments: list[str] = []

    def split(row: str) -> list[str]:
        fields = dialect.fields(row)
        comments.extend(filter(None, fields[width:]))
        return [field.replace(dialect.decimal, ".") for field in fields[skipped:width]]

    place = f"{dialect.source} line {segment.line}"
    columns = _headings(segment, names[skipped:width], dialect)
    if not columns:
        raise SubmissionError(f"{place}: names no channel")
    rows = parse_rows(
        segment.rows, segment.lines, split=split, names=columns, source=dialect.source
    )
    if dialect.x_columns == "multi":
        rows = _with_one_clock(rows, segment.names, place=place)
    names = checked_names(rows.names, place=place)
    made = make_table(
        replace(rows, names=names),
        form="lvm",
        typed=[""] * len(names),  # all numbers have a decimal mark, whole or not
        cut=rows.cut or _missing(segment, len(rows.values)),
        notes=["comments beside the rows are not read"] if comments else [],
    )
    return _with_times(made, segment, dialect) if dialect.x_columns == "no" else made


def _missing(segment: _Segment, found: int) -> str | None:
    """Return a note if a segment has fewer rows than its header states; otherwise None."""
    stated = max((int(n) for n in segment.header.get("Samples", []) if n.isdecimal()), default=0)
    return f"line {segment.lines[-1]}: {found:,} of {stated:,} samples" if found < stated else None


def _headings(segment: _Segment, names: Sequence[str], dialect: _Dialect) -> list[str]:
    """Return the column names with the units that the header states."""
    channels = [name for name in names if name != "X_Value"]
    units = [unit for unit in segment.header.get("Y_Unit_Label", []) if unit]
    if len(units) != len(channels):
        units = [""] * len(channels)
    named = iter([with_unit(name, unit) for name, unit in zip(channels, units, strict=True)])
    across = segment.header.get("X_Dimension", ["Time"])[0]
    unit = segment.header.get("X_Unit_Label", [""])[0]
    clock = with_unit("time" if across.casefold() in ("", "time") else across, unit)
    return [clock if name == "X_Value" else next(named) for name in names]


def _with_one_clock(rows: Rows, names: Sequence[str], *, place: str) -> Rows:
    """Return the rows with only the first time column; all time columns must be equal."""
    clocks = [i for i in range(len(rows.names)) if names[i] == "X_Value"]
    if any((rows.values[:, i] != rows.values[:, clocks[0]]).any() for i in clocks[1:]):
        raise SubmissionError(
            f"{place}: the channels were sampled at different times; save them with X_Columns One"
        )
    keep = [i for i in range(len(rows.names)) if i not in clocks[1:]]
    return replace(rows, names=[rows.names[i] for i in keep], values=rows.values[:, keep])


def _with_times(table: FileTable, segment: _Segment, dialect: _Dialect) -> FileTable:
    """Return the table with the times that the header states, if it states any."""
    start, interval = (_stated(tag, segment, dialect) for tag in ("X0", "Delta_X"))
    if not interval:
        return table
    times = even_times(table.values.shape[1], start=start or 0.0, interval=interval)
    return replace(
        table,
        names=("time", *table.names),
        values=np.vstack([times, table.values]),
        whole=(False, *table.whole),
    )


def _stated(tag: str, segment: _Segment, dialect: _Dialect) -> float | None:
    """Return the number that a header states for all channels; None if it states none.

    Raises
    ------
    SubmissionError : the entry is not a number, or differs between channels.
    """
    place = f"{dialect.source} line {segment.line}: the header above states {tag}"
    values = [value for value in segment.header.get(tag, []) if value]
    numbers = [value.replace(dialect.decimal, ".") for value in values]
    if not all(map(is_number, numbers)):
        raise SubmissionError(f"{place} {first_few(values, 3)[:60]!r}, which is not a number")
    found = set(map(float, numbers))
    if len(found) > 1 or not all(map(np.isfinite, found)):
        raise SubmissionError(f"{place} differently for each channel: {first_few(values, 3)[:60]}")
    return found.pop() if found else None


def _join(tables: Sequence[FileTable], *, notes: Sequence[str]) -> FileTable:
    """Join segments to one table; each must continue in time where the one before ended."""
    first, *others = tables
    for before, after in pairwise(tables):
        assert before.lines is not None
        assert after.lines is not None
        place = f"{first.source} line {after.lines[0]}"
        if before.cut is not None:
            raise SubmissionError(f"{first.source} {before.cut}")
        if after.names != first.names:
            raise SubmissionError(
                f"{place}: the channels differ from those before; keep one measurement"
            )
        has_time = first.names[0].startswith("time")
        if has_time and after.values[0, 0] <= before.values[0, -1]:
            raise SubmissionError(
                f"{place}: a segment begins again at {after.values[0, 0]:g} s: "
                "two measurements in one file; keep one"
            )
    if not others:
        return replace(first, notes=(*first.notes, *notes))
    lines = [table.lines for table in tables if table.lines is not None]
    values = np.hstack([table.values for table in tables])
    said = dict.fromkeys(note for table in tables for note in table.notes)
    return replace(
        first,
        values=values,
        whole=tuple(all(whole) for whole in zip(*(table.whole for table in tables), strict=True)),
        lines=np.concatenate(lines),
        cut=tables[-1].cut,
        notes=(*said, *notes, f"{len(tables)} segments that continue each other were joined"),
    )
