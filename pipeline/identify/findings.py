"""What the searches for findings share: witnesses, limits, parts of sentences, valid records.

`tests/statistics/test_honest_records.py` shows that good records are not accused, even with
sticking carts and coarse encoders. `tests/grading/mistakes/test_faults.py` shows that wrong records
are found.
"""

from collections.abc import Iterable, Mapping, Sequence

from pipeline.results import Finding, Record
from pipeline.words.phrases import phrases

_WORDS = phrases("findings", "parts")
# Independent records, or kinds of record, that must agree. A single one may be wrong by chance.
WITNESSES = 2
SIGMAS = 4.0  # standard errors; by chance, one number in 16,000 is as far off
# Relative difference up to which encoder steps, clocks or lengths are equal, if a program sets them
# for all recordings.
SAME = 0.02
SAME_SIZE = 0.2  # relative difference up to which friction affects two step sizes equally


def say(key: str, **values: object) -> str:
    """Return a part of a sentence, or the sentence of a check that does not fail."""
    return _WORDS.text(key, **values)


def explain_ratio(ratio: float, factors: Mapping[float, str], *, within: float) -> str:
    """Return the words for the known factor that a ratio equals, within a relative error, or ""."""
    return next((said for factor, said in factors.items() if abs(ratio / factor - 1) < within), "")


def first_by_run(found: Iterable[Finding]) -> dict[str, Finding]:
    """Return the first finding of each recording, by the recording's id."""
    first: dict[str, Finding] = {}
    for one in found:
        first.setdefault(one.run, one)
    return first


def by_kind(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Return the records of each kind of experiment, in the order of the records."""
    kinds: dict[str, list[Record]] = {}
    for record in records:
        kinds.setdefault(record.kind, []).append(record)
    return kinds


def valid_records(records: Sequence[Record], left_out: Sequence[Finding]) -> list[Record]:
    """Return the records that show what happened, even if they differ from others."""
    wrong = {one.run for one in left_out if one.is_wrong}
    return [record for record in records if record.id not in wrong]
