"""What could not run, and what a reader must know."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

from pipeline.errors import DataError
from pipeline.results import Skipped

P = ParamSpec("P")
T = TypeVar("T")
Progress = Callable[[str], None]


@dataclass
class Log:
    """What could not run and what a reader must know, collected along the way."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    measured: dict[str, Any] = field(default_factory=dict)  # by stage, for `attempt_once`

    def attempt(
        self, stage: str, run: Callable[P, T], *args: P.args, **options: P.kwargs
    ) -> T | None:
        """Run one stage; data that do not support it are a reason, not an end."""
        try:
            return run(*args, **options)
        except DataError as error:
            self.skip(stage, str(error))
            return None

    def attempt_once(
        self, stage: str, run: Callable[P, T], *args: P.args, **options: P.kwargs
    ) -> T | None:
        """Run a stage of one record, which tells the same whatever others are left out."""
        if stage not in self.measured:
            try:
                self.measured[stage] = run(*args, **options)
            except DataError as error:
                self.measured[stage] = error
        found = self.measured[stage]
        if isinstance(found, DataError):
            self.skip(stage, str(found))
            return None
        return found

    def skip(self, stage: str, reason: str, *, missing: str = "") -> None:
        """Note why a stage did not run, and what would let it."""
        self.skipped.append(Skipped(stage=stage, reason=reason, missing=missing))

    def warn(self, texts: Iterable[str]) -> None:
        """Add what is not said yet."""
        self.warnings += [text for text in texts if text and text not in self.warnings]

    def add(self, other: "Log") -> None:
        """Add what another log holds."""
        self.skipped += other.skipped
        self.warn(other.warnings)
