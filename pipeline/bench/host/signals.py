"""Signals that end a program: raise them as an exception, or hold them until work is finished."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

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
