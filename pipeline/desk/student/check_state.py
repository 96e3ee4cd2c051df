"""The state of the check of a student's own numbers."""

from pathlib import Path

from pipeline.desk.student.way import Status
from pipeline.errors import SubmissionError
from pipeline.grading.self_check.log import find_basis, read_answers
from pipeline.submission import Submission, load_submission


def find_check_state(folder: Path) -> Status:
    """Return the state of the check (done, needs, old or none), and a word for it."""
    submission, problems = load_if_sound(folder)
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


def load_if_sound(folder: Path) -> tuple[Submission | None, list[str]]:
    """Return the submission, or None with what is wrong with it."""
    try:
        return load_submission(folder), []
    except SubmissionError as error:
        return None, [str(error)]
