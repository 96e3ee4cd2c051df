"""Read recordings from an Excel workbook: every sheet with headings above numbers."""

import datetime as dt
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from typing import Any

from pipeline.errors import SubmissionError
from pipeline.ingest.table import MOST_NAMED, SETTING, FileTable, Format
from pipeline.ingest.text import Layout, read_blocks
from pipeline.words.numbers import first_few

_FORMAT = Format(title="Excel workbook")
_PARTS = (b"[Content_Types].xml", b"docProps/", b"xl/")  # one of these occurs early in the archive
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(e[-+]?\d+)?", re.IGNORECASE)
_FORMULA = re.compile(rb"<(?:\w+:)?f[ >]")


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
    tables, sheets = [], []
    for name, rows, notes in _sheets(raw, source=source):
        sheets.append(name)
        if lines := _lines(rows, notes, where=f"{source} sheet {name!r}"):
            found = _read_sheet(name, lines, source=source)
            tables += [replace(one, notes=(*one.notes, *notes)) for one in found]
    if not tables:
        names = first_few([repr(name) for name in sheets], MOST_NAMED) or "none"
        raise SubmissionError(
            f"{source}: no sheet has a row of headings (such as time, input, x1) above rows of "
            f"numbers; the sheets: {names}"
        )
    longest = max(table.values.shape[1] for table in tables)
    return [table for table in tables if table.values.shape[1] > SETTING * longest]


def _has_formulas(raw: bytes, *, source: str) -> bool:
    """Return whether a workbook has formulas.

    Raises
    ------
    SubmissionError : the archive is no workbook.
    """
    with zipfile.ZipFile(BytesIO(raw)) as archive:
        parts = archive.infolist()
        if parts and not any(part.filename.startswith("xl/") for part in parts):
            raise SubmissionError(f"{source}: an Office document, but not an Excel workbook")
        sheets = [p for p in parts if p.filename.startswith("xl/worksheets/")]
        return any(_FORMULA.search(archive.read(sheet)) for sheet in sheets)


def _sheets(
    raw: bytes, *, source: str
) -> Iterator[tuple[str, list[tuple[object, ...]], list[str]]]:
    """Yield the name, the rows and notes of each sheet.

    Raises
    ------
    SubmissionError : the workbook is broken, or none.
    """
    import openpyxl

    def load(*, data_only: bool) -> Any:
        return openpyxl.load_workbook(BytesIO(raw), read_only=True, data_only=data_only)

    try:
        formulas = load(data_only=False) if _has_formulas(raw, source=source) else None
        for sheet in load(data_only=True).worksheets:
            sheet.reset_dimensions()  # the stated size need not be true
            rows = list(sheet.iter_rows(values_only=True))
            if formulas is not None:
                other = formulas[sheet.title]
                other.reset_dimensions()
                for i, row in enumerate(other.iter_rows(values_only=True)):
                    if any(isinstance(value, str) and value[:1] == "=" for value in row):
                        pairs = zip(rows[i], row, strict=True)
                        rows[i] = tuple(
                            _Formula(b) if a is None and b is not None else a for a, b in pairs
                        )
            # Forty rows show how the numbers of a column are formatted.
            percent = {
                cell.column_letter
                for row in sheet.iter_rows(max_row=40)
                for cell in row
                if cell.value is not None and str(cell.number_format).endswith("%")
            }
            notes = [
                f"column {letter} is shown in percent, but its stored value is used: 0.5 for 50 %"
                for letter in sorted(percent)
            ]
            yield sheet.title, rows, notes
    except (SubmissionError, MemoryError):
        raise
    except Exception:  # zipfile and openpyxl raise many kinds of errors
        raise SubmissionError(
            f"{source}: the workbook is broken or cut short; save it again"
        ) from None


class _Formula(str):
    """A formula without the value that a spreadsheet program computes for it."""

    __slots__ = ()


def _lines(
    rows: Sequence[tuple[object, ...]], notes: list[str], *, where: str
) -> list[tuple[int, str]]:
    """Return the rows of a sheet as lines, without empty rows and columns of a few cells.

    Raises
    ------
    SubmissionError : a column of numbers has a formula without a value.
    """
    counts: dict[int, int] = {}
    for row in rows:
        for i, value in enumerate(row):
            if value is not None and _is_number(value):
                counts[i] = counts.get(i, 0) + 1
    most = max(counts.values(), default=0)
    used = [i for i, count in sorted(counts.items()) if count > SETTING * most]
    lines = []
    for number, row in enumerate(rows, start=1):
        cells = [row[i] if i < len(row) else None for i in used]
        if any(isinstance(cell, _Formula) for cell in cells):
            raise SubmissionError(
                f"{where} row {number}: a formula without its value: open the workbook in Excel "
                "or LibreOffice, and save it"
            )
        fields = [_text(cell) for cell in cells]
        if any(fields):
            lines.append((number, "\x01".join(fields)))
    commas = (cell for row in rows for cell in row if isinstance(cell, str) and _is_comma(cell))
    if (example := next(commas, None)) is not None:
        notes.append(f"the comma in {example.strip()!r} is taken as a decimal mark")
    return lines


def _is_comma(text: str) -> bool:
    return _DECIMAL_COMMA.fullmatch(text.strip()) is not None


def _is_number(value: object) -> bool:
    if isinstance(value, _Formula):
        return True
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
        return text.replace(",", ".") if _is_comma(text) else text
    return repr(value)


def _read_sheet(name: str, lines: Sequence[tuple[int, str]], *, source: str) -> list[FileTable]:
    """Return the tables of a sheet; no tables without headings."""
    where, layout = f"{source} sheet {name!r}", Layout("\x01", comma=False)
    found = read_blocks(lines, layout, source=where, format=_FORMAT, line="row")
    return [
        replace(table, source=source, run=f"{name} {table.run}".strip())
        for table in found
        if not all(heading.isdigit() for heading in table.names)
    ]
