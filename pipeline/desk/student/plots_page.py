"""The plots of all recordings in the desk's frame, made again only if a source has changed."""

from dataclasses import dataclass
from urllib.parse import urlencode

from starlette.responses import Response

from pipeline.desk.last_report import PLOTS, plots_are_current
from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.submission_view import SubmissionView, read_room

TASK = "make_plots"


@dataclass(frozen=True, kw_only=True)
class PlotsPage:
    """What the page of plots shows.

    Attributes
    ----------
    busy : whether a job is running in the folder.
    plots : address of the plots; "" if they are missing or out of date.
    again : address of this page, which keeps the chosen recording.
    failed : whether the last attempt to make the plots failed.
    """

    room: SubmissionView
    busy: bool
    plots: str
    again: str
    failed: bool


def show(ask: PageRequest) -> Response:
    """Show the plots; if they are missing or out of date, show the job or a button to start it."""
    room, chosen = read_room(ask), _choose(ask)
    again = f"{ask.here}compare{chosen and '?' + chosen}"
    # Read the job before the plots. If it ends in between, the page shows it as running, and asks
    # again.
    job, busy = ask.desk.jobs.of(ask.folder()), _is_busy(ask)
    there = not busy and plots_are_current(ask.folder())
    if there and ask.request.headers.get("hx-request"):
        return ask.go(again)  # plots need a page of another width
    page = PlotsPage(
        room=room,
        busy=busy,
        plots=f"{ask.here}{PLOTS}{chosen and '#' + chosen}" if there else "",
        again=again,
        failed=job is not None and job.task[0] == TASK and job.state in ("failed", "stopped"),
    )
    return ask.page("plots", title=f"Plots of {ask.folder().name}", page=page)


def make(ask: PageRequest) -> Response:
    """Start the task that makes the plots, unless they are up to date."""
    if not _is_busy(ask) and not plots_are_current(ask.folder()):
        ask.start(TASK, title="The plots")
    chosen = _choose(ask)
    return ask.back(f"{ask.here}compare{chosen and '?' + chosen}")


def _choose(ask: PageRequest) -> str:
    """Return the recording that the URL names, as part of a URL; "" if it names none."""
    run = ask.query("run")
    return urlencode({"run": run}) if run else ""


def _is_busy(ask: PageRequest) -> bool:
    job = ask.desk.jobs.of(ask.folder())
    return job is not None and not job.over
