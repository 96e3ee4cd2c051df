"""The bench's room: plan, acquire, explore, watch.

Some modules are imported late, because they load the estimators.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.responses import Response

from pipeline.bench.live_page import live_view
from pipeline.bench.serial_line import port_names
from pipeline.desk.benches import BenchSession
from pipeline.desk.crash_log import find_log
from pipeline.desk.form_input import read_number, read_whole_number
from pipeline.desk.page_request import PageRequest
from pipeline.desk.served_files import serve_file
from pipeline.errors import ConfigError, PipelineError
from pipeline.experiments.information import read_error_goal
from pipeline.experiments.plan import (
    Plan,
    Recording,
    load_plan,
    plan_path,
    session_time,
    time_words,
    what_words,
)
from pipeline.names import parameter_names, read_name
from pipeline.output import write_file
from pipeline.report.exploration import NAME as DIARY
from pipeline.simulated.links import running_benches
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME, file_problem
from pipeline.words.text import with_symbols

_KINDS = (("step", "Step"), ("sweep", "Sweep"), ("sine", "Dwell"), ("decay", "Decay"))
_TYPED = ("kind", "amplitude", "frequency", "frequency_end", "seconds", "cart", "goal")


@dataclass(frozen=True, kw_only=True)
class Port:
    """A port that the user can choose.

    Attributes
    ----------
    name : the device at the port, as far as the system knows it.
    """

    address: str
    name: str


def plan(ask: PageRequest) -> Response:
    """Start the task that makes a plan or adds recordings to it."""
    _note_plan(ask)
    ask.start("propose_recordings", title="The plan", stock=bool(ask.text("stock")))
    return ask.back(ask.here)


def acquire(ask: PageRequest) -> Response:
    """Start acquiring the ticked recordings, or the whole plan if no recording is ticked."""
    only = [value for value in ask.form.getlist("only") if isinstance(value, str)]
    port = read_port(ask)
    _note_plan(ask)
    ask.desk.benches.start(ask.folder(), port=port, only=only)
    return ask.back(ask.here)


def explore(ask: PageRequest) -> Response:
    """Start an exploration."""
    error = read_number(ask.text("error"), name="Accuracy to reach, ± %", above=0, below=100)
    minutes = read_number(ask.text("minutes"), name="minutes", above=0, below=10_000)
    until, limit = f"{ask.text('what')} {error!r}%", f"{minutes!r} min"
    read_error_goal(until)  # report an invalid goal before anything starts
    port = read_port(ask)
    _note_plan(ask)
    ask.desk.benches.start(ask.folder(), port=port, explore=(until, limit))
    return ask.back(ask.here)


def add(ask: PageRequest) -> Response:
    """Add a recording to the plan; a running exploration records it next."""
    from pipeline.experiments.propose import add_recording

    folder, typed = ask.folder(), {name: ask.text(name) for name in _TYPED}
    try:
        before = plan_ids(folder)
        new = add_recording(folder, _read_recording(typed, load_submission(folder)))
    except PipelineError as error:
        return show(ask, status=422, typed=typed, refused=str(error))
    ask.desk.benches.planned[folder] = before
    return ask.back(ask.here, f"{new.id} is in the plan.")


def show_comparison(ask: PageRequest) -> Response:
    """Show how much a typed recording would reduce the error, and how much the best one would."""
    from pipeline.experiments.information import WORST

    folder, typed = ask.folder(), {name: ask.text(name) for name in _TYPED}
    try:
        wanted = _read_recording(typed, load_submission(folder)).model_dump(mode="json")
        goal = typed["goal"] or WORST
        found = ask.do("weigh_recording", recording=wanted, goal=goal)
    except PipelineError as error:
        return show(ask, status=422, typed=typed, refused=str(error))
    goal = typed["goal"]
    words = f"the {read_name(goal).words}" if goal else with_symbols(found["words"])
    return show(ask, typed=typed, weighed={**found, "words": words, "bars": _scale_bars(found)})


def show_diary(ask: PageRequest) -> Response:
    """Return the diary of the last exploration; the browser may run only the diary's own script."""
    return serve_file(ask.folder(), DIARY)


def press(ask: PageRequest) -> Response:
    """Send a pressed button to the session; a page without scripts is then shown again."""
    session = _find_session(ask)
    if session.ended.is_set():
        raise HTTPException(404, "the session is over")
    status = session.press(ask.text("wish"), ask.text("number"))
    return ask.back(ask.here) if ask.text("plain") else Response(status_code=status)


async def stream(ask: PageRequest) -> Response:
    """Return a stream of the session's events; if the session has ended, it reports only that."""
    return _find_session(ask).stream()


def show(
    ask: PageRequest,
    *,
    status: int = 200,
    typed: Mapping[str, str] = {},
    refused: str = "",
    weighed: Mapping[str, Any] | None = None,
) -> Response:
    """Show the plan and the forms, or the current session.

    Parameters
    ----------
    typed : fields of the form for a custom recording.
    refused : why the custom recording is not possible.
    weighed : predicted benefit of the custom recording.
    """
    folder = ask.folder()
    session = ask.desk.benches.of(folder)
    running = session if session and not session.ended.is_set() else None
    kind = typed.get("kind") or ask.query("kind")
    return ask.page(
        "bench",
        status=status,
        title=f"{folder.name} at the bench",
        plan=read_plan(folder, session=session, before=ask.desk.benches.planned.get(folder)),
        session=session,
        asks=running is not None and not running.is_shown,
        live=Markup(live_view()) if running and running.is_shown else "",
        ports=list_ports(ask),
        has_report=file_problem(folder, "report/report.html") is None,
        kind=kind if kind in dict(_KINDS) else _KINDS[0][0],
        kind_asked=bool(ask.query("kind")),
        diary=file_problem(folder, DIARY) is None,
        typed={name: typed.get(name, "") for name in _TYPED},
        refused=refused,
        weighed=weighed,  # the predicted benefit of the typed recording
        kinds=_KINDS,
    )


def _note_plan(ask: PageRequest) -> None:
    """Remember the recordings of the current plan, so that later ones are shown as new."""
    ask.desk.benches.planned[ask.folder()] = plan_ids(ask.folder())


def _read_recording(typed: Mapping[str, str], submission: Submission) -> Recording:
    """Return the custom recording of the form."""
    from pipeline.experiments.propose import KINDS, NEEDED, TYPED, current_plan, make_recording

    if typed["kind"] not in KINDS:
        raise ConfigError(f"kind: expected {', '.join(KINDS)}, found {typed['kind']!r}")
    kind = KINDS[KINDS.index(typed["kind"])]
    if blank := [TYPED.get(key, key) for key in NEEDED[kind] if not typed[key].strip()]:
        raise ConfigError(f"{' and '.join(blank)}: the field is empty")
    carts = submission.system.carts
    return make_recording(
        kind,
        seconds=read_number(typed["seconds"], name="duration"),
        amplitude=read_number(typed["amplitude"], name="amplitude"),
        frequency=read_number(typed["frequency"], name="frequency"),
        frequency_end=read_number(typed["frequency_end"], name="frequency at the end"),
        cart=read_whole_number(typed["cart"] or "1", name="cart", least=1, most=carts),
        plan=current_plan(submission),
        submission=submission,
    )


def _scale_bars(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the three errors in percent, and the lengths of their bars on one scale."""
    rows = {
        "now": found["now"],
        "after yours": found["proposed"],
        "after the program's": found["best"],
    }
    largest, half = max(rows.values()), 140.0  # length of the largest bar, in points
    return [
        {"of": of, "percent": f"{100 * error:.2g}", "half": round(half * error / largest, 1)}
        for of, error in rows.items()
    ]


def _find_session(ask: PageRequest) -> BenchSession:
    session = ask.desk.benches.of(ask.folder())
    if session is None:
        raise HTTPException(404, "no session was started here")
    return session


# -------------------------------------------------------------------------------------------- ports

_KEPT = 200  # folders whose port is remembered


def list_ports(ask: PageRequest) -> list[Port]:
    """Return the ports at which a person may record, the most likely first.

    The last port used in this folder comes first if it still exists. Ports with a device follow,
    and then the virtual benches on this computer, first the one with the folder's name. On a lab
    server, only the ports in the list of users are returned.
    """
    folder = ask.folder()
    used = _read_memory().get(str(folder), "")
    if ask.user.owns:
        plugged = [Port(address=name.partition(" (")[0], name=name) for name in port_names()]
        virtual = [
            Port(address=one.address, name=f"virtual bench {one.name} ({one.address})")
            for one in sorted(running_benches(), key=lambda one: one.name != folder.name)
        ]
        # A port about which the system knows nothing seldom has a bench, so it comes last.
        unknown = [port for port in plugged if port.name == port.address]
        found = [port for port in plugged if port not in unknown] + virtual + unknown
    else:
        found = [Port(address=at, name=at) for at in ask.user.ports]
    if used and ask.user.owns and used not in [port.address for port in found]:
        found.append(Port(address=used, name=f"{used} (used last, not found now)"))
        return found
    return sorted(found, key=lambda port: port.address != used)


def read_port(ask: PageRequest) -> str:
    """Return the port that was typed, or else the one that was chosen; remember it for this folder.

    Raises
    ------
    ConfigError : the form has no port, or one that is not listed for this person.
    """
    port = ask.text("other") or ask.text("port")
    if not port:
        raise ConfigError("choose the port of the bench, or type one such as COM3 or /dev/ttyACM0")
    if not ask.user.owns and port not in ask.user.ports:
        raise ConfigError(
            f"{port}: is not one of your ports, which are {', '.join(ask.user.ports)}"
        )
    _remember(ask.folder(), port)
    return port


def _remember(folder: Path, port: str) -> None:
    ports = {at: used for at, used in _read_memory().items() if at != str(folder)}
    kept = dict(list(ports.items())[1 - _KEPT :]) | {str(folder): port}
    with suppress(OSError):  # the home folder is not writable: nothing is remembered
        write_file(_find_memory(), json.dumps(kept, indent=1), private=True)


def _read_memory() -> dict[str, str]:
    """Return the last port used in each folder; the folder used last comes last."""
    try:
        read = json.loads(_find_memory().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    pairs: Sequence[tuple[object, object]] = list(read.items()) if isinstance(read, dict) else []
    return {str(folder): str(port) for folder, port in pairs}


def _find_memory() -> Path:
    return find_log().with_suffix(".ports.json")


# ----------------------------------------------------------------------------------------- the plan


def plan_ids(folder: Path) -> frozenset[str] | None:
    """Return the ids of the recordings in a folder's plan; None if it has no readable plan."""
    try:
        submission = load_submission(folder)
        if plan_path(submission).exists():
            return frozenset(one.id for one in load_plan(submission).recordings)
    except PipelineError:
        pass
    return None


def read_plan(
    folder: Path, *, session: BenchSession | None, before: Collection[str] | None
) -> dict[str, Any]:
    """Return what the page shows of the plan.

    `sound` says whether the submission and its plan can be read; `wrong` says why not. `rows` are
    the recordings of the plan, and `left` the time still needed, "" if nothing is left to record.
    `units` are those of input and position, None without a readable submission. `parameters` have
    the name and the words of each parameter, and `recorded` is the number of recordings.

    Parameters
    ----------
    session : the last session in the folder; it knows why a run ended early.
    before : ids of the recordings that the plan had before the latest addition; None if no
        recording is new.
    """
    found: dict[str, Any] = {
        "sound": False, "wrong": "", "rows": (), "left": "", "units": None, "parameters": (),
        "carts": 0, "recorded": 0,
    }  # fmt: skip
    if not (folder / NAME).exists():
        return found
    try:
        submission = load_submission(folder)
    except PipelineError as error:
        return found | {"wrong": str(error)}
    system = submission.system
    names = parameter_names(system.carts, rigid=not system.bench.tied)
    found |= {
        "carts": system.carts,
        "recorded": len(submission.experiments),
        "units": {"input": system.input.unit, "position": system.position.unit},
        "parameters": [(name, f"the {read_name(name).words}") for name in names],
    }
    try:
        plan = load_plan(submission) if plan_path(submission).exists() else None
    except PipelineError as error:
        return found | {"wrong": str(error)}
    found["sound"] = True
    if plan is not None:
        found |= _describe(plan, submission, why=_why_again(session), before=before)
    return found


def _describe(
    plan: Plan,
    submission: Submission,
    *,
    why: Mapping[str, str],
    before: Collection[str] | None,
) -> dict[str, Any]:
    """Return a row for each recording, and the total time of the recordings still to make."""
    done = {experiment.id for experiment in submission.experiments}
    left = [recording for recording in plan.recordings if recording.id not in done]
    following = left[0].id if left else ""
    rows = [
        {
            "id": one.id,
            "what": what_words(one, submission),
            "done": one.id in done,
            "next": one.id == following,
            "new": before is not None and one.id not in before,
            "why": "" if one.id in done else why.get(one.id, _find_partial(submission, one.id)),
        }
        for one in plan.recordings
    ]
    return {"rows": rows, "left": time_words(session_time(left)) if left else ""}


def _why_again(session: BenchSession | None) -> dict[str, str]:
    """Return, by id, why a run of the last session must be repeated."""
    plan = session.snapshot().get("plan", ()) if session else ()
    return {entry["id"]: f"It ended early: {entry['why']}." for entry in plan if entry["why"]}


def _find_partial(submission: Submission, name: str) -> str:
    """Return a note if an earlier run of this recording ended early, else ""."""
    file = f"data/{name}.partial.txt"
    is_there = file_problem(submission.folder, file) is None
    return f"An earlier try ended early; what it recorded is in {file}." if is_there else ""
