"""Stages that could not run, and warnings."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pipeline.errors import DataError
from pipeline.results import Skipped, Stage

T = TypeVar("T")


@dataclass
class Log:
    """Skipped stages and warnings, collected along the way."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    measured: dict[Any, Any] = field(default_factory=dict)  # by stage, run and cart

    def attempt(self, stage: Stage, run: Callable[[], T], *, of: str = "") -> T | None:
        """Run one stage, perhaps for one recording `of`; unsuitable data are noted as a reason."""
        try:
            return run()
        except DataError as error:
            self.skip(stage, str(error), run=of)
            return None

    def attempt_once(self, stage: Stage, run: Callable[[], T], *, of: str, cart: int) -> T | None:
        """Run a stage of one record, whose result does not depend on which others are left out."""
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
        """Add a warning, unless it exists already."""
        self.warnings += [text for text in texts if text and text not in self.warnings]

    def add(self, other: "Log") -> None:
        """Add the content of another log."""
        self.skipped += other.skipped
        self.warn(other.warnings)
