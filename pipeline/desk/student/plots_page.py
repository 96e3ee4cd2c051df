"""The page with plots of all recordings, made again only if a source has changed."""

from starlette.responses import RedirectResponse, Response

from pipeline.desk.last_report import PLOTS, plots_are_current
from pipeline.desk.page_request import PageRequest

TASK = "make_plots"


def show(ask: PageRequest) -> Response:
    """Show the plots; if they are missing or out of date, show the job or a button to start it."""
    if not _is_busy(ask) and plots_are_current(ask.folder()):
        return _lead_to(ask, f"{ask.here}{PLOTS}")
    job = ask.desk.jobs.of(ask.folder())
    failed = job is not None and job.task[0] == TASK and job.state in ("failed", "stopped")
    return ask.page("plots", title=f"Plots of {ask.folder().name}", failed=failed)


def make(ask: PageRequest) -> Response:
    """Start the task that makes the plots, unless they are up to date."""
    if not _is_busy(ask) and not plots_are_current(ask.folder()):
        ask.start(TASK, title="The plots")
    return ask.back(f"{ask.here}compare")


def _is_busy(ask: PageRequest) -> bool:
    job = ask.desk.jobs.of(ask.folder())
    return job is not None and not job.over


def _lead_to(ask: PageRequest, address: str) -> Response:
    """Return an answer that opens an address in the whole window, also after a request by htmx."""
    if ask.request.headers.get("hx-request"):
        return ask.go(address)
    return RedirectResponse(address, status_code=303)
