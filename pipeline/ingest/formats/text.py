"""Read data files of text: ECP exports, bench logs, and CSV with any delimiter and decimal mark."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from operator import methodcaller

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import FileTable, refuse_unusable

MOST_COLUMNS = 64
_SNIFFED_ROWS = 40
# The names in an ECP heading consist of words with single spaces between them.
_HEADING_WORDS = re.compile(
    r"encoder\s*\d+\s+(?:pos|vel|acc)\w*|commanded\s+\w+|control\s+effort|[^\s,;]+", re.IGNORECASE
)
_TIME_HEADING = re.compile(
    r"(?:^|[,;\t])[^\w,;\t]*(?:sample\s+)?(?:t|time)(?![a-z])", re.IGNORECASE
)
_OPENING = re.compile(r"^[^\S\n]*(?:[A-Za-z]\w*\s*=\s*)?\[", re.MULTILINE)
_LONGEST_HEADING = 100  # characters
_LONGEST_UNIT = 8  # characters; enough for "counts" and "rad/s"
QUOTES = " \"'"


def read_text(raw: bytes, *, source: str) -> FileTable:
    """Read a table of numbers from text.

    Raises
    ------
    SubmissionError : the file is not text or not a table, or a row does not fit; the message names
        the line.
    """
    text = decode(raw, source=source).replace("\r\n", "\n").replace("\r", "\n")
    opening = _OPENING.search(text) if "[" in text else None
    return _ecp(text, opening, source) if opening else _delimited(text, source)


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


# ------------------------------------------------------------------------- rows of numbers


@dataclass(frozen=True)
class Rows:
    """Parsed rows of a file: numbers (n, width), their lines, and signs of truncation."""

    source: str
    names: Sequence[str]
    values: np.ndarray
    lines: np.ndarray
    cut: str | None


def parse_rows(
    rows: Sequence[str],
    lines: Sequence[int],
    *,
    split: Callable[[str], Sequence[str]],
    names: Sequence[str],
    source: str,
) -> Rows:
    """Parse rows into numbers; a bad last row means a truncated file, any other is an error.

    Parameters
    ----------
    lines : line number in the file, for each row.
    split : function that returns the fields of a row.
    """
    values, cut = _numbers(map(split, rows), width=len(names)), None
    if values is None:
        bad = next(i for i, row in enumerate(rows) if not _fits(split(row), width=len(names)))
        cut = f"line {lines[bad]}: {_what_is_wrong(split(rows[bad]), names)}"
        values = _numbers(map(split, rows[:bad]), width=len(names))
        if bad < len(rows) - 1 or values is None or not values.size:
            raise SubmissionError(f"{source} {cut}")
    if not values.size:
        raise SubmissionError(f"{source}: holds no rows of numbers")
    lines = lines[: len(values)]
    refuse_unusable(values.T, names=names, place=lambda row: f"{source} line {lines[row]}")
    return Rows(source=source, names=names, values=values, lines=np.array(lines), cut=cut)


def _numbers(rows: Iterable[Sequence[str]], *, width: int) -> Array | None:
    """Return the rows as numbers (n, width); None if a field is not a number or a row does not fit.

    To save time, the rows are not checked one by one.
    """
    fields = chain.from_iterable(row if len(row) == width else ("",) for row in rows)
    try:
        return np.fromiter(map(float, fields), np.float64).reshape(-1, width)
    except ValueError:
        return None


def _fits(row: Sequence[str], *, width: int) -> bool:
    return len(row) == width and all(map(is_number, row))


def _what_is_wrong(fields: Sequence[str], names: Sequence[str]) -> str:
    """Return why a row does not fit its heading."""
    if [field.strip(QUOTES).casefold() for field in fields] == [n.casefold() for n in names]:
        return "a second heading: two recordings were pasted together"
    if len(fields) != len(names):
        return f"expected {len(names)} columns, found {len(fields)}"
    for name, field in zip(names, fields, strict=True):
        if not is_number(field):
            if not field.strip():
                return f"{name!r} is empty"
            return f"{name!r} is not a number: {field[:30]!r}"
    return "not a row of numbers"


def is_number(field: str) -> bool:
    """Return whether a field holds a number."""
    try:
        float(field)
    except ValueError:
        return False
    return True


def make_table(
    rows: Rows,
    *,
    form: str,
    typed: Sequence[str],
    cut: str | None,
    notes: Sequence[str] = (),
) -> FileTable:
    """Return a table made of rows; `typed` is the first row as written in the file."""
    values = np.ascontiguousarray(rows.values.T)
    whole = tuple(
        "." not in field and "," not in field and bool((column == np.round(column)).all())
        for column, field in zip(values, typed, strict=True)
    )
    return FileTable(
        source=rows.source,
        form=form,
        names=tuple(rows.names),
        values=values,
        whole=whole,
        lines=rows.lines,
        cut=cut or rows.cut,
        notes=tuple(notes),
    )


def checked_names(names: Sequence[str], *, place: str) -> list[str]:
    """Return headings without quotes; an empty one becomes its number.

    Raises
    ------
    SubmissionError : there are too many headings, or a heading is too long or repeated; the message
        begins with `place`.
    """
    if len(names) > MOST_COLUMNS:
        raise SubmissionError(f"{place}: more than {MOST_COLUMNS} columns")
    if (longest := max(map(len, names), default=0)) > _LONGEST_HEADING:
        raise SubmissionError(
            f"{place}: a heading of {longest:,} characters; the limit is {_LONGEST_HEADING}"
        )
    clean = [name.strip(QUOTES) or str(i) for i, name in enumerate(names, start=1)]
    clean = [name if name.isprintable() else repr(name)[1:-1] for name in clean]
    seen: set[str] = set()
    for name in clean:
        if name.casefold() in seen:
            raise SubmissionError(f"{place}: the heading {name[:40]!r} appears twice")
        seen.add(name.casefold())
    return clean


# ------------------------------------------------------------------------------ ECP exports


def _ecp(text: str, opening: re.Match[str], source: str) -> FileTable:
    """Read `heading [ row; row; … ]`, as written by the ECP program and by MATLAB scripts."""
    first_line = text.count("\n", 0, opening.end()) + 1
    end = text.find("]", opening.end())
    body = text[opening.end() : end if end >= 0 else len(text)]
    rows: list[str] = []
    lines: list[int] = []
    for line, content in enumerate(body.replace(",", " ").split("\n"), start=first_line):
        found = [piece for piece in content.partition("%")[0].split(";") if piece.strip()]
        rows += found
        lines += [line] * len(found)
    if not rows:
        raise SubmissionError(f"{source} line {first_line}: no rows after the opening bracket")
    typed = rows[0].split()
    width = len(typed)
    heading, heading_line = _ecp_heading(text[: opening.start()])
    if heading and len(heading) != width:
        raise SubmissionError(
            f"{source} line {lines[0]}: expected {len(heading)} columns "
            f"as in the heading, found {width}"
        )
    names = checked_names(
        heading or [str(i) for i in range(1, width + 1)], place=f"{source} line {heading_line}"
    )
    notes = []
    cut = None
    if end < 0:
        cut = f"line {lines[-1]}: the closing bracket is missing"
    elif (rest := text[end + 1 :].strip("; \t\n")) != "":
        line = text.count("\n", 0, end) + 1
        if "[" in rest:
            raise SubmissionError(
                f"{source} line {line}: more data after the closing bracket: two recordings were "
                f"pasted together"
            )
        notes.append(f"text after line {line} is not data and was not read")
    return make_table(
        parse_rows(rows, lines, split=str.split, names=names, source=source),
        form="ecp",
        typed=typed,
        cut=cut,
        notes=notes,
    )


def _ecp_heading(head: str) -> tuple[list[str], int]:
    """Return the names in an ECP heading, and the number of its line."""
    lines = head.split("\n")
    for number in range(len(lines), 0, -1):
        line = lines[number - 1].strip().lstrip("%#").strip()
        if re.search(r"\b(time|encoder)\b", line, re.IGNORECASE):
            return _HEADING_WORDS.findall(line), number
    return [], 1


# ----------------------------------------------------------------------------- delimited text


@dataclass(frozen=True)
class _Layout:
    """How the lines of a table are split; `delimiter` None means any white space."""

    delimiter: str | None
    decimal_comma: bool
    has_heading: bool
    trailing: bool  # whether a delimiter ends each row

    def fields(self, line: str) -> list[str]:
        """Return the fields of one line."""
        if self.delimiter is None:
            words = _HEADING_WORDS.findall(line)
            return words if any(word[0].isalpha() for word in words) else line.split()
        fields = line.strip(" " if self.delimiter == "\t" else None).split(self.delimiter)
        return fields[:-1] if self.trailing and not fields[-1].strip() else fields

    @property
    def split(self) -> Callable[[str], list[str]]:
        """The function that splits a row of numbers and replaces decimal commas by points."""
        if self.decimal_comma:
            return lambda row: [field.replace(",", ".") for field in self.fields(row)]
        if self.delimiter is None or self.trailing:
            return self.fields
        return methodcaller("split", self.delimiter)  # white space around a number does no harm


def _delimited(text: str, source: str) -> FileTable:
    """Read a heading and rows; delimiter and decimal mark are found from the text."""
    # A spreadsheet may write rows of empty cells after its last row.
    numbered = enumerate(text.split("\n"), start=1)
    lines = [(i, line) for i, line in numbered if line.strip().strip(' \t;,"')]
    start = 0
    while start < len(lines) and lines[start][1].lstrip().startswith(("#", "%", "sep=")):
        start += 1
    if start == len(lines):
        raise SubmissionError(
            f"{source}: the file is empty" if not lines else f"{source}: holds no rows of numbers"
        )
    layout = _sniff([line for _, line in lines[start : start + _SNIFFED_ROWS + 1]])
    if layout is None:
        number, line = lines[start]
        if start + 1 == len(lines) and _TIME_HEADING.search(line):
            raise SubmissionError(f"{source} line {number}: headings, but no rows of numbers below")
        number, line = lines[min(start + 1, len(lines) - 1)]
        raise SubmissionError(
            f"{source} line {number}: not a table of numbers, found {line.strip()[:40]!r}"
        )
    heading, first = _heading(lines, start, layout)
    typed = layout.fields(lines[first][1])
    names = checked_names(
        heading or [str(i) for i in range(1, len(typed) + 1)],
        place=f"{source} line {lines[start][0]}",
    )
    rows = parse_rows(
        [line for _, line in lines[first:]],
        [number for number, _ in lines[first:]],
        split=layout.split,
        names=names,
        source=source,
    )
    return make_table(
        rows,
        form="bench_log" if is_bench_log(names) else "csv",
        typed=typed if len(typed) == len(names) else [""] * len(names),
        cut=None,
    )


def _heading(
    lines: Sequence[tuple[int, str]], start: int, layout: _Layout
) -> tuple[list[str] | None, int]:
    """Return the headings, None if missing, and the index of the first row of numbers.

    The last comment before a table without headings may be its heading. A row of units below the
    heading ("ms", "V") is added to the names: "time [ms]".
    """
    if not layout.has_heading:
        width = len(layout.fields(lines[start][1]))
        above = lines[start - 1][1].lstrip(" %#") if start else ""
        names = layout.fields(above)
        return (names if len(names) == width else None), start
    names = layout.fields(lines[start][1])
    if start + 2 < len(lines):
        united = with_units(names, layout.fields(lines[start + 1][1]))
        if united is not None:
            return united, start + 2
    return names, start + 1


def with_units(names: Sequence[str], units: Sequence[str]) -> list[str] | None:
    """Return headings joined with units, "time [ms]"; None if `units` are not units."""
    bare = [unit.strip(' ()[]"') for unit in units]
    words = all(re.fullmatch(rf"[^\d]{{1,{_LONGEST_UNIT}}}", unit) for unit in bare)
    if not words or len(bare) != len(names) or bare == list(names):
        return None
    return [f"{name.strip(QUOTES)} [{unit}]" for name, unit in zip(names, bare, strict=True)]


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


def _sniff(sample: Sequence[str]) -> _Layout | None:
    """Return the layout in which the most lines are rows of equally many numbers; None if none are.

    Among equally good layouts, the first one is used. So "0,5;1,2" is two numbers with decimal
    commas, and "0,5" is two integers.
    """
    best, best_score = None, 0.0
    for delimiter in ("\t", ";", ",", None):
        for decimal_comma in (False, True) if delimiter != "," else (False,):
            trailing = delimiter not in (None, "\t") and all(
                line.rstrip().endswith(delimiter) for line in sample[1:] or sample
            )
            layout = _Layout(delimiter, decimal_comma, has_heading=False, trailing=trailing)
            split = list(map(layout.split, sample))
            has_heading = not all(map(is_number, split[0]))
            width = len(split[0])
            numeric = [len(row) for row in split[has_heading:] if all(map(is_number, row))]
            # A single column counts only if nothing else fits. Numbers under a heading of another
            # width count only so that the error can be reported.
            score = numeric.count(width) * (2 if width > 1 else 1) + 0.01 * len(numeric)
            if score > best_score:
                best, best_score = replace(layout, has_heading=has_heading), score
            if width > 1 and numeric.count(width) == len(split) - has_heading > 0:
                return best  # every line contains the delimiter, and no number does
    return best
