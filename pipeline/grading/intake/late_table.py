"""Find how late each hand-in is, from the rubric's deadline or from a table.

The table has the columns `submission` and `days_late`. Its values replace the computed lateness, so
they can also grant extensions.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.grading.intake.find import HandIn
from pipeline.grading.rubric import Late
from pipeline.submission.toml import quote

_DAY = 86_400.0  # s
_HEADS = ["submission", "days_late"]
_LONGEST = 3_650.0  # days; a larger number must be a typing error


def read_late_table(path: Path) -> dict[str, float]:
    """Return the days late by submission name; the names are in lower case.

    Raises
    ------
    ConfigError : the table lacks a column, or one of its rows is not valid.
    """
    table = read_table(path)
    if not {*_HEADS} <= {*table.columns}:
        raise ConfigError(f"{path.name}: expected columns {' and '.join(_HEADS)}")
    days: dict[str, float] = {}
    for line, *cells in table.loc[:, _HEADS].itertuples():
        who, typed = (str(cell).strip() for cell in cells[:2])
        late = _number(typed)
        if late is None or not 0 <= late <= _LONGEST:
            raise ConfigError(f"{path.name} line {line}: days_late: cannot read {quote(typed)}")
        if days.get(who.casefold(), late) != late:
            raise ConfigError(
                f"{path.name} line {line}: {late:g} days late here, and "
                f"{days[who.casefold()]:g} in an earlier line: keep one of them"
            )
        if who:
            days[who.casefold()] = late
    return days


def settle_lateness(
    hand_ins: Iterable[HandIn], *, late: Late, table: Mapping[str, float]
) -> tuple[list[HandIn], list[str]]:
    """Return the hand-ins with their lateness, and the names in the table that match no hand-in.

    The table takes precedence over the deadline, and the deadline over a platform's late mark.
    """
    settled, known = [], set()
    for hand_in in hand_ins:
        days = table.get(hand_in.id.casefold())
        known.add(hand_in.id.casefold())
        if days is None and late.due is not None and hand_in.handed_in:
            waited = datetime.fromisoformat(hand_in.handed_in) - late.due
            days = max(0.0, waited.total_seconds() / _DAY)
        settled.append(hand_in if days is None else replace(hand_in, days_late=days))
    return settled, [name for name in table if name not in known]


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", ".") or 0)
    except ValueError:
        return None
