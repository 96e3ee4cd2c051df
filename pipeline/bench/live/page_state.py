"""What a live page shows: told by the acquisition in one thread, asked by a server in another."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pipeline.bench.live.observer import Anomalies, Buttons, RunOutcome, Wish
from pipeline.bench.planning.plan import Plan, Recording
from pipeline.bench.planning.plan_words import session_time, what_words
from pipeline.bench.protocol.messages import Reading
from pipeline.errors import ConfigError
from pipeline.submission import Input, Position, Submission, load_submission

Phase = Literal["waiting", "settling", "recording", "thinking", "over"]

_APART = 5  # ms between points shown: no eye sees more on a screen of ten seconds
_KEPT = 2400  # points; what a page that reads too slowly has not fetched by then is left out
_REMARKS = 20  # the last ones
_ASK = 0.2  # s between looks whether the page was closed, while a person is awaited


@dataclass(frozen=True, kw_only=True)
class Points:
    """Points of a run from `start` on; each is (t in s, input, target, x1, x2, …).

    `end` is where the next ones start; `counters` are those of the run so far.
    """

    run: int
    start: int
    end: int
    points: list[tuple[float, ...]]
    counters: dict[str, int]


class LiveState:
    """An observer that remembers what there is to see.

    Parameters
    ----------
    folder : of the submission, whose units are shown; it is there once a plan is told.

    Attributes
    ----------
    buttons : what is pressed on the page, for the acquisition to heed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.buttons = Buttons()
        self._lock = threading.Lock()
        self._answered = threading.Condition(self._lock)
        self._submission: Submission | None = None
        self._plan: Plan | None = None
        self._done: set[str] = set()
        self._partial: dict[str, str] = {}
        self._now: Recording | None = None
        self._phase: Phase = "waiting"
        self._instruction: tuple[int, str] | None = None  # its number, its text
        self._asked = 0
        self._stage = ""  # of what it thinks about
        self._thoughts = 0
        self._thought = ""
        self._remarks: deque[str] = deque(maxlen=_REMARKS)
        self._version = 0
        self._run = 0
        self._points: deque[tuple[float, ...]] = deque(maxlen=_KEPT)
        self._n_points = 0  # in this run, also those that are gone
        self._last_ms = -_APART
        self._lines = 0
        self._anomalies = Anomalies()

    # ------------------------------------------------------------- by the acquisition

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Tell what will be recorded, and the ids of what already is."""
        submission = load_submission(self._folder)
        with self._lock:
            self._submission, self._plan, self._done = submission, plan, set(done)
            self._version += 1

    def confirm(self, instruction: str) -> None:
        """Show what a person must do, and wait until it is done or another button is pressed.

        Raises
        ------
        ConfigError : the page was closed meanwhile; nobody can confirm any more.
        """
        with self._lock:
            self._asked += 1
            self._instruction = self._asked, instruction
            self._version += 1
            while (
                self._instruction is not None and self._phase != "over" and not self.buttons.pressed
            ):
                self._answered.wait(_ASK)
            unanswered, self._instruction = self._instruction is not None, None
            self._version += 1
            if unanswered and not self.buttons.pressed:
                raise ConfigError(f"nobody confirmed: {instruction}")

    def settling(self, recording: Recording, seconds: float) -> None:
        """Tell that the carts come to rest first."""
        self._change("settling", recording)

    def started(self, recording: Recording) -> None:
        """Tell that the bench streams."""
        with self._lock:
            self._run += 1
            self._points.clear()
            self._n_points, self._last_ms, self._lines = 0, -_APART, 0
            self._anomalies = Anomalies()
        self._change("recording", recording)

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Keep a few of the lines that came."""
        kept = []
        for reading in batch:
            if reading.ms - self._last_ms >= _APART:
                self._last_ms = reading.ms
                kept.append(self._point(reading))
        with self._lock:
            self._points.extend(kept)
            self._n_points += len(kept)
            self._lines += len(batch)
            self._anomalies = anomalies

    def finished(self, outcome: RunOutcome) -> None:
        """Tell how the run ended."""
        name = outcome.recording.id
        with self._lock:
            if outcome.partial:
                self._partial[name] = outcome.partial
            else:
                self._partial.pop(name, None)
                self._done.add(name)
            self._remarks.extend(f"{name}: {remark}" for remark in outcome.remarks)
            self._lines, self._anomalies = outcome.lines, outcome.anomalies
        self._change("waiting", None)

    def remark(self, sentence: str) -> None:
        """Tell what concerns no single run."""
        with self._lock:
            if sentence not in self._remarks:  # an exploration opens the line once a turn
                self._remarks.append(sentence)
            self._version += 1

    def thinking(self, stage: str) -> None:
        """Tell what the data are asked meanwhile."""
        with self._lock:
            self._stage = stage
        self._change("thinking", None)

    def thought(self, sentence: str) -> None:
        """Tell what is known, what is doubted, what is recorded next and why."""
        with self._lock:
            self._thoughts += 1
            self._thought = sentence
        self._change("waiting", None)

    def _change(self, phase: Phase, recording: Recording | None) -> None:
        with self._lock:
            self._phase, self._now = phase, recording
            self._version += 1

    def _point(self, reading: Reading) -> tuple[float, ...]:
        """Return a line in the submission's units, or in counts where it states none."""
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

    @property
    def version(self) -> int:
        """A number that grows whenever `snapshot` changes."""
        return self._version

    def answer(self, number: int) -> bool:
        """Take a person's word that instruction `number` is done; an earlier one's is void."""
        with self._lock:
            if self._instruction is None or self._instruction[0] != number:
                return False
            self._instruction = None
            self._version += 1
            self._answered.notify_all()
            return True

    def press(self, wish: Wish, *, turn: int) -> bool:
        """Press a button; return whether it will be heeded."""
        heeded = self.buttons.press(wish, turn=turn)
        with self._lock:
            self._version += 1
            self._answered.notify_all()
        return heeded

    def end(self) -> None:
        """Tell that nothing comes any more."""
        self._change("over", None)

    def points(self, *, run: int, start: int) -> Points:
        """Return the points since `start` of a run; of another run than the present: all."""
        with self._lock:
            first = self._n_points - len(self._points)
            begin = max(first, start) if run == self._run else first
            points = list(self._points)[begin - first :]
            counters = {"lines": self._lines, **asdict(self._anomalies)}
            return Points(
                run=self._run, start=begin, end=self._n_points, points=points, counters=counters
            )

    def snapshot(self) -> dict[str, Any]:
        """Return all but the points, for JSON."""
        with self._lock:
            system = self._submission.system if self._submission else None
            recordings = self._plan.recordings if self._plan else ()
            left = [r for r in recordings if r.id not in self._done]
            asked = self._instruction
            return {
                "title": self._submission.title if self._submission else "",
                "carts": system.carts if system else 0,
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
        """Return in one sentence what the program is about, or waiting for."""
        if self._phase == "over":
            return "The session is over."
        if self.buttons.pressed == "stop":
            return "Stopping."
        if self._instruction:
            return "Waiting for you."
        if self._phase == "thinking":
            return f"Asking the data: {self._stage}."
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


def _unit(scale: Input | Position | None) -> str:
    """Return the unit that counts are turned into; they stay counts where no scale is stated."""
    return scale.unit if scale and scale.per_count else "counts"
