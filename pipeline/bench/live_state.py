"""The content of a live page.

The acquisition writes it in one thread, and a server reads it in another.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from pipeline.bench.events import ACTIONS, Action, Anomalies, Buttons, RunOutcome
from pipeline.errors import ConfigError
from pipeline.experiments.plan import Plan, Recording, session_time, what_words
from pipeline.protocol import Reading
from pipeline.submission import InputScale, PositionScale, Submission, load_submission

Phase = Literal["waiting", "settling", "recording", "thinking", "over"]
FRAME = 1 / 30  # s between two checks for changes

_APART = 5  # ms between points; a screen that shows ten seconds cannot show more


class ShownSession(ABC):
    """The state of a session that pages show, and the buttons of the pages.

    One thread writes the state and another reads it.

    Attributes
    ----------
    version : grows with every change of `snapshot`.
    viewers : number of open pages.
    """

    def __init__(self) -> None:
        self.version = self.viewers = 0
        self._lock = threading.Lock()
        self._run = 0
        # The points of the last 12 s. A page that connects later does not get earlier points.
        self._points: deque[Sequence[float]] = deque(maxlen=2400)
        self._end = 0  # number of points of this run, including those dropped
        self._counters: Mapping[str, int] = _count(0, Anomalies())

    @abstractmethod
    def snapshot(self) -> dict[str, Any]:
        """Return everything except the points, for JSON."""

    @abstractmethod
    def apply(self, wish: str, number: int) -> bool:
        """Handle a pressed button; return whether it is accepted.

        Parameters
        ----------
        wish : `done`, or one of the buttons of a run.
        number : number of the instruction that was carried out, or of the turn in which the page
            showed the button.
        """

    def points(self, *, run: int, start: int) -> dict[str, Any]:
        """Return the points of a run from index `start` on; all points if the run has changed.

        Each point is (t in s, input, target, x1, x2, …). In the result, `end` is the index of the
        next point, and `counters` are the numbers of lines and faults of the run so far.
        """
        with self._lock:
            first = self._end - len(self._points)
            begin = max(first, start) if run == self._run else first
            return {
                "run": self._run,
                "start": begin,
                "end": self._end,
                "points": list(self._points)[begin - first :],
                "counters": dict(self._counters),
            }

    def follow(self, *, version: int = 0) -> Iterator[list[tuple[str, Mapping[str, Any]]]]:
        """Yield at each step the changes since the last step, as ("state" or "points", content).

        Parameters
        ----------
        version : version of the state that the reader already has.
        """
        run = start = 0
        while True:
            events: list[tuple[str, Mapping[str, Any]]] = []
            if version != self.version:
                version = self.version
                events.append(("state", self.snapshot()))
            points = self.points(run=run, start=start)
            if (points["run"], points["end"]) != (run, start):
                run, start = points["run"], points["end"]
                events.append(("points", points))
            yield events

    def _keep(
        self, run: int, points: Sequence[Sequence[float]], counters: Mapping[str, int]
    ) -> None:
        """Add points of the current run or of a new one; the caller must hold the lock."""
        if run != self._run:
            self._run, self._end = run, 0
            self._points.clear()
        self._points.extend(points)
        self._end += len(points)
        self._counters = counters


class LiveState(ShownSession):
    """An observer that stores what pages show.

    Parameters
    ----------
    folder : folder of the submission, whose units are shown. The submission need not exist before
        `planned` is called.

    Attributes
    ----------
    buttons : the buttons pressed on the page, for the acquisition.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self.buttons = Buttons()
        self._answered = threading.Condition(self._lock)
        self._submission: Submission | None = None
        self._plan: Plan | None = None
        self._done: set[str] = set()
        self._partial: dict[str, str] = {}
        self._now: Recording | None = None
        self._phase: Phase = "waiting"
        # Number and text of the current instruction.
        self._instruction: tuple[int, str] | None = None
        self._asked = 0
        self._stage = ""  # what is being computed
        self._thoughts = 0
        self._thought = ""
        self._remarks: deque[str] = deque(maxlen=20)
        self.version = 1
        # In the current run: stamp of the last point, and number of lines.
        self._last_ms, self._lines = -_APART, 0

    # ------------------------------------------------------------- by the acquisition

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Announce the planned recordings, and the ids of those already made."""
        submission = load_submission(self._folder)
        with self._lock:
            self._submission, self._plan, self._done = submission, plan, set(done)
            self.version += 1

    def confirm(self, instruction: str) -> None:
        """Show what a person must do; wait until it is done or another button is pressed.

        Raises
        ------
        ConfigError : the page was closed, so nobody can confirm.
        """
        with self._lock:
            self._asked += 1
            self._instruction = self._asked, instruction
            self.version += 1
            while (
                self._instruction is not None and self._phase != "over" and not self.buttons.pressed
            ):
                self._answered.wait(0.2)  # s; the page may be closed in the meantime
            unanswered, self._instruction = self._instruction is not None, None
            self.version += 1
            if unanswered and not self.buttons.pressed:
                raise ConfigError(f"nobody confirmed: {instruction}")

    def settling(self, recording: Recording, seconds: float) -> None:
        """Announce that the carts must come to rest first."""
        self._change("settling", recording)

    def started(self, recording: Recording) -> None:
        """Announce that the run has started."""
        with self._lock:
            self._last_ms, self._lines = -_APART, 0
            self._keep(self._run + 1, [], _count(0, Anomalies()))
        self._change("recording", recording)

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Store a few of the lines that arrived."""
        kept = []
        for reading in batch:
            if reading.ms - self._last_ms >= _APART:
                self._last_ms = reading.ms
                kept.append(self._point(reading))
        with self._lock:
            self._lines += len(batch)
            self._keep(self._run, kept, _count(self._lines, anomalies))

    def finished(self, outcome: RunOutcome) -> None:
        """Announce how the run ended."""
        name = outcome.recording.id
        with self._lock:
            if outcome.partial:
                self._partial[name] = outcome.partial
            else:
                self._partial.pop(name, None)
                self._done.add(name)
            self._remarks.extend(f"{name}: {remark}" for remark in outcome.remarks)
            self._keep(self._run, [], _count(outcome.lines, outcome.anomalies))
        self._change("waiting", None)

    def remark(self, sentence: str) -> None:
        """Announce something that does not belong to a single run."""
        with self._lock:
            # An exploration opens the line again and again, and repeats its remarks.
            if sentence not in self._remarks:
                self._remarks.append(sentence)
            self.version += 1

    def thinking(self, stage: str) -> None:
        """Announce what is being computed."""
        with self._lock:
            self._stage = stage
        self._change("thinking", None)

    def thought(self, sentence: str) -> None:
        """Announce what is known, what is uncertain, which recording is next, and why."""
        with self._lock:
            self._thoughts += 1
            self._thought = sentence
        self._change("waiting", None)

    def _change(self, phase: Phase, recording: Recording | None) -> None:
        with self._lock:
            self._phase, self._now = phase, recording
            self.version += 1

    def _point(self, reading: Reading) -> tuple[float, ...]:
        """Return a line as a point in the submission's units, or in counts if no scale is known."""
        position, drive, carts = 1.0, 1.0, len(reading.counts)
        if self._submission is not None:
            system = self._submission.system
            position, drive = system.position.per_count or 1.0, system.input.per_count or 1.0
            carts = system.carts
        closed = self._now is not None and self._now.kind == "closed_loop"
        target = reading.target * (position if closed else drive)
        counts = reading.counts[:carts]
        values = (drive * reading.duty, target, *(position * count for count in counts))
        return (reading.ms / 1e3, *(float(f"{value:.5g}") for value in values))

    # ------------------------------------------------------------------ by the server

    def answer(self, number: int) -> bool:
        """Confirm the current instruction if it has this number; otherwise return False."""
        with self._lock:
            if self._instruction is None or self._instruction[0] != number:
                return False
            self._instruction = None
            self.version += 1
            self._answered.notify_all()
            return True

    def press(self, wish: Action, *, turn: int) -> bool:
        """Press a button; return whether the acquisition accepts it."""
        heeded = self.buttons.press(wish, turn=turn)
        with self._lock:
            self.version += 1
            self._answered.notify_all()
        return heeded

    def apply(self, wish: str, number: int) -> bool:
        """Handle a pressed button; return whether it is accepted. See `ShownSession.apply`."""
        if wish == "done":
            return self.answer(number)
        return wish in ACTIONS and self.press(wish, turn=number)

    def end(self) -> None:
        """Announce the end of the session."""
        self._change("over", None)

    def snapshot(self) -> dict[str, Any]:
        """Return everything except the points, for JSON."""
        with self._lock:
            system = self._submission.system if self._submission else None
            recordings = self._plan.recordings if self._plan else ()
            left = [r for r in recordings if r.id not in self._done]
            asked = self._instruction
            return {
                "title": self._submission.title if self._submission else "",
                "carts": system.carts if system else 0,
                "springs": list(system.springs) if system else [],
                "free": list(self._now.carts) if self._now else [],
                "units": {
                    "position": _unit(system and system.position),
                    "input": _unit(system and system.input),
                },
                "phase": self._phase,
                "instruction": {"number": asked[0], "text": asked[1]} if asked else None,
                "waits": self._waits(),
                "turn": self.buttons.turn,
                "offered": [] if self.buttons.pressed else list(self.buttons.offered),
                "now": self._now and self._now.id,
                "closed": self._now is not None and self._now.kind == "closed_loop",
                "duration": self._now.duration if self._now else 0.0,
                "settle": self._now.settle if self._now else 0.0,
                "seconds": session_time(recordings),
                "seconds_left": session_time(left),
                "plan": [self._entry(recording) for recording in recordings],
                "remarks": list(self._remarks),
                "thought": {"number": self._thoughts, "text": self._thought},
            }

    def _waits(self) -> str:
        """Return a sentence on what the program is doing or waiting for."""
        if self._phase == "over":
            return "The session is over."
        if self.buttons.pressed == "stop":
            return "Stopping."
        if self._instruction:
            return "Waiting for you."
        if self._phase == "thinking":
            return f"Analysing the data: {self._stage}."
        if self._phase == "settling" and self._now:
            return f"Waiting for the carts to come to rest before {self._now.id}."
        if self._phase == "recording" and self._now:
            return f"Recording {self._now.id}."
        if self._plan is None:
            return "Waiting for the bench to answer."
        return "Waiting for the bench to be ready for the next recording."

    def _entry(self, recording: Recording) -> dict[str, str]:
        name = recording.id
        state = "to come"
        if name in self._done:
            state = "done"
        elif self._now is not None and name == self._now.id:
            state = "now"
        elif name in self._partial:
            state = "partial"
        what = what_words(recording, self._submission) if self._submission else recording.kind
        return {"id": name, "what": what, "state": state, "why": self._partial.get(name, "")}


def _unit(scale: InputScale | PositionScale | None) -> str:
    """Return the unit into which counts are converted; "counts" without a scale."""
    return scale.unit if scale and scale.per_count else "counts"


def _count(lines: int, anomalies: Anomalies) -> dict[str, int]:
    return {"lines": lines, **asdict(anomalies)}
