"""The bench's room: plan, acquire, watch. The run is decided on where it is acquired, not here."""

from pathlib import Path
from typing import Any

from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.responses import Response, StreamingResponse

from pipeline.bench.host.serial_line import port_names
from pipeline.bench.live.page import live_view
from pipeline.bench.planning.plan_file import load_plan, plan_path
from pipeline.bench.planning.plan_words import session_time, time_words, what_words
from pipeline.desk.benches import Session
from pipeline.desk.state import Ask
from pipeline.errors import ConfigError, PipelineError
from pipeline.submission import load_submission
from pipeline.submission.load import NAME


def show(ask: Ask) -> Response:
    """Show the plan and the form, or the session that is under way."""
    folder = ask.folder()
    session = ask.desk.benches.of(folder)
    return ask.page(
        "bench",
        title=f"{folder.name} at the bench",
        folder=folder,
        here=_here(ask),
        session=session,
        live=Markup(live_view()) if session and not session.ended.is_set() else "",
        ports=_ports(ask),
        job=ask.desk.jobs.of(folder),
        said=ask.told(),
        **_plan(folder),
    )


def plan(ask: Ask) -> Response:
    """Have a plan made, or added to."""
    folder = ask.folder()
    stock = bool(ask.text("stock"))
    ask.desk.jobs.start("plan", title="The plan", place=folder, folder=str(folder), stock=stock)
    return ask.back(_here(ask))


def start(ask: Ask) -> Response:
    """Begin to acquire what is ticked; all of the plan where nothing is."""
    folder, port = ask.folder(), ask.text("port")
    if not port:
        raise ConfigError("name the port of the bench, such as COM3, /dev/ttyACM0 or socket://…")
    if not ask.user.owns and port not in ask.user.ports:
        raise ConfigError(f"{port}: is not listed for you; there are {', '.join(ask.user.ports)}")
    only = [value for value in ask.form.getlist("only") if isinstance(value, str)]
    ask.desk.benches.start(folder, port=port, only=only)
    return ask.back(_here(ask))


def press(ask: Ask) -> Response:
    """Pass on a button; one of a page without scripts leads back to it."""
    session = _session(ask)
    if session.ended.is_set():
        raise HTTPException(404, "the session is over")
    status = session.press(ask.text("wish"), ask.text("number"))
    return ask.back(_here(ask)) if ask.text("plain") else Response(status_code=status)


def events(ask: Ask) -> Response:
    """Pass on the news of the session; one that ended while its page was on the way says so."""
    return StreamingResponse(_session(ask).events(), media_type="text/event-stream")


def _ports(ask: Ask) -> list[tuple[str, str]]:
    """Return what ports there are to choose from, and what each is."""
    if not ask.user.owns:
        return [(name, name) for name in ask.user.ports]
    return [(name.partition(" (")[0], name) for name in port_names()]


def _here(ask: Ask) -> str:
    return f"/bench/{ask.request.path_params['n']}/"


def _session(ask: Ask) -> Session:
    session = ask.desk.benches.of(ask.folder())
    if session is None or not session.url:
        raise HTTPException(404, "no session was begun here")
    return session


def _plan(folder: Path) -> dict[str, Any]:
    """Return the recordings of the plan, and what is wrong with what is there."""
    nothing = {"sound": False, "rows": [], "left": "", "wrong": ""}
    if not (folder / NAME).exists():
        return nothing
    try:
        submission = load_submission(folder)
        if not plan_path(submission).exists():
            return nothing | {"sound": True}
        found = load_plan(submission)
    except PipelineError as error:
        return nothing | {"wrong": str(error)}
    done = {experiment.id for experiment in submission.experiments}
    left = [recording for recording in found.recordings if recording.id not in done]
    rows = [
        {"id": one.id, "what": what_words(one, submission), "done": one.id in done}
        for one in found.recordings
    ]
    return nothing | {"sound": True, "rows": rows, "left": time_words(session_time(left))}
