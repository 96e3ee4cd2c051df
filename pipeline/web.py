"""Serve pages to a browser on this computer: admit requests and limit connections."""

import asyncio
import socket
import threading
import time
from collections.abc import Collection, Mapping
from typing import Any, Protocol

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn import Config, Server
from uvicorn.protocols.http.h11_impl import H11Protocol

# -------------------------------------------------------------------- a server in its own thread
#
# Anybody on this computer can connect. Connections that are not yet admitted share a fixed number
# of places, so the server never runs out of file descriptors. The limits of uvicorn do not ensure
# this: it keeps every idle connection, and its `limit_concurrency` refuses all later ones. Each
# request must arrive, apart from its body, within the same time.

_BACKLOG = 32  # connections accepted in one turn of the loop, before any can be closed
# Largest number of connections that are not admitted; a new one closes the oldest. A request that
# arrives with its connection reaches the application three turns later, so it is never closed
# before that.
_MOST_STRANGERS = 4 * _BACKLOG
_STRANGER_STAYS = 5.0  # s


class Served:
    """An application served at a port that is already open."""

    def __init__(self, app: ASGIApp, listener: socket.socket) -> None:
        self._listener = listener
        config = Config(
            app,
            http=_limit_strangers(),
            backlog=_BACKLOG,
            proxy_headers=False,  # take the sender's address from the connection, not from headers
            log_config=None,
            log_level="critical",  # do not log addresses
            access_log=False,
            lifespan="off",
            ws="none",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [listener]}, name="server", daemon=True
        )

    @property
    def runs(self) -> bool:
        """Whether the server is running."""
        return self._thread.is_alive()

    def start(self) -> bool:
        """Start the server; return whether it runs."""
        self._thread.start()
        while not self._server.started:
            if not self._thread.is_alive():
                return False
            time.sleep(0.01)
        return True

    def stop(self) -> None:
        """Stop the server and free the port."""
        self._server.should_exit = True
        self._thread.join()
        self._listener.close()


def let_in(scope: Scope) -> None:
    """Keep the connection of a request, because its sender is admitted."""
    scope["state"]["let_in"]()


def _limit_strangers() -> type[asyncio.Protocol]:
    """Return an HTTP protocol that closes connections soon unless `let_in` admits a request."""
    strangers: dict[asyncio.Transport, asyncio.TimerHandle] = {}  # oldest first
    # Connections whose next request has not arrived completely.
    between: dict[asyncio.Transport, asyncio.TimerHandle] = {}

    def forget(transport: asyncio.Transport) -> None:
        for timers in (strangers, between):
            if timer := timers.pop(transport, None):
                timer.cancel()

    class Limited(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            self.app_state = {**self.app_state, "let_in": lambda: forget(transport)}
            loop = asyncio.get_running_loop()
            strangers[transport] = loop.call_later(_STRANGER_STAYS, transport.abort)
            if len(strangers) > _MOST_STRANGERS:
                oldest = next(iter(strangers))
                forget(oldest)
                oldest.abort()

        def on_response_complete(self) -> None:
            admitted = self.transport not in strangers
            if admitted:
                forget(self.transport)
            if admitted and not self.transport.is_closing():
                loop = asyncio.get_running_loop()
                between[self.transport] = loop.call_later(_STRANGER_STAYS, self.transport.abort)
            super().on_response_complete()

        def connection_lost(self, exc: Exception | None) -> None:
            forget(self.transport)
            super().connection_lost(exc)

    return Limited


# ---------------------------------------------- which requests to answer, and with which headers

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Login(Protocol):
    """The rules for who may send requests."""

    def site(self, headers: Headers) -> str:
        """Return the address (scheme, name and port) that a request uses; "" if it is not ours."""
        ...

    @property
    def allows_arrivals(self) -> bool:
        """Whether a person may come from another page, by a link or a login.

        Such a request may only load a whole page. It changes nothing, and the other page cannot
        read the answer.
        """
        ...

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return information about the sender for the application, or the response that refuses."""
        ...


class OriginCheck:
    """Passes on requests that the login admits, and refuses those made by other pages.

    Parameters
    ----------
    headers : security headers added to every answer, unless the page itself sets them.
    """

    def __init__(self, app: ASGIApp, login: Login, *, headers: Mapping[str, str] = HEADERS) -> None:
        self._app, self._login, self._headers = app, login, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    own.setdefault(name, value)
            await send(message)

        headers = Headers(scope=scope)
        why = _find_refusal(headers, scope["method"], self._login)
        found = refuse(why) if why else self._login.enter(scope, headers)
        if isinstance(found, Response):
            await found(scope, receive, answer)
            return
        let_in(scope)
        await self._app({**scope, **found}, receive, answer)


def refuse(why: str, *, status: int = 403) -> Response:
    """Return the answer that refuses a request and closes the connection."""
    return PlainTextResponse(why, status_code=status, headers={"Connection": "close"})


def list_own_names(port: int) -> frozenset[str]:
    """Return the addresses of this computer for a page served at one of its ports."""
    return frozenset(f"http://{host}:{port}" for host in ("127.0.0.1", "localhost"))


def find_site(sites: Collection[str], headers: Headers) -> str:
    """Return the address in `sites` that a request uses, or "" if it uses none."""
    host = headers.get("host", "")
    return next((site for site in sites if site.partition("://")[2] == host), "")


def _find_refusal(headers: Headers, method: str, login: Login) -> str:
    """Return why a request must be refused, or "" if a person or our own page sent it.

    A request that reached this computer under a foreign name has a different Host. A request by
    another page has a different Origin. Browsers state in Sec-Fetch-Site which page caused a
    request.
    """
    origin, site = headers.get("origin"), login.site(headers)
    if not site:
        return "use the address that cartlab printed"
    if origin != site and (origin is not None or method != "GET"):
        return "another page's request"
    if headers.get("sec-fetch-site", "none") in ("same-origin", "none"):
        return ""
    asked = headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")
    if login.allows_arrivals and method == "GET" and asked == ("navigate", "document"):
        return ""
    return "another page's request"
