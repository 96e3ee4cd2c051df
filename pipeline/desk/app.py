"""The desk as an application: every address in one table, and the server that answers there."""

import asyncio
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Self

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from pipeline.desk.bench import room as bench
from pipeline.desk.doors import Guard, ProxyDoor, SecretDoor
from pipeline.desk.grades import room as grades
from pipeline.desk.grades import team
from pipeline.desk.grades import work as whole
from pipeline.desk.home import enter, open_place, show_home
from pipeline.desk.instructor import room as instructor
from pipeline.desk.instructor import rubrics
from pipeline.desk.pages import static_file
from pipeline.desk.scratch import clear_scratch
from pipeline.desk.state import Ask, Desk, plain_error, prepare_pages
from pipeline.desk.student import report as student_report
from pipeline.desk.student import room as student
from pipeline.desk.users import User, read_users
from pipeline.errors import ConfigError, PipelineError
from pipeline.grading.intake.unpack import HAND_IN
from pipeline.web.server import Served
from pipeline.web.strangers import Strangers, announced

Handler = Callable[[Ask], Response]
Listener = Callable[[Ask], Awaitable[Response]]
_MOST_FIELDS = 5_000
_FRAME = 0.2  # s between looks for news
_ALIVE = 5.0  # s between signs of life where there is none

# Address, method, who answers. What changes anything is a POST of a form that needs no script.
ROUTES: tuple[tuple[str, str, Handler], ...] = (
    ("/", "GET", show_home),
    ("/open", "POST", open_place),
    ("/static/{name}", "GET", lambda ask: static_file(ask.request.path_params["name"])),
    ("/student/{n:int}/", "GET", student.show),
    ("/student/{n:int}/files", "POST", student.upload),
    ("/student/{n:int}/fill", "POST", student.fill),
    ("/student/{n:int}/aside", "POST", student.aside),
    ("/student/{n:int}/save", "POST", student.save),
    ("/student/{n:int}/experiments/{index:int}", "POST", student.save_experiment),
    ("/student/{n:int}/make-report", "POST", student_report.start_report),
    ("/student/{n:int}/make-gap", "POST", student_report.start_gap),
    ("/student/{n:int}/gap/{name:path}", "GET", student_report.gap_file),
    ("/student/{n:int}/stop", "POST", student_report.stop),
    ("/student/{n:int}/report", "GET", student_report.show),
    ("/student/{n:int}/report/{name:path}", "GET", student_report.report_file),
    ("/student/{n:int}/answer", "POST", student_report.answer),
    ("/student/{n:int}/hand-in", "GET", student.show_hand_in),
    ("/student/{n:int}/hand-in", "POST", student.start_hand_in),
    ("/student/{n:int}/hand-in.zip", "GET", student.packed),
    ("/bench/{n:int}/", "GET", bench.show),
    ("/bench/{n:int}/plan", "POST", bench.plan),
    ("/bench/{n:int}/acquire", "POST", bench.start),
    ("/bench/{n:int}/explore", "POST", bench.explore),
    ("/bench/{n:int}/add", "POST", bench.add),
    ("/bench/{n:int}/weigh", "GET", bench.weigh),
    ("/bench/{n:int}/exploration.html", "GET", bench.diary),
    ("/bench/{n:int}/press", "POST", bench.press),
    ("/exercises/", "GET", instructor.show),
    ("/exercises/picture.svg", "GET", instructor.picture),
    ("/exercises/make", "POST", instructor.make),
    ("/exercises/made", "GET", instructor.made),
    ("/exercises/stop", "POST", instructor.stop),
    ("/effects/", "GET", instructor.catalogue),
    ("/rubric/", "GET", rubrics.show),
    ("/rubric/check", "POST", rubrics.check),
    ("/rubric/save", "POST", rubrics.save),
    ("/solution/{n:int}/", "GET", instructor.show_solution),
    ("/solution/{n:int}/make", "POST", instructor.make_solution),
    ("/solution/{n:int}/{name:path}", "GET", instructor.solution_file),
    ("/grades/{n:int}/", "GET", grades.show),
    ("/grades/{n:int}/news", "GET", grades.news),
    ("/grades/{n:int}/distribution.svg", "GET", grades.distribution),
    ("/grades/{n:int}/class.html", "GET", grades.at_a_glance),
    ("/grades/{n:int}/feedback/{name:path}/feedback.html", "GET", grades.feedback),
    ("/grades/{n:int}/team", "GET", team.show),
    ("/grades/{n:int}/team", "POST", team.act),
    ("/grades/{n:int}/figure", "GET", team.figure),
    ("/grades/{n:int}/import", "POST", whole.take_table),
    ("/grades/{n:int}/export", "POST", whole.export_class),
    ("/grades/{n:int}/publish", "POST", whole.publish),
    ("/grades/{n:int}/regrade", "POST", whole.regrade),
    ("/grades/{n:int}/stop", "POST", whole.stop),
)  # fmt: skip
# A Stop does not wait for one of the threads in which all others are answered.
STOPS = frozenset([student_report.stop, bench.press, instructor.stop, whole.stop])


class DeskServer:
    """The desk, served; a context.

    Parameters
    ----------
    folder : to begin with, of the person at this computer.
    port : to serve at; 0: a free one.
    host, users : of a lab server: the address to listen at, and the file that says who may what.

    Attributes
    ----------
    url : to open; the secret in it, if any, opens once.
    """

    def __init__(
        self,
        *,
        folder: Path | None = None,
        port: int = 0,
        host: str = "127.0.0.1",
        users: Path | None = None,
    ) -> None:
        listed = read_users(users) if users else None
        owner = User(name="", role="owner")
        start = enter(owner, folder) if folder else "/"
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            raise ConfigError(
                f"the desk cannot listen at port {port} of {host} ({error.strerror}): name another "
                "with --port, or an IPv4 address of this computer with --host"
            ) from None
        port = listener.getsockname()[1]
        if listed:
            door: SecretDoor | ProxyDoor = ProxyDoor(*listed)
            self.url = f"http://{host}:{port}/"
        else:
            door = SecretDoor(owner, port=port, start=start)
            self.url = f"http://127.0.0.1:{port}/{door.secret}/"
        self._desk = Desk()
        clear_scratch()
        prepare_pages()
        strangers = Strangers()
        guard = Guard(
            app=application(self._desk), door=door, uploads=HAND_IN.total, strangers=strangers
        )
        self._served = Served(guard, listener, protocol=announced(strangers, shows=door.shows))

    def __enter__(self) -> Self:
        if not self._served.start():
            raise ConfigError("the desk could not be served")
        return self

    @property
    def runs(self) -> bool:
        """Whether it is served."""
        return self._served.runs

    def __exit__(self, *raised: object) -> None:
        self._served.stop()
        self._desk.close()


def application(desk: Desk) -> Starlette:
    """Return what answers, where a guard has said who asks (`scope["user"]`)."""
    routes = [
        Route(path, _endpoint(desk, handler, room=_room(path)), methods=[method])
        for path, method, handler in ROUTES
    ]
    events = [Route(path, _events(desk, news, room=_room(path))) for path, news in EVENTS.items()]
    return Starlette(
        routes=[*routes, *events],
        exception_handlers={HTTPException: _wrong(desk), Exception: _wrong(desk)},
    )


def _room(path: str) -> str:
    return path.split("/")[1]


def _admit(user: User, room: str) -> None:
    if not user.may(room):
        raise HTTPException(403, f"this room is not for a {user.role}")


def _endpoint(
    desk: Desk, handler: Handler, *, room: str
) -> Callable[[Request], Awaitable[Response]]:
    """Return what reads the form, answers in a thread, and tells a person what went wrong."""

    async def answer(request: Request) -> Response:
        _admit(request.scope["user"], room)
        form = FormData()
        if request.method == "POST":
            form = await request.form(max_files=HAND_IN.members, max_fields=_MOST_FIELDS)
        ask = Ask(desk=desk, user=request.scope["user"], request=request, form=form)
        try:
            run = asyncio.to_thread if handler in STOPS else run_in_threadpool
            return await run(handler, ask)
        except PipelineError as error:
            return plain_error(ask, str(error), status=422)
        except OSError as error:
            file = str(error.filename) if ask.user.owns else Path(str(error.filename)).name
            where = f"{file}: " if error.filename else ""
            return plain_error(ask, f"{where}{error.strerror or error}", status=500)
        finally:
            await form.close()

    return answer


def _wrong(desk: Desk) -> Callable[[Request, Exception], Response]:
    """Return what tells of an address that is none, and of a fault of our own."""

    def answer(request: Request, error: Exception) -> Response:
        ask = Ask(desk=desk, user=request.scope["user"], request=request, form=FormData())
        if isinstance(error, HTTPException):
            return plain_error(ask, str(error.detail), status=error.status_code)
        what = f"the desk itself failed ({type(error).__name__}: {error}); please report it"
        return plain_error(ask, what, status=500)

    return answer


def _events(desk: Desk, listen: Listener, *, room: str) -> Callable[[Request], Awaitable[Response]]:
    """Return what tells news as they come, in the server's own loop."""

    async def answer(request: Request) -> Response:
        _admit(request.scope["user"], room)
        ask = Ask(desk=desk, user=request.scope["user"], request=request, form=FormData())
        return await listen(ask)

    return answer


async def _work_in_folder(ask: Ask) -> Response:
    return StreamingResponse(_news(ask, ask.folder()), media_type="text/event-stream")


async def _work_on_class(ask: Ask) -> Response:
    return StreamingResponse(_news(ask, ask.grades()), media_type="text/event-stream")


async def _news(ask: Ask, place: Any) -> AsyncIterator[str]:
    """Send a line for every stage; one a person has not read is not kept for them."""
    seen, quiet = -1, 0.0
    while (job := ask.desk.jobs.of(place)) is not None:
        if job.news != seen:
            seen, quiet = job.news, 0.0
            said = " ".join(ask.user.told(job.said).split())
            yield f"event: {'end' if job.over else 'stage'}\ndata: {said}\n\n"
        elif quiet > _ALIVE:
            quiet = 0.0
            yield ": still here\n\n"
        if job.over:
            return
        await asyncio.sleep(_FRAME)
        quiet += _FRAME
    yield "event: end\ndata: \n\n"


# Streams of news take no thread: those in which pages are answered would soon be used up.
EVENTS: Mapping[str, Listener] = {
    "/student/{n:int}/events": _work_in_folder,
    "/grades/{n:int}/events": _work_on_class,
    "/bench/{n:int}/events": bench.events,
}
