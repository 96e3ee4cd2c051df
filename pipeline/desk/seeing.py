"""Decide whether a student sees the report, or only the check of their own numbers."""

from pathlib import Path

from pipeline.desk.jobs import Job
from pipeline.desk.users import Place, User
from pipeline.errors import SubmissionError
from pipeline.grading.rubric import Rubric
from pipeline.submission.edit import submission_text
from pipeline.submission.load import NAME
from pipeline.submission.toml_file import parse_toml

# The parts of the student's room that show no computed number. Any part that is not in this list is
# refused.
_SHOWS_NONE = frozenset(
    {"", "files", "fill", "aside", "save", "experiments", "check", "hand-in", "hand-in.zip",
     "events", "stop"}
)  # fmt: skip
_TELLS_NONE = frozenset({"check_numbers"})  # tasks whose stages and result show no computed number
REFUSED = (
    "in this lab you find the numbers yourself: the report is for your TA. "
    "The check shows which of your numbers disagree with your recordings"
)


def sees_check(user: User, folder: Place | None) -> bool:
    """Return whether the room of a folder shows the check instead of the report.

    On a lab server, the rubric in the list of users decides. If the list has no rubric, `[students]
    see` in submission.toml decides. Students can change this file, so this is only an agreement.
    """
    if user.role == "instructor" or not isinstance(folder, Path):
        return False
    if user.see is not None:
        return user.see == "check"
    try:
        text = submission_text(folder)
        students = parse_toml(text, where=NAME, error=SubmissionError).get("students")
    except (SubmissionError, OSError):  # the page says what is wrong
        return False
    return isinstance(students, dict) and students.get("see") == "check"


def hides_values(user: User, rubric: Rubric) -> bool:
    """Return whether a student's feedback leaves out the numbers that they must find."""
    return (user.see or rubric.students.see) == "check"


def is_refused(path: str, user: User, folder: Place | None) -> bool:
    """Return whether to refuse an address that could show numbers that the student must find."""
    parts = path.split("/")
    return parts[1] == "student" and parts[3] not in _SHOWS_NONE and sees_check(user, folder)


def show_job(job: Job | None, user: User, folder: Path) -> Job | None:
    """Return the job in a folder as the person may see it.

    The job's stages are hidden if they could show numbers, because another person may be making
    a report in the folder.
    """
    if job is None or job.task[0] in _TELLS_NONE or not sees_check(user, folder):
        return job
    return job.without_message()
