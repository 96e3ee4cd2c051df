"""Run stages, and note those that could not run."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

from pipeline.errors import DataError
from pipeline.results import LogDecrement, SinePoint, Skipped, Stage, StepGain

T = TypeVar("T")
# The result of a stage, or its error, by record and cart.
Known: TypeAlias = dict[tuple[str, int], T | DataError]


@dataclass(frozen=True)
class Measured:
    """The results that depend on a single record; they stay the same if others are left out."""

    decays: Known[list[LogDecrement]] = field(default_factory=dict)
    gains: Known[StepGain] = field(default_factory=dict)
    points: Known[SinePoint] = field(default_factory=dict)


@dataclass
class Log:
    """Skipped stages and warnings of one analysis."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    measured: Measured = field(default_factory=Measured)

    def attempt(self, stage: Stage, run: Callable[[], T], *, of: str = "") -> T | None:
        """Run one stage; if the data are unsuitable, note the reason and return None.

        `of` is the id of the recording, if the stage uses only one.
        """
        try:
            return run()
        except DataError as error:
            self.skip(stage, str(error), run=of)
            return None

    def attempt_once(
        self, stage: Stage, run: Callable[[], T], known: Known[T], *, of: str, cart: int
    ) -> T | None:
        """Run a stage of one record as `attempt` does, and once only: `known` keeps its result."""
        if (of, cart) not in known:
            try:
                known[of, cart] = run()
            except DataError as error:
                known[of, cart] = error
        found = known[of, cart]
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
