"""A server in its own thread, without an access log.

Anybody on this computer can connect. Connections that are not admitted yet share a fixed number of
places, so that the server never runs out of descriptors. uvicorn's own limits do not do this: it
keeps every idle connection, and its `limit_concurrency` refuses all later ones.
"""

import asyncio
import socket
import threading
import time

from starlette.types import ASGIApp, Scope
from uvicorn import Config, Server
from uvicorn.protocols.http.h11_impl import H11Protocol

_BACKLOG = 32  # connections accepted in one turn of the loop, before any can be driven out
# Connections not let in; the newest drives out the oldest. A request that is there when its
# connection is accepted reaches the application three turns later, so it is never driven out first.
_MOST_STRANGERS = 4 * _BACKLOG
_STRANGER_STAYS = 5.0  # s


class Served:
    """An application that is served at a port that is open already."""

    def __init__(self, app: ASGIApp, listener: socket.socket) -> None:
        self._listener = listener
        config = Config(
            app,
            http=_limit_strangers(),
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
            target=self._server.run, kwargs={"sockets": [listener]}, name="server", daemon=True
        )

    @property
    def runs(self) -> bool:
        """Whether it serves."""
        return self._thread.is_alive()

    def start(self) -> bool:
        """Serve; tell whether it does."""
        self._thread.start()
        while not self._server.started:
            if not self._thread.is_alive():
                return False
            time.sleep(0.01)
        return True

    def stop(self) -> None:
        """Serve no more, and free the port."""
        self._server.should_exit = True
        self._thread.join()
        self._listener.close()


def let_in(scope: Scope) -> None:
    """Keep the connection of a request, because its sender is admitted."""
    scope["state"]["let_in"]()


def _limit_strangers() -> type[asyncio.Protocol]:
    """Return HTTP over connections that end soon unless `let_in` is called for a request."""
    strangers: dict[asyncio.Transport, asyncio.TimerHandle] = {}  # the oldest first

    def forget(transport: asyncio.Transport) -> None:
        if timer := strangers.pop(transport, None):
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

        def connection_lost(self, exc: Exception | None) -> None:
            forget(self.transport)
            super().connection_lost(exc)

    return Limited
