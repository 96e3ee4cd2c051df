"""An answer of the check as text, with sentences from `templates/words/check.toml`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import SubmissionError
from pipeline.grading.self_check.log import (
    CheckAnswer,
    Hint,
    MistakeKind,
    RecordingPart,
    read_answers,
)
from pipeline.grading.words import WORDS as GRADING
from pipeline.words.numbers import count
from pipeline.words.phrases import phrases
from pipeline.words.text import symbol_text

WORDS = phrases("check")
_NAMED = 4  # largest number of recordings named one by one; of more, only the first and last


@dataclass(frozen=True, kw_only=True)
class HintWords:
    """A hint as text, one sentence each for the kind of mistake and for where to look."""

    title: str
    look: tuple[str, ...]


def number_words(number: str) -> str:
    """Return the name of a reported number as a page shows it: "K₁, first estimate"."""
    table, _, name = number.partition(".")
    if table == "feedback":
        return WORDS.text(f"feedback_{name}")
    if not name:
        return WORDS.text("state_space")
    called = name if table == "state_space" else symbol_text(name)
    return f"{called}, {WORDS.text(f'table_{table}')}"


def result_words(answer: CheckAnswer) -> str:
    """Return the result of a check as a sentence."""
    wrong, checked = len(answer.disagree), len(answer.disagree) + len(answer.agree)
    if not checked:
        return WORDS.text("nothing_read" if answer.unread else "nothing_checked")
    if wrong == 1:
        return WORDS.text("disagree_one", all=checked)
    return WORDS.text("disagree", some=wrong, all=checked) if wrong else WORDS.text(
        "agree", all=checked
    )  # fmt: skip


def asked_words(times: int) -> str:
    """Return a sentence that says how often the numbers were checked, and who sees this."""
    return WORDS.text("asked", times=count(times, "time"))


def hint_words(hint: Hint) -> HintWords:
    """Return a hint as text."""
    look = [WORDS.text("where", place=_slip_text("place", hint.slip))]
    look += [
        WORDS.text("or_else", title=_slip_text("title", slip), place=_slip_text("place", slip))
        for slip in hint.or_else
    ]
    look += [_stretch_text(stretch) for stretch in hint.stretches]
    return HintWords(title=_slip_text("title", hint.slip), look=tuple(look))


def _slip_text(what: str, slip: MistakeKind) -> str:
    key = f"{what}_{slip}"
    return (WORDS if key in WORDS.by_key else GRADING).text(key)


def _stretch_text(stretch: RecordingPart) -> str:
    part = WORDS.text(f"part_{stretch.part}")
    if len(stretch.recordings) == 1:
        return WORDS.text("stretch_one", runs=stretch.recordings[0], part=part)
    kind = WORDS.text(f"kind_{stretch.kind}")
    return WORDS.text("stretch_every", kind=kind, runs=_runs_text(stretch.recordings), part=part)


def _runs_text(runs: Sequence[str]) -> str:
    return ", ".join(runs) if len(runs) <= _NAMED else f"{runs[0]} … {runs[-1]}"


def answer_lines(answer: CheckAnswer) -> Iterator[str]:
    """Yield an answer as lines for a terminal; each number is named by its key."""
    yield result_words(answer)
    hinted: dict[tuple, list[Hint]] = {}
    for hint in answer.hints:
        hinted.setdefault((hint.slip, hint.or_else, hint.stretches), []).append(hint)
    for hints in hinted.values():
        words = hint_words(hints[0])
        yield f"  {', '.join(hint.number for hint in hints)}: {words.title}"
        yield from (f"      {line}" for line in words.look)
    with_hint = {hint.number for hint in answer.hints}
    left = [number for number in answer.disagree if number not in with_hint]
    yield from (f"  {number}" for number in left)
    if answer.not_checked:
        yield WORDS.text("not_checked", numbers=", ".join(answer.not_checked))
    if answer.unread:
        yield WORDS.text("unread")
        yield from (f"  {message}" for message in answer.unread)
    if answer.doubtful:
        yield WORDS.text("doubtful", runs=", ".join(answer.doubtful))
    if left:
        yield WORDS.text("ask_again")
    yield asked_words(answer.ask)


def asked_note(folder: Path) -> tuple[str, ...]:
    """Return a note for the TA on how often the students used the check; empty if never."""
    try:
        times = len(read_answers(folder))
    except SubmissionError:
        return (WORDS.text("note_not_read"),)
    return (WORDS.text("note_asked", times=count(times, "time")),) if times else ()
