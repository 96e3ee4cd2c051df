"""The bench's room: plan, acquire, explore, watch. What runs is decided where it is acquired."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse, Response, StreamingResponse

from pipeline.bench.design.goal import WORST
from pipeline.bench.explore.wish import read_wish
from pipeline.bench.host.serial_line import port_names
from pipeline.bench.live.page import live_view
from pipeline.bench.planning.by_hand import (
    KINDS,
    NEEDED,
    TYPED,
    add_recording,
    recording_by_hand,
)
from pipeline.bench.planning.plan import Recording
from pipeline.bench.planning.plan_file import load_plan, plan_path
from pipeline.bench.planning.plan_words import session_time, time_words, what_words
from pipeline.bench.planning.propose import current_plan
from pipeline.desk.benches import Session
from pipeline.desk.pages import served_file
from pipeline.desk.state import Ask
from pipeline.desk.typed import number, whole_number
from pipeline.errors import ConfigError, PipelineError
from pipeline.names import parameter_names, read_name
from pipeline.report.exploration.page import NAME as DIARY
from pipeline.report.words import with_symbols
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME, outside

_TYPED = ("kind", "amplitude", "frequency", "frequency_end", "seconds", "cart", "goal")
_MOST_MINUTES = 10_000.0  # of an exploration: a week
_HALF = 140.0  # of the largest error bar's length, points


def show(ask: Ask) -> Response:
    """Show the plan and the forms, or the session that is under way."""
    return _room(ask)


def plan(ask: Ask) -> Response:
    """Have a plan made, or added to."""
    folder = ask.folder()
    stock = bool(ask.text("stock"))
    ask.desk.jobs.start("plan", title="The plan", place=folder, folder=str(folder), stock=stock)
    return ask.back(ask.here)


def start(ask: Ask) -> Response:
    """Begin to acquire what is ticked; all of the plan where nothing is."""
    only = [value for value in ask.form.getlist("only") if isinstance(value, str)]
    ask.desk.benches.start(ask.folder(), port=_port(ask), only=only)
    return ask.back(ask.here)


def explore(ask: Ask) -> Response:
    """Begin to explore."""
    error = number(ask.text("error"), name="to within ± %", above=0, below=100)
    minutes = number(ask.text("minutes"), name="minutes", above=0, below=_MOST_MINUTES)
    until, limit = f"{ask.text('what')} {error!r}%", f"{minutes!r} min"
    read_wish(until)  # what is none is said before anything begins
    ask.desk.benches.start(ask.folder(), port=_port(ask), explore=(until, limit))
    return ask.back(ask.here)


def add(ask: Ask) -> Response:
    """Put a recording into the plan; an exploration that is under way makes it next."""
    folder, typed = ask.folder(), {name: ask.text(name) for name in _TYPED}
    try:
        new = add_recording(folder, _wanted(typed, load_submission(folder)))
    except PipelineError as error:
        return _room(ask, status=422, typed=typed, refused=str(error))
    return ask.back(ask.here, f"{new.id} is in the plan.")


def weigh(ask: Ask) -> Response:
    """Show what a recording would bring, and what the program would choose."""
    folder, sent = ask.folder(), ask.request.query_params
    typed = {name: sent.get(name, "") for name in _TYPED}
    try:
        wanted = _wanted(typed, load_submission(folder)).model_dump(mode="json")
        goal = typed["goal"] or WORST
        found = ask.desk.hand.do("weigh", folder=str(folder), recording=wanted, goal=goal)
    except PipelineError as error:
        return _room(ask, status=422, typed=typed, refused=str(error))
    goal = typed["goal"]
    words = f"the {read_name(goal).words}" if goal else with_symbols(found["words"])
    return _room(ask, typed=typed, weighed={**found, "words": words, "bars": _bars(found)})


def diary(ask: Ask) -> Response:
    """Return the diary of the last exploration, which runs no script but its own."""
    return served_file(ask.folder(), DIARY)


def press(ask: Ask) -> Response:
    """Pass on a button; one of a page without scripts leads back to it."""
    session = _session(ask)
    if session.ended.is_set():
        raise HTTPException(404, "the session is over")
    status = session.press(ask.text("wish"), ask.text("number"))
    return ask.back(ask.here) if ask.text("plain") else Response(status_code=status)


async def events(ask: Ask) -> Response:
    """Pass on the news of the session; one that ended while its page was on the way says so."""
    news = await _session(ask).events()
    if news is None:
        return PlainTextResponse("too many pages show this session", status_code=503)
    return StreamingResponse(news, media_type="text/event-stream")


def _room(
    ask: Ask,
    *,
    status: int = 200,
    typed: Mapping[str, str] = {},
    refused: str = "",
    weighed: Mapping[str, Any] | None = None,
) -> Response:
    """Show the room.

    Parameters
    ----------
    typed : of a recording that somebody wants.
    refused : why that is none.
    weighed : what it would bring.
    """
    folder = ask.folder()
    session = ask.desk.benches.of(folder)
    running = session if session and not session.ended.is_set() else None
    return ask.page(
        "bench",
        status=status,
        title=f"{folder.name} at the bench",
        folder=folder,
        session=session,
        asks=running and not running.url,
        live=Markup(live_view()) if running and running.url else "",
        ports=_ports(ask),
        job=ask.desk.jobs.of(folder),
        said=ask.told(),
        diary=outside(folder, DIARY) is None,
        typed={name: typed.get(name, "") for name in _TYPED},
        refused=refused,
        weighed=weighed,
        **_plan(folder),
    )


def _port(ask: Ask) -> str:
    port = ask.text("port")
    if not port:
        raise ConfigError("name the port of the bench, such as COM3, /dev/ttyACM0 or socket://…")
    if not ask.user.owns and port not in ask.user.ports:
        raise ConfigError(f"{port}: is not listed for you; there are {', '.join(ask.user.ports)}")
    return port


def _wanted(typed: Mapping[str, str], submission: Submission) -> Recording:
    """Return the recording that was typed."""
    if typed["kind"] not in KINDS:
        raise ConfigError(f"kind: expected {', '.join(KINDS)}, found {typed['kind']!r}")
    kind = KINDS[KINDS.index(typed["kind"])]
    if blank := [TYPED.get(key, key) for key in NEEDED[kind] if not typed[key].strip()]:
        raise ConfigError(f"{' and '.join(blank)}: what is it to be? The field is empty")
    carts = submission.system.carts
    return recording_by_hand(
        kind,
        plan=current_plan(submission),
        submission=submission,
        seconds=number(typed["seconds"], name="how long"),
        amplitude=number(typed["amplitude"], name="amplitude"),
        frequency=number(typed["frequency"], name="frequency"),
        frequency_end=number(typed["frequency_end"], name="to") or None,
        cart=whole_number(typed["cart"] or "1", name="cart", least=1, most=carts),
    )


def _bars(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the three errors as they are shown: in percent, as error bars on one scale."""
    rows = {
        "now": found["now"],
        "after yours": found["proposed"],
        "after the program's": found["best"],
    }
    largest = max(rows.values())
    return [
        {"of": of, "percent": f"{100 * error:.2g}", "half": round(_HALF * error / largest, 1)}
        for of, error in rows.items()
    ]


def _ports(ask: Ask) -> list[tuple[str, str]]:
    """Return what ports there are to choose from, and what each is."""
    if not ask.user.owns:
        return [(name, name) for name in ask.user.ports]
    return [(name.partition(" (")[0], name) for name in port_names()]


def _session(ask: Ask) -> Session:
    session = ask.desk.benches.of(ask.folder())
    if session is None:
        raise HTTPException(404, "no session was begun here")
    return session


def _plan(folder: Path) -> dict[str, Any]:
    """Return the plan, what can be wanted of it, and what is wrong with what is there."""
    found = {"sound": False, "rows": [], "left": "", "wrong": "", "units": None, "parameters": []}
    if not (folder / NAME).exists():
        return found
    try:
        submission = load_submission(folder)
        system = submission.system
        names = parameter_names(system.carts, rigid=not system.tied)
        found |= {
            "sound": True,
            "units": {"input": system.input.unit, "position": system.position.unit},
            "parameters": [(name, f"the {read_name(name).words}") for name in names],
        }
        if not plan_path(submission).exists():
            return found
        plan = load_plan(submission)
    except PipelineError as error:
        return found | {"sound": False, "wrong": str(error)}
    done = {experiment.id for experiment in submission.experiments}
    left = [recording for recording in plan.recordings if recording.id not in done]
    rows = [
        {"id": one.id, "what": what_words(one, submission), "done": one.id in done}
        for one in plan.recordings
    ]
    return found | {"rows": rows, "left": time_words(session_time(left))}
