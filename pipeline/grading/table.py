"""Tables as CSV, written so that a spreadsheet runs nothing that a student wrote."""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from pipeline.errors import ConfigError

_MOST_BYTES = 20_000_000
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_FORMULA = tuple("=+-@\t\r\n＝＋－＠")  # what starts a formula, full-width forms too
_UNSEEN = " \v\f\u00a0\u200b\u2060\ufeff"


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]], *, bom: bool = False) -> str:
    """Return a table as CSV: commas, line feeds, formulas neutralised.

    Parameters
    ----------
    bom : start with the mark by which Excel knows UTF-8.
    """
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([neutral(text) for text in head])
    writer.writerows([neutral(value) for value in row] for row in rows)
    return ("\ufeff" if bom else "") + buffer.getvalue()


def neutral(value: object) -> str:
    """Return a cell; text that a spreadsheet would take for a formula begins with an apostrophe."""
    if isinstance(value, float):
        return f"{value:.10g}"
    text = str(value).replace("\0", "")
    # Blanks, and marks that show as nothing, do not keep a spreadsheet from seeing a formula.
    if text.lstrip(_UNSEEN).startswith(_FORMULA) and not _NUMBER.fullmatch(text):
        return f"'{text}"
    return text


def read_table(path: Path) -> list[tuple[int, list[str]]]:
    """Return the rows of a CSV with the lines they end on: commas, semicolons or tabs.

    Raises
    ------
    ConfigError : it is no such table.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path.name}: is larger than {_MOST_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path.name}: is not UTF-8 text; export it anew as CSV") from None
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise ConfigError(f"{path.name} line {reader.line_num}: no table: {error}") from None
    return [(line, row) for line, row in rows if any(cell.strip() for cell in row)]
