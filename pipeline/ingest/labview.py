"""Read the formats of National Instruments: LabVIEW's text (.lvm) and binary files (.tdms).

An .lvm file is a header, then segments with their own header and rows. In a .tdms file, each group
of channels is a recording. Layouts: "Specification for the LabVIEW Measurement File (.lvm)" and
"TDMS File Format Internal Structure", National Instruments.
"""

import logging
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import BytesIO
from logging.handlers import BufferingHandler
from typing import TYPE_CHECKING

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import is_time, join_unit
from pipeline.ingest.table import (
    MOST_NAMED,
    SETTING,
    FileTable,
    Format,
    Variable,
    binary_table,
    checked_names,
    not_read,
)
from pipeline.ingest.text import Block, Layout, decode, read_block
from pipeline.words.numbers import first_few

if TYPE_CHECKING:
    from nptdms import TdmsChannel

_LVM = Format(title="LabVIEW measurement file (.lvm)")
_TDMS = Format(title="National Instruments .tdms")
_START = re.compile(rb"(\xef\xbb\xbf)?LabVIEW Measurement[\t,\r\n]")
_END, _SPECIAL, _END_OF_SPECIAL = "***End_of_Header***", "***Start_Special***", "***End_Special***"


def is_lvm(raw: bytes) -> bool:
    """Return whether the first line is that of a LabVIEW measurement file."""
    return _START.match(raw) is not None


def _even_times(n: int, *, start: float, interval: float) -> Array:
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
    table = read_block(block, apart, format=_LVM, names=headings)
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
    times = _even_times(table.values.shape[1], start=start, interval=interval)
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


# -------------------------------------------------------------------------------------------- .tdms

_LEAD_IN = 28  # bytes
_BIG_ENDIAN = 0x40  # flag of a segment


def is_tdms(raw: bytes) -> bool:
    """Return whether a file begins with the tag of a .tdms segment."""
    return raw.startswith(b"TDSm")


def read_tdms(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the channels of each group that holds a recording.

    Raises
    ------
    SubmissionError : the file is broken or truncated, or holds no recording.
    """
    _refuse_cut(raw, source=source)
    channels = _read_channels(raw, source=source)
    groups = _recordings(channels, source=source)
    used = [channel for read in groups.values() for channel in read]
    longest = max(channel.samples for channel in used)
    variables = tuple(
        Variable(
            name=f"{channel.group}/{channel.name}",
            size=(channel.samples, 1),
            kind=channel.kind,
            read=channel in used,
            advice="if it is a signal, write it as numbers"
            if channel.values is None and channel.samples >= longest
            else "",
        )
        for channel in channels
    )
    notes = tuple(not_read([variable for variable in variables if not variable.read]))
    return [
        replace(_table(group, read, source=source), variables=variables, notes=notes)
        for group, read in groups.items()
    ]


def _table(group: str, read: Sequence["_Channel"], *, source: str) -> FileTable:
    """Return the channels of a group, with the time that they state."""
    names = [channel.heading for channel in read]
    columns = [channel.numbers for channel in read]
    if not any(is_time(channel.name) for channel in read):
        interval, start = _clock(read, source=source)
        if interval:
            names.insert(0, "time")
            columns.insert(0, _even_times(read[0].samples, start=start, interval=interval))
    names = checked_names(names, place=f"{source} group {group!r}")
    return binary_table(columns, names=names, source=source, format=_TDMS, run=group)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Channel:
    """A channel with its stated unit and clock; `values` is None if it holds no numbers."""

    group: str
    name: str
    kind: str
    samples: int
    values: Array | None
    unit: str
    interval: float
    start: float

    @property
    def numbers(self) -> Array:
        """The numbers; the channel must have some."""
        assert self.values is not None
        return self.values

    @property
    def heading(self) -> str:
        """The channel's name and unit."""
        return join_unit(self.name, self.unit)


def _refuse_cut(raw: bytes, *, source: str) -> None:
    """Refuse a truncated file, of which npTDMS would read a part without a word.

    Raises
    ------
    SubmissionError : the file is refused.
    """
    at = 0
    while at < len(raw):
        if raw[at : at + 4] != b"TDSm" or at + _LEAD_IN > len(raw):
            raise SubmissionError(f"{source}: broken at byte {at:,}, where a segment should begin")
        order = ">" if raw[at + 4] & _BIG_ENDIAN else "<"
        (length,) = struct.unpack_from(f"{order}Q", raw, at + 12)
        end = at + _LEAD_IN + length
        if end > len(raw):  # also true if LabVIEW never wrote the length
            raise SubmissionError(
                f"{source}: the segment at byte {at:,} is not whole: the file was cut short, or "
                "copied while LabVIEW was writing it"
            )
        at = end


def _read_channels(raw: bytes, *, source: str) -> list[_Channel]:
    """Return the channels of a file.

    Raises
    ------
    SubmissionError : npTDMS fails, or reports a problem.
    """
    from nptdms import TdmsFile

    with _complaints() as messages:
        try:
            file = TdmsFile.read(BytesIO(raw))
            channels = [_channel(one) for group in file.groups() for one in group.channels()]
        except MemoryError:
            raise
        except Exception:  # npTDMS raises many kinds of errors
            raise SubmissionError(f"{source}: the .tdms file is broken or cut short") from None
    if messages:
        raise SubmissionError(
            f"{source}: the .tdms file is damaged ({messages[0].getMessage()[:100]})"
        )
    return channels


def _channel(one: "TdmsChannel") -> _Channel:
    values, kind = np.asarray(one[:]), str(one.dtype)
    if values.dtype.kind == "M":
        start = values[0] if values.size else None
        values = (values - start) / np.timedelta64(1, "s") if values.size else values
        kind = "times"
    is_number = values.dtype.kind in "biuf" and values.ndim == 1
    properties = one.properties
    return _Channel(
        group=_printable(one.group_name),
        name=_printable(one.name),
        kind=kind if is_number else "no numbers",
        samples=values.size,
        values=values.astype(np.float64) if is_number else None,
        unit="s" if kind == "times" else _printable(str(properties.get("unit_string", ""))),
        interval=_number(properties.get("wf_increment")),
        start=_number(properties.get("wf_start_offset")),
    )


def _printable(text: str) -> str:
    return text if text.isprintable() else repr(text)[1:-1]


def _number(value: object) -> float:
    """Return a property if it is a finite number; 0 otherwise."""
    known = isinstance(value, float | int | np.number) and bool(np.isfinite(value))
    return float(value) if known else 0.0  # type: ignore[arg-type]


@contextmanager
def _complaints() -> Iterator[list[logging.LogRecord]]:
    """Collect the messages that npTDMS only logs, for example that data are missing."""
    from nptdms.log import log_manager

    log_manager.console_handler.setLevel(logging.CRITICAL)
    listener = BufferingHandler(1_000_000)
    listener.setLevel(logging.WARNING)
    logger = logging.getLogger("nptdms")
    logger.addHandler(listener)
    try:
        yield listener.buffer
    finally:
        logger.removeHandler(listener)


def _recordings(channels: Sequence[_Channel], *, source: str) -> dict[str, list[_Channel]]:
    """Return the channels of each group that is a recording, without short channels.

    A short channel holds settings.

    Raises
    ------
    SubmissionError : there is no recording, or the channels of a group differ in length.
    """
    signals = [one for one in channels if one.values is not None and one.samples > 1]
    if not signals:
        found = first_few([f"{one.group}/{one.name}" for one in channels], MOST_NAMED)
        raise SubmissionError(f"{source}: holds no channel of numbers, but {found or 'nothing'}")
    longest = max(one.samples for one in signals)
    groups: dict[str, list[_Channel]] = {}
    for one in signals:
        if one.samples > SETTING * longest:
            groups.setdefault(one.group, []).append(one)
    for read in groups.values():
        if len({one.samples for one in read}) > 1:
            sizes = first_few([f"{one.name} ({one.samples:,})" for one in read], MOST_NAMED)
            raise SubmissionError(f"{source}: the channels differ in length: {sizes}")
    return groups


def _clock(channels: Sequence[_Channel], *, source: str) -> tuple[float, float]:
    """Return the sample interval and the first time (s) of the channels; zeros if not stated.

    Raises
    ------
    SubmissionError : the channels state different intervals or first times.
    """
    stated = {(one.interval, one.start) for one in channels if one.interval > 0}
    if len(stated) > 1:
        shown = first_few([f"{interval:g} s" for interval, _ in sorted(stated)], MOST_NAMED)
        raise SubmissionError(
            f"{source}: the channels were sampled at different times (wf_increment {shown}); "
            "keep those of one rate"
        )
    return stated.pop() if stated else (0.0, 0.0)
