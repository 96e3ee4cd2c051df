"""A server in a thread of its own, which writes nowhere who asked for what."""

import asyncio
import socket
import threading
import time

from starlette.types import ASGIApp
from uvicorn import Config, Server

from pipeline.web.strangers import BACKLOG


class Served:
    """An application that is served at a port that is open already."""

    def __init__(
        self, app: ASGIApp, listener: socket.socket, *, protocol: type[asyncio.Protocol]
    ) -> None:
        self._listener = listener
        config = Config(
            app,
            http=protocol,
            backlog=BACKLOG,
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
