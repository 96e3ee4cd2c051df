"""A server in its own thread, without an access log.

Anybody on this computer can connect. Connections that are not yet admitted share a fixed number of
places, so the server never runs out of file descriptors. The limits of uvicorn do not ensure this:
it keeps every idle connection, and its `limit_concurrency` refuses all later ones. Each request
must arrive, apart from its body, within the same time.
"""

import asyncio
import socket
import threading
import time

from starlette.types import ASGIApp, Scope
from uvicorn import Config, Server
from uvicorn.protocols.http.h11_impl import H11Protocol

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
