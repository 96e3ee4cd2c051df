"""Who may ask: what every answer to a browser carries, and which requests another page made."""

from collections.abc import Collection, Mapping
from typing import Any, Protocol

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.web.server import let_in

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Door(Protocol):
    """Knows who may come in."""

    def site(self, headers: Headers) -> str:
        """Return scheme, name and port by which a request asks; "" if they do not lead here."""
        ...

    @property
    def arrivals(self) -> bool:
        """Whether people may come from another page, by a link or led on by a login.

        A whole page may then be asked for, which writes nothing and no other page can read.
        """
        ...

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return what the application is to know of who asks, or the answer to who may not."""
        ...


class Guard:
    """Lets in who the door knows and no other page.

    Parameters
    ----------
    headers : of every answer; those that a page sets itself stand.
    """

    def __init__(self, app: ASGIApp, door: Door, *, headers: Mapping[str, str] = HEADERS) -> None:
        self._app, self._door, self._headers = app, door, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                own = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    own.setdefault(name, value)
            await send(message)

        headers = Headers(scope=scope)
        why = _find_refusal(headers, scope["method"], self._door)
        found = refuse(why) if why else self._door.enter(scope, headers)
        if isinstance(found, Response):
            await found(scope, receive, answer)
            return
        let_in(scope)
        await self._app({**scope, **found}, receive, answer)


def refuse(why: str, *, status: int = 403) -> Response:
    """Return the answer to who may not ask, after which the connection ends."""
    return PlainTextResponse(why, status_code=status, headers={"Connection": "close"})


def list_own_names(port: int) -> frozenset[str]:
    """Return what this computer is called by a page that is served at a port of it."""
    return frozenset(f"http://{host}:{port}" for host in ("127.0.0.1", "localhost"))


def find_site(sites: Collection[str], headers: Headers) -> str:
    """Return which of the addresses a request asks for, or "" if it matches none."""
    host = headers.get("host", "")
    return next((site for site in sites if site.partition("://")[2] == host), "")


def _find_refusal(headers: Headers, method: str, door: Door) -> str:
    """Return why a request is not one of our own pages' or of a person; "" where it is.

    Names that lead here from elsewhere have another Host; other pages have another Origin, and
    browsers say Sec-Fetch-Site of what they were made to ask.
    """
    origin, site = headers.get("origin"), door.site(headers)
    if not site:
        return "use the address that cartlab printed"
    if origin != site and (origin is not None or method != "GET"):
        return "another page's request"
    if headers.get("sec-fetch-site", "none") in ("same-origin", "none"):
        return ""
    asked = headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")
    if door.arrivals and method == "GET" and asked == ("navigate", "document"):
        return ""
    return "another page's request"
