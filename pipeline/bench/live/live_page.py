"""A page in the browser that shows a session at the bench while it runs.

The desk shows it among its own pages. `cartlab acquire --web` serves it alone, to this computer
only, and only to visitors with the address, which holds a secret for this session. Requests from
other pages are refused. The server polls for news a few times a second, so a slow browser never
delays the acquisition.
"""

import asyncio
import json
import secrets
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Scope

from pipeline.bench.live.live_state import FRAME, LiveState, ShownSession
from pipeline.errors import HardwareError
from pipeline.resources import TEMPLATES
from pipeline.web.guard import Guard, find_site, list_own_names, refuse
from pipeline.web.server import Served

_LARGEST_ANSWER = 200  # largest body of a button's request, bytes
_FILES = {
    "": ("live.html", "text/html"),
    "live.js": ("live.js", "text/javascript"),
    "report.css": ("report.css", "text/css"),
    "live.css": ("live.css", "text/css"),
}


def stream_news(
    session: ShownSession, *, is_over: Callable[[], bool], last_words: str = ""
) -> Response:
    """Return the news of a session as it comes, in the server's own loop.

    Parameters
    ----------
    is_over : whether the session has ended.
    last_words : an event that says so.
    """
    if session.viewers >= 8:  # each costs a little of the processor
        return PlainTextResponse("too many pages show this session", status_code=503)

    async def news() -> AsyncIterator[str]:
        """Send changes as they happen; a slow page gets less, not later."""
        session.viewers += 1
        try:
            said, over = time.monotonic(), is_over()
            for changed in session.follow():
                for kind, data in changed:
                    said = time.monotonic()
                    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
                    yield f"event: {kind}\ndata: {text}\n\n"
                if over:
                    break
                if time.monotonic() - said > 5.0:  # s
                    said = time.monotonic()
                    yield ": still here\n\n"
                await asyncio.sleep(FRAME)
                over = is_over()
            if last_words:
                yield last_words
        finally:
            session.viewers -= 1

    return StreamingResponse(news(), media_type="text/event-stream")


def press_button(session: ShownSession, wish: str, number: str) -> int:
    """Pass on a button; return the status to answer with, 204 if it is accepted."""
    try:
        heeded = session.heed(wish, int(number))
    except ValueError:
        return 400
    return 204 if heeded else 409


def live_view() -> str:
    """Return the view of a session, with its buttons, for live.js to fill."""
    return (TEMPLATES / "live-view.html").read_text(encoding="utf-8")


class LivePage(LiveState):
    """An observer with a page in the browser; a context manager that serves the page.

    Parameters
    ----------
    folder : of the submission.
    port : to serve at; 0: a free one.

    Attributes
    ----------
    url : of the page, including the secret: for the person only, not for a file or a log.
    """

    def __init__(self, folder: Path, *, port: int = 0) -> None:
        super().__init__(folder)
        try:
            listener = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise HardwareError(f"port {port} is not free for the page: {error.strerror}") from None
        port, secret = listener.getsockname()[1], secrets.token_urlsafe(24)
        self.url = f"http://127.0.0.1:{port}/{secret}/"
        self._closing = False
        routes = [
            Route("/", self._show_file),
            Route("/events", self._stream),
            Route("/press", self._press, methods=["POST"]),
            Route("/{name}", self._show_file),
        ]
        door = _SecretPath(secret, port=port)
        self._served = Served(Guard(Starlette(routes=routes), door), listener)

    def __enter__(self) -> Self:
        if not self._served.start():
            raise HardwareError("the page could not be served")
        return self

    def __exit__(self, *raised: object) -> None:
        self.end()
        self._closing = True
        until = time.monotonic() + 1.0  # s for open pages to hear that the session is over
        while self.viewers and time.monotonic() < until:
            time.sleep(0.02)
        self._served.stop()

    # ------------------------------------------------------------------ in the server's thread

    async def _show_file(self, request: Request) -> Response:
        name = request.path_params.get("name", "")
        if name not in _FILES:
            return PlainTextResponse("not found", status_code=404)
        file, kind = _FILES[name]
        text = (TEMPLATES / file).read_text(encoding="utf-8")
        return Response(text.replace("<!-- the view -->", live_view()), media_type=kind)

    async def _press(self, request: Request) -> Response:
        """Take a button: `done` with an instruction, or a wish for a turn, by its number."""
        if int(request.headers.get("content-length", _LARGEST_ANSWER + 1)) > _LARGEST_ANSWER:
            return PlainTextResponse("too long", status_code=413)
        try:
            sent = dict(parse_qsl((await request.body()).decode("ascii"), strict_parsing=True))
            status = press_button(self, sent["wish"], sent["number"])
        except (ValueError, KeyError):
            return PlainTextResponse("not understood", status_code=400)
        return Response(status_code=status)

    async def _stream(self, request: Request) -> Response:
        return stream_news(self, is_over=lambda: self._closing)


class _SecretPath:
    """Access for visitors with the secret, with which every address begins."""

    arrivals = False

    def __init__(self, secret: str, *, port: int) -> None:
        self._sites = list_own_names(port)
        self._secret = f"{secret}/"  # relative links of the page start at the slash

    def site(self, headers: Headers) -> str:
        """Return by which name of this computer the request asks."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return the rest of the path."""
        secret, slash, inside = scope["path"].removeprefix("/").partition("/")
        if secrets.compare_digest((secret + slash).encode(), self._secret.encode()):
            return {"path": f"/{inside}"}
        return refuse("the address lacks its secret, or has an old one")
