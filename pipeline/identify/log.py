"""Run stages, and note those that could not run."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

from pipeline.errors import DataError
from pipeline.results import Skipped, Stage

T = TypeVar("T")
# The result of a stage that uses a single record, or its error, by stage, record and cart. It stays
# the same if other records are left out.
Measured: TypeAlias = dict[tuple[Stage, str, int], Any]


@dataclass
class Log:
    """Skipped stages and warnings of one analysis."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    measured: Measured = field(default_factory=dict)

    def attempt(
        self, stage: Stage, run: Callable[[], T], *, of: str = "", cart: int = 0
    ) -> T | None:
        """Run one stage; if the data are unsuitable, note the reason and return None.

        `of` is the id of the recording, if the stage uses only one. A stage that also uses only one
        `cart` of it is run only if `measured` lacks its result.
        """
        known = self.measured if cart else {}
        key = stage, of, cart
        if key not in known:
            try:
                known[key] = run()
            except DataError as error:
                known[key] = error
        found = known[key]
        if isinstance(found, DataError):
            self.skip(stage, str(found), run=of, cart=cart or None)
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
