"""Read a recording from an Excel workbook: the first sheet with headings above numbers."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import FileTable, refuse_unusable
from pipeline.ingest.formats.text import checked_names, is_bench_log, with_units
from pipeline.ingest.formats.workbook_cells import Book, Cells
from pipeline.words.numbers import first_few

# Share of the longest column. Shorter columns and tables are settings, like shorter vectors of a
# .mat file.
_SETTING = 0.1
_MOST_NAMED = 8
_PARTS = (b"[Content_Types].xml", b"docProps/", b"xl/")  # one of these occurs early in the archive
_DAY = 86_400.0  # s
_NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?")
_UNIT_OF_HEADING = re.compile(r"(?<!\s)\s*[\[(][^\[\]()]*[\])]\s*$")


def is_workbook(raw: bytes) -> bool:
    """Return whether an archive is an Office document, even if it is truncated."""
    return raw.startswith(b"PK\x03\x04") and any(part in raw for part in _PARTS)


def read_workbook(raw: bytes, *, source: str) -> FileTable:
    """Read the table of the first sheet that has one.

    Raises
    ------
    SubmissionError : the file is broken or has no headings, or a cell is not a number; the message
        names the cell.
    """
    book = Book(raw, source=source)
    for name in book.sheets:
        sheet = _Sheet(book.cells(name), book.formats, source=source, name=name)
        if (block := sheet.longest_block()) is not None:
            others = [other for other in book.sheets if other != name and book.has_cells(other)]
            return sheet.read(block, notes=_not_read(others))
    names = first_few([repr(name) for name in book.sheets], _MOST_NAMED) or "none"
    raise SubmissionError(
        f"{source}: no sheet has a row of headings (such as time, input, x1) above rows of "
        f"numbers; the sheets: {names}"
    )


def _not_read(sheets: Sequence[str]) -> list[str]:
    if not sheets:
        return []
    shown = first_few([repr(name) for name in sheets], _MOST_NAMED)
    return [f"not read: the sheets {shown}; save each recording in a separate workbook"]


@dataclass(frozen=True, kw_only=True)
class _Block:
    """A table in a sheet, given by its rows.

    Attributes
    ----------
    heading : the row of the headings.
    units : row below the headings that holds units; zero if there is no such row.
    rows : the rows of numbers, between the headings and `end`.
    end : row of the next headings; it is not included.
    """

    heading: int
    units: int
    rows: NDArray[np.int64]
    end: int


class _Sheet:
    """The cells of a sheet, sorted into numbers (even if stored as text), texts, and others."""

    def __init__(self, cells: Cells, formats: Sequence[str], *, source: str, name: str) -> None:
        self._source, self._where = source, f"{source} sheet {name!r}"
        self._merged, self._wrong = cells.merged, cells.wrong
        self._typed = {at: text for at, text in cells.texts.items() if _NUMBER.fullmatch(text)}
        self._texts = {at: text for at, text in cells.texts.items() if at not in self._typed}
        places = np.array(list(self._typed), dtype=np.int64).reshape(-1, 2)
        numbers = [float(text.replace(",", ".")) for text in self._typed.values()]
        self._rows = np.r_[np.array(cells.rows, dtype=np.int64), places[:, 0]]
        self._columns = np.r_[np.array(cells.columns, dtype=np.int64), places[:, 1]]
        self._values = np.r_[np.array(cells.values), numbers]
        known = np.array([*formats, ""])  # the last entry is for a format that is not listed
        numbered = np.array(cells.formats, dtype=np.int64)
        numbered[(numbered < 0) | (numbered >= len(formats))] = len(formats)
        self._formats = np.r_[known[numbered], np.full(len(numbers), "")]
        self._is_typed = np.arange(self._rows.size) >= numbered.size
        order = np.lexsort((self._columns, self._rows))
        self._rows, self._columns = self._rows[order], self._columns[order]
        self._values, self._formats = self._values[order], self._formats[order]
        self._is_typed = self._is_typed[order]

    # ---------------------------------------------------------------- finding the table

    def longest_block(self) -> _Block | None:
        """Return the longest table below a row of headings; None if there is no table.

        Raises
        ------
        SubmissionError : two tables have about the same length.
        """
        blocks = self._blocks()
        if not blocks:
            return None
        longest = max(blocks, key=lambda block: block.rows.size)
        alike = [block for block in blocks if block.rows.size > _SETTING * longest.rows.size]
        if len(alike) > 1:
            rows = first_few([str(block.heading) for block in alike], _MOST_NAMED)
            raise SubmissionError(
                f"{self._where}: holds several tables, with headings in the rows {rows}; keep one"
            )
        return longest

    def _blocks(self) -> list[_Block]:
        """Return the tables: each has a row of headings, perhaps a row of units, then numbers."""
        texts: dict[int, set[int]] = {}
        for row, column in self._texts:
            texts.setdefault(row, set()).add(column)
        numbers = np.unique(self._rows)
        numeric = set(numbers.tolist())
        filled = sorted(numeric | texts.keys() | {row for row, _ in self._wrong})
        below = dict(pairwise(filled))
        headings: dict[int, int] = {}
        units = 0
        for row in filled:
            if row not in texts or row in numeric or row == units:
                continue
            after = below.get(row, 0)
            units = after if after not in numeric and self._has_units(after, texts, row) else 0
            after = below.get(units, 0) if units else after
            if after in numeric and self._names_half(row, after):
                headings[row] = units
        ends = [*list(headings)[1:], filled[-1] + 1] if headings else []
        return [
            _Block(
                heading=row,
                units=units,
                rows=numbers[slice(*np.searchsorted(numbers, [row, end]))],
                end=end,
            )
            for (row, units), end in zip(headings.items(), ends, strict=True)
        ]

    def _names_half(self, row: int, numbers: int) -> bool:
        """Return whether a row names at least half of the columns, unlike a remark."""
        columns = self._columns[slice(*np.searchsorted(self._rows, [numbers, numbers + 1]))]
        named = sum(bool(self._text(row, column)) for column in columns.tolist())
        return 2 * named >= columns.size

    def _text(self, row: int, column: int) -> str:
        """Return the text of a cell, or of the merged cell that it belongs to."""
        at = row, column
        return self._texts.get(at) or self._texts.get(self._merged.get(at, at), "")

    def _has_units(self, row: int, texts: Mapping[int, set[int]], heading: int) -> bool:
        columns = sorted(texts.get(row, ()))
        names = [self._texts.get((heading, column), "") for column in columns]
        units = [self._texts[row, column] for column in columns]
        return bool(columns) and all(names) and with_units(names, units) is not None

    # ------------------------------------------------------------------ reading the table

    def read(self, block: _Block, *, notes: list[str]) -> FileTable:
        """Return the columns of a table; a column much shorter than the longest is not read."""
        inside = (self._rows > block.heading) & (self._rows < block.end)
        wrong = [at for at in self._wrong if block.heading < at[0] < block.end]
        held = np.r_[self._columns[inside], np.array([c for _, c in wrong], dtype=np.int64)]
        columns, counts = np.unique(held, return_counts=True)
        used = columns[counts > _SETTING * counts.max()].tolist()
        names = checked_names(
            [self._heading(block, column) for column in used],
            place=f"{self._where} row {block.heading}",
        )
        inside &= np.isin(self._columns, used)
        first, last = block.rows[0], block.rows[-1]
        texts = [at for at in self._texts if first < at[0] < last]  # _refuse_gaps refuses these
        stray = [row for row, column in (*wrong, *texts) if column in used]
        rows = np.unique(np.r_[self._rows[inside], np.array(stray, dtype=np.int64)])
        notes = [*self._left_out(block, used), *self._typed_numbers(inside), *notes]
        mine = [np.flatnonzero(inside & (self._columns == column)) for column in used]
        for column, name, cells in zip(used, names, mine, strict=True):
            self._refuse_gaps(rows, self._rows[cells], column=column, name=name)
        values, whole = np.empty((len(used), rows.size)), []
        for i, (column, cells) in enumerate(zip(used, mine, strict=True)):
            times, note = self._times(cells, column=column, name=names[i])
            if note and times is None:
                notes.append(note)
            values[i] = self._values[cells] if times is None else times
            whole.append(times is None and bool((values[i] == np.round(values[i])).all()))
            if times is not None:
                notes.append(note)
                names[i] = f"{_UNIT_OF_HEADING.sub('', names[i])} [s]"
        refuse_unusable(values, names=names, place=lambda row: f"{self._where} row {rows[row]}")
        return FileTable(
            source=self._source,
            form="bench_log" if is_bench_log(names) else "workbook",
            names=tuple(names),
            values=values,
            whole=tuple(whole),
            lines=rows,
            lines_are="row",
            notes=tuple(notes),
        )

    def _heading(self, block: _Block, column: int) -> str:
        """Return the text above a column, perhaps from a merged cell, with the unit below it."""
        name = self._text(block.heading, column)
        unit = self._texts.get((block.units, column), "")
        united = with_units([name], [unit]) if unit else None
        return united[0] if united else name

    def _refuse_gaps(
        self, rows: NDArray[np.int64], own: NDArray[np.int64], *, column: int, name: str
    ) -> None:
        """Refuse a column if a cell holds no number, or is in the file twice."""
        if (doubled := np.flatnonzero(np.diff(own) == 0)).size:
            cell = _cell(int(own[doubled[0]]), column)
            raise SubmissionError(f"{self._where} cell {cell}: the file has it twice")
        if own.size == rows.size:
            return
        at = int(np.setdiff1d(rows, own)[0]), column
        text = self._texts.get(at)
        what = self._wrong.get(at) or (f"not a number: {text[:30]!r}" if text else "empty")
        raise SubmissionError(f"{self._where} cell {_cell(*at)}: {name!r} is {what}")

    def _times(
        self, cells: NDArray[np.int64], *, column: int, name: str
    ) -> tuple[Array | None, str]:
        """Return dates or times of day in seconds, with a note; None for other numbers.

        A spreadsheet stores dates and times in days. A single date among numbers is an error: the
        spreadsheet has turned a number such as 1.5 into a date.
        """
        formats, values = self._formats[cells], self._values[cells]
        is_time = (formats == "date") | (formats == "time")
        if not is_time.any():
            note = f"{name!r} is shown in percent, but its stored value is used: 0.5 for 50 %"
            return None, note if (formats == "percent").any() else ""
        if not is_time.all():
            at = int(self._rows[cells[np.argmax(is_time)]]), column
            raise SubmissionError(
                f"{self._where} cell {_cell(*at)}: {name!r} is a date or a time among numbers; "
                "spreadsheet programs turn numbers such as 1.5 into dates: import the recording "
                "again with its columns as text, or with the other decimal mark"
            )
        start = values[0] if (formats == "date").any() else 0.0
        what = "dates" if start else "times of day"
        # Rounded to 1e-5 s, because doubles and files keep a date to 1e-11 days.
        times = np.round(_DAY * (values - start), 5)
        return times, f"{name!r}: {what} were converted to seconds"

    # -------------------------------------------------------------------------------- notes

    def _typed_numbers(self, inside: NDArray[np.bool_]) -> list[str]:
        """Return a note on numbers that were typed as text."""
        typed = np.flatnonzero(inside & self._is_typed)
        places = zip(self._rows[typed].tolist(), self._columns[typed].tolist(), strict=True)
        read = [self._typed[place] for place in places]
        if not read:
            return []
        comma = next((text for text in read if "," in text), None)
        mark = f"; the comma in {comma[:30]!r} is taken as a decimal mark" if comma else ""
        return [f"{len(read)} numbers that are stored as text were read{mark}"]

    def _left_out(self, block: _Block, used: Sequence[int]) -> list[str]:
        """Return a note on rows and columns of the sheet that are not in the table."""
        texts = np.array([*self._texts, *self._wrong], dtype=np.int64).reshape(-1, 2)
        rows, columns = np.r_[self._rows, texts[:, 0]], np.r_[self._columns, texts[:, 1]]
        inside = (rows >= block.heading) & (rows < block.end)
        own = np.isin(rows, np.r_[block.heading, block.units, block.rows])
        outside = np.unique(rows[~inside | ~own]).tolist()
        beside = np.unique(columns[inside & own & ~np.isin(columns, used)]).tolist()
        said = [
            f"{what}{'s' if len(held) > 1 else ''} {first_few(held, _MOST_NAMED)}"
            for what, held in (("row", [*map(str, outside)]), ("column", [*map(_letters, beside)]))
            if held
        ]
        return [f"not read: {' and '.join(said)} of the sheet"] if said else []


def _cell(row: int, column: int) -> str:
    return f"{_letters(column)}{row}"


def _letters(column: int) -> str:
    """Return a column's letters, such as "AB" for 28."""
    letters = ""
    while column:
        column, rest = divmod(column - 1, 26)
        letters = chr(65 + rest) + letters
    return letters
