"""The plots to look through, in the student's room: made once, kept until a source changes."""

from starlette.responses import RedirectResponse, Response

from pipeline.desk.ask import Ask
from pipeline.desk.last_report import PLOTS, plots_are_current

TASK = "make_plots"


def show(ask: Ask) -> Response:
    """Show the plots; where they are missing or out of date, the work on them or how to begin."""
    if not _is_busy(ask) and plots_are_current(ask.folder()):
        return _lead_to(ask, f"{ask.here}{PLOTS}")
    job = ask.desk.jobs.of(ask.folder())
    failed = job is not None and job.asked[0] == TASK and job.state in ("failed", "stopped")
    return ask.page("plots", title=f"Plots of {ask.folder().name}", failed=failed)


def make(ask: Ask) -> Response:
    """Have the plots made, where they are not there already."""
    if not _is_busy(ask) and not plots_are_current(ask.folder()):
        ask.start(TASK, title="The plots")
    return ask.back(f"{ask.here}compare")


def _is_busy(ask: Ask) -> bool:
    job = ask.desk.jobs.of(ask.folder())
    return job is not None and not job.over


def _lead_to(ask: Ask, address: str) -> Response:
    """Lead to a page of another frame: htmx, which fetches pages by itself, opens it whole."""
    if ask.request.headers.get("hx-request"):
        return ask.go(address)
    return RedirectResponse(address, status_code=303)
