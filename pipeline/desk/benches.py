"""The acquisitions that the desk has started; each runs in its own process."""

import json
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from starlette.responses import Response

from pipeline.bench.live_page import press_button, stream_events
from pipeline.bench.live_state import ShownSession
from pipeline.processes import LineProcess


class BenchSession(ShownSession):
    """One acquisition or exploration, with the state that its process reports.

    Attributes
    ----------
    outcome : how the session ended; "" while it runs.
    """

    def __init__(self, request: Mapping[str, Any]) -> None:
        super().__init__()
        self.port: str = request["port"]
        self.explores = any(request["explore"])
        self.outcome, self.failed = "", False
        self.ended = threading.Event()
        self._state: dict[str, Any] = {}
        self._process = LineProcess("pipeline.desk.bench.process")
        with suppress(OSError):
            self._process.send(json.dumps(request).encode() + b"\n")
        threading.Thread(target=self._listen, daemon=True).start()

    # ------------------------------------------------------------------ by the desk's pages

    @property
    def is_shown(self) -> bool:
        """Whether the process has reported a state; if not, perhaps no bench has answered yet."""
        return self.version > 0

    def snapshot(self) -> dict[str, Any]:
        """Return the state without the points of the plots, for JSON."""
        return self._state

    def apply(self, wish: str, number: int) -> bool:
        """Send a pressed button to the process; return whether it fits the current state.

        The process itself decides whether to act on it.
        """
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
        """Send a pressed button to the process; return the status, 503 if it cannot be sent."""
        if not self.is_shown and wish != "stop":
            return 503
        try:
            return press_button(self, wish, number)
        except OSError:
            return 503  # the process is ending

    def stop(self) -> None:
        """Stop the bench and end the session."""
        with suppress(OSError, ValueError):  # the process has ended and closed its pipe
            self.apply("stop", 0)

    def stream(self) -> Response:
        """Return a stream of the session's events; the last one reports its end."""
        ended = "event: ended\ndata:\n\n"
        if self.ended.is_set():
            return Response(ended, media_type="text/event-stream")
        return stream_events(self, is_over=self.ended.is_set, exit_message=ended)

    def close(self, *, by: float) -> None:
        """Wait for the end of the session, then end its process.

        Parameters
        ----------
        by : time of the monotonic clock, in s, at which to stop waiting.
        """
        if not self.ended.wait(max(0.0, by - time.monotonic())):
            self._process.close()

    # --------------------------------------------------------------------- by its process

    def _listen(self) -> None:
        """Read what the process reports until it ends."""
        try:
            while line := self._line():
                self._take(**json.loads(line))
            if not self.outcome:
                self.outcome, self.failed = self._process.exit_message(), True
        finally:
            self._process.close()
            self.ended.set()

    def _line(self) -> bytes:
        """Wait for the next line from the process; b"" if it has ended."""
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
        """Store one report of the process: a state, points, or the end."""
        self.outcome, self.failed = over, failed
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
    planned : for each folder, the ids of the recordings that the plan had before the latest
        addition; None if there was no plan.
    """

    def __init__(self) -> None:
        self.planned: dict[Path, frozenset[str] | None] = {}
        self._sessions: dict[Path, BenchSession] = {}
        self._lock = threading.Lock()

    def of(self, folder: Path) -> BenchSession | None:
        """Return the last session in a folder, if any."""
        return self._sessions.get(folder)

    def start(
        self,
        folder: Path,
        *,
        port: str,
        only: Sequence[str] = (),
        explore: tuple[str, str] = ("", ""),
    ) -> BenchSession:
        """Start a session, or return the one that is running in the folder.

        Parameters
        ----------
        only : ids of the recordings to acquire; () for the whole plan.
        explore : goal and time limit of an exploration, as `cartlab explore` takes them.
        """
        with self._lock:
            before = self._sessions.get(folder)
            if before is None or before.ended.is_set():
                request = {"folder": str(folder), "port": port, "only": only, "explore": explore}
                self._sessions[folder] = BenchSession(request)
            return self._sessions[folder]

    def close(self) -> None:
        """Stop all sessions, and wait until their benches are stopped."""
        for session in self._sessions.values():
            session.stop()
        # 20 s are enough to stop the bench and save the data, even on a busy machine.
        by = time.monotonic() + 20.0
        for session in self._sessions.values():
            session.close(by=by)
