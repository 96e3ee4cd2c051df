"""What the searches for findings share: witnesses, limits, parts of sentences, valid records.

`tests/statistics/test_honest_records.py` shows that good records are not accused, even with
sticking carts and coarse encoders. `tests/grading/mistakes/test_faults.py` shows that wrong records
are found.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pipeline.errors import DataError
from pipeline.results import Finding, Record, Skipped, Stage
from pipeline.words.phrases import phrases

_WORDS = phrases("findings")
# Independent records, or kinds of record, that must agree. A single one may be wrong by chance.
WITNESSES = 2
SIGMAS = 4.0  # standard errors; by chance, one number in 16,000 is as far off
# Relative difference up to which encoder steps, clocks or lengths are equal, if a program sets them
# for all recordings.
SAME = 0.02
SAME_SIZE = 0.2  # relative difference up to which friction affects two step sizes equally
T = TypeVar("T")


def say(key: str, **values: object) -> str:
    """Return the sentence, or part of a sentence, with this key."""
    return _WORDS.text(key, **values)


def valid_records(records: Sequence[Record], left_out: Sequence[Finding]) -> list[Record]:
    """Return the records that show what happened, even if they differ from others."""
    wrong = {one.experiment for one in left_out if one.is_wrong}
    return [record for record in records if record.id not in wrong]


@dataclass
class Log:
    """Skipped stages and warnings of one analysis."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    measured: dict[Any, Any] = field(default_factory=dict)  # results by stage, record and cart

    def attempt(self, stage: Stage, run: Callable[[], T], *, of: str = "") -> T | None:
        """Run one stage; if the data are unsuitable, note the reason and return None.

        `of` is the id of the recording, if the stage uses only one.
        """
        try:
            return run()
        except DataError as error:
            self.skip(stage, str(error), run=of)
            return None

    def attempt_once(self, stage: Stage, run: Callable[[], T], *, of: str, cart: int) -> T | None:
        """Run a stage of one record as `attempt` does, but only once; then reuse its result."""
        key = stage, of, cart
        if key not in self.measured:
            try:
                self.measured[key] = run()
            except DataError as error:
                self.measured[key] = error
        found = self.measured[key]
        if isinstance(found, DataError):
            self.skip(stage, str(found), run=of, cart=cart)
            return None
        return found

    def skip(
        self,
        stage: Stage,
        reason: str,
        *,
        run: str = "",
        cart: int | None = None,
        missing: str = "",
    ) -> None:
        """Note why a stage did not run, and what it would need."""
        self.skipped.append(
            Skipped(stage=stage, run=run, cart=cart, reason=reason, missing=missing)
        )

    def warn(self, texts: Iterable[str]) -> None:
        """Add warnings, except those that exist already."""
        self.warnings += [text for text in texts if text and text not in self.warnings]

    def add(self, other: "Log") -> None:
        """Add the content of another log."""
        self.skipped += other.skipped
        self.warn(other.warnings)
