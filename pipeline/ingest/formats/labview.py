"""Read LabVIEW's measurement file (.lvm): a header, then segments with their own header and rows.

Layout: "Specification for the LabVIEW Measurement File (.lvm)", National Instruments.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.formats.headings import join_unit
from pipeline.ingest.formats.table import FileTable
from pipeline.ingest.formats.text import Block, Layout, decode, read_block
from pipeline.words.numbers import first_few

_START = re.compile(rb"(\xef\xbb\xbf)?LabVIEW Measurement[\t,\r\n]")
_END, _SPECIAL, _END_OF_SPECIAL = "***End_of_Header***", "***Start_Special***", "***End_Special***"


def is_lvm(raw: bytes) -> bool:
    """Return whether the first line is that of a LabVIEW measurement file."""
    return _START.match(raw) is not None


def even_times(n: int, *, start: float, interval: float) -> Array:
    """Return n times in s, from the first time and the interval."""
    return start + interval * np.arange(n, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """A segment: its header's tags, its column names and their line, and its numbered rows."""

    tags: dict[str, list[str]]
    names: list[str]
    line: int
    rows: list[tuple[int, str]] = field(default_factory=list)

    def stated(self, tag: str, layout: Layout, *, source: str) -> float | None:
        """Return the number that the header states for all channels; None if it states none.

        Raises
        ------
        SubmissionError : the entry is not a number, or differs between channels.
        """
        place = f"{source} line {self.line}: the header above states {tag}"
        typed = [value for value in self.tags.get(tag, []) if value]
        try:
            found = {layout.cell(value) for value in typed}
        except ValueError:
            shown = first_few(typed, 3)[:60]
            raise SubmissionError(f"{place} {shown!r}, which is not a number") from None
        if len(found) > 1 or not all(map(np.isfinite, found)):
            raise SubmissionError(f"{place} differently for each channel: {first_few(typed, 3)}")
        return found.pop() if found else None


def read_lvm(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the channels of each segment.

    Raises
    ------
    SubmissionError : the file is broken; the message names the line.
    """
    text = decode(raw, source=source).replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    delimiter = "," if re.search(r"^Separator,Comma", text[:4000], re.MULTILINE) else "\t"
    about, at = _header(lines, 0, delimiter, source=source)
    comma = about.get("Decimal_Separator", [""])[0].startswith(",")
    across = about.get("X_Columns", ["One"])[0].casefold()
    if across not in ("one", "multi", "no"):
        raise SubmissionError(f"{source}: X_Columns is {across[:20]!r}")
    layout = Layout(delimiter, comma=comma)
    segments = [one for one in _segments(lines, at, layout, source=source) if one.rows]
    if not segments:
        raise SubmissionError(f"{source}: holds no rows of numbers")
    tables = [_read(one, layout, across=across, source=source) for one in segments]
    if any(line.startswith(_SPECIAL) for line in lines):
        notes = (*tables[0].notes, "a special block of LabVIEW is not read")
        tables[0] = replace(tables[0], notes=notes)
    return tables


def _header(
    lines: Sequence[str], at: int, delimiter: str, *, source: str
) -> tuple[dict[str, list[str]], int]:
    """Return the tags of a header with their values, and the line (from 0) after it."""
    tags: dict[str, list[str]] = {}
    for i in range(at, len(lines)):
        tag, *values = [part.strip() for part in lines[i].split(delimiter)]
        if tag == _END:
            return tags, i + 1
        tags[tag] = values or [""]
    raise SubmissionError(
        f"{source} line {at + 1}: the header that begins here has no {_END}; "
        "the file was cut short or edited"
    )


def _segments(lines: Sequence[str], at: int, layout: Layout, *, source: str) -> Iterator[_Segment]:
    """Yield the segments; rows without a header of their own belong to the segment before."""
    segment: _Segment | None = None
    while at < len(lines):
        line = lines[at]
        if line.startswith(_SPECIAL):
            ends = (i for i in range(at, len(lines)) if lines[i].startswith(_END_OF_SPECIAL))
            if (end := next(ends, None)) is None:
                raise SubmissionError(
                    f"{source} line {at + 1}: the special block that begins here has no "
                    f"{_END_OF_SPECIAL}; the file was cut short or edited"
                )
            at = end
        elif line.strip():
            first = line.partition(str(layout.delimiter))[0].strip()
            after_row = segment is not None and segment.rows[-1:] == [(at, lines[at - 1])]
            # A line directly after a row is a row, because an empty line comes before every header.
            if segment is not None and (after_row or not first or _is_number(first, layout)):
                segment.rows.append((at + 1, line))
            else:
                if segment is not None:
                    yield segment
                tags, behind = _header(lines, at, str(layout.delimiter), source=source)
                if behind >= len(lines) or not lines[behind].strip():
                    raise SubmissionError(f"{source}: ends after the header of a segment")
                names = [part.strip() for part in lines[behind].split(str(layout.delimiter))]
                segment = _Segment(tags=tags, names=names, line=behind + 1)
                at = behind
        at += 1
    if segment is not None:
        yield segment


def _is_number(field: str, layout: Layout) -> bool:
    try:
        layout.cell(field)
    except ValueError:
        return False
    return True


def _read(segment: _Segment, layout: Layout, *, across: str, source: str) -> FileTable:
    """Return the table of one segment; comments and channels without values are left out."""
    names = segment.names[: len(segment.names) - (segment.names[-1].casefold() == "comment")]
    while names and not names[-1]:
        names = names[:-1]
    has_times = across != "no"
    clocks = [i for i, name in enumerate(names) if name == "X_Value"]
    used = [i for i in range(len(names)) if i not in clocks[has_times:]]
    if len(used) <= has_times:
        raise SubmissionError(f"{source} line {segment.line}: names no channel")
    rows, beside = [], False
    for number, line in segment.rows:
        fields = line.split(str(layout.delimiter))
        beside = beside or any(one.strip() for one in fields[len(names) :])
        fields = fields[: len(names)]
        full = len(fields) == len(names)
        if full and has_times and any(fields[i] != fields[clocks[0]] for i in clocks[1:]):
            raise SubmissionError(
                f"{source} line {number if number > segment.line + 1 else segment.line}: the "
                "channels were sampled at different times; save them with X_Columns One"
            )
        rows.append((number, "\x01".join([fields[i] for i in used] if full else fields[:-1])))
    block = Block(head=[(segment.line, "")], rows=rows, source=source)
    headings = _headings(segment, [names[i] for i in used])
    apart = Layout("\x01", comma=layout.comma)
    table = read_block(block, apart, form="lvm", names=headings)
    most = max((int(n) for n in segment.tags.get("Samples", []) if n.isdecimal()), default=0)
    complete = len(rows) - (rows[-1][1].count("\x01") != len(used) - 1)
    if complete < most:
        cut = f"line {segment.rows[-1][0]}: {complete:,} of {most:,} samples"
        table = replace(table, cut=cut)
    notes = (*table.notes, *(["comments beside the rows are not read"] if beside else []))
    # All numbers have a decimal mark, whole or not.
    table = replace(table, notes=notes, whole=(False,) * len(table.names))
    interval = None if has_times else segment.stated("Delta_X", layout, source=source)
    if not interval:
        return table
    start = segment.stated("X0", layout, source=source) or 0.0
    times = even_times(table.values.shape[1], start=start, interval=interval)
    return replace(
        table,
        names=("time", *table.names),
        values=np.vstack([times, table.values]),
        whole=(False, *table.whole),
    )


def _headings(segment: _Segment, names: Sequence[str]) -> list[str]:
    """Return the column names with the units that the header states."""
    channels = [name for name in names if name != "X_Value"]
    units = [unit for unit in segment.tags.get("Y_Unit_Label", []) if unit]
    if len(units) != len(channels):
        units = [""] * len(channels)
    named = iter([join_unit(name, unit) for name, unit in zip(channels, units, strict=True)])
    across = segment.tags.get("X_Dimension", ["Time"])[0]
    unit = segment.tags.get("X_Unit_Label", [""])[0]
    clock = join_unit("time" if across.casefold() in ("", "time") else across, unit)
    return [clock if name == "X_Value" else next(named) for name in names]
