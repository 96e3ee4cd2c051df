"""A page in the browser that shows a session at the bench while it runs.

`cartlab acquire --web` serves only this page, and only to visitors on this computer whose URL
contains the secret. The server checks for changes itself, so a slow browser never delays the
acquisition.
"""

import asyncio
import json
import secrets
import socket
import time
from collections.abc import AsyncIterator, Callable
from typing import Any, Self
from urllib.parse import parse_qsl

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Scope

from pipeline.bench.live_state import FRAME, LiveState, ShownSession
from pipeline.errors import HardwareError
from pipeline.resources import TEMPLATES
from pipeline.web import OriginCheck, Served, find_site, list_own_names, refuse

_LARGEST_ANSWER = 200  # bytes; the largest request of a button
# The style sheets and scripts of the view.
LIVE_FILES = ("report.css", "uplot.css", "live.css", "uplot.min.js", "charts.js", "live.js")
_FILES = {"": "live.html", **{name: name for name in LIVE_FILES}}
_KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript"}


def stream_events(
    session: ShownSession, *, is_over: Callable[[], bool], exit_message: str = ""
) -> Response:
    """Return the changes of a session as a stream of events.

    Parameters
    ----------
    is_over : function that returns whether the session has ended.
    exit_message : event that is sent when the session has ended.
    """
    if session.viewers >= 8:  # each open page costs a little computing time
        return PlainTextResponse("too many pages show this session", status_code=503)

    async def events() -> AsyncIterator[str]:
        """Yield changes as they happen; a slow page gets fewer events, not late ones."""
        session.viewers += 1
        try:
            last_sent, over = time.monotonic(), is_over()
            for changed in session.follow():
                for kind, data in changed:
                    last_sent = time.monotonic()
                    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
                    yield f"event: {kind}\ndata: {text}\n\n"
                if over:
                    break
                if time.monotonic() - last_sent > 5.0:  # s
                    last_sent = time.monotonic()
                    yield ": still here\n\n"
                await asyncio.sleep(FRAME)
                over = is_over()
            if exit_message:
                yield exit_message
        finally:
            session.viewers -= 1

    return StreamingResponse(events(), media_type="text/event-stream")


def press_button(session: ShownSession, wish: str, number: str) -> int:
    """Pass a pressed button to the session; return the HTTP status, 204 if it is accepted."""
    try:
        heeded = session.apply(wish, int(number))
    except ValueError:
        return 400
    return 204 if heeded else 409


def live_view() -> str:
    """Return the HTML of a session's view and buttons, which live.js fills in."""
    return (TEMPLATES / "live-view.html").read_text(encoding="utf-8")


class LivePage:
    """Serves a page that shows a session to the browser; use it as a context manager.

    The session ends with the block.

    Parameters
    ----------
    port : port to listen at; 0 for any free port.

    Attributes
    ----------
    url : address of the page, with the secret. Show it only to the person; write it to no file or
        log.
    """

    def __init__(self, session: LiveState, *, port: int = 0) -> None:
        self.session = session
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
        self._served = Served(OriginCheck(Starlette(routes=routes), door), listener)

    def __enter__(self) -> Self:
        if not self._served.start():
            raise HardwareError("the page could not be served")
        return self

    def __exit__(self, *raised: object) -> None:
        self.session.end()
        self._closing = True
        until = time.monotonic() + 1.0  # s for open pages to learn that the session has ended
        while self.session.viewers and time.monotonic() < until:
            time.sleep(0.02)
        self._served.stop()

    # ------------------------------------------------------------------ in the server's thread

    async def _show_file(self, request: Request) -> Response:
        name = request.path_params.get("name", "")
        if name not in _FILES:
            return PlainTextResponse("not found", status_code=404)
        file = TEMPLATES / _FILES[name]
        text = file.read_text(encoding="utf-8").replace("<!-- the view -->", live_view())
        return Response(text, media_type=_KINDS[file.suffix[1:]])

    async def _press(self, request: Request) -> Response:
        """Handle a pressed button; its number says for which instruction or turn it was pressed."""
        if int(request.headers.get("content-length", _LARGEST_ANSWER + 1)) > _LARGEST_ANSWER:
            return PlainTextResponse("too long", status_code=413)
        try:
            sent = dict(parse_qsl((await request.body()).decode("ascii"), strict_parsing=True))
            status = press_button(self.session, sent["wish"], sent["number"])
        except (ValueError, KeyError):
            return PlainTextResponse("not understood", status_code=400)
        return Response(status_code=status)

    async def _stream(self, request: Request) -> Response:
        return stream_events(self.session, is_over=lambda: self._closing)


class _SecretPath:
    """Admit visitors whose address begins with the secret."""

    allows_arrivals = False

    def __init__(self, secret: str, *, port: int) -> None:
        self._sites = list_own_names(port)
        self._secret = f"{secret}/"  # the slash makes relative links of the page work

    def site(self, headers: Headers) -> str:
        """Return the name by which the request addresses this computer."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return the path without the secret, or a refusal."""
        secret, slash, inside = scope["path"].removeprefix("/").partition("/")
        if secrets.compare_digest((secret + slash).encode(), self._secret.encode()):
            return {"path": f"/{inside}"}
        return refuse("the address lacks its secret, or has an old one")
