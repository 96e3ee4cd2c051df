"""Store the answers of the check, one line per request, in `checks.jsonl` of the submission.

The answers contain no values. But with enough guesses they would reveal a number, so the file
counts every request and is part of the submission.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, ValidationError

from pipeline.errors import SubmissionError
from pipeline.grading.grade import Code, GradeTable
from pipeline.output import write_file
from pipeline.results import ExperimentKind
from pipeline.submission import Submission
from pipeline.submission.load import file_problem

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
