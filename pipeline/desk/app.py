"""The desk as a web application: the table of its addresses, and the server that answers them."""

import asyncio
import re
import socket
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from inspect import iscoroutinefunction
from pathlib import Path
from typing import Any, Self

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.datastructures import FormData, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.desk.bench import bench_page
from pipeline.desk.grades import (
    bulk_change,
    class_page,
    grading_form,
    request_queue,
    team_page,
)
from pipeline.desk.home import enter, open_place, show_folders, show_home
from pipeline.desk.instructor import exercise_pages, rubric_pages
from pipeline.desk.login import PAGE_HEADERS, JupyterLogin, ProxyLogin, SecretLogin, limit_bodies
from pipeline.desk.page_request import Desk, PageRequest, plain_error, prepare_pages
from pipeline.desk.served_files import clear_scratch, serve_file, serve_static
from pipeline.desk.student import my_feedback, result_pages, submission_page
from pipeline.desk.users import REFUSED, User, read_users
from pipeline.errors import ConfigError, PipelineError
from pipeline.grading.intake.unpack import HAND_IN
from pipeline.web import Login, OriginCheck, Served, refuse

Handler = Callable[[PageRequest], Any]  # returns a Response or a coroutine of one


def _start(task: str, title: str, *, then: str = "") -> Handler:
    """Return a handler that starts a long task in the folder that the URL names.

    Parameters
    ----------
    task : name of a function in `tasks.py`.
    then : last part of the URL to open next.
    """

    def start(ask: PageRequest) -> Response:
        ask.start(task, title=title)
        return ask.back(ask.here + then)

    return start


def _serve(inside: str) -> Handler:
    """Return a handler that serves a file from the subfolder `inside` of the URL's folder."""
    return lambda ask: serve_file(ask.folder(), f"{inside}/{ask.request.path_params['name']}")


def _stop(ask: PageRequest) -> Response:
    """Stop the work in the folder that the URL names; what is already done stays."""
    ask.stop(ask.folder())
    return ask.back(ask.here + ("#work" if ask.here.startswith("/grades/") else "#report"))


_BLANKS = re.compile(r"\s+")  # a line break would end the event


async def _stream_events(ask: PageRequest) -> Response:
    """Return a stream of events that report the work in the place that the URL names."""
    return StreamingResponse(_events(ask, ask.place_or_404()), media_type="text/event-stream")


async def _events(ask: PageRequest, place: Any) -> AsyncIterator[str]:
    """Yield an event for every new stage of the work; a slow reader gets only the latest stage."""
    version, quiet, frame = -1, 0.0, 0.2  # `frame` is the time in s between two checks for changes
    while (job := ask.desk.jobs.of(place)) is not None:
        if job.version != version:
            version, quiet = job.version, 0.0
            shown = await run_in_threadpool(lambda: ask.job) or job
            message = _BLANKS.sub(" ", shown.message).strip()
            yield f"event: {'end' if job.over else 'stage'}\ndata: {message}\n\n"
        elif quiet > 5.0:  # s without an event; the line sent then keeps the connection open
            quiet = 0.0
            yield ": still here\n\n"
        if job.over:
            return
        await asyncio.sleep(frame)
        quiet += frame
    yield "event: end\ndata: \n\n"


class _Number(IntegerConvertor):
    """A number in an address; one with more digits is no address of the desk."""

    regex = "[0-9]{1,9}"


register_url_convertor("nth", _Number())

# Address, method, handler. Every change is a POST from a form that works without scripts. Handlers
# of streams are coroutines, because a thread for each stream would soon leave no thread to answer
# requests.
ROUTES: tuple[tuple[str, str, Handler], ...] = (
    ("/", "GET", show_home),
    ("/open", "GET", show_folders),
    ("/open", "POST", open_place),
    ("/static/{name}", "GET", serve_static),
    ("/student/{n:nth}/", "GET", submission_page.show),
    ("/student/{n:nth}/files", "POST", submission_page.upload),
    ("/student/{n:nth}/fill", "POST", submission_page.fill),
    ("/student/{n:nth}/aside", "POST", submission_page.set_aside),
    ("/student/{n:nth}/save", "POST", submission_page.save),
    ("/student/{n:nth}/experiments/{index:nth}", "POST", submission_page.save_experiment),
    ("/student/{n:nth}/answer-together", "POST", submission_page.answer_together),
    ("/student/{n:nth}/make-report", "POST", _start("make_report", "The report", then="#report")),
    ("/student/{n:nth}/make-gap", "POST", _start("make_gap", "The gap", then="#report")),
    ("/student/{n:nth}/gap/{name:path}", "GET", _serve("gap")),
    ("/student/{n:nth}/stop", "POST", _stop),
    ("/student/{n:nth}/events", "GET", _stream_events),
    ("/student/{n:nth}/report", "GET", result_pages.show_report),
    ("/student/{n:nth}/report/{name:path}", "GET", _serve("report")),
    ("/student/{n:nth}/questions", "GET", result_pages.show_questions),
    ("/student/{n:nth}/compare", "GET", result_pages.show_plots),
    ("/student/{n:nth}/compare", "POST", result_pages.make_plots),
    ("/student/{n:nth}/answer", "POST", result_pages.answer),
    ("/student/{n:nth}/discussion", "POST", result_pages.write_discussion),
    ("/student/{n:nth}/state-signs", "POST", result_pages.state_signs),
    ("/student/{n:nth}/check", "GET", result_pages.show_check),
    ("/student/{n:nth}/check", "POST", result_pages.begin_check),
    ("/student/{n:nth}/hand-in", "GET", submission_page.show_hand_in),
    ("/student/{n:nth}/hand-in", "POST", submission_page.start_hand_in),
    ("/student/{n:nth}/hand-in.zip", "GET", submission_page.download_hand_in),
    ("/bench/{n:nth}/", "GET", bench_page.show),
    ("/bench/{n:nth}/plan", "POST", bench_page.plan),
    ("/bench/{n:nth}/acquire", "POST", bench_page.acquire),
    ("/bench/{n:nth}/explore", "POST", bench_page.explore),
    ("/bench/{n:nth}/add", "POST", bench_page.add),
    ("/bench/{n:nth}/weigh", "GET", bench_page.show_comparison),
    ("/bench/{n:nth}/exploration.html", "GET", bench_page.show_diary),
    ("/bench/{n:nth}/press", "POST", bench_page.press),
    ("/bench/{n:nth}/events", "GET", bench_page.stream),
    ("/exercises/", "GET", exercise_pages.show),
    ("/exercises/picture.svg", "GET", exercise_pages.draw),
    ("/exercises/make", "POST", exercise_pages.make),
    ("/exercises/made", "GET", exercise_pages.show_made),
    ("/exercises/stop", "POST", exercise_pages.stop),
    ("/effects/", "GET", exercise_pages.show_catalogue),
    ("/rubric/", "GET", rubric_pages.show),
    ("/rubric/check", "POST", rubric_pages.check),
    ("/rubric/save", "POST", rubric_pages.save),
    ("/rubric/preview", "POST", rubric_pages.preview),
    ("/rubric/simulated", "POST", rubric_pages.simulate),
    ("/rubric/simulated", "GET", rubric_pages.show_simulated),
    ("/rubric/preview.svg", "GET", rubric_pages.draw_preview),
    ("/solution/{n:nth}/", "GET", exercise_pages.show_solution),
    ("/solution/{n:nth}/make", "POST", _start("make_solution", "The solution")),
    ("/solution/{n:nth}/{name:path}", "GET", _serve("solution")),
    ("/grading/", "GET", grading_form.show_new),
    ("/grading/", "POST", grading_form.grade_new),
    ("/grades/{n:nth}/", "GET", class_page.show),
    ("/grades/{n:nth}/events", "GET", _stream_events),
    ("/grades/{n:nth}/news", "GET", class_page.show_news),
    ("/grades/{n:nth}/distribution.svg", "GET", class_page.draw_distribution),
    ("/grades/{n:nth}/class.html", "GET", class_page.show_class_page),
    ("/grades/{n:nth}/feedback/{name:path}/feedback.html", "GET", class_page.show_feedback),
    ("/grades/{n:nth}/team", "GET", team_page.show),
    ("/grades/{n:nth}/team", "POST", team_page.act),
    ("/grades/{n:nth}/bulk-change", "GET", bulk_change.show),
    ("/grades/{n:nth}/bulk-change", "POST", bulk_change.apply),
    ("/grades/{n:nth}/figure", "GET", team_page.show_figure),
    ("/grades/{n:nth}/paper", "GET", team_page.send_paper),
    ("/grades/{n:nth}/requests", "GET", request_queue.show),
    ("/grades/{n:nth}/requests", "POST", request_queue.act),
    ("/grades/{n:nth}/clean", "GET", class_page.show_clean),
    ("/grades/{n:nth}/clean", "POST", class_page.accept),
    ("/grades/{n:nth}/release", "POST", class_page.release),
    ("/grades/{n:nth}/hold", "POST", class_page.hold_criterion),
    ("/feedback/{n:nth}/", "GET", my_feedback.show),
    ("/feedback/{n:nth}/whole", "GET", my_feedback.show_whole),
    ("/feedback/{n:nth}/ask", "POST", my_feedback.send),
    ("/grades/{n:nth}/import", "POST", class_page.take_table),
    ("/grades/{n:nth}/export", "POST", class_page.export_class),
    ("/grades/{n:nth}/publish", "POST", _start("publish_grades", "Writing", then="#work")),
    ("/grades/{n:nth}/grade", "POST", class_page.grade),
    ("/grades/{n:nth}/stop", "POST", _stop),
)  # fmt: skip


class DeskServer:
    """The desk and its server, as a context manager.

    Parameters
    ----------
    folder : the folder that the person at this computer sees first.
    port : port to listen at; 0 for any free port.
    host : address to listen at, on a lab server.
    users : file that states who may do what, on a lab server.
    jupyter : the secret of the Jupyter server that starts the desk and forwards requests to it.

    Attributes
    ----------
    url : address to open; if it contains a secret, the secret works only once.
    """

    def __init__(
        self,
        *,
        folder: Path | None = None,
        port: int = 0,
        host: str = "127.0.0.1",
        users: Path | None = None,
        jupyter: str = "",
    ) -> None:
        listed = read_users(users) if users else None
        owner = User(name="", role="owner")
        start = enter(owner, folder) if folder else "/"
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            raise ConfigError(
                f"the desk cannot listen at port {port} of {host} ({error.strerror}): choose "
                f"another with --port, or give an IPv4 address of this computer with --host"
            ) from None
        port = listener.getsockname()[1]
        self.url = f"http://{host}:{port}/"
        door: Login
        if listed:
            door = ProxyLogin(*listed)
        elif jupyter:
            door = JupyterLogin(owner, secret=jupyter)
        else:
            door = SecretLogin(owner, port=port, start=start)
            self.url = f"http://127.0.0.1:{port}/{door.secret}/"
        self._desk = Desk()
        clear_scratch()
        prepare_pages()
        if listed and any(user.folders for user in listed[1].values()):
            self._desk.workers.start()
        limited = limit_each_person(limit_bodies(application(self._desk), uploads=HAND_IN.total))
        self._served = Served(OriginCheck(limited, door, headers=PAGE_HEADERS), listener)

    def __enter__(self) -> Self:
        if not self._served.start():
            raise ConfigError("the desk could not be served")
        return self

    @property
    def runs(self) -> bool:
        """Whether the server runs."""
        return self._served.runs

    def __exit__(self, *raised: object) -> None:
        self._served.stop()
        self._desk.close()


def application(desk: Desk) -> Starlette:
    """Return the application; a guard must have stored the person who asks in `scope["user"]`."""
    return Starlette(
        routes=[
            Route(path, _answer(desk, handler, path=path), methods=[method])
            for path, method, handler in ROUTES
        ],
        exception_handlers={HTTPException: _explain(desk), Exception: _explain(desk)},
    )


def _answer(desk: Desk, handler: Handler, *, path: str) -> Callable[[Request], Awaitable[Response]]:
    """Return a function that checks access, reads the form, runs the handler and reports errors."""

    async def answer(request: Request) -> Response:
        user, room = request.scope["user"], path.split("/")[1]
        if not user.may(room):
            raise HTTPException(403, f"this page is not for the role {user.role}")
        if path.endswith("/grade") and not user.owns:
            raise HTTPException(403, "only the owner of this computer can enter folders")
        form = FormData()
        if request.method == "POST":
            form = await request.form(max_files=HAND_IN.members, max_fields=5_000)
        ask = PageRequest(desk=desk, user=user, request=request, form=form)
        try:
            # A Stop must not wait until one of the shared threads is free, so it gets a thread of
            # its own.
            at_once = path.endswith(("/stop", "/press"))
            run = asyncio.to_thread if at_once else run_in_threadpool
            if iscoroutinefunction(handler):
                await run(_admit, ask, path)
                return await handler(ask)
            return await run(lambda: (_admit(ask, path), handler(ask))[1])
        except PipelineError as error:
            return plain_error(ask, str(error), status=422)
        except OSError as error:
            file = str(error.filename) if ask.user.owns else Path(str(error.filename)).name
            where = f"{file}: " if error.filename else ""
            return plain_error(ask, f"{where}{error.strerror or error}", status=500)
        finally:
            await form.close()

    return answer


def _admit(ask: PageRequest, path: str) -> None:
    """Refuse a request whose folder is gone, or that could show what the student must find."""
    ask.require_place()
    if ask.desk.visibility.is_refused(path, ask.user, ask.place):
        raise HTTPException(403, REFUSED)


def _explain(desk: Desk) -> Callable[[Request, Exception], Response]:
    """Return the handler for unknown addresses, refused access, and failures of the desk."""

    def answer(request: Request, error: Exception) -> Response:
        ask = PageRequest(desk=desk, user=request.scope["user"], request=request, form=FormData())
        if isinstance(error, HTTPException):
            return plain_error(ask, str(error.detail), status=error.status_code)
        what = f"the desk itself failed ({type(error).__name__}: {error}); please report it"
        return plain_error(ask, what, status=500)

    return answer


# ----------------------------------------------------------------------------- limits of one person

AT_ONCE = 4  # requests of one person that are answered at the same time
_WAITING = 24  # further requests of one person that wait for their turn
# Requests of one person that take no turn: streams, which last as long as a page is open, and
# buttons that stop something.
_OTHERS, _WITHOUT_TURN = 12, ("/events", "/stop", "/press")
_STALLED = 20.0  # s without a byte of the body
_BUSY = (
    "Too many of your requests are still being answered. Wait until your uploads and downloads "
    "end, then load this page again."
)


def limit_each_person(app: ASGIApp, *, stalled: float = _STALLED) -> ASGIApp:
    """Return an application that answers at most `AT_ONCE` requests of one person at a time.

    Further requests wait; very many are refused with status 429. A guard must have stored the
    person in `scope["user"]`.

    Parameters
    ----------
    stalled : longest time in s without a byte of a request's body.
    """
    turns: dict[str, asyncio.Semaphore] = {}
    begun: Counter[tuple[str, bool]] = Counter()

    async def limited(scope: Scope, receive: Receive, send: Send) -> None:
        name, takes_turn = scope["user"].name, not scope["path"].endswith(_WITHOUT_TURN)
        if begun[name, takes_turn] >= (AT_ONCE + _WAITING if takes_turn else _OTHERS):
            await refuse(_BUSY, status=429)(scope, receive, send)
            return
        begun[name, takes_turn] += 1
        try:
            if takes_turn:
                async with turns.setdefault(name, asyncio.Semaphore(AT_ONCE)):
                    await _with_timeout(app, stalled)(scope, receive, send)
            else:
                await _with_timeout(app, stalled)(scope, receive, send)
        finally:
            begun[name, takes_turn] -= 1

    return limited


def _with_timeout(app: ASGIApp, stalled: float) -> ASGIApp:
    """Return an application that refuses a request whose body stops arriving."""

    async def timed(scope: Scope, receive: Receive, send: Send) -> None:
        whole = False

        async def body() -> Message:
            nonlocal whole
            if whole:  # what follows is the end of the connection, which may take any time
                return await receive()
            try:
                message = await asyncio.wait_for(receive(), stalled)
            except TimeoutError:
                why = f"nothing of your upload arrived for {stalled:g} s; send it again"
                raise HTTPException(408, why) from None
            whole = not message.get("more_body", False)
            return message

        async def answer(message: Message) -> None:
            # The rest of a body that nobody reads must not keep the connection open.
            if message["type"] == "http.response.start" and scope["method"] == "POST" and not whole:
                MutableHeaders(scope=message)["Connection"] = "close"
            await send(message)

        await app(scope, body, answer)

    return timed
