"""Acquisitions that the desk has begun: each a process of its own, its live page behind ours."""

import asyncio
import json
import queue
import threading
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException, HTTPResponse
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from pipeline.processes import LineProcess

_PROCESS = "pipeline.desk.bench.process"
_TO_STOP = 20.0  # s for the bench to be told and what came to be saved, on a busy machine
_ANSWERS = 10.0  # s; the live page says that it is there every five
_LUMP = 65_536  # bytes
_LOOK = 0.1  # s between looks whether it has ended
_FULL = HTTPStatus.SERVICE_UNAVAILABLE  # the live page has as many viewers as it takes


@dataclass(kw_only=True, eq=False)
class Session:
    """One acquisition, or one exploration.

    Attributes
    ----------
    url : of its live page, known to nobody else; "" until it has something to show.
    said : how it ended; "" while it goes on. `failed`: by what was wrong.
    """

    port: str
    process: LineProcess
    explores: bool = False
    url: str = ""
    said: str = ""
    failed: bool = False
    ended: threading.Event = field(default_factory=threading.Event)

    def press(self, wish: str, number: str) -> int:
        """Pass a button on to the process, which decides; return its status, 503 for no answer."""
        body = urlencode({"wish": wish, "number": number})
        with suppress(OSError, HTTPException):
            connection, answer = self._ask("POST", "press", body)
            with closing(connection):
                return answer.status
        if wish == "stop":  # the page does not answer: the process does
            self.stop()
            return 204
        return 503

    def stop(self) -> None:
        """Have it end: the bench is told first."""
        with suppress(OSError, ValueError):  # it has ended, its pipe is closed
            self.process.send(b"stop\n")

    async def events(self) -> AsyncIterator[bytes] | None:
        """Return the news of its live page as they come, and that it has ended.

        None where the live page takes no more viewers. No thread is held, however many watch.
        """
        reader = writer = None
        if self.url and not self.ended.is_set():
            url = urlsplit(self.url)
            # In HTTP/1.0 an answer ends with its connection: what comes is passed on as it is.
            asked = f"GET {url.path}events HTTP/1.0\r\nHost: {url.netloc}\r\n\r\n"
            with suppress(OSError):  # the page is gone: the session is about to end
                reader, writer = await asyncio.open_connection(url.hostname, url.port)
                writer.write(asked.encode("ascii"))
        if reader is None or writer is None:
            return self._passed_on(None, None)
        status = await _status(reader)
        if status == _FULL:
            writer.close()
            return None
        return self._passed_on(reader if status == HTTPStatus.OK else None, writer)

    async def _passed_on(
        self, reader: asyncio.StreamReader | None, writer: asyncio.StreamWriter | None
    ) -> AsyncIterator[bytes]:
        try:
            with suppress(OSError):
                while reader is not None and (lump := await reader.read(_LUMP)):
                    yield lump
        finally:
            if writer is not None:
                writer.close()
        end = time.monotonic() + _TO_STOP
        while not self.ended.is_set() and time.monotonic() < end:
            await asyncio.sleep(_LOOK)
        if self.ended.is_set():
            yield b"event: ended\ndata:\n\n"

    def _ask(
        self, method: str, what: str, body: str | None = None
    ) -> tuple[HTTPConnection, HTTPResponse]:
        if not self.url:  # there is no page yet to ask
            raise ConnectionError
        url = urlsplit(self.url)
        connection = HTTPConnection(url.hostname or "", url.port, timeout=_ANSWERS)
        headers = {"Origin": f"http://{url.netloc}"}
        connection.request(method, f"{url.path}{what}", body, headers)
        return connection, connection.getresponse()

    def listen(self) -> None:
        """Take down what the process says until it ends."""
        try:
            while line := self._line():
                told = json.loads(line)
                self.url, self.said = told.get("url", self.url), told.get("over", self.said)
                self.failed = told.get("failed", self.failed)
            if not self.said:
                self.said, self.failed = self.process.last_words(), True
        finally:
            self.process.close()
            self.ended.set()

    def _line(self) -> bytes:
        """Wait for the next line of the process; b"" where it has ended."""
        while True:
            with suppress(queue.Empty):
                return self.process.line(timeout=_ANSWERS)


class Sessions:
    """The last acquisition in each folder."""

    def __init__(self) -> None:
        self._sessions: dict[Path, Session] = {}
        self._lock = threading.Lock()

    def of(self, folder: Path) -> Session | None:
        """Return the last one in a folder."""
        return self._sessions.get(folder)

    def start(
        self,
        folder: Path,
        *,
        port: str,
        only: Sequence[str] = (),
        explore: tuple[str, str] = ("", ""),
    ) -> Session:
        """Begin one; where one is under way, that is what is returned.

        Parameters
        ----------
        only : ids to acquire; () for the whole plan.
        explore : until when to explore, and for how long, as `cartlab explore` takes them.
        """
        with self._lock:
            before = self._sessions.get(folder)
            if before and not before.ended.is_set():
                return before
            session = Session(port=port, process=LineProcess(_PROCESS), explores=any(explore))
            self._sessions[folder] = session
        given = {"folder": str(folder), "port": port, "only": list(only), "explore": explore}
        with suppress(OSError):
            session.process.send(json.dumps(given).encode() + b"\n")
        threading.Thread(target=session.listen, daemon=True).start()
        return session

    def close(self) -> None:
        """Have all of them end, and wait until their benches have been told."""
        for session in self._sessions.values():
            session.stop()
        end = time.monotonic() + _TO_STOP
        for session in self._sessions.values():
            if not session.ended.wait(max(0.0, end - time.monotonic())):
                session.process.close()


async def _status(reader: asyncio.StreamReader) -> int:
    """Read the head of an answer and return its status, 0 where there is none in time."""
    with suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _ANSWERS)
        return int(head.split(None, 2)[1])
    return 0
