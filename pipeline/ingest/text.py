"""Read tables from text: CSV in any dialect, ECP exports, bench logs, exports of oscilloscopes.

The first long block of similar lines is the table. The last line of text above it has the headings.
Another heading with another block begins another run.
"""

import csv
import datetime as dt
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from operator import methodcaller

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import are_units, is_time, join_unit, parse_heading
from pipeline.ingest.table import (
    BENCH_LOG,
    FEW_NAMED,
    FileTable,
    Format,
    Note,
    checked_names,
    refuse_unusable,
)
from pipeline.words.numbers import first_few

CSV = Format(title="table of text (CSV)")
ECP = Format(title='ECP "Export Raw Data" text', positions="count")
_FEW_LINES, _SNIFFED_LINES = 40, 400
_LONG = 8  # similar rows that begin a table; a shorter table must be alone in its file
_BEST = 1.5 * _LONG  # score of a layout in which every field is a plain number
_WORST = 0.01  # largest share of rows that may be skipped
# The names in an ECP heading consist of words with single spaces between them.
_HEADING_WORDS = re.compile(
    r"encoder\s*\d+\s+(?:pos|vel|acc)\w*|commanded\s+\w+|control\s+effort|"
    r"[^\s,;\[(]+(?: ?[\[(][^\[\]()]{0,20}[\])])?",
    re.IGNORECASE,
)
# The bracket before the rows of a matrix; text in brackets in one line is a remark or a unit.
_OPENING = re.compile(r"^[^\S\n]*(?:[A-Za-z]\w*\s*=\s*)?\[(?![^\n;\]]+\])", re.MULTILINE)
_MISSING = frozenset({"", "-", "--", "nan", "na", "n/a", "null", "none", "#n/a", "inf", "-inf"})
_TIME_OF_DAY = re.compile(
    r"(?:(\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[./-]\d\d?[./-]\d{4})[T ,]+)?"
    r"(\d\d?):(\d\d)(?::(\d\d(?:[.,:]\d+)?))?(Z| ?[AaPp][Mm])?"
)
_THOUSANDS = {
    ".": re.compile(r"[-+]?[1-9]\d{0,2}(?:[, '’\u00a0\u202f]\d{3})+(?:\.\d*)?"),
    ",": re.compile(r"[-+]?[1-9]\d{0,2}(?:[. '’\u00a0\u202f]\d{3})+(?:,\d*)?"),
}
_FIRST_DAY = dt.date(1900, 1, 1)
_FORTRAN = re.compile(r"([-+]?[\d.]+)[dD]([-+]?\d+)")


def read_text(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the tables of a text file, one for each run.

    Raises
    ------
    SubmissionError : the file is not text or not a table, or too many rows do not fit; the message
        names the line.
    """
    text = decode(raw, source=source)
    if not text.strip().strip(' \t\n;,"'):
        raise SubmissionError(f"{source}: the file is empty")
    if "[" in text and (opening := _OPENING.search(text)):
        block, end = _in_brackets(text, opening, source)
        return [read_block(block, format=ECP, names=find_names(block), cut=end)]
    lines = [(i, line) for i, line in enumerate(text.split("\n"), 1) if line.strip(' \t;,"')]
    sample = [line for _, line in lines[:_SNIFFED_LINES]]
    layout = _sniff(sample[:_FEW_LINES], least=_LONG) or _sniff(sample)
    if layout is None:
        raise SubmissionError(_no_table(lines, source))
    return read_blocks(lines, layout, source=source, format=CSV)


def decode(raw: bytes, *, source: str) -> str:
    """Return the text of a file in UTF-8, UTF-16 or an old Windows encoding; LF ends its lines.

    Raises
    ------
    SubmissionError : the file is not text.
    """
    is_utf16 = raw.startswith((b"\xff\xfe", b"\xfe\xff"))  # Excel's "Unicode text"
    if not is_utf16 and (b"\0" in raw or re.search(rb"[\1-\x08\x0e\x0f\x1b]", raw[:4096])):
        raise SubmissionError(f"{source}: neither text nor a .mat file that can be read")
    try:
        text = raw.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        if is_utf16:
            raise SubmissionError(f"{source}: broken UTF-16 text") from None
        text = raw.decode("latin-1")  # such as a micro sign from an old Windows program
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _no_table(lines: Sequence[tuple[int, str]], source: str) -> str:
    """Return why a text is refused: the last line, if it has headings, or else the second one."""
    if all(line.lstrip().startswith(("#", "%", "sep=")) for _, line in lines):
        return f"{source}: holds no rows of numbers"
    number, line = lines[-1]
    words = re.split(r"[,;\t]", line[:300])
    if len(words) > 1 and is_time(words[0]):
        return f"{source} line {number}: headings, but no rows of numbers below"
    number, line = lines[min(1, len(lines) - 1)]
    return f"{source} line {number}: not a table of numbers, found {line.strip()[:40]!r}"


# ---------------------------------------------------------------------------------- one cell


@dataclass(frozen=True)
class Layout:
    """How lines are split; `delimiter` None means any white space, `comma` a decimal comma."""

    delimiter: str | None
    comma: bool
    quoted: bool = False

    def split(self, line: str) -> list[str]:
        """Return the fields of one line."""
        if self.delimiter is None:
            return line.split()
        if self.quoted:
            try:
                return next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True), [])
            except csv.Error:
                return []
        return line.split(self.delimiter)

    @property
    def fast(self) -> Callable[[str], Iterable[str]]:
        """The function that splits a row of plain numbers."""
        if self.comma:
            return lambda row: [field.replace(",", ".") for field in self.split(row)]
        if self.delimiter is None or self.quoted:
            return self.split
        return methodcaller("split", self.delimiter)  # white space around a number does no harm

    def cell(self, field: str) -> float:
        """Return the number in a field; NaN for an empty field.

        Raises
        ------
        ValueError : the field holds text.
        """
        try:
            return float(field.replace(",", ".") if self.comma else field)
        except ValueError:
            plain = field.strip(" \t\"'").replace("\u2212", "-")
        if plain.casefold() in _MISSING:
            return np.nan
        if _THOUSANDS["," if self.comma else "."].fullmatch(plain):
            plain = re.sub(r"[^\d+\-,.]" + (r"|\." if self.comma else "|,"), "", plain)
        if match := _FORTRAN.fullmatch(plain.replace(",", ".")):
            plain = f"{match[1]}e{match[2]}"
        return float(plain.replace(",", ".") if self.comma else plain)

    def value(self, field: str) -> float | None:
        """Return the number or the time of day in a field, NaN for an empty one, None for text."""
        try:
            return self.cell(field)
        except ValueError:
            return _time_of_day(field)

    def signature(self, line: str) -> str:
        """Return a letter a field: n number, - empty, x text; "" for a comment."""
        if line.lstrip().startswith(("#", "%")):
            return ""
        try:
            values: list[float | None] = list(map(float, self.fast(line)))
        except ValueError:
            values = [self.value(field) for field in self.split(line)]
        return "".join("x" if v is None else "-" if v != v else "n" for v in values)


def _time_of_day(field: str) -> float | None:
    """Return the seconds of a time of day, from midnight or, with a date, from 1900."""
    if ":" not in field or not (match := _TIME_OF_DAY.fullmatch(field.strip(" \"'"))):
        return None
    date, hour, minute, second, half = match.groups()
    half = (half or "").strip().casefold()
    if second is None and half in ("", "z"):
        return None
    seconds = float((second or "0").replace(",", ".").replace(":", "."))
    hours = int(hour) % 12 + 12 * (half == "pm") if half in ("am", "pm") else int(hour)
    seconds += 3600.0 * hours + 60.0 * int(minute)
    if not date:
        return seconds
    numbers = [int(part) for part in re.split(r"[-/.]", date)]
    year, month, day = numbers if numbers[0] > 31 else numbers[::-1]
    try:
        stamp = dt.date(year, month, day) if month <= 12 else dt.date(year, day, month)
    except ValueError:
        return None
    return 86_400.0 * (stamp - _FIRST_DAY).days + seconds


# ------------------------------------------------------------------------------- the layout


def _alike(a: str, b: str) -> bool:
    """Return whether two rows may belong to one table: the same cells hold numbers."""
    same = len(a) == len(b) and "n" in a and "n" in b
    return same and all(p == q or "-" in (p, q) for p, q in zip(a, b, strict=True))


def _start(signatures: Sequence[str]) -> tuple[int, int]:
    """Return (start, length) of the first long run of similar rows, or of the longest.

    A row that does not fit does not end a run, unless it may be a heading.
    """
    best, start = (0, 0), 0
    while start < len(signatures):
        first = signatures[start]
        last, length = start, 1 if "n" in first else 0
        for i in range(start + 1, len(signatures) if length else 0):
            if _alike(first, signatures[i]):
                last, length = i, length + 1
                first = signatures[i] if "-" not in signatures[i] else first
            elif i - last > 3 or ("n" not in signatures[i] and len(signatures[i]) == len(first)):
                break
            if length >= _LONG:
                return start, length
        if length > best[1]:
            best = start, length
        start = last + 1
    return best


def _sniff(sample: Sequence[str], *, least: int = 1) -> Layout | None:
    """Return the layout in which the first long block of rows has most numbers; None without one.

    `least` is the smallest number of its rows.

    Among equally good layouts, the first one is used. So "0,5;1,2" is two numbers with decimal
    commas, and "0,5" is two integers.
    """
    best, most = None, 0.0
    quoted = any('"' in line for line in sample)
    for delimiter in ("\t", ";", ",", "|", None):
        if delimiter and not any(delimiter in line for line in sample):
            continue
        for comma in (False, True) if delimiter != "," or quoted else (False,):
            layout = Layout(delimiter, comma, quoted=quoted and delimiter is not None)
            signatures = [*map(layout.signature, sample)]
            start, length = _start(signatures)
            found = signatures[start : start + length]
            rows = sample[start : start + length]
            plain = sum(_is_plain(field, comma) for row in rows for field in layout.split(row))
            share = plain / max(sum(map(len, found)), 1)
            # A single column counts only if nothing else fits.
            wide = 1.0 if length and len(found[0]) > 1 else 0.3
            numbers = sum(s.count("n") / len(s) for s in found if s)
            score = wide * numbers * (0.5 + share)
            if length >= least and score > 1.001 * most:
                best, most = layout, score
            if most >= _BEST:
                return best
    return best


def _is_plain(field: str, comma: bool) -> bool:
    """Return whether a field is a number without thousands separators, or a time, or empty."""
    plain = field.strip(" \"'")
    if comma and "." in plain and ":" not in plain:
        return False
    try:
        float(plain.replace(",", ".") if comma else plain)
    except ValueError:
        return not plain or _time_of_day(plain) is not None
    return True


# ------------------------------------------------------------------------------- the blocks


@dataclass(frozen=True, kw_only=True)
class Block:
    """The lines of one table with their numbers: those above it, and those from its first row.

    `line` is what the numbers count, such as the rows of a sheet. `values` are the numbers in the
    rows (n, width), if that is all that the rows hold. `notes` are about lines left out.
    """

    head: Sequence[tuple[int, str]]
    rows: Sequence[tuple[int, str]]
    layout: Layout
    source: str
    line: str = "line"
    values: Array | None = None
    notes: tuple[str, ...] = ()

    def place(self, number: int) -> str:
        """Return the file and a line of it, as in "a.csv line 12"."""
        return f"{self.source} {self.line} {number}"


def read_blocks(
    lines: Sequence[tuple[int, str]],
    layout: Layout,
    *,
    source: str,
    format: Format,
    line: str = "line",
) -> list[FileTable]:
    """Return the tables of a file: each begins with similar rows, below its heading.

    Raises
    ------
    SubmissionError : as for `read_block`.
    """
    blocks = _find_blocks(lines, layout, source=source, line=line)
    return [table for block in blocks for table in _read_runs(block, format=format)]


def _find_blocks(
    lines: Sequence[tuple[int, str]], layout: Layout, *, source: str, line: str
) -> Iterator[Block]:
    start, length = _start([layout.signature(line) for _, line in lines[:_FEW_LINES]])
    if length < _LONG:
        start = _start([layout.signature(line) for _, line in lines[:_SNIFFED_LINES]])[0]
    rows = [row for _, row in lines[start:]]
    values = _numbers(rows, layout, len(layout.split(rows[0])))
    starts = [start, len(lines)]
    signatures: list[str] = []
    if values is None:
        signatures = [layout.signature(row) for _, row in lines]
        below = signatures[start:]  # not the heading above the first table
        again = (start + i for i in range(1, len(below) - _LONG) if _begins(below, i))
        starts = [start, *again, len(lines)]
    end = 0
    for first, following in pairwise(starts):
        head, end = lines[end:first], following
        # Text above the next table is a part of its head.
        while following < len(lines) and "n" not in signatures[end - 1]:
            end -= 1
        below = len(head)
        while below and layout.signature(head[below - 1][1]).startswith("n"):
            below -= 1
        said = ()
        if 0 < below < len(head) and _is_name(head[below - 1][1]):  # broken rows
            where = first_few([str(number) for number, _ in head[below:]], FEW_NAMED)
            what = head[below][1].strip()[:30]
            rows_are = "1 row was" if below == len(head) - 1 else f"{len(head) - below} rows were"
            text = f"{rows_are} skipped, {line} {where}: expected numbers, found {what!r}"
            said = (Note(text, "skipped", at=(number for number, _ in head[below:])),)
            head = head[:below]
        yield Block(
            head=head, rows=lines[first:end], layout=layout, source=source, line=line,
            values=values, notes=said,
        )  # fmt: skip


def _begins(signatures: Sequence[str], i: int) -> bool:
    """Return whether a long block with a heading of its width begins at line i."""
    if "n" in signatures[i - 1] or "n" not in signatures[i]:
        return False
    above = signatures[max(i - 3, 0) : i]
    named = any(len(s) == len(signatures[i]) > s.count("-") + 1 and "n" not in s for s in above)
    return named and _start(signatures[i : i + _LONG]) == (0, _LONG)


def _read_runs(block: Block, *, format: Format) -> list[FileTable]:
    """Return the table of each run in a block: runs may stand side by side."""
    names = number_repeats(find_names(block))
    of_run = [parse_heading(name).run for name in names]
    runs = [run for run in dict.fromkeys(of_run) if run]
    if len(runs) < 2:
        return [replace(read_block(block, format=format, names=names), run="".join(runs))]
    tables = []
    rows = [(number, block.layout.split(row)) for number, row in block.rows]
    rows = [(number, fields + [""] * (len(names) - len(fields))) for number, fields in rows]
    for run in runs:
        # A column that belongs to no run, such as the time, belongs to all.
        columns = [i for i, other in enumerate(of_run) if other in ("", run)]
        lines = [
            (number, "\x01".join(fields[i] for i in columns))
            for number, fields in rows
            if any(fields[i].strip() for i in columns if of_run[i])
        ]
        if lines:
            layout = Layout("\x01", comma=block.layout.comma)
            part = replace(block, rows=lines, layout=layout, values=None)
            table = read_block(part, format=format, names=[names[i] for i in columns])
            tables.append(replace(table, run=run))
    return tables


def number_repeats(names: Sequence[str]) -> list[str]:
    """Return headings in which each repetition of a whole series of headings is a run."""
    plain = [name.casefold().strip() for name in names]
    n = len(plain)
    for width in range(2, n // 2 + 1):
        if n % width == 0 and plain == plain[:width] * (n // width) and all(plain):
            return [f"{name} Run #{i // width + 1}" for i, name in enumerate(names)]
    return [*names]


def read_block(
    block: Block, *, format: Format, names: Sequence[str], cut: str | None = None
) -> FileTable:
    """Return a table without the rows that do not fit; its notes name them.

    Parameters
    ----------
    cut : why the file is truncated, if it is known to be.

    Raises
    ------
    SubmissionError : more than one row in a hundred does not fit.
    """
    typed = block.layout.split(block.rows[0][1])
    width = len(typed)
    if width != len(names):
        raise SubmissionError(
            f"{block.place(block.rows[0][0])}: expected {len(names)} columns as in the heading, "
            f"found {width}"
        )
    values, used, partial = block.values, [*range(width)], dict[str, str]()
    if values is None:
        values = _numbers([row for _, row in block.rows], block.layout, width)
    end = block.rows[-1][0]
    if values is None or not np.isfinite(values).all():
        block, values, used, names, partial = _mend(block, names=names, cut=cut)
    lines = [number for number, _ in block.rows]
    place = block.place(block.head[-1][0] if block.head else lines[0])
    names = checked_names([names[i] for i in used], numbers=used, place=place)
    values = np.ascontiguousarray(values.T)
    refuse_unusable(values, names=names, place=lambda row: block.place(lines[row]))
    whole = tuple(
        not set(typed[i]) & set(".,:") and bool((column == np.round(column)).all())
        for i, column in zip(used, values, strict=True)
    )
    return FileTable(
        source=block.source,
        format=BENCH_LOG if format.positions == "heading" and is_bench_log(names) else format,
        names=tuple(names),
        values=values,
        whole=whole,
        lines=np.array(lines),
        lines_are=block.line,
        cut=cut,
        ends_broken=lines[-1] != end,
        notes=block.notes,
        partial=partial,
    )


def _numbers(rows: Sequence[str], layout: Layout, width: int) -> Array | None:
    """Return the rows as numbers (n, width); None if a field is not a number or a row does not fit.

    To save time, the rows are not checked one by one.
    """
    split = layout.fast
    fields = chain.from_iterable(
        row if len(row) == width else ("",)  # type: ignore[arg-type]
        for row in map(split, rows)
    )
    try:
        return np.fromiter(map(float, fields), np.float64).reshape(-1, width)
    except ValueError:
        return None


def _mend(
    block: Block, *, names: Sequence[str], cut: str | None
) -> tuple[Block, Array, list[int], list[str], dict[str, str]]:
    """Return the rows that fit, their numbers, the columns used, all names, and partial columns.

    Raises
    ------
    SubmissionError : no row fits, or more than one in a hundred does not.
    """
    layout, width, notes = block.layout, len(names), list[str]()
    lines, rows = zip(*block.rows, strict=True)
    end = len(rows)
    while end > 1 and "n" not in layout.signature(rows[end - 1]):
        end -= 1  # text below the table
    comments = {i for i, row in enumerate(rows) if i >= end or row.lstrip()[:1] in ("#", "%")}
    if comments:
        at = [lines[i] for i in sorted(comments)]
        where = first_few([*map(str, at)], FEW_NAMED)
        notes.append(Note(f"not read: text in {block.line} {where}", "text", at=at))
    table = np.full((len(rows), width), np.nan)
    texts, times = np.zeros((2, len(rows), width), dtype=np.bool_)
    faults: dict[int, str] = {}
    kept = []
    for i in range(len(rows)):
        if i in comments:
            continue
        fields = layout.split(rows[i])
        while len(fields) > width and not fields[-1].strip():
            fields.pop()
        if len(fields) != width:
            faults[i] = f"expected {width} columns, found {len(fields)}"
            continue
        kept.append(i)
        for j, typed in enumerate(fields):
            value = layout.value(typed)
            texts[i, j], times[i, j] = value is None, value is not None and ":" in typed
            table[i, j] = np.nan if value is None else value
    good = np.isfinite(table[kept])
    used, partial = list[int](), dict[str, str]()
    for j in range(width) if kept else ():
        name, share = _named(names, j), good[:, j].mean()
        last = int(np.flatnonzero(good[:, j])[-1]) + 1 if share else 0
        # A column with more than a tenth of its values missing is left out.
        if share >= 0.9 and last >= min((1 - _WORST) * len(kept), len(kept) - 1):
            used.append(j)
        elif share > 0.2:
            said = f"{name!r} has {good[:, j].sum():,} of {len(kept):,} values"
            if not good[:last, j].all():
                bad = [str(lines[i]) for i, fits in zip(kept, good[:, j], strict=True) if not fits]
                said += f", missing in {block.line} {first_few(bad, FEW_NAMED)}"
                partial[name] = said
            notes.append(f"not read: {said}")
        elif names[j].strip():
            notes.append(f"not read: {name!r} has no numbers")
    if not used:
        raise SubmissionError(f"{block.source}: holds no rows of numbers")
    names = _named_by_oscilloscope(block, names, used)
    for j in used:
        timed = times[:, j].sum()
        if 0 < timed < 0.5 * np.isfinite(table[:, j]).sum():
            # Spreadsheets turn numbers such as 1.5 into dates.
            texts[times[:, j], j], table[times[:, j], j] = True, np.nan
        elif timed:
            first = table[kept, j][np.isfinite(table[kept, j])][0]
            # A time of day is less than 1e6 s, the time since 1900 is more.
            if first > 1e6:  # a date: rounded, because doubles keep a date to 1e-6 s
                table[:, j] = np.round(table[:, j] - first, 5)
            names[j] = f"{parse_heading(names[j]).name} [s]"
    for i in kept:
        bad = next((j for j in used if not np.isfinite(table[i, j])), None)
        if bad is not None:
            typed = layout.split(rows[i])[bad].strip(" \"'")
            what = f"a number: {typed[:30]!r}" if texts[i, bad] else "a finite number"
            faults[i] = f"{_named(names, bad)!r} is " + (f"not {what}" if typed else "empty")
    fits = [i for i in kept if i not in faults]
    last = len(rows) - 1
    if faults.get(last, "").startswith("expected") and fits:
        what = faults.pop(last)
        if cut is None:
            said = f"the last row, {block.line} {lines[last]}, is cut off: {what}"
            notes.append(Note(said, "cut_row", at=[lines[last]]))
    if faults:
        first, *_ = bad_rows = sorted(faults)
        where, others = (
            first_few([str(lines[i]) for i in some], FEW_NAMED) for some in (bad_rows, bad_rows[1:])
        )
        if len(faults) > _WORST * len(rows) or not fits:
            more = f" (and {len(faults) - 1} more: {others})" if others else ""
            raise SubmissionError(f"{block.place(lines[first])}: {faults[first]}{more}")
        rows_are = "1 row was" if len(faults) == 1 else f"{len(faults)} rows were"
        said = f"{rows_are} skipped, {block.line} {where}: {faults[first]}"
        notes.append(Note(said, "skipped", at=[lines[i] for i in bad_rows]))
    fitting = replace(
        block, rows=[block.rows[i] for i in fits], notes=(*block.notes, *notes), values=None
    )
    return fitting, table[np.ix_(fits, used)], used, names, partial


def _named(names: Sequence[str], j: int) -> str:
    return names[j].strip(" \"'") or str(j + 1)


def _named_by_oscilloscope(block: Block, names: Sequence[str], used: Sequence[int]) -> list[str]:
    """Return the headings, or those that old Tektronix files state beside their first rows."""
    named = [*names]
    rows = [block.layout.split(row)[:2] for _, row in block.rows[:_FEW_LINES]]
    said = {row[0].strip(): row[-1].strip() for row in rows if row}
    if len(used) == 2 and {"Horizontal Units", "Vertical Units"} <= said.keys():
        named[used[0]] = f"TIME [{said['Horizontal Units']}]"
        named[used[1]] = f"{said.get('Source', 'CH1')} [{said['Vertical Units']}]"
    return named


# ------------------------------------------------------------------------------- headings


def find_names(block: Block) -> list[str]:
    """Return the headings from the lines above a table; numbers without headings.

    Below the names, a row may hold units; above them, a row may hold the numbers of runs.

    Raises
    ------
    SubmissionError : the last line has another number of names than the table has columns.
    """
    layout = block.layout
    typed = layout.split(block.rows[0][1])
    width = len(typed)
    ends = width > 1 and not typed[-1].strip()  # a delimiter ends each row
    texts = [
        (line.strip(" ").lstrip("#%").strip(" "), line.lstrip().startswith(("#", "%")))
        for _, line in block.head
        if _is_name(line) and not line.startswith("sep=")
    ]
    found: list[list[str]] = []
    for text, is_comment in reversed(texts[-4:]):
        names = _fields(text, layout, width, ends=ends)
        if names is None:
            said = _other_width(text, layout, width=width)
            if said and not found and (layout.delimiter is None or not is_comment):
                raise SubmissionError(f"{block.place(block.rows[0][0])}: {said}")
            if found or not is_comment:
                break
            continue
        found.append([name.strip(" \"'") for name in names])
    if not found:
        return [str(i) for i in range(1, width + 1)]
    names, above = found[0], found[1:]
    if above and are_units(names) and sum(map(bool, above[0])) >= sum(map(bool, names)):
        names = [join_unit(n, u) if n else u for n, u in zip(above[0], names, strict=True)]
        above = above[1:]
    if above and not all(names) and not _runs(above[0]):  # a name over two rows
        names = [name or over for name, over in zip(names, above[0], strict=True)]
    if above and (runs := _runs(above[0])):
        names = [f"{name} {run}".strip() for name, run in zip(names, runs, strict=True)]
    return names


def _runs(fields: Sequence[str]) -> list[str]:
    """Return the run of each column from a row of runs; [] if it is another row."""
    held = [field for field in fields if field]
    if not held or not all(re.fullmatch(r"(?i)\W*(run|trial|messung)\s*#?\s*\d+\W*", f)
                           for f in held):  # fmt: skip
        return []
    runs = []
    for text in fields:
        runs.append(text.strip(" :;,") or (runs[-1] if runs else ""))
    return runs


def _other_width(text: str, layout: Layout, *, width: int) -> str:
    """Return what is wrong with headings that are more or fewer than the columns; "" for a remark.

    A remark is a sentence, or a setting and its value.
    """
    if layout.delimiter is None:
        words = _HEADING_WORDS.findall(text[:4000])
        return (
            f"expected {len(words)} columns as in the heading, found {width}"
            if any(map(is_time, words)) else ""
        )  # fmt: skip
    fields = [field for field in layout.split(text) if field.strip()]
    are_names = len(fields) > 2 or any(map(is_time, fields))
    return f"expected {len(fields)} columns, found {width}" if 1 < len(fields) and are_names else ""


def _fields(text: str, layout: Layout, width: int, *, ends: bool) -> list[str] | None:
    """Return the names in a line, if there are `width` of them; None otherwise."""
    ways: list[Callable[[], list[str]]] = [lambda: layout.split(text)]
    if layout.delimiter is None:
        ways = [
            lambda: re.split(r"\t+|\s{2,}", text.strip()),
            lambda: _HEADING_WORDS.findall(text[:4000]),
            lambda: text.split(),
            lambda: [field.strip() for field in re.split("[,;\t]", text)],
        ]
    for way in ways:
        fields = way()
        if len(fields) == width + 1 and not fields[-1].strip():
            fields = fields[:-1]
        if len(fields) == width - 1 and ends:
            fields = [*fields, ""]
        if len(fields) == width and any(map(_is_name, fields)):
            return fields
    return None


def _is_name(field: str) -> bool:
    return any(c.isalpha() for c in field)


def is_bench_log(names: Sequence[str]) -> bool:
    """Return whether the headings are those of the bench's own log.

    These are the headings of an ECP file without a commanded position and without brackets.
    """
    words = {name.casefold() for name in names}
    return (
        {"sample", "time", "control effort"} <= words
        and any(word.startswith("encoder") for word in words)
        and "commanded pos" not in words
    )


# ------------------------------------------------------------------------------ ECP exports


def _in_brackets(text: str, opening: re.Match[str], source: str) -> tuple[Block, str | None]:
    """Return the rows of `heading [ row; row; … ]`, and what is missing at their end.

    The ECP program and scripts of MATLAB write this.

    Raises
    ------
    SubmissionError : there are no rows, or two recordings.
    """
    first = text.count("\n", 0, opening.end()) + 1
    body, closing, rest = text[opening.end() :].partition("]")
    rows = [
        (number, piece)
        for number, line in enumerate(body.replace(",", " ").split("\n"), start=first)
        for piece in line.partition("%")[0].split(";")
        if piece.strip()
    ]
    if not rows:
        raise SubmissionError(f"{source} line {first}: no rows after the opening bracket")
    last = first + body.count("\n")
    if "[" in rest:
        raise SubmissionError(
            f"{source} line {last}: more data after the closing bracket: two recordings were "
            "pasted together"
        )
    above = enumerate(text[: opening.start()].split("\n"), start=1)
    head = [one for one in above if re.search(r"(?i)\b(time|encoder)\b", one[1])][-1:]
    notes = (
        (f"text after line {last} is not data and was not read",) if rest.strip("; \t\n") else ()
    )
    cut = None if closing else f"line {rows[-1][0]}: the closing bracket is missing"
    layout = Layout(None, comma=False)
    return Block(head=head, rows=rows, layout=layout, source=source, notes=notes), cut
