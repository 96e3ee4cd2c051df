"""A fault of a recording, and where it becomes a sentence: `templates/words/soundness.toml`.

`tests/statistics/test_honest_records.py` shows that no honest record is accused, of sticking carts
and coarse encoders too; `tests/grading/mistakes/test_faults.py` that wrong ones are found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pipeline.results import Check, CheckKind, LeftOut, Record
from pipeline.words.phrases import phrases

_WORDS = phrases("soundness")

# Who may bear witness: one record, or one kind of record, is right or wrong by chance.
WITNESSES = 2
SIGMAS = 4.0  # standard errors: by chance one number in 16,000 is as far off
SAME = 0.02  # relative: of an encoder step, a clock or a length that a program sets for all
SAME_SIZE = 0.2  # relative: two steps that friction treats alike


@dataclass(frozen=True, kw_only=True)
class RecordingFault:
    """What is wrong with a recording, or contradicts others.

    Attributes
    ----------
    code : of which sort; the key of its sentence.
    run, cart : where; no cart where it is none's.
    said : what stands in the sentence, already written as text.
    value, limit : the number that shows it, and how large it may be at most, if there is one.
    is_wrong : the recording does not hold what happened; else it only stands off others.
    """

    code: str
    run: str
    cart: int | None = None
    said: Mapping[str, str] = field(default_factory=dict)
    value: float | None = None
    limit: float | None = None
    is_wrong: bool = True

    @property
    def reason(self) -> str:
        """What is wrong, in words that follow the recording's name."""
        return _WORDS.text(self.code, cart=self.cart, **self.said)

    @property
    def left_out(self) -> LeftOut:
        """The recording as one that is not used."""
        return LeftOut(experiment=self.run, reason=self.reason, is_wrong=self.is_wrong)

    def check(self, kind: CheckKind) -> Check:
        """Return the failed check of a kind that finds it."""
        return Check(
            kind=kind,
            run=self.run,
            cart=self.cart if kind == "held" else None,
            outcome="fail",
            value=self.value,
            limit=self.limit,
            message=f"{self.run}: {self.reason}",
        )


def say(key: str, **values: str) -> str:
    """Return a part of such a sentence, or one with others in it."""
    return _WORDS.text(key, **values)


def sound_ones(records: Sequence[Record], left_out: Sequence[LeftOut]) -> list[Record]:
    """Return the records of which nothing is said to be wrong; they may stand off others."""
    wrong = {one.experiment for one in left_out if one.is_wrong}
    return [record for record in records if record.id not in wrong]
