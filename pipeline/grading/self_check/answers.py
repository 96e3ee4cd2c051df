"""The answers of the check: stored in `checks.jsonl` of the submission, and as text.

The answers contain no values. But with enough guesses they would reveal a number, so the file
counts every request, one line each, and is part of the submission. The sentences are in
`templates/words/check.toml`.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, ValidationError

from pipeline.errors import SubmissionError
from pipeline.grading.grade import Code, GradeTable
from pipeline.grading.words import WORDS as GRADING
from pipeline.output import write_file
from pipeline.results import ExperimentKind
from pipeline.submission import Submission
from pipeline.submission.load import file_problem
from pipeline.words.numbers import count
from pipeline.words.phrases import phrases
from pipeline.words.text import symbol_text

FILE = "checks.jsonl"
MAX_BYTES = 5_000_000  # bytes; enough for several thousand requests

Part = Literal["whole", "beginning", "first_half", "middle", "second_half", "end"]
MistakeKind = Code | Literal["claims_off"]


class RecordingPart(GradeTable):
    """A part of a recording, or the same part of several recordings of one kind.

    All sine dwells are named, because a single one would reveal a resonance.
    """

    kind: ExperimentKind
    recordings: tuple[str, ...]
    part: Part


class Hint(GradeTable):
    """Where to look for one number."""

    number: str
    slip: Annotated[MistakeKind, Field(description="the kind of mistake")]
    or_else: Annotated[
        tuple[MistakeKind, ...], Field(description="another mistake that explains it equally well")
    ] = ()
    stretches: tuple[RecordingPart, ...] = ()


class CheckAnswer(GradeTable):
    """One answer, a line of `checks.jsonl`; each number is named by its key under `[reported]`."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)

    schema_: Annotated[Literal["cartlab-check/1"], Field(alias="schema")] = "cartlab-check/1"
    ask: Annotated[int, Field(ge=1, description="number of checks, including this one")]
    stage: Literal["which", "where"]
    basis: Annotated[str, Field(description="unchanged as long as set-up, tables and numbers are")]
    disagree: tuple[str, ...]
    agree: tuple[str, ...]
    not_checked: Annotated[
        tuple[str, ...], Field(description="reported, but not decided by any recording")
    ]
    unread: Annotated[
        tuple[str, ...],
        Field(description="why a number or table cannot be read, and what to write instead"),
    ] = ()
    doubtful: Annotated[
        tuple[str, ...], Field(description="recordings with something wrong in them")
    ]
    hints: Annotated[tuple[Hint, ...], Field(description="hints that were asked for")] = ()


def read_answers(folder: Path) -> tuple[CheckAnswer, ...]:
    """Return all earlier answers; empty without a file.

    Raises
    ------
    SubmissionError : the file was changed by hand.
    """
    path = folder / FILE
    if not path.exists() and not path.is_symlink():
        return ()
    if path.is_symlink():
        raise SubmissionError(f"{FILE}: is a link; put the file itself there")
    if problem := file_problem(folder, FILE):
        raise SubmissionError(problem)
    if path.stat().st_size > MAX_BYTES:
        raise SubmissionError(f"{FILE}: has more than {MAX_BYTES:,} bytes; ask your instructor")
    answers: list[CheckAnswer] = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            answer = CheckAnswer.model_validate_json(line)
        except ValidationError:
            answer = None
        if answer is None or answer.ask != number:
            raise SubmissionError(
                f"{FILE}, line {number}: this line was not written by `cartlab check`; restore "
                f"the file, or ask your instructor"
            )
        answers.append(answer)
    return tuple(answers)


def write_answer(folder: Path, answer: CheckAnswer) -> None:
    """Append an answer to the file.

    The caller must hold the lock and have read the other answers.
    """
    path = folder / FILE
    before = path.read_bytes() if path.exists() else b""
    write_file(path, before + answer_line(answer).encode())


def answer_line(answer: CheckAnswer) -> str:
    """Return an answer as a line of JSON."""
    return answer.model_dump_json(by_alias=True) + "\n"


def find_basis(submission: Submission) -> str:
    """Return a hash that changes only if set-up, experiments or reported numbers change."""
    about = {"system", "design", "experiments", "reported"}
    return hashlib.sha256(submission.model_dump_json(include=about).encode()).hexdigest()[:12]


WORDS = phrases("check")


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
    runs = stretch.recordings
    named = ", ".join(runs) if len(runs) <= 4 else f"{runs[0]} … {runs[-1]}"
    return WORDS.text("stretch_every", kind=kind, runs=named, part=part)


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
