"""Three ways to identify a person: a one-time secret, a reverse proxy, or a Jupyter server."""

import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import suppress
from ipaddress import ip_address
from typing import Any

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.desk.users import Proxy, User
from pipeline.web import HEADERS, find_site, let_in, list_own_names, refuse

PAGE_HEADERS = {
    **HEADERS,
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "Referrer-Policy": "same-origin",  # browsers then state the origin of a form, which is checked
}
JUPYTER_SECRET = "X-Cartlab-Secret"
MOST_FORM = 2_000_000  # bytes of a request that is not an upload
_UPLOADS = "/files", "/grade", "/grading/"  # ends of the addresses of uploads


class SecretLogin:
    """Let in the person at this computer: the first one to open the address that was printed.

    The secret in the address works once. From then on a cookie identifies the person. Scripts
    cannot read the cookie, and other sites cannot send it. So no secret stays in an address, where
    the browser's history or a screenshot could keep it.
    """

    allows_arrivals = False  # a person who arrives from another site does not send the cookie yet

    def __init__(self, user: User, *, port: int, start: str) -> None:
        self._sites = list_own_names(port)
        self.secret = secrets.token_urlsafe(24)
        self._user, self._session, self._opened = user, secrets.token_urlsafe(24), False
        self._start = start
        self._cookie = f"cartlab-{port}"  # named by port, because cookies do not distinguish ports
        self._sent = re.compile(rf"\b{self._cookie}=([\w-]+)".encode())

    def site(self, headers: Headers) -> str:
        """Return the address of the desk that the request uses."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return the person who asks, or a refusal."""
        known = self._knows(headers.get("cookie", "").encode("latin-1"))
        if not _is_same(scope["path"].strip("/").encode(), self.secret):
            why = "open the desk with the address that cartlab printed when it started"
            return {"user": self._user} if known else refuse(why)
        if self._opened and not known:
            return refuse("this address was used already; start `cartlab desk` again")
        self._opened = True
        let_in(scope)
        answer = RedirectResponse(
            self._start, status_code=303, headers={"Referrer-Policy": "no-referrer"}
        )
        answer.set_cookie(self._cookie, self._session, httponly=True, samesite="strict")
        return answer

    def _knows(self, sent: bytes) -> bool:
        """Return whether one of the cookies sent is right.

        Other pages may have set cookies of the same name.
        """
        return any([_is_same(found[1], self._session) for found in self._sent.finditer(sent)])


class ProxyLogin:
    """Let in people whom the reverse proxy of a lab server names; refuse all other requests."""

    allows_arrivals = True  # people come from the page of a login or a course

    def __init__(self, proxy: Proxy, users: Mapping[str, User]) -> None:
        self._sites = frozenset([proxy.site])
        self._proxy, self._users = proxy, users

    def site(self, headers: Headers) -> str:
        """Return the address of the desk that the request uses."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return the person who asks, or a refusal."""
        sent = headers.getlist(self._proxy.secret_header)
        # Other people on the proxy's computer share its address, but they do not know its secret.
        known = len(sent) == 1 and _is_same(sent[0].encode("latin-1"), self._proxy.secret)
        if not known or ip_address(scope["client"][0]) != ip_address(self._proxy.address):
            return refuse("use the address of the lab's server")
        names = headers.getlist(self._proxy.header)
        listed = [name for name in _read_name(names[0]) if name in self._users] if names else []
        if len(names) != 1 or not listed:
            return refuse("you are not on the list of this desk; ask your instructor")
        return {"user": self._users[listed[0]]}


class JupyterLogin:
    """Let in the owner of a Jupyter server, which forwards requests and adds a secret.

    The browser's addresses begin with a prefix, which Jupyter removes and states in a header.
    """

    allows_arrivals = True  # people come from the page of a login

    def __init__(self, user: User, *, secret: str) -> None:
        self._user, self._secret = user, secret

    def site(self, headers: Headers) -> str:
        """Find in the headers the address at which the browser reaches Jupyter.

        Pages from other sites have a different origin, so they are refused.
        """
        scheme = headers.get("origin", "").partition("://")[0] or "http"
        return f"{scheme}://{headers.get('host', '')}"

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return the person who asks, or a refusal."""
        sent = headers.getlist(JUPYTER_SECRET)
        if len(sent) != 1 or not _is_same(sent[0].encode("latin-1"), self._secret):
            return refuse("open the desk from the launcher of Jupyter")
        return {"user": self._user, "prefix": headers.get("x-forwarded-prefix", "").rstrip("/")}


def _read_name(name: str) -> Iterator[str]:
    """Yield the possible names in a header; a proxy may write a name in UTF-8 or in Latin-1."""
    with suppress(UnicodeDecodeError):
        yield name.encode("latin-1").decode()
    yield name


def _is_same(sent: bytes, secret: str) -> bool:
    return secrets.compare_digest(sent, secret.encode())


def limit_bodies(app: ASGIApp, *, uploads: int) -> ASGIApp:
    """Return an application that refuses requests with too much data.

    Parameters
    ----------
    uploads : largest number of bytes of an upload, whose address has an end of `_UPLOADS`.
    """

    async def limited(scope: Scope, receive: Receive, send: Send) -> None:
        most = left = uploads if scope["path"].endswith(_UPLOADS) else MOST_FORM
        too_much = f"too much data in one request: at most {most:,} bytes"

        async def count() -> Message:
            """Receive and count data, because the length that a request states may be false."""
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:
                raise HTTPException(413, too_much)
            return message

        sent = Headers(scope=scope).get("content-length", "0")
        if not sent.isdecimal() or len(sent) > 15 or int(sent) > most:
            await refuse(too_much, status=413)(scope, receive, send)
        else:
            await app(scope, count, send)

    return limited
