"""Who watches a session at the bench and may press a button: the terminal, a web page, a test."""

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
    """What went wrong on the line, in how many places.

    Attributes
    ----------
    lost : lines that never came, by their time stamps.
    garbled : lines that say nothing, or a merger of several.
    late : lines that came in a lump, long after they were due.
    resets : the bench's clock began again in mid-run.
    stuck : encoders that did not move although the motor did.
    """

    lost: int = 0
    garbled: int = 0
    late: int = 0
    resets: int = 0
    stuck: int = 0

    def __str__(self) -> str:
        """Say what there is, "12 lines lost, 3 late"; "none" where there is nothing."""
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
    remarks : what a person should know, a sentence each.
    is_astray : the bench did what nothing told it to: nothing more is asked of it.
    is_unsafe : to go on was not safe: the same is not tried again.
    wish : the button that ended it; None: none did.
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
    """What acquisition tells while it goes on; every call returns at once but `confirm`."""

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Tell what will be recorded, and the ids of what already is."""
        ...

    def confirm(self, instruction: str) -> None:
        """Have a person do something at the bench, and wait until it is done.

        Raises
        ------
        ConfigError : there is nobody who could.
        """
        ...

    def settling(self, recording: Recording, seconds: float) -> None:
        """Tell that the carts come to rest first."""
        ...

    def started(self, recording: Recording) -> None:
        """Tell that the bench streams."""
        ...

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Hand on the lines that came, in order; `anomalies` are those of this run so far."""
        ...

    def finished(self, outcome: RunOutcome) -> None:
        """Tell how the run ended."""
        ...

    def remark(self, sentence: str) -> None:
        """Tell what concerns no single run."""
        ...

    def thinking(self, stage: str) -> None:
        """Tell what the data are asked meanwhile, the bench at rest."""
        ...

    def thought(self, sentence: str) -> None:
        """Tell what is known, what is doubted, what is recorded next and why."""
        ...


class Observers:
    """Several observers as one; the first of them has the person confirm."""

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._observers = tuple(observers)

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Tell what will be recorded, and the ids of what already is."""
        for observer in self._observers:
            observer.planned(plan, done)

    def confirm(self, instruction: str) -> None:
        """Have a person do something at the bench, and wait until it is done."""
        for observer in self._observers[:1]:
            observer.confirm(instruction)

    def settling(self, recording: Recording, seconds: float) -> None:
        """Tell that the carts come to rest first."""
        for observer in self._observers:
            observer.settling(recording, seconds)

    def started(self, recording: Recording) -> None:
        """Tell that the bench streams."""
        for observer in self._observers:
            observer.started(recording)

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Hand on the lines that came."""
        for observer in self._observers:
            observer.readings(batch, anomalies)

    def finished(self, outcome: RunOutcome) -> None:
        """Tell how the run ended."""
        for observer in self._observers:
            observer.finished(outcome)

    def remark(self, sentence: str) -> None:
        """Tell what concerns no single run."""
        for observer in self._observers:
            observer.remark(sentence)

    def thinking(self, stage: str) -> None:
        """Tell what the data are asked meanwhile."""
        for observer in self._observers:
            observer.thinking(stage)

    def thought(self, sentence: str) -> None:
        """Tell what is known, what is doubted, what is recorded next and why."""
        for observer in self._observers:
            observer.thought(sentence)


class Buttons:
    """What a person wants done with the run at hand: pressed in one thread, done in another.

    A button does nothing by itself. The acquisition says what it would heed now, looks at every
    turn of its loop what was pressed, and decides.

    Attributes
    ----------
    turn : which try of which recording the offer is about; a press for another is void.
    offered : what would be heeded now besides "stop", which always is.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.turn = 0
        self.offered: tuple[Wish, ...] = ()
        self._pressed: Wish | None = None

    @property
    def pressed(self) -> Wish | None:
        """What was pressed in this turn; "stop" stays pressed."""
        return self._pressed

    def begin(self) -> None:
        """Begin another turn, with nothing offered yet."""
        with self._lock:
            self.turn += 1
            self.offered = ()
            if self._pressed != "stop":
                self._pressed = None

    def offer(self, *wishes: Wish) -> None:
        """Say what would be heeded now; what was pressed before in this turn stays so."""
        with self._lock:
            self.offered = wishes

    def press(self, wish: Wish, *, turn: int) -> bool:
        """Press one; return whether it will be heeded. "stop" will, at any time."""
        with self._lock:
            if wish != "stop" and (self._pressed or turn != self.turn or wish not in self.offered):
                return False
            self._pressed = wish
            return True
