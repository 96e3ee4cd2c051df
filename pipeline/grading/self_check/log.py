"""What the check answered, ask by ask: `checks.jsonl` in the submission, never with a value.

Answers to many guesses lead to a number as a scale does to a weight. So every ask is counted, and
the file goes with what is handed in.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, ValidationError

from pipeline.errors import SubmissionError
from pipeline.grading.grade import Code, GradeTable
from pipeline.output import write_file
from pipeline.results import Kind
from pipeline.submission import Submission
from pipeline.submission.load import outside

FILE = "checks.jsonl"
MAX_BYTES = 5_000_000  # some thousand asks

Part = Literal["whole", "beginning", "first_half", "middle", "second_half", "end"]
Slip = Code | Literal["claims_off"]


class Stretch(GradeTable):
    """A part of some recordings; all dwells are named, because one alone would tell a value."""

    kind: Kind
    recordings: tuple[str, ...]
    part: Part


class Hint(GradeTable):
    """Where to look for one number."""

    number: str
    slip: Annotated[Slip, Field(description="the kind of mistake")]
    or_else: Annotated[tuple[Slip, ...], Field(description="what explains it as well")] = ()
    stretches: tuple[Stretch, ...] = ()


class CheckAnswer(GradeTable):
    """One answer, a line of the file; numbers are called by their key under `[reported]`."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)

    schema_: Annotated[Literal["cartlab-check/1"], Field(alias="schema")] = "cartlab-check/1"
    ask: Annotated[int, Field(ge=1, description="how often it was asked, this time included")]
    stage: Literal["which", "where"]
    basis: Annotated[
        str, Field(description="stays the same as long as set-up, tables and numbers do")
    ]
    disagree: tuple[str, ...]
    agree: tuple[str, ...]
    not_checked: Annotated[
        tuple[str, ...], Field(description="reported, and no recording decides them")
    ]
    doubtful: Annotated[
        tuple[str, ...], Field(description="recordings that do not hold what they should")
    ]
    hints: Annotated[tuple[Hint, ...], Field(description="where it was asked where to look")] = ()


def read_answers(folder: Path) -> tuple[CheckAnswer, ...]:
    """Return all answers so far; none where there is no file.

    Raises
    ------
    SubmissionError : it is not as it was written.
    """
    path = folder / FILE
    if not path.exists() and not path.is_symlink():
        return ()
    if path.is_symlink():
        raise SubmissionError(f"{FILE}: is a link; put the file itself there")
    if problem := outside(folder, FILE):
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
                f"{FILE}, line {number}: expected what `cartlab check` wrote, found something "
                "else; put the file back as it was, or ask your instructor"
            )
        answers.append(answer)
    return tuple(answers)


def write_answer(folder: Path, answer: CheckAnswer) -> None:
    """Write one more line; the caller has the turn and knows that the others can be read."""
    path = folder / FILE
    before = path.read_bytes() if path.exists() else b""
    write_file(path, before + answer_line(answer).encode())


def answer_line(answer: CheckAnswer) -> str:
    """Return an answer as a line of JSON."""
    return answer.model_dump_json(by_alias=True) + "\n"


def find_basis(submission: Submission) -> str:
    """Return a text that stays the same as long as set-up, experiments and numbers do."""
    about = {"system", "design", "experiments", "reported"}
    return hashlib.sha256(submission.model_dump_json(include=about).encode()).hexdigest()[:12]
