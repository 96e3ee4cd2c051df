"""The check in the student's room: which numbers disagree and where to look, but no values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from starlette.responses import Response

from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.submission_view import SubmissionView, read_room


@dataclass(frozen=True, kw_only=True)
class CheckPage:
    """What the page of the check shows: the submission, and `check_state.describe`."""

    room: SubmissionView
    busy: bool
    problems: Sequence[str]
    ready: bool
    last: bool
    result: str
    rows: Sequence[Mapping[str, Any]]
    agree: Sequence[str]
    not_checked: Sequence[str]
    unread: Sequence[str]
    doubtful: Sequence[str]
    asked: str


def show(ask: PageRequest) -> Response:
    """Show the last answer, and what the student can ask next."""
    folder = ask.folder()
    # Read the job before the answers. If a check ends in between, the page then shows it as running
    # and asks again, instead of showing earlier answers as the result.
    job = ask.desk.jobs.of(folder)
    busy = job is not None and not job.over
    found = ask.desk.workers.do("describe_check", folder=str(folder))
    page = CheckPage(room=read_room(ask), busy=busy, **found)
    return ask.page("check", title=f"Check of {folder.name}", page=page)


def begin(ask: PageRequest) -> Response:
    """Start a check of all numbers, or ask where to look for one number."""
    number, rubric = ask.text("number"), ask.user.rubric
    ask.start(
        "check_numbers",
        title="The check",
        rubric=str(rubric) if rubric else "",
        where=[number] if number else [],
    )
    return ask.back(f"{ask.here}check")
