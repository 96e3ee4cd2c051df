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

from pipeline.errors import SubmissionError
from pipeline.ingest.columns import is_time, join_unit
from pipeline.ingest.table import (
    MOST_NAMED,
    SETTING,
    FileTable,
    Format,
    Signal,
    Variable,
    binary_table,
    checked_names,
    even_times,
    not_read,
    printable,
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


@dataclass(frozen=True, kw_only=True)
class _Segment:
    """A segment: its header's tags, its column names and their line, and its numbered rows."""

    tags: dict[str, list[str]]
    names: list[str]
    line: int
    rows: list[tuple[int, str]] = field(default_factory=list)

    def stated(self, tag: str, layout: Layout, *, source: str) -> float:
        """Return the number that the header states for all channels; 0 if it states none.

        Raises
        ------
        SubmissionError : the entry is not a number, or differs between channels.
        """
        typed = [value for value in self.tags.get(tag, []) if value] or ["0"]
        try:
            found = {layout.cell(value) for value in typed}
        except ValueError:
            found = {np.nan}
        if len(found) > 1 or not all(map(np.isfinite, found)):
            raise SubmissionError(
                f"{source} line {self.line}: the header above states {tag} "
                f"{first_few(typed, 3)[:60]!r}; expected the same number for all channels"
            )
        return found.pop()


def read_lvm(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the channels of each segment.

    Raises
    ------
    SubmissionError : the file is broken; the message names the line.
    """
    lines = [*enumerate(decode(raw, source=source).split("\n"), 1)]
    delimiter = "," if any(line.startswith("Separator,Comma") for _, line in lines[:40]) else "\t"
    about, segments, special = _segments(lines, delimiter, source=source)
    layout = Layout(delimiter, comma=about.get("Decimal_Separator", [""])[0].startswith(","))
    across = about.get("X_Columns", ["One"])[0].casefold()
    if across not in ("one", "multi", "no"):
        raise SubmissionError(f"{source}: X_Columns is {across[:20]!r}")
    segments = [one for one in segments if one.rows]
    if not segments:
        raise SubmissionError(f"{source}: holds no rows of numbers")
    first, *others = [
        _read(one, layout, has_times=across != "no", source=source) for one in segments
    ]
    return [replace(first, notes=(*first.notes, *special)), *others]


def _segments(
    lines: Sequence[tuple[int, str]], delimiter: str, *, source: str
) -> tuple[dict[str, list[str]], list[_Segment], list[str]]:
    """Return the tags of the file, its segments, and a note on special blocks.

    Rows without a header of their own belong to the segment before.

    Raises
    ------
    SubmissionError : a header or a special block has no end.
    """
    about: dict[str, list[str]] | None = None
    segments: list[_Segment] = []
    special: list[str] = []
    tags: dict[str, list[str]] = {}
    part, begin, block, last = "header", 1, 0, 0
    for number, line in lines:
        fields = [one.strip() for one in line.split(delimiter)]
        if block or line.startswith(_SPECIAL):
            special = ["a special block of LabVIEW is not read"]
            block = 0 if line.startswith(_END_OF_SPECIAL) else block or number
        elif not any(fields):
            continue
        # A line directly after a row is a row, because an empty line comes before every header.
        elif part == "rows" and (last == number - 1 or re.match(r"[-+.\d]|$", fields[0])):
            segments[-1].rows.append((number, line))
            last = number
        elif part == "names":
            segments.append(_Segment(tags=tags, names=fields, line=number))
            part = "rows"
        elif fields[0] == _END:
            part, about = ("header", tags) if about is None else ("names", about)
            begin, tags = (number + 1, {}) if part == "header" else (begin, tags)
        else:
            if part == "rows":
                part, begin, tags = "header", number, {}
            tags[fields[0]] = fields[1:] or [""]
    if block or part == "header":
        what, end = ("special block", _END_OF_SPECIAL) if block else ("header", _END)
        raise SubmissionError(
            f"{source} line {block or begin}: the {what} that begins here has no {end}; "
            "the file was cut short or edited"
        )
    if part == "names":
        raise SubmissionError(f"{source}: ends after the header of a segment")
    return about or {}, segments, special


def _read(segment: _Segment, layout: Layout, *, has_times: bool, source: str) -> FileTable:
    """Return the table of one segment; comments and channels without values are left out."""
    names = segment.names[: len(segment.names) - (segment.names[-1].casefold() == "comment")]
    while names and not names[-1]:
        names = names[:-1]
    clocks = [i for i, name in enumerate(names) if name == "X_Value"]
    used = [i for i in range(len(names)) if i not in clocks[has_times:]]
    if len(used) <= has_times:
        raise SubmissionError(f"{source} line {segment.line}: names no channel")
    rows, notes = [], list[str]()
    for number, line in segment.rows:
        fields = line.split(str(layout.delimiter))
        if any(one.strip() for one in fields[len(names) :]):
            notes = ["comments beside the rows are not read"]
        fields = fields[: len(names)]
        is_full = len(fields) == len(names)
        if is_full and has_times and len({fields[i] for i in clocks}) > 1:
            place = number if number > segment.line + 1 else segment.line
            raise SubmissionError(
                f"{source} line {place}: the channels were sampled at different times; save them "
                "with X_Columns One"
            )
        rows.append((number, "\x01".join([fields[i] for i in used] if is_full else fields[:-1])))
    block = Block(
        head=[(segment.line, "")],
        rows=rows,
        layout=Layout("\x01", comma=layout.comma),
        source=source,
    )
    table = read_block(block, format=_LVM, names=_headings(segment, [names[i] for i in used]))
    most = max((int(n) for n in segment.tags.get("Samples", []) if n.isdecimal()), default=0)
    complete = len(rows) - (rows[-1][1].count("\x01") != len(used) - 1)
    if complete < most:
        cut = f"line {rows[-1][0]}: {complete:,} of {most:,} samples"
        table = replace(table, cut=cut)
    # All numbers have a decimal mark, whole or not.
    n = len(table.names)
    table = replace(table, notes=(*table.notes, *notes), whole=(False,) * n)
    if has_times or not (interval := segment.stated("Delta_X", layout, source=source)):
        return table
    start = segment.stated("X0", layout, source=source)
    times = even_times(table.values.shape[1], start=start, interval=interval)
    values = np.vstack([times, table.values])
    return replace(table, names=("time", *table.names), values=values, whole=(False,) * (n + 1))


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


def is_tdms(raw: bytes) -> bool:
    """Return whether a file begins with the tag of a .tdms segment."""
    return raw.startswith(b"TDSm")


def read_tdms(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the channels of each group that holds a recording; a short channel holds settings.

    Raises
    ------
    SubmissionError : the file is broken or truncated, or holds no recording.
    """
    _refuse_cut(raw, source=source)
    channels = _read_channels(raw, source=source)
    signals = [one for one in channels if one.values is not None and one.samples > 1]
    if not signals:
        found = first_few([f"{one.group}/{one.name}" for one in channels], MOST_NAMED)
        raise SubmissionError(f"{source}: holds no channel of numbers, but {found or 'nothing'}")
    longest = max(one.samples for one in signals)
    groups: dict[str, list[Signal]] = {}
    for one in signals:
        if one.samples > SETTING * longest:
            groups.setdefault(one.group, []).append(one)
    advice = "if it is a signal, write it as numbers"
    variables = [
        replace(one, name=f"{one.group}/{one.name}").entry(
            read=one in groups.get(one.group, ()),
            advice=advice if one.values is None and one.samples >= longest else "",
        )
        for one in channels
    ]
    return [
        _table(group, read, variables=variables, source=source) for group, read in groups.items()
    ]


def _table(
    group: str, read: Sequence[Signal], *, variables: Sequence[Variable], source: str
) -> FileTable:
    """Return the channels of a group, with the time that they state.

    Raises
    ------
    SubmissionError : the channels differ in length, or state different times.
    """
    if len({one.samples for one in read}) > 1:
        sizes = first_few([f"{one.name} ({one.samples:,})" for one in read], MOST_NAMED)
        raise SubmissionError(f"{source}: the channels differ in length: {sizes}")
    clocks = {(one.interval, one.start) for one in read if one.interval > 0}
    names = [join_unit(one.name, one.unit) for one in read]
    columns = [one.numbers[:, 0] for one in read]
    if not any(is_time(one.name) for one in read):
        if len(clocks) > 1:
            shown = first_few([f"{interval:g} s" for interval, _ in sorted(clocks)], MOST_NAMED)
            raise SubmissionError(
                f"{source}: the channels were sampled at different times (wf_increment {shown}); "
                "keep those of one rate"
            )
        for interval, start in clocks:
            names.insert(0, "time")
            columns.insert(0, even_times(read[0].samples, start=start, interval=interval))
    return binary_table(
        columns,
        names=checked_names(names, place=f"{source} group {group!r}"),
        source=source,
        format=_TDMS,
        run=group,
        variables=variables,
        notes=not_read(variables),
    )


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
        # This flag of a segment means big-endian.
        order = ">" if raw[at + 4] & 0x40 else "<"
        (length,) = struct.unpack_from(f"{order}Q", raw, at + 12)
        end = at + _LEAD_IN + length
        if end > len(raw):  # also true if LabVIEW never wrote the length
            raise SubmissionError(
                f"{source}: the segment at byte {at:,} is not whole: the file was cut short, or "
                "copied while LabVIEW was writing it"
            )
        at = end


def _read_channels(raw: bytes, *, source: str) -> list[Signal]:
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


def _channel(one: "TdmsChannel") -> Signal:
    values, unit = np.asarray(one[:]), str(one.properties.get("unit_string", ""))
    kind = str(one.dtype)
    if values.dtype.kind == "M":
        kind, unit = "times", "s"
        values = (values - values[:1]) / np.timedelta64(1, "s")
    is_number = values.dtype.kind in "biuf" and values.ndim == 1
    interval, start = (
        float(value) if isinstance(value, float | int | np.number) and np.isfinite(value) else 0.0
        for value in map(one.properties.get, ("wf_increment", "wf_start_offset"))
    )
    return Signal(
        group=printable(one.group_name),
        name=printable(one.name),
        kind=kind if is_number else "no numbers",
        size=(values.size, 1),
        values=values.astype(np.float64)[:, None] if is_number else None,
        unit=printable(unit),
        interval=interval,
        start=start,
    )


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
