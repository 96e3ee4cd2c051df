"""Tables that platforms and people bring as CSV."""

import csv
import io
from pathlib import Path

from pipeline.errors import ConfigError

_MOST_BYTES = 20_000_000


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
