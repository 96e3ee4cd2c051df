"""Make Ctrl-C end a command, even if a library does not pass it on."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pipeline.cli import INTERRUPTED


@contextmanager
def ctrl_c_says(say: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Call `say` when Ctrl-C is pressed; yield a function that then ends the work.

    A library may turn an interrupt into a different error. And Python drops an interrupt in the
    callback of a weak reference, for example during an import. In both cases, the next call of the
    yielded function ends the work.
    """
    pressed = False

    def stop(*_: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, stop)
    try:
        yield check
        check()
    except BaseException:
        if not pressed:
            raise
        say()
        sys.exit(INTERRUPTED)
    finally:
        signal.signal(signal.SIGINT, before)
