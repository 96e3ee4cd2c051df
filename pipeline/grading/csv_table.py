"""Read CSV tables written by learning platforms or by people."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd

_MOST_BYTES = 20_000_000
_MOST_ROWS, _MOST_COLUMNS = 100_000, 2_000  # more than any class or questionnaire has


def read_table(path: Path, *, exact: bool = False) -> "pd.DataFrame":
    """Return the cells of a CSV file as text, one row per record.

    The index of a row is the line of the file on which the row ends. Separators are commas,
    semicolons or tabs. Empty rows are left out, short rows are padded with empty cells, and cells
    beyond the heading are dropped.

    Parameters
    ----------
    exact : whether to refuse rows with more cells than the heading, as "0,5" gives them.

    Raises
    ------
    ConfigError : the file cannot be read, is not a CSV table, or is too large.
    """
    import pandas as pd

    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path.name}: is larger than {_MOST_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path.name}: is not UTF-8 text; save it as CSV UTF-8") from None
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    # Messages need the line of each row, which pandas' own reader does not report.
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter)
    head: list[str] = []
    rows: dict[int, list[str]] = {}
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if not head:
                head = [name.strip() for name in row]
            else:
                if exact and any(cell.strip() for cell in row[len(head) :]):
                    raise ConfigError(
                        f"{path.name} line {reader.line_num}: expected {len(head)} cells, found "
                        f"{len(row)}; write numbers with a point, or separate cells by semicolons"
                    )
                rows[reader.line_num] = [*row, *[""] * (len(head) - len(row))][: len(head)]
            if len(head) > _MOST_COLUMNS or len(rows) > _MOST_ROWS:
                raise ConfigError(
                    f"{path.name}: has more than {_MOST_COLUMNS} columns or {_MOST_ROWS} rows"
                )
    except csv.Error as error:
        raise ConfigError(f"{path.name} line {reader.line_num}: not a table: {error}") from None
    return pd.DataFrame(list(rows.values()), index=list(rows), columns=head, dtype=object)
