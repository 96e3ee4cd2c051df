"""Make Ctrl-C end a command, even inside libraries that handle it badly."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from pipeline.cli import INTERRUPTED


@contextmanager
def ctrl_c_says(say: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Yield `look`, which ends the work if Ctrl-C was pressed; call `say` when that happens.

    An interrupted library may raise its own error. Python itself drops an interrupt that arrives
    in the callback of a weak reference, as can happen during any import. Then the next call of
    `look` ends the work.
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
