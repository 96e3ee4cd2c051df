"""Ctrl-C ends a command, whatever a library makes of it."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from pipeline.cli import INTERRUPTED


@contextmanager
def ctrl_c_says(say: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Yield a look that ends the work where Ctrl-C was pressed; call `say` where that ended it.

    A library that is interrupted may end in an error of its own. And Python itself drops the
    interrupt where it falls into the callback of a weak reference, as it may at any import: then
    the next look ends the work.
    """
    pressed = False

    def stop(*_: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def look() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, stop)
    try:
        yield look
        look()
    except BaseException:
        if not pressed:
            raise
        say()
        raise typer.Exit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGINT, before)
