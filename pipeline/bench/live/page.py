"""A page in the browser that shows a session at the bench while it goes on.

Served to this computer alone, and only to who has the address: it holds a secret that is made anew
for every session. Requests that another page makes (by a name that leads here, or from an origin
of its own) are refused. The server runs in a thread of its own and looks for news a few times a
second, so however slow a browser reads, the acquisition never waits.
"""

import asyncio
import json
import secrets
import socket
import time
from collections.abc import AsyncIterator, Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Self
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from pipeline.bench.live.observer import WISHES
from pipeline.bench.live.page_state import LiveState
from pipeline.errors import HardwareError
from pipeline.resources import TEMPLATES
from pipeline.web.guard import HEADERS, guarded, own_names, refusal
from pipeline.web.server import Served
from pipeline.web.strangers import Strangers, announced

_FRAME = 1 / 30  # s between looks for news
_ALIVE = 5.0  # s between signs of life where there is none
_MOST_PAGES = 8  # open at a time; each costs a little of the processor
_LARGEST_ANSWER = 200  # bytes of what a button sends
_GOODBYE = 1.0  # s for open pages to hear that the session is over

_FILES = {
    "": ("live.html", "text/html"),
    "live.js": ("live.js", "text/javascript"),
    "report.css": ("report.css", "text/css"),
    "live.css": ("live.css", "text/css"),
}
_VIEW = "<!-- the view -->"


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
            listener = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise HardwareError(f"port {port} is not free for the page: {error.strerror}") from None
        port, token = listener.getsockname()[1], secrets.token_urlsafe(24)
        self.url = f"http://127.0.0.1:{port}/{token}/"
        self._pages = 0
        self._closing = False
        routes = [
            Route("/", self._file),
            Route("/events", self._events),
            Route("/press", self._press, methods=["POST"]),
            Route("/{name}", self._file),
        ]
        app = _Guard(Starlette(routes=routes), token=token, sites=own_names(port))

        def shows(data: bytes) -> bool:
            shown = data[:_LARGEST_ANSWER].split(b"/", 2)[1:2]
            return bool(shown) and secrets.compare_digest(shown[0], token.encode())

        self._served = Served(app, listener, protocol=announced(Strangers(), shows=shows))

    def __enter__(self) -> Self:
        if not self._served.start():
            raise HardwareError("the page could not be served")
        return self

    def __exit__(self, *raised: object) -> None:
        self.end()
        self._closing = True
        until = time.monotonic() + _GOODBYE
        while self._pages and time.monotonic() < until:
            time.sleep(0.02)
        self._served.stop()

    # ------------------------------------------------------------------ in the server's thread

    async def _file(self, request: Request) -> Response:
        name = request.path_params.get("name", "")
        if name not in _FILES:
            return PlainTextResponse("not found", status_code=404)
        file, kind = _FILES[name]
        text = (TEMPLATES / file).read_text(encoding="utf-8").replace(_VIEW, live_view())
        return Response(text, media_type=kind)

    async def _press(self, request: Request) -> Response:
        """Take a button: `done` of an instruction, or what is wanted of a turn, by its number."""
        if int(request.headers.get("content-length", _LARGEST_ANSWER + 1)) > _LARGEST_ANSWER:
            return PlainTextResponse("too long", status_code=413)
        try:
            pressed = dict(parse_qsl((await request.body()).decode("ascii"), strict_parsing=True))
            wish, number = pressed["wish"], int(pressed["number"])
        except (ValueError, KeyError):
            return PlainTextResponse("not understood", status_code=400)
        if wish == "done":
            heeded = self.answer(number)
        else:
            heeded = wish in WISHES and self.press(wish, turn=number)
        return Response(status_code=204 if heeded else 409)

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


def live_view() -> str:
    """Return what a page shows of a session, with its buttons, for live.js to fill."""
    return (TEMPLATES / "live-view.html").read_text(encoding="utf-8")


def _event(kind: str, data: Mapping[str, object]) -> str:
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return f"event: {kind}\ndata: {text}\n\n"


class _Guard:
    """Lets in who knows the secret, asks by this computer's own name and is no other page."""

    def __init__(self, app: ASGIApp, *, token: str, sites: Collection[str]) -> None:
        self._app, self._token = app, f"{token}/"  # links of the page go on from the slash
        self._sites = sites

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        send = guarded(send, HEADERS)
        token, slash, inside = scope["path"].removeprefix("/").partition("/")
        why = refusal(Headers(scope=scope), method=scope["method"], sites=self._sites)
        if not why and not secrets.compare_digest((token + slash).encode(), self._token.encode()):
            why = "the address lacks its secret, or has an old one"
        if why:
            answer = PlainTextResponse(why, status_code=403, headers={"Connection": "close"})
            await answer(scope, receive, send)
            return
        await self._app({**scope, "path": f"/{inside}"}, receive, send)
