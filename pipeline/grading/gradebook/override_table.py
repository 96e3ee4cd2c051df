"""Points given by hand, many at once: a table with a row for each."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.override import read_points
from pipeline.grading.table import read_table

_HEADS = ("submission", "criterion", "points", "why")


@dataclass(frozen=True, kw_only=True)
class Wish:
    """A row of the table; points None: the automatic ones again."""

    line: int
    submission: str
    criterion: str
    points: float | None
    why: str


def read_wishes(path: Path) -> list[Wish]:
    """Read a CSV with the columns submission, criterion, points (or auto) and why.

    Raises
    ------
    ConfigError : it is no such table, with the line.
    """
    table = read_table(path)
    missing = [name for name in _HEADS if name not in table.columns]
    if missing or not table.columns.is_unique:
        raise ConfigError(
            f"{path.name}: needs the columns {', '.join(_HEADS)}, each once"
            + (f"; it lacks {', '.join(missing)}" if missing else "")
        )
    wishes = []
    for line, row in table.iterrows():
        submission, criterion, points, why = (str(row[name]).strip() for name in _HEADS)
        try:
            given = read_points(points)
        except ConfigError as error:
            raise ConfigError(f"{path.name} line {line}: {error}") from None
        wishes.append(
            Wish(line=int(str(line)), submission=submission, criterion=criterion, points=given,
                 why=why)
        )  # fmt: skip
    return wishes
