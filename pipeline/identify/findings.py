"""What is wrong with a recording, the set-up or the model, and which stages could not run.

Each `Finding` has its sentence in `templates/words/findings.toml`.
`tests/statistics/test_honest_records.py` shows that good records are not accused, even with
sticking carts and coarse encoders. `tests/grading/mistakes/test_faults.py` shows that wrong records
are found.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from pipeline.errors import DataError
from pipeline.results import Check, CheckKind, LeftOut, Record, Skipped, Stage
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
Excludes = Literal["no", "odd", "wrong"]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that is wrong with a recording, the set-up or the model.

    Attributes
    ----------
    code : what is wrong, which is also the key of its sentence.
    kind : the consistency check that fails.
    run, cart, parameter, part : what it is about, as in `Check`. Without a cart, it concerns the
        whole recording; without a recording, the set-up or the model.
    details : values for the sentence.
    value, limit : the number that shows it, and its largest allowed value. None if there is no such
        number.
    excludes : whether the recording is used: "no" if it is, "odd" if it is left out because it
        differs from others, "wrong" if it is left out because it does not show what happened.
    """

    code: str
    kind: CheckKind = "record"
    run: str = ""
    cart: int | None = None
    parameter: str = ""
    part: str = ""
    details: Mapping[str, object] = field(default_factory=dict)
    value: float | None = None
    limit: float | None = None
    excludes: Excludes

    @property
    def reason(self) -> str:
        """What is wrong, in words that follow the recording's name, if it is about one."""
        return say(self.code, **{"cart": self.cart, **self.details})

    @property
    def check(self) -> Check:
        """The failed check."""
        return Check(
            kind=self.kind,
            run=self.run,
            cart=self.cart,
            parameter=self.parameter,
            part=self.part,
            outcome="fail",
            value=self.value,
            limit=self.limit,
            message=f"{self.run}: {self.reason}" if self.run else self.reason,
        )

    @property
    def left_out(self) -> LeftOut:
        """The entry in the list of recordings that were not used."""
        return LeftOut(experiment=self.run, reason=self.reason, is_wrong=self.excludes == "wrong")


def say(key: str, **values: object) -> str:
    """Return the sentence, or part of a sentence, with this key."""
    return _WORDS.text(key, **values)


def valid_records(records: Sequence[Record], left_out: Sequence[LeftOut]) -> list[Record]:
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
