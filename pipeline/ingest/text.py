"""Data files of text: ECP exports, bench logs and CSV of any delimiter and decimal mark."""

import re
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.table import Form, Table, refuse_unusable

_MAX_COLUMNS = 64
_SNIFFED_ROWS = 40
# An ECP heading has names of two words with single spaces in them.
_HEADING_WORDS = re.compile(
    r"encoder\s*\d+\s+(?:pos|vel|acc)\w*|commanded\s+\w+|control\s+effort|[^\s,;]+", re.IGNORECASE
)
_OPENING = re.compile(r"^[^\S\n]*(?:[A-Za-z]\w*\s*=\s*)?\[", re.MULTILINE)
_SPACES = None  # `str.split(None)`: any run of white space


def read_text(raw: bytes, *, source: str) -> Table:
    """Read a table of numbers from text.

    Raises
    ------
    SubmissionError : not text, not a table, or a row that does not fit; names the line.
    """
    text = _decode(raw, source=source).replace("\r\n", "\n").replace("\r", "\n")
    opening = _OPENING.search(text)
    return _ecp(text, opening, source) if opening else _delimited(text, source)


def _decode(raw: bytes, *, source: str) -> str:
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
        return raw.decode("latin-1")  # a micro sign from an old Windows program


# ------------------------------------------------------------------------- rows of numbers


@dataclass(frozen=True)
class _Rows:
    """Parsed rows: (n, width) numbers, their lines, and what shows that the file was cut."""

    values: np.ndarray
    lines: np.ndarray
    cut: str | None


def _parse(
    rows: Iterable[tuple[int, list[str]]],
    *,
    names: Sequence[str],
    source: str,
    decimal_comma: bool = False,
) -> _Rows:
    """Parse fields into numbers; a bad last row is a file cut short, any other an error."""
    width = len(names)
    numbers, lines = array("d"), array("q")
    failure: str | None = None
    for line, fields in rows:
        if failure is not None:  # the bad row was not the last
            raise SubmissionError(f"{source} {failure}")
        if decimal_comma:
            fields = [field.replace(",", ".") for field in fields]
        try:
            if len(fields) != width:
                raise ValueError
            numbers.extend([float(field) for field in fields])
        except ValueError:
            failure = f"line {line}: {_what_is_wrong(fields, names)}"
            continue
        lines.append(line)
    if not lines:
        raise SubmissionError(
            f"{source} {failure}" if failure else f"{source}: holds no rows of numbers"
        )
    values = np.frombuffer(numbers, dtype=np.float64).reshape(-1, width)
    refuse_unusable(values.T, names=names, place=lambda row: f"{source} line {lines[row]}")
    return _Rows(values=values, lines=np.array(lines), cut=failure)


def _what_is_wrong(fields: Sequence[str], names: Sequence[str]) -> str:
    """Return why a row does not fit its heading."""
    if [field.strip(" \"'").casefold() for field in fields] == [n.casefold() for n in names]:
        return "a second heading: two records pasted together"
    if len(fields) != len(names):
        return f"expected {len(names)} columns, found {len(fields)}"
    for name, field in zip(names, fields, strict=True):
        if not _is_number(field):
            if not field.strip():
                return f"{name!r} is empty"
            return f"{name!r} is no number: {field[:30]!r}"
    return "not a row of numbers"


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _table(
    rows: _Rows,
    *,
    source: str,
    form: Form,
    names: Sequence[str],
    typed: Sequence[str],
    cut: str | None,
    notes: Sequence[str] = (),
) -> Table:
    values = np.ascontiguousarray(rows.values.T)
    whole = tuple(
        "." not in field and "," not in field and bool((column == np.round(column)).all())
        for column, field in zip(values, typed, strict=True)
    )
    return Table(
        source=source,
        form=form,
        names=tuple(names),
        values=values,
        whole=whole,
        lines=rows.lines,
        cut=cut or rows.cut,
        notes=tuple(notes),
    )


def _checked_names(names: Sequence[str], *, source: str, line: int) -> list[str]:
    """Return headings without quotes; an empty one becomes its number."""
    if len(names) > _MAX_COLUMNS:
        raise SubmissionError(f"{source} line {line}: more than {_MAX_COLUMNS} columns")
    clean = [name.strip().strip("\"'").strip() or str(i) for i, name in enumerate(names, start=1)]
    clean = [name if name.isprintable() else repr(name)[1:-1] for name in clean]
    seen: set[str] = set()
    for name in clean:
        if name.casefold() in seen:
            raise SubmissionError(f"{source} line {line}: the heading {name[:40]!r} stands twice")
        seen.add(name.casefold())
    return clean


# ------------------------------------------------------------------------------ ECP exports


def _ecp(text: str, opening: re.Match[str], source: str) -> Table:
    """Read `heading [ row; row; … ]`, as the ECP program and MATLAB scripts of it write."""
    first_line = text.count("\n", 0, opening.end()) + 1
    end = text.find("]", opening.end())
    body = text[opening.end() : end if end >= 0 else len(text)]
    rows: list[tuple[int, list[str]]] = []
    for line, content in enumerate(body.split("\n"), start=first_line):
        pieces = content.partition("%")[0].split(";")
        rows += [(line, piece.replace(",", " ").split()) for piece in pieces if piece.strip()]
    if not rows:
        raise SubmissionError(f"{source} line {first_line}: no rows after the opening bracket")
    width = len(rows[0][1])
    heading, heading_line = _ecp_heading(text[: opening.start()])
    if heading and len(heading) != width:
        raise SubmissionError(
            f"{source} line {rows[0][0]}: expected {len(heading)} columns "
            f"as in the heading, found {width}"
        )
    names = _checked_names(
        heading or [str(i) for i in range(1, width + 1)], source=source, line=heading_line
    )
    notes = []
    cut = None
    if end < 0:
        cut = f"line {rows[-1][0]}: the closing bracket is missing"
    elif (rest := text[end + 1 :].strip("; \t\n")) != "":
        line = text.count("\n", 0, end) + 1
        if "[" in rest:
            raise SubmissionError(
                f"{source} line {line}: more data after the closing bracket; "
                "two records pasted together"
            )
        notes.append(f"text after line {line} is not data and was not read")
    return _table(
        _parse(rows, names=names, source=source),
        source=source,
        form="ecp",
        names=names,
        typed=rows[0][1],
        cut=cut,
        notes=notes,
    )


def _ecp_heading(head: str) -> tuple[list[str], int]:
    """Return the last line before the bracket that names a time or an encoder, and its number."""
    lines = head.split("\n")
    for number in range(len(lines), 0, -1):
        line = lines[number - 1].strip().lstrip("%#").strip()
        if re.search(r"\b(time|encoder)\b", line, re.IGNORECASE):
            return _HEADING_WORDS.findall(line), number
    return [], 1


# ----------------------------------------------------------------------------- delimited text


def _delimited(text: str, source: str) -> Table:
    """Read a heading and rows; the delimiter and the decimal mark are found."""
    lines = [(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]
    start, comment = 0, None
    while start < len(lines) and (
        lines[start][1].lstrip().startswith(("#", "%")) or lines[start][1].startswith("sep=")
    ):
        comment, start = lines[start], start + 1
    if start == len(lines):
        raise SubmissionError(
            f"{source}: the file is empty" if not lines else f"{source}: holds no rows of numbers"
        )
    sample = [line for _, line in lines[start : start + _SNIFFED_ROWS + 1]]
    found = _sniff(sample)
    if found is None:
        number, line = lines[min(start + 1, len(lines) - 1)]
        raise SubmissionError(
            f"{source} line {number}: not a table of numbers, found {line.strip()[:40]!r}"
        )
    delimiter, decimal_comma, has_heading, trailing = found

    def fields_of(line: str) -> list[str]:
        return _fields(line, delimiter, trailing)

    heading = fields_of(sample[0]) if has_heading else None
    first = start + 1 if has_heading else start
    typed = fields_of(lines[first][1])
    heading_line = lines[start][0]
    if heading is None and comment is not None:  # "# time, x1"
        names = _fields(comment[1].strip().lstrip("%#").strip(), delimiter, trailing=False)
        heading, heading_line = (names, comment[0]) if len(names) == len(typed) else (None, 0)
    names = _checked_names(
        heading or [str(i) for i in range(1, len(typed) + 1)], source=source, line=heading_line
    )
    rows = _parse(
        ((number, fields_of(line)) for number, line in lines[first:]),
        names=names,
        source=source,
        decimal_comma=decimal_comma,
    )
    return _table(
        rows,
        source=source,
        form="bench_log" if _is_bench_log(names, delimiter) else "csv",
        names=names,
        typed=typed if len(typed) == len(names) else [""] * len(names),
        cut=None,
    )


def _is_bench_log(names: Sequence[str], delimiter: str | None) -> bool:
    """Tell the bench's own log: an ECP's headings, but no commanded position and no brackets."""
    words = {name.casefold() for name in names}
    return (
        {"sample", "time", "control effort"} <= words
        and any(word.startswith("encoder") for word in words)
        and "commanded pos" not in words
    )


def _fields(line: str, delimiter: str | None, trailing: bool) -> list[str]:
    if delimiter is None:
        words = _HEADING_WORDS.findall(line)
        return words if any(w[0].isalpha() for w in words) else line.split()
    fields = line.strip(" \n" if delimiter == "\t" else None).split(delimiter)
    return fields[:-1] if trailing and fields and not fields[-1].strip() else fields


def _sniff(sample: Sequence[str]) -> tuple[str | None, bool, bool, bool] | None:
    """Return (delimiter, decimal comma, has a heading, a delimiter ends each row), or None.

    The delimiter that makes the most rows into numbers of one width wins; of equals the first,
    so that "0,5;1,2" is two numbers with decimal commas and "0,5" two whole ones.
    """
    best, best_score = None, 0.0
    for delimiter in ("\t", ";", ",", _SPACES):
        for decimal_comma in (False, True) if delimiter != "," else (False,):
            trailing = delimiter not in (None, "\t") and all(
                line.rstrip().endswith(delimiter) for line in sample[1:] or sample
            )
            split = [_fields(line, delimiter, trailing) for line in sample]
            if decimal_comma:
                split = [[field.replace(",", ".") for field in fields] for fields in split]
            has_heading = not all(_is_number(field) for field in split[0])
            rows = split[1:] if has_heading else split
            width = len(split[0])
            numeric = [len(row) for row in rows if all(map(_is_number, row))]
            # One column only where nothing else fits; numbers under a heading of another width
            # only to say so.
            score = numeric.count(width) * (2 if width > 1 else 1) + 0.01 * len(numeric)
            if score > best_score:
                best, best_score = (delimiter, decimal_comma, has_heading, trailing), score
    return best
