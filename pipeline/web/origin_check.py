"""Decide which requests to answer, and add the security headers to every answer."""

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
    """Passes on requests that the door admits, and refuses those made by other pages.

    Parameters
    ----------
    headers : security headers added to every answer, unless the page itself sets them.
    """

    def __init__(self, app: ASGIApp, door: Login, *, headers: Mapping[str, str] = HEADERS) -> None:
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
    """Return the answer that refuses a request and closes the connection."""
    return PlainTextResponse(why, status_code=status, headers={"Connection": "close"})


def list_own_names(port: int) -> frozenset[str]:
    """Return the addresses of this computer for a page served at one of its ports."""
    return frozenset(f"http://{host}:{port}" for host in ("127.0.0.1", "localhost"))


def find_site(sites: Collection[str], headers: Headers) -> str:
    """Return the address in `sites` that a request uses, or "" if it uses none."""
    host = headers.get("host", "")
    return next((site for site in sites if site.partition("://")[2] == host), "")


def _find_refusal(headers: Headers, method: str, door: Login) -> str:
    """Return why a request must be refused, or "" if a person or our own page sent it.

    A request that reached this computer under a foreign name has a different Host. A request by
    another page has a different Origin. Browsers state in Sec-Fetch-Site which page caused a
    request.
    """
    origin, site = headers.get("origin"), door.site(headers)
    if not site:
        return "use the address that cartlab printed"
    if origin != site and (origin is not None or method != "GET"):
        return "another page's request"
    if headers.get("sec-fetch-site", "none") in ("same-origin", "none"):
        return ""
    asked = headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")
    if door.allows_arrivals and method == "GET" and asked == ("navigate", "document"):
        return ""
    return "another page's request"
