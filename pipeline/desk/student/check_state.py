"""The state of the check of a student's own numbers; only workers read it from the folder."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.desk.student.steps import Status
from pipeline.errors import SubmissionError
from pipeline.grading.self_check.answers import (
    CheckAnswer,
    asked_words,
    find_basis,
    hint_words,
    number_words,
    read_answers,
    result_words,
)
from pipeline.submission import Submission, load_submission


def find_check_state(folder: Path) -> Status:
    """Return the state of the check (done, needs, old or none), and a word for it."""
    submission, problems = _load_if_sound(folder)
    try:
        answers = read_answers(folder)
    except SubmissionError:
        return "needs", "cannot be read"
    if problems or not answers or submission is None:
        return "none", "not run yet"
    last = answers[-1]
    if last.basis != find_basis(submission):
        return "old", "changed since"
    return ("needs", "some disagree") if last.disagree else ("done", "all agree")


def describe(folder: Path) -> dict[str, Any]:
    """Return the last answer, and what the student can ask next, as the page of the check shows it.

    An answer about earlier numbers or an earlier set-up is not shown, only that there is one.
    """
    submission, problems = _load_if_sound(folder)
    answers: Sequence[CheckAnswer] = ()
    try:
        answers = read_answers(folder)
    except SubmissionError as error:
        problems.append(str(error))
    last = answers[-1] if answers else None
    current = last if last and submission and last.basis == find_basis(submission) else None
    return {
        "problems": problems,
        "ready": submission is not None and submission.reported is not None,
        "last": last is not None,
        "result": result_words(current) if current else "",
        "rows": _describe_rows(current, answers, submission) if current and submission else [],
        "agree": [number_words(number) for number in current.agree] if current else [],
        "not_checked": [number_words(number) for number in current.not_checked] if current else [],
        "unread": list(current.unread) if current else [],
        "doubtful": list(current.doubtful) if current else [],
        "asked": asked_words(len(answers)) if answers else "",
    }


def _load_if_sound(folder: Path) -> tuple[Submission | None, list[str]]:
    """Return the submission, or None with what is wrong with it."""
    try:
        return load_submission(folder), []
    except SubmissionError as error:
        return None, [str(error)]


def _describe_rows(
    current: CheckAnswer, answers: Sequence[CheckAnswer], submission: Submission
) -> list[dict[str, Any]]:
    """Return a row for each number that disagrees, with its hint if there is one."""
    hints = {
        hint.number: asdict(hint_words(hint))
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
