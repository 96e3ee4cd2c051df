"""The two ways in: the one-time secret of an address, or a reverse proxy that knows the person."""

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
from pipeline.web.guard import HEADERS, find_site, list_own_names, refuse
from pipeline.web.server import let_in

PAGE_HEADERS = {
    **HEADERS,
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "Referrer-Policy": "same-origin",  # a form says where it is from only where the page may tell
}
JUPYTER_SECRET = "X-Cartlab-Secret"
MOST_FORM = 2_000_000  # bytes of a request that is no upload


class SecretDoor:
    """For the person at this computer: who opens the printed address first is let in.

    The secret opens once; then a cookie that no script reads and no other site sends does, and the
    address is without a secret that a history or a picture of the screen could keep.
    """

    arrivals = False  # the cookie does not come along

    def __init__(self, user: User, *, port: int, start: str) -> None:
        self._sites = list_own_names(port)
        self.secret = secrets.token_urlsafe(24)
        self._user, self._session, self._opened = user, secrets.token_urlsafe(24), False
        self._start = start
        self._cookie = f"cartlab-{port}"  # cookies do not tell ports apart
        self._sent = re.compile(rf"\b{self._cookie}=([\w-]+)".encode())

    def site(self, headers: Headers) -> str:
        """Return by which of its own addresses the request asks."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return who asks, or the answer to who may not."""
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
        """Whether the cookie is among those sent: any page of this computer may set its like."""
        return any([_is_same(found[1], self._session) for found in self._sent.finditer(sent)])


class ProxyDoor:
    """For a lab server: the proxy in front says who somebody is, and nobody else is heard."""

    arrivals = True  # from the page of a login, or of a course

    def __init__(self, proxy: Proxy, users: Mapping[str, User]) -> None:
        self._sites = frozenset([proxy.site])
        self._proxy, self._users = proxy, users

    def site(self, headers: Headers) -> str:
        """Return by which of its own addresses the request asks."""
        return find_site(self._sites, headers)

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return who asks, or the answer to who may not."""
        sent = headers.getlist(self._proxy.secret_header)
        # Whoever is logged in where the proxy runs has its address, and not its secret.
        known = len(sent) == 1 and _is_same(sent[0].encode("latin-1"), self._proxy.secret)
        if not known or ip_address(scope["client"][0]) != ip_address(self._proxy.address):
            return refuse("use the address of the lab's server")
        names = headers.getlist(self._proxy.header)
        listed = [name for name in _read_name(names[0]) if name in self._users] if names else []
        if len(names) != 1 or not listed:
            return refuse("you are not on the list of this desk; ask your instructor")
        return {"user": self._users[listed[0]]}


class JupyterDoor:
    """For a person's own Jupyter server, which passes on what this person asks, and the secret.

    The addresses of the desk then begin with a prefix, which Jupyter takes away and names.
    """

    arrivals = True  # from the page of a login

    def __init__(self, user: User, *, secret: str) -> None:
        self._user, self._secret = user, secret

    def site(self, headers: Headers) -> str:
        """Return the name by which Jupyter lets itself be asked; another page has another."""
        scheme = headers.get("origin", "").partition("://")[0] or "http"
        return f"{scheme}://{headers.get('host', '')}"

    def enter(self, scope: Scope, headers: Headers) -> dict[str, Any] | Response:
        """Return who asks, or the answer to who may not."""
        sent = headers.getlist(JUPYTER_SECRET)
        if len(sent) != 1 or not _is_same(sent[0].encode("latin-1"), self._secret):
            return refuse("open the desk from the launcher of Jupyter")
        return {"user": self._user, "prefix": headers.get("x-forwarded-prefix", "").rstrip("/")}


def _read_name(name: str) -> Iterator[str]:
    """Yield what the bytes of a header may say: a proxy writes a name in UTF-8 or in Latin-1."""
    with suppress(UnicodeDecodeError):
        yield name.encode("latin-1").decode()
    yield name


def _is_same(sent: bytes, secret: str) -> bool:
    return secrets.compare_digest(sent, secret.encode())


def limit_bodies(app: ASGIApp, *, uploads: int) -> ASGIApp:
    """Return an application to which nobody sends more than is read.

    Parameters
    ----------
    uploads : bytes of an upload, which goes to an address that ends in /files.
    """

    async def limited(scope: Scope, receive: Receive, send: Send) -> None:
        most = left = uploads if scope["path"].endswith("/files") else MOST_FORM
        too_much = f"too much data in one request: at most {most:,} bytes"

        async def count() -> Message:
            """Read on, whatever the request says of its length itself."""
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:
                raise HTTPException(413, too_much)
            return message

        sent = Headers(scope=scope).get("content-length", "0")
        if not sent.isdecimal() or int(sent) > most:
            await refuse(too_much, status=413)(scope, receive, send)
        else:
            await app(scope, count, send)

    return limited
