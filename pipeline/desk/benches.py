"""Acquisitions that the desk has begun: each a process of its own, told by what it says."""

import json
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.responses import Response

from pipeline.bench.live.live_page import press_button, stream_news
from pipeline.bench.live.live_state import ShownSession
from pipeline.processes import LineProcess


class BenchSession(ShownSession):
    """One acquisition, or one exploration, as its process tells it.

    Attributes
    ----------
    said : how it ended; "" while it goes on. `failed`: by what was wrong.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        super().__init__()
        self.port: str = given["port"]
        self.explores = any(given["explore"])
        self.said, self.failed = "", False
        self.ended = threading.Event()
        self._state: dict[str, Any] = {}
        self._process = LineProcess("pipeline.desk.bench.process")
        with suppress(OSError):
            self._process.send(json.dumps(given).encode() + b"\n")
        threading.Thread(target=self._listen, daemon=True).start()

    # ------------------------------------------------------------------ by the desk's pages

    @property
    def is_shown(self) -> bool:
        """Whether there is something to see: before, it may be that no bench is there."""
        return self.version > 0

    def snapshot(self) -> dict[str, Any]:
        """Return all but the points, for JSON."""
        return self._state

    def heed(self, wish: str, number: int) -> bool:
        """Pass on a button; tell whether it counts, by what the pages show. The process decides."""
        asked = self._state.get("instruction")
        if wish == "done":
            counts = asked is not None and number == asked["number"]
        else:
            offered = self._state.get("offered", ())
            counts = wish == "stop" or (wish in offered and number == self._state["turn"])
        if counts:
            self._process.send(json.dumps({"wish": wish, "number": number}).encode() + b"\n")
        return counts

    def press(self, wish: str, number: str) -> int:
        """Pass on a button; return the status to answer with, 503 where nobody hears it."""
        if not self.is_shown and wish != "stop":
            return 503
        try:
            return press_button(self, wish, number)
        except OSError:
            return 503  # its process ends

    def stop(self) -> None:
        """End it, after stopping the bench."""
        with suppress(OSError, ValueError):  # it has ended, its pipe is closed
            self.heed("stop", 0)

    def stream(self) -> Response:
        """Return its news as they come, and that it has ended."""
        ended = "event: ended\ndata:\n\n"
        if self.ended.is_set():
            return Response(ended, media_type="text/event-stream")
        return stream_news(self, is_over=self.ended.is_set, last_words=ended)

    def close(self, *, by: float) -> None:
        """Wait for its end until a time (s, monotonic), then end its process."""
        if not self.ended.wait(max(0.0, by - time.monotonic())):
            self._process.close()

    # --------------------------------------------------------------------- by its process

    def _listen(self) -> None:
        """Take down what the process says until it ends."""
        try:
            while line := self._line():
                self._take(**json.loads(line))
            if not self.said:
                self.said, self.failed = self._process.last_words(), True
        finally:
            self._process.close()
            self.ended.set()

    def _line(self) -> bytes:
        """Wait for the next line of the process; b"" where it has ended."""
        while True:
            with suppress(queue.Empty):
                return self._process.line(timeout=10.0)

    def _take(
        self,
        *,
        state: dict[str, Any] | None = None,
        points: Mapping[str, Any] | None = None,
        over: str = "",
        failed: bool = False,
    ) -> None:
        """Keep what the process said: one of these."""
        self.said, self.failed = over, failed
        if state is not None:
            self._state = state
            self.version += 1
        if points is not None:
            with self._lock:
                self._keep(points["run"], points["points"], points["counters"])


class Benches:
    """The last session in each folder.

    Attributes
    ----------
    planned : ids that the plan of a folder had before it last grew; None where there was no plan.
    """

    def __init__(self) -> None:
        self.planned: dict[Path, frozenset[str] | None] = {}
        self._sessions: dict[Path, BenchSession] = {}
        self._lock = threading.Lock()

    def of(self, folder: Path) -> BenchSession | None:
        """Return the last one in a folder."""
        return self._sessions.get(folder)

    def start(
        self,
        folder: Path,
        *,
        port: str,
        only: Sequence[str] = (),
        explore: tuple[str, str] = ("", ""),
    ) -> BenchSession:
        """Begin one; where one is under way, that is what is returned.

        Parameters
        ----------
        only : ids to acquire; () for the whole plan.
        explore : until when to explore, and for how long, as `cartlab explore` takes them.
        """
        with self._lock:
            before = self._sessions.get(folder)
            if before is None or before.ended.is_set():
                given = {"folder": str(folder), "port": port, "only": only, "explore": explore}
                self._sessions[folder] = BenchSession(given)
            return self._sessions[folder]

    def close(self) -> None:
        """Have all of them end, and wait until their benches have been told."""
        for session in self._sessions.values():
            session.stop()
        # s to stop the bench and save the data, on a busy machine
        by = time.monotonic() + 20.0
        for session in self._sessions.values():
            session.close(by=by)
