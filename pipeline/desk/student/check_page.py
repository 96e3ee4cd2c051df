"""The check in the student's room: which numbers disagree and where to look, but no values."""

from collections.abc import Sequence
from typing import Any

from starlette.responses import Response

from pipeline.desk.ask import Ask
from pipeline.desk.student.check_state import load_if_sound
from pipeline.desk.student.room import read_room
from pipeline.errors import SubmissionError
from pipeline.grading.self_check.log import CheckAnswer, find_basis, read_answers
from pipeline.grading.self_check.words import (
    asked_words,
    hint_words,
    number_words,
    result_words,
)
from pipeline.submission import Submission


def show(ask: Ask) -> Response:
    """Show the last answer, and what the student can ask next."""
    folder = ask.folder()
    # Read the job before the answers. If a check ends in between, the page then shows it as running
    # and asks again, instead of showing earlier answers as the result.
    job = ask.desk.jobs.of(folder)
    busy = job is not None and not job.over
    submission, problems = load_if_sound(folder)
    answers: Sequence[CheckAnswer] = ()
    try:
        answers = read_answers(folder)
    except SubmissionError as error:
        problems.append(str(error))
    last = answers[-1] if answers else None
    current = last if last and submission and last.basis == find_basis(submission) else None
    return ask.page(
        "check",
        title=f"Check of {folder.name}",
        room=read_room(ask),
        busy=busy,
        problems=problems,
        ready=submission is not None and submission.reported is not None,
        last=last,
        result=result_words(current) if current else "",
        rows=_describe_rows(current, answers, submission) if current and submission else [],
        agree=[number_words(number) for number in current.agree] if current else [],
        not_checked=[number_words(number) for number in current.not_checked] if current else [],
        doubtful=list(current.doubtful) if current else [],
        asked=asked_words(len(answers)) if answers else "",
    )


def begin(ask: Ask) -> Response:
    """Start a check of all numbers, or ask where to look for one number."""
    number, rubric = ask.text("number"), ask.user.rubric
    ask.start(
        "check_numbers",
        title="The check",
        rubric=str(rubric) if rubric else "",
        where=[number] if number else [],
    )
    return ask.back(f"{ask.here}check")


def _describe_rows(
    current: CheckAnswer, answers: Sequence[CheckAnswer], submission: Submission
) -> list[dict[str, Any]]:
    """Return a row for each number that disagrees, with its hint if there is one."""
    hints = {
        hint.number: hint_words(hint)
        for answer in answers
        if answer.basis == current.basis
        for hint in answer.hints
    }
    return [
        {
            "number": number,
            "name": number_words(number),
            "typed": _find_typed(number, submission),
            "hint": hints.get(number),
        }
        for number in current.disagree
    ]


def _find_typed(number: str, submission: Submission) -> str:
    """Return an initial or final estimate as typed; "" for any other number."""
    table, _, name = number.partition(".")
    typed = submission.typed.get(table, {}).get(name)
    return "" if typed is None else str(typed)
