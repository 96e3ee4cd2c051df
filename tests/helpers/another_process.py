"""Functions for tests of a second process, whose tests never import this module."""

import os
import signal
import sys
import time
from typing import Any

from pipeline.errors import DataError
from pipeline.words.progress import Progress


def where(*args: Any, progress: Progress, **named: Any) -> tuple[int, tuple, dict]:
    """Report two stages; return this process's id and the arguments."""
    progress("one")
    progress("two")
    sys.stdout.write("what a library prints")
    return os.getpid(), args, named


def die_elsewhere(home: int, *, progress: Progress) -> int:
    """Kill this process, unless its id is `home`; return the id."""
    progress("begun")
    if os.getpid() != home:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60.0)
    return os.getpid()


def refuse(*, progress: Progress) -> None:
    """Raise an error."""
    raise DataError("no data")


def linger(*, progress: Progress) -> None:
    """Report this process's id, then wait."""
    progress(str(os.getpid()))
    time.sleep(60.0)
