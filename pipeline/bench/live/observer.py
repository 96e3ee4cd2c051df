"""Observers of a session at the bench: the terminal, a web page, a test."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, get_args

from pipeline.bench.protocol.messages import Reading
from pipeline.experiments.plan import Plan, Recording

Wish = Literal["stop", "skip", "keep", "repeat"]
WISHES: tuple[Wish, ...] = get_args(Wish)


@dataclass(frozen=True, kw_only=True)
class Anomalies:
    """Faults on the line, with their numbers.

    Attributes
    ----------
    lost : lines that never came, by their time stamps.
    garbled : unreadable lines, and merged ones.
    late : lines that came together, long after they were due.
    resets : the bench's clock started again during the run.
    stuck : encoders that did not move although the motor did.
    """

    lost: int = 0
    garbled: int = 0
    late: int = 0
    resets: int = 0
    stuck: int = 0

    def __str__(self) -> str:
        """Return a list such as "12 lines lost, 3 late", or "none"."""
        words = [
            (self.lost, "line" if self.lost == 1 else "lines", "lost"),
            (self.garbled, "garbled"),
            (self.late, "late"),
            (self.resets, "reset" if self.resets == 1 else "resets"),
            (self.stuck, "encoder" if self.stuck == 1 else "encoders", "stuck"),
        ]
        return ", ".join(" ".join(map(str, entry)) for entry in words if entry[0]) or "none"


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """How one recording ended.

    Attributes
    ----------
    lines : valid lines kept.
    partial : why it ended early; "": it did not.
    remarks : notes for the person, one sentence each.
    is_astray : the bench acted without an order, so it gets no more orders.
    is_unsafe : going on was not safe, so the same is not tried again.
    wish : the button that ended it; None: no button.
    """

    recording: Recording
    lines: int
    anomalies: Anomalies = Anomalies()
    partial: str = ""
    remarks: tuple[str, ...] = field(default=())
    is_astray: bool = False
    is_unsafe: bool = False
    wish: Wish | None = None


class Observer(Protocol):
    """Events of an acquisition; every call returns at once except `confirm`."""

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Announce the recordings, and the ids of those that exist."""
        ...

    def confirm(self, instruction: str) -> None:
        """Have a person do something at the bench, and wait until it is done.

        Raises
        ------
        ConfigError : there is nobody who could.
        """
        ...

    def settling(self, recording: Recording, seconds: float) -> None:
        """Announce that the carts come to rest first."""
        ...

    def started(self, recording: Recording) -> None:
        """Announce that the bench streams."""
        ...

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Pass on new lines, in order; `anomalies` are those of this run so far."""
        ...

    def finished(self, outcome: RunOutcome) -> None:
        """Announce how the run ended."""
        ...

    def remark(self, sentence: str) -> None:
        """Announce something that concerns no single run."""
        ...

    def thinking(self, stage: str) -> None:
        """Announce what is being computed while the bench rests."""
        ...

    def thought(self, sentence: str) -> None:
        """Announce what is known, what is doubted, and the next recording with its reason."""
        ...


class Observers:
    """Several observers as one; the first of them asks a person to confirm."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = tuple(observers)

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Announce the recordings, and the ids of those that exist."""
        for observer in self._observers:
            observer.planned(plan, done)

    def confirm(self, instruction: str) -> None:
        """Have a person do something at the bench, and wait until it is done."""
        for observer in self._observers[:1]:
            observer.confirm(instruction)

    def settling(self, recording: Recording, seconds: float) -> None:
        """Announce that the carts come to rest first."""
        for observer in self._observers:
            observer.settling(recording, seconds)

    def started(self, recording: Recording) -> None:
        """Announce that the bench streams."""
        for observer in self._observers:
            observer.started(recording)

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Pass on new lines."""
        for observer in self._observers:
            observer.readings(batch, anomalies)

    def finished(self, outcome: RunOutcome) -> None:
        """Announce how the run ended."""
        for observer in self._observers:
            observer.finished(outcome)

    def remark(self, sentence: str) -> None:
        """Announce something that concerns no single run."""
        for observer in self._observers:
            observer.remark(sentence)

    def thinking(self, stage: str) -> None:
        """Announce what is being computed."""
        for observer in self._observers:
            observer.thinking(stage)

    def thought(self, sentence: str) -> None:
        """Announce what is known, what is doubted, and the next recording with its reason."""
        for observer in self._observers:
            observer.thought(sentence)


class Buttons:
    """A person's wish for the present run: pressed in one thread, carried out in another.

    A button does nothing by itself. The acquisition states which buttons it would accept now,
    checks them in every turn of its loop, and decides.

    Attributes
    ----------
    turn : the try and the recording of the offer; a press for another turn does not count.
    offered : buttons accepted now besides "stop", which always is.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.turn = 0
        self.offered: tuple[Wish, ...] = ()
        self._pressed: Wish | None = None

    @property
    def pressed(self) -> Wish | None:
        """The button pressed in this turn; "stop" stays pressed."""
        return self._pressed

    def begin(self) -> None:
        """Begin another turn, with nothing offered yet."""
        with self._lock:
            self.turn += 1
            self.offered = ()
            if self._pressed != "stop":
                self._pressed = None

    def offer(self, *wishes: Wish) -> None:
        """Set the accepted buttons; a button already pressed in this turn stays pressed."""
        with self._lock:
            self.offered = wishes

    def press(self, wish: Wish, *, turn: int) -> bool:
        """Press a button; return whether it is accepted. "stop" is, at any time."""
        with self._lock:
            if wish != "stop" and (self._pressed or turn != self.turn or wish not in self.offered):
                return False
            self._pressed = wish
            return True
