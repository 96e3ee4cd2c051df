"""How late each hand-in is: by the rubric's deadline, or a table that somebody has.

The table is Gradescope's *Download Grades*, Moodle's grading worksheet, or one's own with the
columns `submission` and `days_late`: extensions, too, are a line in it.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.intake.hand_ins import HandIn
from pipeline.grading.intake.lms_names import read_owner
from pipeline.grading.rubric import Late
from pipeline.grading.table import read_table
from pipeline.submission.complaints import quote

_DAY = 86_400.0  # s
_CLOCK = re.compile(r"(\d+):([0-5]\d):([0-5]\d)")
# Moodle's status of a submission: "Submitted for grading - 1 day 3 hours late - Released".
_LATE = re.compile(r"((?:\d+ [a-z]+ ?)+) late\b")
_PART = re.compile(r"(\d+) (year|week|day|hour|min|sec)s?")
_SECONDS = {"year": 365 * _DAY, "week": 7 * _DAY, "day": _DAY, "hour": 3600.0, "min": 60.0,
            "sec": 1.0}  # fmt: skip
_ENGLISH = ("submitted", "submission")
_PARTICIPANT = re.compile(r"\D*(\d+)")
_LONGEST = 3_650.0  # days: more is a slip of the keyboard


@dataclass(frozen=True, kw_only=True)
class LateTable:
    """Days late by what a table knows a hand-in by: ("", its id), or a platform and its number."""

    file: str
    days: Mapping[tuple[str, str], float]

    @classmethod
    def read(cls, path: Path) -> "LateTable":
        """Read a table.

        Raises
        ------
        ConfigError : it is none of the three, or a line in it cannot be understood.
        """
        table = read_table(path)
        form = next((form for form in _FORMS if set(form[1]) <= set(table.columns)), None)
        if form is None:
            raise ConfigError(
                f"{path.name}: says nobody's lateness: expected columns submission and days_late, "
                "Gradescope's grades or Moodle's grading worksheet"
            )
        platform, (name, value) = form
        days: dict[tuple[str, str], float] = {}
        for line, *cells in table.loc[:, [name, value]].itertuples():
            who, said = (str(cell).strip() for cell in cells[:2])
            if platform == "moodle" and (found := _PARTICIPANT.fullmatch(who)):
                who = found[1]
            late = _READERS[value](said)
            if late is None or not 0 <= late <= _LONGEST:
                raise ConfigError(f"{path.name} line {line}: {value}: cannot read {quote(said)}")
            if who:
                days[platform, who if platform else who.casefold()] = late
        return cls(file=path.name, days=days)

    def of(self, hand_in: HandIn) -> float | None:
        """Return how late a hand-in is, None where the table does not know it."""
        _, platform, number = read_owner(hand_in.owner)
        if platform and (platform, number) in self.days:
            return self.days[platform, number]
        return self.days.get(("", hand_in.id.casefold()))


def settle_lateness(
    hand_ins: Iterable[HandIn], *, late: Late, table: LateTable | None
) -> tuple[list[HandIn], list[str]]:
    """Return the hand-ins with their lateness, and what a person should know about it.

    The table goes before the deadline, and that before the mark a platform makes.
    """
    settled, known = [], set()
    for hand_in in hand_ins:
        days = table.of(hand_in) if table else None
        known |= {hand_in.id.casefold()}
        if days is None and late.due is not None and hand_in.handed_in:
            waited = datetime.fromisoformat(hand_in.handed_in) - late.due
            days = max(0.0, waited.total_seconds() / _DAY)
        settled.append(hand_in if days is None else replace(hand_in, days_late=days))
    strangers = [name for platform, name in table.days if not platform] if table else []
    missing = [name for name in strangers if name not in known]
    remarks = (
        [f"{table.file}: no such submission: {', '.join(missing)}"] if missing and table else []
    )
    return settled, remarks


def _own_days(text: str) -> float | None:
    try:
        return float(text.replace(",", ".") or 0)
    except ValueError:
        return None


def _clock_days(text: str) -> float | None:
    """Return H:M:S as days; nothing there: nothing handed in."""
    found = _CLOCK.fullmatch(text)
    if not text or found is None:
        return None if text else 0.0
    hours, minutes, seconds = map(int, found.groups())
    return (3600 * hours + 60 * minutes + seconds) / _DAY


def _status_days(text: str) -> float | None:
    """Return the lateness in a status of Moodle's; None where it is not in English."""
    if found := _LATE.search(text):
        parts: Sequence[tuple[str, str]] = _PART.findall(found[1])
        return sum(int(count) * _SECONDS[unit] for count, unit in parts) / _DAY
    return 0.0 if not text or any(word in text.casefold() for word in _ENGLISH) else None


_FORMS: tuple[tuple[str, tuple[str, str]], ...] = (
    ("", ("submission", "days_late")),
    ("gradescope", ("Submission ID", "Lateness (H:M:S)")),
    ("moodle", ("Identifier", "Status")),
)
_READERS = {
    "days_late": _own_days,
    "Lateness (H:M:S)": _clock_days,
    "Status": _status_days,
}
