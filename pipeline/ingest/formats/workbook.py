"""Read recordings from an Excel workbook: every sheet with headings above numbers."""

import datetime as dt
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BytesIO

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import FileTable
from pipeline.ingest.formats.text import Layout, find_blocks, is_bench_log, read_runs
from pipeline.words.numbers import first_few

_PARTS = (b"[Content_Types].xml", b"docProps/", b"xl/")  # one of these occurs early in the archive
_MOST_BYTES = 200_000_000  # of all parts, unpacked
_MOST_PARTS = 1_000
_SETTING = 0.1  # share of the longest; shorter columns and tables are settings
_MOST_NAMED = 8
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_BOUND = 2**14  # columns of a sheet


def is_workbook(raw: bytes) -> bool:
    """Return whether an archive is an Office document, even if it is truncated."""
    return raw.startswith(b"PK\x03\x04") and any(part in raw for part in _PARTS)


def read_workbook(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the table of each sheet that has one.

    Raises
    ------
    SubmissionError : the file is broken or has no headings, or too many cells are not numbers; the
        message names the row.
    """
    _check_archive(raw, source=source)
    tables, sheets = [], []
    for name, rows in _sheets(raw, source=source):
        sheets.append(name)
        if lines := _lines(rows):
            tables += _read_sheet(name, lines, source=source)
    if not tables:
        names = first_few([repr(name) for name in sheets], _MOST_NAMED) or "none"
        raise SubmissionError(
            f"{source}: no sheet has a row of headings (such as time, input, x1) above rows of "
            f"numbers; the sheets: {names}"
        )
    longest = max(table.values.shape[1] for table in tables)
    return [table for table in tables if table.values.shape[1] > _SETTING * longest]


def _check_archive(raw: bytes, *, source: str) -> None:
    """Refuse an archive that is broken, locked, or larger than any recording when unpacked."""
    try:
        with zipfile.ZipFile(BytesIO(raw)) as archive:
            parts = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        parts = []
    if any(part.flag_bits & 1 for part in parts):
        raise SubmissionError(f"{source}: the workbook is locked by a password; save it without")
    if not parts or len(parts) > _MOST_PARTS or sum(p.file_size for p in parts) > _MOST_BYTES:
        raise SubmissionError(
            f"{source}: the workbook is broken, cut short or larger than a recording; save it again"
        )


def _sheets(raw: bytes, *, source: str) -> Iterator[tuple[str, list[tuple[object, ...]]]]:
    """Yield the name and the rows of each sheet."""
    import openpyxl

    try:
        book = openpyxl.load_workbook(BytesIO(raw), read_only=True, data_only=True)
        for sheet in book.worksheets:
            sheet.reset_dimensions()  # the stated size need not be true
            yield sheet.title, list(sheet.iter_rows(values_only=True))
    except SubmissionError:
        raise
    except Exception:  # openpyxl raises many kinds of errors
        raise SubmissionError(
            f"{source}: the workbook is broken, cut short or larger than a recording; save it again"
        ) from None


def _lines(rows: Sequence[tuple[object, ...]]) -> list[tuple[int, str]]:
    """Return the rows of a sheet as lines, without empty rows and columns of a few cells."""
    counts: dict[int, int] = {}
    for row in rows:
        for i, value in enumerate(row[:_BOUND]):
            if value is not None and _is_number(value):
                counts[i] = counts.get(i, 0) + 1
    most = max(counts.values(), default=0)
    used = [i for i, count in sorted(counts.items()) if count > _SETTING * most]
    lines = []
    for number, row in enumerate(rows, start=1):
        fields = [_text(row[i]) if i < len(row) else "" for i in used]
        if any(fields):
            lines.append((number, "\x01".join(fields)))
    return lines


def _is_number(value: object) -> bool:
    if isinstance(value, str):
        return value.strip()[:1] in tuple("0123456789+-.,")
    return not isinstance(value, bool)


def _text(value: object) -> str:
    """Return the content of a cell as a text file would show it."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, dt.timedelta):
        return repr(value.total_seconds())
    if isinstance(value, dt.datetime | dt.time):
        return value.isoformat(" ") if isinstance(value, dt.datetime) else value.isoformat()
    if isinstance(value, str):
        text = " ".join(value.split())
        return text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text
    return repr(value)


def _read_sheet(name: str, lines: Sequence[tuple[int, str]], *, source: str) -> list[FileTable]:
    """Return the tables of a sheet; no tables without headings."""
    layout = Layout("\x01", comma=False)
    where = f"{source} sheet {name!r}"
    tables = []
    for block in find_blocks(lines, layout, source=where, line="row"):
        for table in read_runs(block, layout, form="workbook"):
            if any(not heading.isdigit() for heading in table.names):
                form = "bench_log" if is_bench_log(table.names) else "workbook"
                run = f"{name} {table.run}".strip() if table.run else name
                tables.append(replace(table, form=form, source=source, run=run))
    return tables
