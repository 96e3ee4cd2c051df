"""A page in the browser that shows a session at the bench while it goes on.

Served to this computer alone, and only to who has the address: it holds a secret that is made anew
for every session. Requests that another page makes (by a name that leads here, or from an origin
of its own) are refused. The server runs in a thread of its own and looks for news a few times a
second, so however slow a browser reads, the acquisition never waits. Anybody on this computer can
connect: those who have not shown the secret share so many connections, so that the files and ports
of the acquisition never lack a descriptor. They are more than arrive between two looks at what was
sent: however fast others connect, who sends the secret at once is known before being driven out.
"""

import asyncio
import json
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Self

from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn import Config, Server
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipeline.bench.watch.live_state import LiveState
from pipeline.errors import HardwareError
from pipeline.resources import TEMPLATES

_FRAME = 1 / 30  # s between looks for news
_ALIVE = 5.0  # s between signs of life where there is none
_MOST_PAGES = 8  # open at a time; each costs a little of the processor
_LARGEST_ANSWER = 200  # bytes of what a button sends
_TO_SHOW_IT = 5.0  # s a stranger may stay
_BACKLOG = 32  # connections accepted in one turn of the loop, before any can be driven out
# Connections without the secret; the newest drives out the oldest. A request that is there when its
# connection is accepted is read two or three turns later.
_MOST_STRANGERS = 4 * _BACKLOG
_GOODBYE = 1.0  # s for open pages to hear that the session is over

_FILES = {
    "": ("live.html", "text/html"),
    "live.js": ("live.js", "text/javascript"),
    "report.css": ("report.css", "text/css"),
    "live.css": ("live.css", "text/css"),
}
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class LivePage(LiveState):
    """An observer that a browser shows; a context, in which the page is served.

    Parameters
    ----------
    folder : of the submission.
    port : to serve at; 0: a free one.

    Attributes
    ----------
    url : of the page, the secret in it: for the person's eyes, not for a file or a log.
    """

    def __init__(self, folder: Path, *, port: int = 0) -> None:
        super().__init__(folder)
        try:
            self._socket = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise HardwareError(f"port {port} is not free for the page: {error.strerror}") from None
        port, token = self._socket.getsockname()[1], secrets.token_urlsafe(24)
        self.url = f"http://127.0.0.1:{port}/{token}/"
        self._pages = 0
        self._closing = False
        routes = [
            Route("/", self._file),
            Route("/events", self._events),
            Route("/confirm", self._confirm, methods=["POST"]),
            Route("/{name}", self._file),
        ]
        strangers = _Strangers()
        app = _Guard(Starlette(routes=routes), token=token, port=port)
        config = Config(
            app,
            http=_protocol(strangers, token=token),
            backlog=_BACKLOG,
            proxy_headers=False,  # a peer is who it is, whatever it says of itself
            log_config=None,
            log_level="critical",  # nothing that holds the address is written anywhere
            access_log=False,
            lifespan="off",
            ws="none",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        while not self._server.started:
            if not self._thread.is_alive():
                raise HardwareError("the page could not be served")
            time.sleep(0.01)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end()
        self._closing = True
        until = time.monotonic() + _GOODBYE
        while self._pages and time.monotonic() < until:
            time.sleep(0.02)
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()

    # ------------------------------------------------------------------ in the server's thread

    async def _file(self, request: Request) -> Response:
        name = request.path_params.get("name", "")
        if name not in _FILES:
            return PlainTextResponse("not found", status_code=404)
        file, kind = _FILES[name]
        return Response((TEMPLATES / file).read_bytes(), media_type=kind)

    async def _confirm(self, request: Request) -> Response:
        if int(request.headers.get("content-length", _LARGEST_ANSWER + 1)) > _LARGEST_ANSWER:
            return PlainTextResponse("too long", status_code=413)
        try:
            number = json.loads(await request.body())["number"]
        except (ValueError, TypeError, KeyError):
            return PlainTextResponse("not understood", status_code=400)
        done = isinstance(number, int) and self.answer(number)
        return Response(status_code=204 if done else 409)

    async def _events(self, request: Request) -> Response:
        if self._pages >= _MOST_PAGES:
            return PlainTextResponse("too many pages are open", status_code=503)
        return StreamingResponse(self._news(), media_type="text/event-stream")

    async def _news(self) -> AsyncIterator[str]:
        """Send what changed as it changes; a page that reads slowly gets less, not later."""
        self._pages += 1
        try:
            version, run, start, said = -1, 0, 0, time.monotonic()
            while True:
                last = self._closing
                if version != self.version:
                    version = self.version
                    yield _event("state", self.snapshot())
                points = self.points(run=run, start=start)
                if points.run != run or points.end != start:
                    run, start, said = points.run, points.end, time.monotonic()
                    yield _event("points", asdict(points))
                elif time.monotonic() - said > _ALIVE:
                    said = time.monotonic()
                    yield ": still here\n\n"
                if last:
                    return
                await asyncio.sleep(_FRAME)
        finally:
            self._pages -= 1


def _event(kind: str, data: Mapping[str, object]) -> str:
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"event: {kind}\ndata: {text}\n\n"


class _Strangers:
    """The connections over which nobody has shown the secret yet: few, and not for long."""

    def __init__(self) -> None:
        # By address, the oldest first; each has a timer that ends its stay.
        self._there: dict[object, tuple[asyncio.Transport, asyncio.TimerHandle]] = {}

    def add(self, transport: asyncio.Transport) -> None:
        """Take in a new one; the oldest goes where there are too many."""
        peer = transport.get_extra_info("peername")
        self.know(peer)  # an earlier one from the same address is closed already
        timer = asyncio.get_running_loop().call_later(_TO_SHOW_IT, self._turn_out, peer)
        self._there[peer] = transport, timer
        if len(self._there) > _MOST_STRANGERS:
            self._turn_out(next(iter(self._there)))

    def know(self, peer: object) -> None:
        """Let one stay: the secret was shown."""
        if peer in self._there:
            self._there.pop(peer)[1].cancel()

    def _turn_out(self, peer: object) -> None:
        transport, _ = self._there[peer]
        self.know(peer)
        transport.abort()


def _protocol(strangers: _Strangers, *, token: str) -> type[asyncio.Protocol]:
    """Return HTTP that tells of each connection as it is made, and as it shows the secret."""

    class Announced(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            strangers.add(transport)

        def data_received(self, data: bytes) -> None:
            shown = data[:_LARGEST_ANSWER].split(b"/", 2)[1:2]
            if shown and secrets.compare_digest(shown[0], token.encode()):
                strangers.know(self.client)
            super().data_received(data)

    return Announced


class _Guard:
    """Lets in who knows the secret, asks by this computer's own name and is no other page."""

    def __init__(self, app: ASGIApp, *, token: str, port: int) -> None:
        self._app, self._token = app, f"{token}/"  # links of the page go on from the slash
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        token, slash, inside = scope["path"].removeprefix("/").partition("/")
        headers = Headers(scope=scope)
        if refusal := self._refusal(headers, method=scope["method"], token=token + slash):
            answer = PlainTextResponse(refusal, status_code=403, headers={"Connection": "close"})
            await answer(scope, receive, guarded)
            return
        await self._app({**scope, "path": f"/{inside}"}, receive, guarded)

    def _refusal(self, headers: Headers, *, method: str, token: str) -> str:
        """Return why a request is refused; "" where it is not."""
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self._hosts:
            return "ask by the address that cartlab printed"
        if origin != f"http://{host}" and (origin is not None or method != "GET"):
            return "another page's request"
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            return "another page's request"
        if not secrets.compare_digest(token.encode(), self._token.encode()):
            return "the address lacks its secret, or has an old one"
        return ""
