"""The two ways in: the one-time secret of an address, or a reverse proxy that knows the person."""

import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import ip_address

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.desk.users import Proxy, User
from pipeline.web.guard import HEADERS, guarded, own_names, refusal
from pipeline.web.strangers import Strangers

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
# A form says where it is from only where the page may tell.
_PAGE = {**HEADERS, "Content-Security-Policy": _POLICY, "Referrer-Policy": "same-origin"}
_MOST_HEADER = 16_000  # bytes of a request in which the secret is looked for
MOST_FORM = 2_000_000  # bytes of a request that is no upload


class SecretDoor:
    """For the person at this computer: who opens the printed address first is let in.

    The secret opens once; then a cookie that no script reads and no other site sends does, and the
    address is without a secret that a history or a picture of the screen could keep.
    """

    arrivals = False  # the cookie does not come along

    def __init__(self, user: User, *, port: int, start: str) -> None:
        self.sites = own_names(port)
        self.secret = secrets.token_urlsafe(24)
        self._user, self._session, self._opened = user, secrets.token_urlsafe(24), False
        self._start = start
        self._cookie = f"cartlab-{port}"  # cookies do not tell ports apart
        self._sent = re.compile(rf"\b{self._cookie}=([\w-]+)".encode())

    def shows(self, data: bytes) -> bool:
        """Tell whether the first bytes of a request hold the secret, or what came of it."""
        head = data[:_MOST_HEADER]
        path = head.split(b"/", 2)[1:2]
        return (bool(path) and _same(path[0].split(b" ")[0], self.secret)) or self._knows(head)

    def enter(self, scope: Scope, headers: Headers) -> User | Response:
        """Return who asks, or the answer to who may not."""
        known = self._knows(headers.get("cookie", "").encode("latin-1"))
        if not _same(scope["path"].strip("/").encode(), self.secret):
            why = "the desk is opened by the address that cartlab printed when it started"
            return self._user if known else _refused(why)
        if self._opened and not known:
            return _refused("this address was opened already; start `cartlab desk` again")
        self._opened = True
        answer = RedirectResponse(
            self._start, status_code=303, headers={"Referrer-Policy": "no-referrer"}
        )
        answer.set_cookie(self._cookie, self._session, httponly=True, samesite="strict")
        return answer

    def _knows(self, sent: bytes) -> bool:
        """Whether the cookie is among those sent: any page of this computer may set its like."""
        return any([_same(found[1], self._session) for found in self._sent.finditer(sent)])


class ProxyDoor:
    """For a lab server: the proxy in front says who somebody is, and nobody else is heard."""

    arrivals = True  # from the page of a login, or of a course

    def __init__(self, proxy: Proxy, users: Mapping[str, User]) -> None:
        self.sites = frozenset([proxy.site])
        self._proxy, self._users = proxy, users

    def shows(self, data: bytes) -> bool:
        """Tell nothing: who asks is known with the whole request."""
        return False

    def enter(self, scope: Scope, headers: Headers) -> User | Response:
        """Return who asks, or the answer to who may not."""
        sent = headers.getlist(self._proxy.secret_header)
        # Whoever is logged in where the proxy runs has its address, and not its secret.
        known = len(sent) == 1 and _same(sent[0].encode("latin-1"), self._proxy.secret)
        if not known or ip_address(scope["client"][0]) != ip_address(self._proxy.address):
            return _refused("ask by the address of the laboratory")
        names = headers.getlist(self._proxy.header)
        listed = [name for name in _readings(names[0]) if name in self._users] if names else []
        if len(names) != 1 or not listed:
            return _refused("you are not on the list of this desk; ask your instructor")
        return self._users[listed[0]]


def _readings(name: str) -> Iterator[str]:
    """Yield what the bytes of a header may say: a proxy writes a name in UTF-8 or in Latin-1."""
    with suppress(UnicodeDecodeError):
        yield name.encode("latin-1").decode()
    yield name


def _same(sent: bytes, secret: str) -> bool:
    return secrets.compare_digest(sent, secret.encode())


def _refused(why: str) -> Response:
    return PlainTextResponse(why, status_code=403, headers={"Connection": "close"})


@dataclass(kw_only=True)
class Guard:
    """Lets in who the door knows and no other page; nobody sends more than is read."""

    app: ASGIApp
    door: SecretDoor | ProxyDoor
    uploads: int  # bytes of an upload, which goes to an address that ends in /files
    strangers: Strangers = field(default_factory=Strangers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        headers, send = Headers(scope=scope), guarded(send, _PAGE)
        why = refusal(
            headers, method=scope["method"], sites=self.door.sites, arrivals=self.door.arrivals
        )
        if why:
            await _refused(why)(scope, receive, send)
            return
        found = self.door.enter(scope, headers)
        if isinstance(found, Response):
            await found(scope, receive, send)
            return
        self.strangers.know(tuple(scope["client"]))
        most = self.uploads if scope["path"].endswith("/files") else MOST_FORM
        sent = headers.get("content-length", "0")
        if not sent.isdecimal() or int(sent) > most:
            answer = PlainTextResponse(_too_much(most), 413, headers={"Connection": "close"})
            await answer(scope, receive, send)
            return
        await self.app({**scope, "user": found}, _limited(receive, most=most), send)


def _limited(receive: Receive, *, most: int) -> Receive:
    """Return what reads no more of a request than so many bytes, whatever it says of itself."""
    left = most

    async def counted() -> Message:
        nonlocal left
        message = await receive()
        left -= len(message.get("body", b""))
        if left < 0:
            raise HTTPException(413, _too_much(most))
        return message

    return counted


def _too_much(most: int) -> str:
    return f"too much at once: at most {most:,} bytes"
