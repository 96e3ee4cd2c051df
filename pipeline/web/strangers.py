"""Connections over which nobody has shown the secret yet: few, and not for long.

Anybody on this computer can connect. Those who have not shown the secret share so many connections,
so that whoever serves never lacks a descriptor. They are more than arrive between two looks at what
was sent: however fast others connect, who sends the secret at once is known before being driven
out.
"""

import asyncio
from collections.abc import Callable

from uvicorn.protocols.http.h11_impl import H11Protocol

BACKLOG = 32  # connections accepted in one turn of the loop, before any can be driven out
_TO_SHOW_IT = 5.0  # s a stranger may stay
# Connections without the secret; the newest drives out the oldest. A request that is there when its
# connection is accepted is read two or three turns later.
_MOST_STRANGERS = 4 * BACKLOG


class Strangers:
    """The connections of those who are not known."""

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


def announced(strangers: Strangers, *, shows: Callable[[bytes], bool]) -> type[asyncio.Protocol]:
    """Return HTTP that tells of each connection as it is made, and as it shows the secret.

    Parameters
    ----------
    shows : whether the bytes of a request, as they come in, hold the secret.
    """

    class Announced(H11Protocol):
        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            strangers.add(transport)

        def data_received(self, data: bytes) -> None:
            if shows(data):
                strangers.know(self.client)
            super().data_received(data)

    return Announced
