"""A desk, and a visitor who uses it like a browser without scripts."""

import http.client
import json
import re
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

from pipeline.desk.app import DeskServer
from pipeline.desk.tasks import do
from pipeline.processes import attempt
from pipeline.resources import EXAMPLES
from pipeline.submission.load import NAME
from pipeline.words.progress import Progress, silent
from tests.helpers.waiting import PATIENCE

BOUNDARY = "----cartlab"
PROXY = """
[proxy]
address = "127.0.0.1"
header = "X-Remote-User"
secret_header = "X-Proxy-Secret"
secret = "the-proxy-and-the-desk-know-it"
site = "https://Lab.example.edu"
"""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The desk's answer to a request."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def text(self) -> str:
        """The page as text."""
        return self.body.decode()

    @property
    def state(self) -> dict[str, str]:
        """The state of the page in keys, as its first `data-state` gives it."""
        found = re.search(r'data-state="([^"]+)"', self.text)
        assert found, self.text
        return dict(one.split("=", 1) for one in unescape(found[1]).split())

    @property
    def wrong_fields(self) -> set[str]:
        """The fields beside which the page shows an error."""
        return set(re.findall(r'id="([\w-]+)-wrong"', self.text))

    def value(self, name: str) -> str:
        """Return the value of a field of the page."""
        found = re.search(rf'name="{re.escape(name)}"[^>]*? value="([^"]*)"', self.text)
        found = found or re.search(rf'value="([^"]*)"[^>]*? name="{re.escape(name)}"', self.text)
        assert found, name
        return unescape(found[1])


@dataclass(kw_only=True)
class Visitor:
    """A visitor whose requests come from this computer, with a cookie or a proxy's headers."""

    port: int
    headers: dict[str, str] = field(default_factory=dict)
    source: str = "127.0.0.1"
    host: str = ""

    @classmethod
    def of(cls, url: str) -> "Visitor":
        """Return a visitor who opened the printed address."""
        parts = urlsplit(url)
        visitor = cls(port=parts.port or 0)
        answer = visitor.get(parts.path)
        assert (answer.status, parts.path in answer.headers["location"]) == (303, False)
        visitor.headers["Cookie"] = answer.headers["set-cookie"].split(";")[0]
        return visitor

    def get(self, path: str, **headers: str) -> Answer:
        """Ask for a page."""
        return self.ask("GET", path, None, headers)

    def post(self, path: str, **fields: str) -> Answer:
        """Send a form."""
        return self.send(path, urlencode(fields).encode(), kind="application/x-www-form-urlencoded")

    def upload(
        self, path: str, files: Iterable[tuple[str, bytes]], *, name: str = "files", **fields: str
    ) -> Answer:
        """Send a form with files, which have this name in it, and with other fields."""
        parts = [(f'name="{key}"', value.encode()) for key, value in fields.items()]
        parts += [(f'name="{name}"; filename="{file}"', raw) for file, raw in files]
        body = b"".join(
            f"--{BOUNDARY}\r\nContent-Disposition: form-data; {head}\r\n\r\n".encode()
            + raw
            + b"\r\n"
            for head, raw in parts
        )
        whole = body + f"--{BOUNDARY}--\r\n".encode()
        return self.send(path, whole, kind=f"multipart/form-data; boundary={BOUNDARY}")

    def send(self, path: str, body: bytes, *, kind: str, **headers: str) -> Answer:
        """Send a request with a body."""
        host = self.host or f"127.0.0.1:{self.port}"
        scheme = "https" if self.host else "http"
        own = {"Content-Type": kind, "Origin": f"{scheme}://{host}"}
        return self.ask("POST", path, body, own | headers)

    def ask(self, method: str, path: str, body: bytes | None, headers: dict[str, str]) -> Answer:
        """Send a request."""
        connection = http.client.HTTPConnection(
            "127.0.0.1", self.port, timeout=PATIENCE, source_address=(self.source, 0)
        )
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        host = {"Host": self.host} if self.host else {}
        try:
            connection.request(method, path, body, host | self.headers | named)
            answer = connection.getresponse()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(status=answer.status, headers=found, body=answer.read())
        finally:
            connection.close()


class WorkerHere:
    """A desk's worker in this process, since another process takes a second to start.

    It does one task at a time; a running task cannot be killed.
    """

    runs = True
    _turn = threading.Lock()

    def __init__(self, module: str, **_: object) -> None:
        pass

    def start(self, stop: threading.Event) -> None:
        """Do nothing: there is no process to start."""

    def do(self, task: Any, *, tell: Progress = silent, **_: object) -> Any:
        """Do a task whose input and result pass through JSON."""
        with self._turn:
            plain = json.loads(json.dumps(task))
            return json.loads(json.dumps(attempt(lambda: do(plain, tell))))

    def close(self) -> None:
        """Do nothing: there is no process to end."""


def through_proxy(port: int, name: str, **given: str) -> Visitor:
    """Return a visitor named by a lab server's proxy; "" stands for no name."""
    headers = {"X-Proxy-Secret": "the-proxy-and-the-desk-know-it"}
    if name:
        headers["X-Remote-User"] = name
    return Visitor(port=port, host="lab.example.edu", headers=headers, **given)


@contextmanager
def at_desk(folder: Path | None = None, *, opened: Path | None = None) -> Iterator[Visitor]:
    """Start a desk, perhaps on a folder; yield a visitor, who may open a further folder."""
    with DeskServer(folder=folder) as server:
        visitor = Visitor.of(server.url)
        if opened:
            assert visitor.post("/open", folder=str(opened)).status == 303
        yield visitor


@contextmanager
def at_lab(folder: Path, users: str) -> Iterator[Callable[..., Visitor]]:
    """Start a desk for these users of a lab server; yield a function from a name to a visitor."""
    with DeskServer(users=write_users(folder, users)) as server:
        yield partial(through_proxy, urlsplit(server.url).port or 0)


def listed_user(name: str, role: str, **keys: str) -> str:
    """Return a user's table in the file of users; values are TOML."""
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f'[[users]]\nname = "{name}"\nrole = "{role}"\n{lines}'


def retype(folder: Path, old: str, new: str) -> None:
    """Replace a text in the submission's file, once."""
    text = (folder / NAME).read_text(encoding="utf-8")
    assert old in text
    (folder / NAME).write_text(text.replace(old, new, 1), encoding="utf-8")


def wrongs(page: str) -> list[str]:
    """Return the errors that a page shows."""
    return [unescape(w) for w in re.findall(r'class="wrong"[^>]*>([^<]*)<', page)]


def write_users(folder: Path, text: str) -> Path:
    """Write the file of users of a lab server so that only the desk can read it."""
    path = folder / "users.toml"
    path.write_text(PROXY + text, encoding="utf-8")
    path.chmod(0o600)
    return path


def some_files(folder: str = "one-cart", *, most: int = 99) -> list[tuple[str, bytes]]:
    """Return the recordings of a worked example."""
    paths = sorted((EXAMPLES / folder / "data").iterdir())
    return [(path.name, path.read_bytes()) for path in paths[:most]]


def a_submission(folder: Path, example: str = "one-cart") -> Path:
    """Return a copy of a worked example."""
    shutil.copytree(EXAMPLES / example, folder, ignore=shutil.ignore_patterns("report"))
    return folder


def a_recorded_cart(folder: Path) -> Path:
    """Return a submission of one cart with its steps and its sweep."""
    shutil.copytree(EXAMPLES / "one-cart", folder)
    head, *tables = (folder / NAME).read_text(encoding="utf-8").split("[[experiments]]\n")
    kept = [one for one in tables if 'kind = "step"' in one or 'kind = "sweep"' in one]
    text = "[[experiments]]\n".join([head, *kept]).partition("[reported")[0]
    (folder / NAME).write_text(text, encoding="utf-8")
    return folder
