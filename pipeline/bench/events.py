"""What a session at the bench shows to its displays, and how people or signals stop it."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Literal, Protocol, get_args

from pipeline.experiments.plan import Plan, Recording
from pipeline.protocol import Reading

Action = Literal["stop", "skip", "keep", "repeat"]
ACTIONS: tuple[Action, ...] = get_args(Action)


@dataclass(frozen=True, kw_only=True)
class Anomalies:
    """The numbers of faults on the line.

    Attributes
    ----------
    lost : lines that never arrived, judged by the time stamps.
    garbled : lines that could not be read or had merged.
    late : lines that arrived long after they were due.
    resets : restarts of the bench's clock during the run.
    stuck : encoders that did not move although the motor was driving.
    """

    lost: int = 0
    garbled: int = 0
    late: int = 0
    resets: int = 0
    stuck: int = 0

    def __str__(self) -> str:
        """Return the faults as a list, such as "12 lines lost, 3 late", or "none"."""
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
    lines : number of valid lines.
    partial : why the run ended early; "" if it did not.
    remarks : notes for the person, one sentence each.
    is_astray : whether the bench acted without an order, so that it gets no more orders.
    is_unsafe : whether it was unsafe to continue, so that the recording is not tried again.
    wish : the button that ended the run; None if no button did.
    """

    recording: Recording
    lines: int
    anomalies: Anomalies = Anomalies()
    partial: str = ""
    remarks: tuple[str, ...] = field(default=())
    is_astray: bool = False
    is_unsafe: bool = False
    wish: Action | None = None


class Observer(Protocol):
    """Receives the events of an acquisition; every method returns at once, except `confirm`."""

    def planned(self, plan: Plan, done: frozenset[str]) -> None:
        """Announce the planned recordings, and the ids of those already made."""
        ...

    def confirm(self, instruction: str) -> None:
        """Ask a person to do something at the bench, and wait until it is done.

        Raises
        ------
        ConfigError : no person can be asked.
        """
        ...

    def settling(self, recording: Recording, seconds: float) -> None:
        """Announce that the carts must come to rest first."""
        ...

    def started(self, recording: Recording) -> None:
        """Announce that the run has started."""
        ...

    def readings(self, batch: Sequence[Reading], anomalies: Anomalies) -> None:
        """Receive new lines in order, and all faults of this run so far."""
        ...

    def finished(self, outcome: RunOutcome) -> None:
        """Announce how the run ended."""
        ...

    def remark(self, sentence: str) -> None:
        """Announce something that does not belong to a single run."""
        ...

    def thinking(self, stage: str) -> None:
        """Announce what is being computed while the bench rests."""
        ...

    def thought(self, sentence: str) -> None:
        """Announce what is known, what is uncertain, which recording is next, and why."""
        ...


class Buttons:
    """The button that a person pressed for the current run.

    One thread presses buttons and another reads them. A button does nothing by itself: the
    acquisition sets which buttons it accepts, checks which one was pressed, and decides what to do.

    Attributes
    ----------
    turn : number of calls of `begin` so far; a press meant for another turn does not count.
    offered : buttons accepted now, apart from "stop", which is always accepted.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.turn = 0
        self.offered: tuple[Action, ...] = ()
        self._pressed: Action | None = None

    @property
    def pressed(self) -> Action | None:
        """The button pressed in this turn, if any; "stop" stays pressed."""
        return self._pressed

    def begin(self) -> None:
        """Begin another turn, in which no button is offered yet."""
        with self._lock:
            self.turn += 1
            self.offered = ()
            if self._pressed != "stop":
                self._pressed = None

    def offer(self, *wishes: Action) -> None:
        """Set which buttons are accepted; a button already pressed in this turn stays pressed."""
        with self._lock:
            self.offered = wishes

    def press(self, wish: Action, *, turn: int) -> bool:
        """Press a button; return whether it is accepted. "stop" is always accepted."""
        with self._lock:
            if wish != "stop" and (self._pressed or turn != self.turn or wish not in self.offered):
                return False
            self._pressed = wish
            return True


# Sent by kill, by a closing terminal, and by Ctrl-Break on Windows. No system has all three.
_ENDING = ("SIGTERM", "SIGHUP", "SIGBREAK")


class Stopped(KeyboardInterrupt):
    """A signal asked the program to end."""


@contextmanager
def stopping_on_signals() -> Iterator[None]:
    """Raise an exception for signals that end a program, so that a run is stopped and saved."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise Stopped(f"signal {number}")

    numbers = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]
    # An ignored signal stays ignored: after nohup, a closed terminal must not end the program.
    before = {n: signal.signal(n, stop) for n in numbers if signal.getsignal(n) == signal.SIG_DFL}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def signals_held() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C and similar signals until the end of the block.

    Yields a function that raises `Stopped` if a signal has arrived.
    """
    waiting: list[int] = []

    def let_in() -> None:
        if waiting:
            raise Stopped(f"signal {waiting[0]}")

    if threading.current_thread() is not threading.main_thread():
        yield let_in
        return

    def hold(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    numbers = [getattr(signal, name) for name in ("SIGINT", *_ENDING) if hasattr(signal, name)]
    # Leave alone a signal that is ignored or that ends the program at once.
    before = {n: signal.signal(n, hold) for n in numbers if callable(signal.getsignal(n))}
    try:
        yield let_in
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    let_in()
