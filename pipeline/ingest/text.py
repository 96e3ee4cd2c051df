"""Read tables from text: CSV in any dialect, ECP exports, bench logs, exports of oscilloscopes.

The first long block of similar lines is the table. The last line of text above it has the headings.
Another heading with another block begins another run.
"""

import csv
import datetime as dt
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
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
_SPARSE = 0.1  # share of missing values from which a column is left out
_DATED = 1e6  # s; a time of day is less, the time since 1900 is more
# The names in an ECP heading consist of words with single spaces between them.
_HEADING_WORDS = re.compile(
    r"encoder\s*\d+\s+(?:pos|vel|acc)\w*|commanded\s+\w+|control\s+effort|"
    r"[^\s,;\[(]+(?: ?[\[(][^\[\]()]{0,20}[\])])?",
    re.IGNORECASE,
)
_OPENING = re.compile(r"^[^\S\n]*(?:[A-Za-z]\w*\s*=\s*)?\[", re.MULTILINE)
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
    text = decode(raw, source=source).replace("\r\n", "\n").replace("\r", "\n")
    if (
        "[" in text
        and (opening := _OPENING.search(text))
        and (lines := _in_brackets(text, opening, source))
    ):
        head, rows, cut, notes = lines
        layout = Layout(None, comma=False)
        block = Block(head=head, rows=rows, source=source)
        names = _names_above(block, layout)
        table = read_block(block, layout, format=ECP, names=names, cut=cut)
        return [replace(table, notes=(*table.notes, *notes))]
    lines = [(i, line) for i, line in enumerate(text.split("\n"), 1) if line.strip(' \t;,"')]
    sample = [line for _, line in lines[:_SNIFFED_LINES]]
    layout = _sniff(sample[:_FEW_LINES], least=_LONG) or _sniff(sample)
    if layout is None:
        raise SubmissionError(_no_table(lines, source))
    blocks = find_blocks(lines, layout, source=source)
    return [table for block in blocks for table in read_runs(block, layout, format=CSV)]


def decode(raw: bytes, *, source: str) -> str:
    """Return the text of a file in UTF-8, UTF-16 or an old Windows encoding.

    Raises
    ------
    SubmissionError : the file is not text.
    """
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):  # Excel's "Unicode text"
        try:
            return raw.decode("utf-16")
        except UnicodeDecodeError:
            raise SubmissionError(f"{source}: broken UTF-16 text") from None
    control = sum(raw[:4096].count(byte) for byte in (0, 1, 2, 3, 4, 5, 6, 7, 8, 14, 15, 27))
    if control or b"\0" in raw:
        raise SubmissionError(f"{source}: neither text nor a .mat file that can be read")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")  # such as a micro sign from an old Windows program


def _no_table(lines: Sequence[tuple[int, str]], source: str) -> str:
    if not any(line.strip() for _, line in lines):
        return f"{source}: the file is empty"
    if all(line.lstrip().startswith(("#", "%", "sep=")) for _, line in lines):
        return f"{source}: holds no rows of numbers"
    number, line = lines[-1]
    words = re.split(r"[,;\t]", line[:300])
    if len(words) > 1 and parse_heading(words[0]).name.strip("\"' ").casefold() in ("t", "time"):
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


def _time_of_day(field: str) -> float | None:
    """Return the seconds of a time of day, from midnight or, with a date, from 1900."""
    if ":" not in field or not (match := _TIME_OF_DAY.fullmatch(field.strip(" \"'"))):
        return None
    date, hour, minute, second, half = match.groups()
    if second is None and (half is None or half == "Z"):
        return None
    seconds = float((second or "0").replace(",", ".").replace(":", "."))
    hours = int(hour) % 12 + 12 * (half.strip().casefold() == "pm") if half and half != "Z" else (
        int(hour)
    )  # fmt: skip
    days = 0
    if date:
        numbers = [int(part) for part in re.split(r"[-/.]", date)]
        try:
            year, *rest = numbers if numbers[0] > 31 else numbers[::-1]
            days = (dt.date(year, *rest) - _FIRST_DAY).days if rest[0] <= 12 else (
                (dt.date(year, rest[1], rest[0]) - _FIRST_DAY).days
            )  # fmt: skip
        except ValueError:
            return None
    return 86_400.0 * days + 3600.0 * hours + 60.0 * int(minute) + seconds


def _value(layout: Layout, field: str) -> float | None:
    """Return the number or the time of day in a field, NaN for an empty one, None for text."""
    try:
        return layout.cell(field)
    except ValueError:
        return _time_of_day(field)


# ------------------------------------------------------------------------------- the layout


def _signature(layout: Layout, line: str) -> str:
    """Return a letter for each field of a line: n number, - empty, x text; "" for a comment."""
    if line.lstrip().startswith(("#", "%")):
        return ""
    try:
        values: list[float | None] = list(map(float, layout.fast(line)))
    except ValueError:
        values = [_value(layout, field) for field in layout.split(line)]
    return "".join("x" if v is None else "-" if v != v else "n" for v in values)


def _alike(a: str, b: str) -> bool:
    """Return whether two rows may belong to one table: the same cells hold numbers."""
    same = len(a) == len(b) and "n" in a and "n" in b
    return same and all(p == q or "-" in (p, q) for p, q in zip(a, b, strict=True))


class _Signatures:
    """The signatures of lines, found only as far as they are asked for."""

    def __init__(self, layout: Layout, lines: Sequence[str]) -> None:
        self._layout, self._lines, self._found = layout, lines, list[str]()

    def __len__(self) -> int:
        return len(self._lines)

    def __getitem__(self, i: int) -> str:
        while len(self._found) <= i:
            self._found.append(_signature(self._layout, self._lines[len(self._found)]))
        return self._found[i]


def _start(signatures: Sequence[str] | _Signatures) -> tuple[int, int]:
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
            signatures = _Signatures(layout, sample)
            start, length = _start(signatures)
            found = [signatures[i] for i in range(start, start + length)]
            rows = sample[start : start + length]
            plain = sum(_is_plain(field, comma) for row in rows for field in layout.split(row))
            share = plain / max(sum(map(len, found)), 1)
            # A single column counts only if nothing else fits.
            wide = 1.0 if length and len(found[0]) > 1 else 0.3
            numbers = sum(s.count("n") / len(s) for s in found)
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
    source: str
    line: str = "line"
    values: Array | None = None
    notes: tuple[str, ...] = ()

    def place(self, number: int) -> str:
        """Return the file and a line of it, as in "a.csv line 12"."""
        return f"{self.source} {self.line} {number}"


def find_blocks(
    lines: Sequence[tuple[int, str]], layout: Layout, *, source: str, line: str = "line"
) -> Iterator[Block]:
    """Yield the tables of a file: each begins with similar rows, below its heading."""
    sample = [line for _, line in lines[:_SNIFFED_LINES]]
    start, length = _start(_Signatures(layout, sample[:_FEW_LINES]))
    if length < _LONG:
        start, _ = _start(_Signatures(layout, sample))
    head, rows = lines[:start], lines[start:]
    width = len(layout.split(rows[0][1]))
    values = _numbers([row for _, row in rows], layout, width)
    if values is None:
        signatures = [_signature(layout, line) for _, line in rows]
        at = 0
        while at < len(rows):
            texts = range(at + 1, len(rows) - _LONG)
            again = next((i for i in texts if _begins(signatures, i)), None)
            if again is None:
                break
            above = next(i for i in range(again, 0, -1) if "n" in signatures[i - 1])
            head, said = _without_rows(head, layout, line=line)
            yield Block(head=head, rows=rows[at:above], source=source, line=line, notes=said)
            head, at = rows[above:again], again
        rows = rows[at:]
    head, said = _without_rows(head, layout, line=line)
    yield Block(head=head, rows=rows, source=source, line=line, values=values, notes=said)


def _without_rows(
    head: Sequence[tuple[int, str]], layout: Layout, *, line: str
) -> tuple[Sequence[tuple[int, str]], tuple[str, ...]]:
    """Return the lines above a table without broken rows below its heading, and a note on these."""
    end = len(head)
    while end and _signature(layout, head[end - 1][1]).startswith("n"):
        end -= 1
    if end == len(head) or not end or not _is_name(head[end - 1][1]):
        return head, ()
    where = first_few([str(number) for number, _ in head[end:]], FEW_NAMED)
    what = head[end][1].strip()[:30]
    rows_are = "1 row was" if end == len(head) - 1 else f"{len(head) - end} rows were"
    return head[:end], (f"{rows_are} skipped, {line} {where}: expected numbers, found {what!r}",)


def _begins(signatures: Sequence[str], i: int) -> bool:
    """Return whether a long block with a heading of its width begins at line i."""
    if "n" in signatures[i - 1] or "n" not in signatures[i]:
        return False
    above = signatures[max(i - 3, 0) : i]
    named = any(len(s) == len(signatures[i]) > s.count("-") + 1 and "n" not in s for s in above)
    return named and _start(signatures[i : i + _LONG]) == (0, _LONG)


def read_runs(block: Block, layout: Layout, *, format: Format) -> list[FileTable]:
    """Return the table of each run in a block: runs may stand side by side.

    Raises
    ------
    SubmissionError : as for `read_block`.
    """
    names = number_repeats(_names_above(block, layout))
    of_run = [parse_heading(name).run for name in names]
    runs = [run for run in dict.fromkeys(of_run) if run]
    if len(runs) < 2:
        table = read_block(block, layout, format=format, names=names)
        return [replace(table, run=runs[0] if runs else "")]
    tables = []
    rows = [(number, layout.split(row)) for number, row in block.rows]
    for run in runs:
        # A column that belongs to no run, such as the time, belongs to all.
        columns = [i for i, other in enumerate(of_run) if other in ("", run)]
        own = [i for i in columns if of_run[i]]
        parts = [
            (number, [fields[i] if i < len(fields) else "" for i in columns])
            for number, fields in rows
            if any(fields[i].strip() for i in own if i < len(fields))
        ]
        if parts:
            apart = Layout("\x01", comma=layout.comma)
            lines = [(number, "\x01".join(fields)) for number, fields in parts]
            own_names = [names[i] for i in columns]
            part = replace(block, rows=lines, values=None)
            table = read_block(part, apart, format=format, names=own_names)
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


def _names_above(block: Block, layout: Layout) -> list[str]:
    typed = layout.split(block.rows[0][1])
    ends = len(typed) > 1 and not typed[-1].strip()  # a delimiter ends each row
    return find_names(block, layout, width=len(typed), ends=ends)


def read_block(
    block: Block,
    layout: Layout,
    *,
    format: Format,
    names: Sequence[str],
    cut: str | None = None,
) -> FileTable:
    """Return a table without the rows that do not fit; its notes name them.

    Parameters
    ----------
    cut : why the file is truncated, if it is known to be.

    Raises
    ------
    SubmissionError : more than one row in a hundred does not fit.
    """
    lines = [number for number, _ in block.rows]
    rows = [row for _, row in block.rows]
    typed = layout.split(rows[0])
    width = len(typed)
    if width != len(names):
        raise SubmissionError(
            f"{block.place(lines[0])}: expected {len(names)} columns as in the heading, "
            f"found {width}"
        )
    notes: list[str] = []
    partial: dict[str, str] = {}
    values = _numbers(rows, layout, width) if block.values is None else block.values
    used = list(range(width))
    if values is None or not np.isfinite(values).all():
        values, lines, used, names, notes, partial = _mend(block, layout, names=names, cut=cut)
    place = block.place(block.head[-1][0] if block.head else lines[0])
    names = checked_names([names[i] for i in used], numbers=used, place=place)
    refuse_unusable(values.T, names=names, place=lambda row: block.place(lines[row]))
    values = np.ascontiguousarray(values.T)
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
        ends_broken=lines[-1] != block.rows[-1][0],
        notes=(*block.notes, *notes),
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
    block: Block, layout: Layout, *, names: Sequence[str], cut: str | None
) -> tuple[Array, list[int], list[int], list[str], list[str], dict[str, str]]:
    """Return the rows that fit, with their lines, columns, names, notes, and partial columns."""
    width, names = len(names), list(names)
    lines, rows = zip(*block.rows, strict=True)
    table = np.full((len(rows), width), np.nan)
    texts = np.zeros((len(rows), width), dtype=np.bool_)
    times = np.zeros_like(texts)
    faults: dict[int, str] = {}
    end = len(rows)
    while end > 1 and "n" not in _signature(layout, rows[end - 1]):
        end -= 1  # text below the table
    comments = {i for i, row in enumerate(rows) if i >= end or row.lstrip()[:1] in ("#", "%")}
    for i, row in enumerate(rows):
        if i in comments:
            continue
        fields = layout.split(row)
        while len(fields) > width and not fields[-1].strip():
            fields.pop()
        if len(fields) != width:
            faults[i] = f"expected {width} columns, found {len(fields)}"
            continue
        for j, field in enumerate(fields):
            try:
                table[i, j] = layout.cell(field)
            except ValueError:
                if (seconds := _time_of_day(field)) is None:
                    texts[i, j] = True
                else:
                    table[i, j] = seconds
                    times[i, j] = True
    kept = np.array([i for i in range(len(rows)) if i not in faults and i not in comments])
    notes = []
    if comments:
        where = first_few([str(lines[i]) for i in sorted(comments)], FEW_NAMED)
        notes.append(f"not read: text in {block.line} {where}")
    if not kept.size:
        raise SubmissionError(f"{block.source}: holds no rows of numbers")
    used, timed, partial = [], times.sum(axis=0), dict[str, str]()
    for j in range(width):
        good = np.isfinite(table[kept, j])
        last = int(np.flatnonzero(good)[-1]) + 1 if good.any() else 0
        name = names[j].strip(" \"'") or str(j + 1)
        if good.mean() < 1 - _SPARSE or last < min((1 - _WORST) * kept.size, kept.size - 1):
            if (good.any() and good.mean() >= 1 - _SPARSE) or good.mean() > 0.2:
                said = f"{name!r} has {good.sum():,} of {kept.size:,} values"
                if not good[:last].all():
                    bad = [str(lines[i]) for i in kept[~good]]
                    said += f", missing in {block.line} {first_few(bad, FEW_NAMED)}"
                    partial[name] = said
                notes.append(f"not read: {said}")
            elif names[j].strip():
                notes.append(f"not read: {name!r} has no numbers")
            continue
        used.append(j)
        if 0 < timed[j] < 0.5 * good.sum():  # spreadsheets turn numbers such as 1.5 into dates
            texts[times[:, j], j], table[times[:, j], j] = True, np.nan
        elif timed[j]:
            stamps = table[:, j]
            first = stamps[np.isfinite(stamps)][0]
            if first > _DATED:  # a date: rounded, because doubles keep a date to 1e-6 s
                stamps[:] = np.round(stamps - first, 5)
            names[j] = f"{parse_heading(name).name} [s]"
    if not used:
        raise SubmissionError(f"{block.source}: holds no rows of numbers")
    first_rows = [layout.split(row)[:2] for row in rows[:_FEW_LINES]]
    beside = {row[0].strip(): row[-1].strip() for row in first_rows if row}  # old Tektronix files
    if len(used) == 2 and not {"Horizontal Units", "Vertical Units"} - beside.keys():
        for j, name, unit in zip(
            used, ("TIME", beside.get("Source", "CH1")), ("Horizontal", "Vertical"), strict=True
        ):
            names[j] = f"{name} [{beside[f'{unit} Units']}]"
    for i in kept:
        bad = next((j for j in used if not np.isfinite(table[i, j])), None)
        if bad is not None:
            name, field = names[bad].strip(" \"'") or str(bad + 1), layout.split(rows[i])[bad]
            empty = field.strip(" \"'").casefold() in _MISSING
            faults[i] = (
                f"{name!r} is not a number: {field.strip()[:30]!r}" if texts[i, bad]
                else f"{name!r} is empty" if not field.strip(" \"'")
                else f"{name!r} is not a finite number" if empty or np.isinf(table[i, bad])
                else f"{name!r} is too large"
            )  # fmt: skip
    fits = [int(i) for i in kept if i not in faults]
    last = len(rows) - 1
    if faults.get(last, "").startswith("expected") and fits:
        what = faults.pop(last)
        if cut is None:
            notes.append(f"the last row, {block.line} {lines[last]}, is cut off: {what}")
    if faults:
        bad_lines = [str(lines[i]) for i in sorted(faults)]
        where, others = (first_few(some, FEW_NAMED) for some in (bad_lines, bad_lines[1:]))
        first = min(faults)
        if len(faults) > _WORST * len(rows) or not fits:
            more = f" (and {len(faults) - 1} more: {others})" if len(faults) > 1 else ""
            raise SubmissionError(f"{block.place(lines[first])}: {faults[first]}{more}")
        rows_are = "1 row was" if len(faults) == 1 else f"{len(faults)} rows were"
        notes.append(f"{rows_are} skipped, {block.line} {where}: {faults[first]}")
    return table[np.ix_(fits, used)], [lines[i] for i in fits], used, names, notes, partial


# ------------------------------------------------------------------------------- headings


def find_names(block: Block, layout: Layout, *, width: int, ends: bool) -> list[str]:
    """Return the headings from the lines above a table; numbers without headings.

    `ends` says that a delimiter ends each row.

    Below the names, a row may hold units; above them, a row may hold the numbers of runs.

    Raises
    ------
    SubmissionError : the last line has another number of names than the table has columns.
    """
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
    for field in fields:
        runs.append(field.strip(" :;,") or (runs[-1] if runs else ""))
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


def _in_brackets(
    text: str, opening: re.Match[str], source: str
) -> tuple[list[tuple[int, str]], list[tuple[int, str]], str | None, list[str]]:
    """Return the lines above, the rows, a missing end and notes of `heading [ row; row; … ]`.

    The ECP program and scripts of MATLAB write this.

    Raises
    ------
    SubmissionError : there are no rows, or two recordings.
    """
    first_line = text.count("\n", 0, opening.end()) + 1
    end = text.find("]", opening.end())
    body = text[opening.end() : end if end >= 0 else len(text)]
    rows = [
        (number, piece)
        for number, line in enumerate(body.replace(",", " ").split("\n"), start=first_line)
        for piece in line.partition("%")[0].split(";")
        if piece.strip()
    ]
    if not rows:
        raise SubmissionError(f"{source} line {first_line}: no rows after the opening bracket")
    above = list(enumerate(text[: opening.start()].split("\n"), start=1))
    head = [one for one in above if re.search(r"(?i)\b(time|encoder)\b", one[1])][-1:]
    if end < 0:
        return head, rows, f"line {rows[-1][0]}: the closing bracket is missing", []
    if (rest := text[end + 1 :].strip("; \t\n")) == "":
        return head, rows, None, []
    line = text.count("\n", 0, end) + 1
    if "[" in rest:
        raise SubmissionError(
            f"{source} line {line}: more data after the closing bracket: two recordings were "
            f"pasted together"
        )
    return head, rows, None, [f"text after line {line} is not data and was not read"]
