"""Wait for events on a machine of any load; the deadline only ends a hang."""

import re
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import psutil

PATIENCE = 120.0  # s after which an event is assumed never to come
# Each check takes processor time from the awaited process, so checks become less frequent.
_OFTEN, _SELDOM = 0.01, 0.1  # first and longest time between two checks, in s, …
_LATER = 0.1  # … and the time between checks as a share of the time waited so far


def until(happened: Callable[[], object], what: str = "it") -> None:
    """Wait until `happened()` holds.

    Raises
    ------
    AssertionError : `happened()` never held.
    """
    begin = time.monotonic()
    while not happened():
        waited = time.monotonic() - begin
        assert waited < PATIENCE, f"{what} never happened"
        time.sleep(min(max(_OFTEN, _LATER * waited), _SELDOM))


@contextmanager
def started(command: Sequence[object], **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """Run a program while the block runs; afterwards it and all its children have ended."""
    with subprocess.Popen(list(map(str, command)), **options) as process:
        try:
            yield process
        finally:
            kill(process)


def address(program: subprocess.Popen[str]) -> str:
    """Return the address that a program prints on stderr when it is ready.

    On a busy machine, lines of progress come first.
    """
    assert program.stderr is not None
    found = (re.search(r"http://\S+", line) for line in program.stderr)
    return next(one[0] for one in found if one)


def kill(process: subprocess.Popen[Any]) -> None:
    """Kill a program and its children, and wait until all of them are gone."""
    if process.poll() is not None:
        return
    tree: list[psutil.Process] = []
    with suppress(psutil.NoSuchProcess):
        tree = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    for other in tree:
        with suppress(psutil.NoSuchProcess):
            other.kill()
    psutil.wait_procs(tree, timeout=PATIENCE)
