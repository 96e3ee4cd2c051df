"""Collect the stages that could not run, and warnings."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pipeline.errors import DataError
from pipeline.results import Skipped, Stage

T = TypeVar("T")


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
