"""What a student claims beside what the last report found in the data."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.desk.student.form import read_document
from pipeline.errors import SubmissionError
from pipeline.report.numbers import percent, with_error
from pipeline.submission.edit import submission_text
from pipeline.submission.load import outside

_MOST_BYTES = 20_000_000


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A number of `[reported]`: as typed, and as the data have it."""

    name: str
    which: str  # initial or final
    unit: str
    yours: str
    found: str
    differs: str


def compare_claims(folder: Path) -> list[Claim]:
    """Return the claims that the last report has a number for; none where there is no report."""
    reported = read_document(submission_text(folder)).get("reported", {})
    claims = []
    for row in _parameters(folder):
        for which in ("initial", "final"):
            value, mine = row.get(which), _typed(reported, which, row["name"])
            if value is not None and mine is not None:
                number = _number(mine)
                off = None if number is None or not value else 100 * (number - value) / abs(value)
                claims.append(
                    Claim(
                        name=row["name"],
                        which=which,
                        unit=row["unit"],
                        yours=str(mine),
                        found=with_error(value, row.get(f"{which}_std")),
                        differs=percent(off, signed=True),
                    )
                )
    return claims


def read_json(folder: Path, name: str) -> Mapping[str, Any]:
    """Return a JSON file of the report; {} where there is none to be read."""
    try:
        if outside(folder, name) is None and (folder / name).stat().st_size < _MOST_BYTES:
            found = json.loads((folder / name).read_bytes())
            return found if isinstance(found, dict) else {}
    except (OSError, ValueError, RecursionError, SubmissionError):
        pass
    return {}


def _parameters(folder: Path) -> list[Mapping[str, Any]]:
    return list(read_json(folder, "report/results.json").get("parameters", ()))


def _typed(reported: Any, which: str, name: str) -> object:
    table = reported.get(which) if isinstance(reported, dict) else None
    return table.get(name) if isinstance(table, dict) else None


def _number(value: object) -> float | None:
    try:
        return float(str(value))
    except ValueError:
        return None
