"""What every answer to a browser carries, and which requests another page made."""

from collections.abc import Collection, Mapping

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Send

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": POLICY,
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def own_names(port: int) -> frozenset[str]:
    """Return what this computer is called by a page that is served at a port of it."""
    return frozenset(f"http://{host}:{port}" for host in ("127.0.0.1", "localhost"))


def refusal(
    headers: Headers, *, method: str, sites: Collection[str], arrivals: bool = False
) -> str:
    """Return why a request is not one of our own pages' or of a person; "" where it is.

    Names that lead here from elsewhere have another Host; other pages have another Origin, and
    browsers say Sec-Fetch-Site of what they were made to ask.

    Parameters
    ----------
    sites : scheme, name and port of the addresses that lead here.
    arrivals : whether people may come from another page, by a link or led on by a login: a whole
        page may then be asked for, which writes nothing and which no other page can read.
    """
    host, origin = headers.get("host", ""), headers.get("origin")
    site = next((site for site in sites if site.partition("://")[2] == host), "")
    if not site:
        return "ask by the address that cartlab printed"
    if origin != site and (origin is not None or method != "GET"):
        return "another page's request"
    if headers.get("sec-fetch-site", "none") in ("same-origin", "none"):
        return ""
    asked = headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")
    if arrivals and method == "GET" and asked == ("navigate", "document"):
        return ""
    return "another page's request"


def guarded(send: Send, headers: Mapping[str, str]) -> Send:
    """Return what sends an answer with these headers; those that a page sets itself stand."""

    async def answer(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = MutableHeaders(scope=message)
            for name, value in headers.items():
                own.setdefault(name, value)
        await send(message)

    return answer
