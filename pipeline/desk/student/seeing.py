"""Whether a student sees the report, or only the check of their own numbers."""

from pipeline.desk.ask import Ask
from pipeline.desk.student.form import read_document
from pipeline.errors import SubmissionError
from pipeline.submission.edit import submission_text

# The parts of the student's room that show no computed number; a new part is refused until it is
# named here.
_SHOWS_NONE = frozenset(
    {"", "files", "fill", "aside", "save", "experiments", "check", "hand-in", "hand-in.zip",
     "events", "stop"}
)  # fmt: skip
REFUSED = (
    "in this lab you find the numbers yourself: the report is for your TA. "
    "The check tells which of your numbers disagree with your recordings"
)


def sees_check(ask: Ask) -> bool:
    """Whether the room has the check in place of the report.

    The rubric that a lab server's list of users names decides. Without one the submission's own
    `[students] see` holds, which is an agreement: who has the folder can change it.
    """
    if ask.user.role == "instructor" or ask.place is None:
        return False
    if ask.user.see is not None:
        return ask.user.see == "check"
    try:
        students = read_document(submission_text(ask.folder())).get("students")
    except (SubmissionError, OSError):  # the page says what is wrong with it
        return False
    return isinstance(students, dict) and students.get("see") == "check"


def is_refused(ask: Ask, path: str) -> bool:
    """Whether an address may show computed numbers to a student who must find them."""
    parts = path.split("/")
    return parts[1] == "student" and parts[3] not in _SHOWS_NONE and sees_check(ask)
