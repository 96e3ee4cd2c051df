"""Decide whether a student sees the report, or only the check of their own numbers."""

from pathlib import Path

from pipeline.desk.jobs import Job, WorkerPool
from pipeline.desk.users import Place, User
from pipeline.processes import Failed
from pipeline.submission.load import NAME

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


class Visibility:
    """What students see in their rooms; a worker reads each submission, again after a change."""

    def __init__(self, workers: WorkerPool) -> None:
        self._workers = workers
        self._known: dict[Path, tuple[tuple[int, int], str]] = {}

    def sees_check(self, user: User, folder: Place | None) -> bool:
        """Return whether the room of a folder shows the check instead of the report.

        On a lab server, the rubric in the list of users decides. If the list has no rubric,
        `[students] see` in submission.toml decides. Students can change this file, so this is only
        an agreement.
        """
        if user.role == "instructor" or not isinstance(folder, Path):
            return False
        if user.see is not None:
            return user.see == "check"
        try:
            info = (folder / NAME).stat()
        except OSError:  # the page says what is wrong
            return False
        stamp = info.st_mtime_ns, info.st_size
        known = self._known.get(folder)
        if known is None or known[0] != stamp:
            try:
                sees = self._workers.do("students_see", folder=str(folder))
            except Failed:  # the page says what is wrong
                sees = ""
            known = self._known[folder] = stamp, sees
        return known[1] == "check"

    def is_refused(self, path: str, user: User, folder: Place | None) -> bool:
        """Return whether to refuse an address that could show numbers the student must find."""
        parts = path.split("/")
        room, part = parts[1], parts[3] if len(parts) > 3 else ""
        return room == "student" and part not in _SHOWS_NONE and self.sees_check(user, folder)

    def show_job(self, job: Job | None, user: User, folder: Path) -> Job | None:
        """Return the job in a folder as the person may see it.

        The job's stages are hidden if they could show numbers, because another person may be making
        a report in the folder.
        """
        if job is None or job.task[0] in _TELLS_NONE or not self.sees_check(user, folder):
            return job
        return job.without_message()
