"""A virtual bench in a process of its own, for tests and for trying a host."""

import json
import os
import queue
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import IO, Any

from tests.helpers.nursery import order
from tests.helpers.waiting import PATIENCE


@dataclass
class Emulator:
    """A running `cartlab emulate`.

    Attributes
    ----------
    address : what pyserial's `serial_for_url` opens.
    said : the lines on stderr so far, without the events.
    runs : number of runs that have ended so far.
    """

    address: str
    output: list[str]
    pid: int = 0
    runs: int = 0
    _events: "queue.Queue[dict[str, Any]]" = field(default_factory=queue.Queue)

    def event(self, name: str, *, timeout: float = PATIENCE) -> dict[str, Any]:
        """Wait for the next event of that name, and drop events of other names before it.

        Raises
        ------
        queue.Empty : no such event came within `timeout` s.
        """
        while True:
            event = self._events.get(timeout=timeout)
            if event["event"] == name:
                return event


@contextmanager
def emulator(
    *options: str, preset: str = "throne-2dof", watchdog: float = PATIENCE
) -> Iterator[Emulator]:
    """Run `cartlab emulate` with these options while the block runs.

    The bench's watchdog waits longer than that of a real bench, since the machine may be busy.
    """
    words = ["cartlab", "emulate", *options]
    if "--model" not in options:
        words += ["--preset", preset]
    running = Emulator(address="", output=[])
    ready = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as door:
        door.settimeout(PATIENCE)
        order(words=words, watchdog=watchdog, port=door.getsockname()[1])
        line, _ = door.accept()
    with line, line.makefile(encoding="utf-8") as said:
        running.pid = int(said.readline())
        listener = threading.Thread(target=_listen, args=(running, said, ready), daemon=True)
        listener.start()
        try:
            assert ready.wait(PATIENCE), "no bench became ready"
            assert running.address, "\n".join(running.output)
            yield running
        finally:
            with suppress(ProcessLookupError):
                os.kill(running.pid, signal.SIGTERM)
            listener.join()


def _listen(running: Emulator, said: IO[str], ready: threading.Event) -> None:
    """Collect the bench's messages until it ends."""
    for line in said:
        if line.startswith("{"):
            event = json.loads(line)
            running.runs += event["event"] == "run"
            running._events.put(event)
        else:
            running.output.append(line.rstrip())
        if line.startswith("ready: "):
            running.address = line.removeprefix("ready: ").strip()
            ready.set()
    ready.set()
