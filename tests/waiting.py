"""Waiting for what happens, however busy the machine: a deadline only ends a hang."""

import time
from collections.abc import Callable

PATIENCE = 300.0  # s after which what is awaited is taken never to come


def until(happened: Callable[[], object], what: str = "it") -> None:
    """Wait until `happened()` holds.

    Raises
    ------
    AssertionError : it never did.
    """
    end = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < end, f"{what} never happened"
        time.sleep(0.01)
