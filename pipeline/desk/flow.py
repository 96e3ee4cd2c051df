"""Limit what one person can ask of the desk at once, and how long a body may take to arrive."""

import asyncio
from collections import Counter

from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.web import refuse

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
