"""A virtual bench in a process of its own, for tests and for whoever tries a host."""

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from tests.waiting import PATIENCE, started


@dataclass
class Emulator:
    """A running `cartlab emulate`.

    Attributes
    ----------
    address : what pyserial's `serial_for_url` opens.
    said : the lines on stderr so far, but for the events.
    runs : how many have ended so far.
    """

    address: str
    process: subprocess.Popen[str]
    said: list[str]
    runs: int = 0
    _events: "queue.Queue[dict[str, Any]]" = field(default_factory=queue.Queue)

    def event(self, name: str, *, timeout: float = PATIENCE) -> dict[str, Any]:
        """Wait for the next event of that name; others before it are passed over.

        Raises
        ------
        queue.Empty : none came in `timeout` s.
        """
        while True:
            event = self._events.get(timeout=timeout)
            if event["event"] == name:
                return event


@contextmanager
def emulator(
    *options: str, preset: str = "throne-2dof", watchdog: float = PATIENCE
) -> Iterator[Emulator]:
    """Run `cartlab emulate` with these options for as long as the block lasts.

    Its watchdog waits longer (s) than a bench's, for a host on a machine that may be busy.
    """
    patient = f"from pipeline.bench.emulator import core; core.WATCHDOG = {watchdog}"
    script = f"{patient}; from pipeline.cli import main; main()"
    command = [sys.executable, "-c", script, "emulate", *options]
    if "--model" not in options:
        command += ["--preset", preset]
    with started(command, stderr=subprocess.PIPE, encoding="utf-8") as process:
        running = Emulator(address="", process=process, said=[])
        ready = threading.Event()
        listener = threading.Thread(target=_listen, args=(running, ready), daemon=True)
        listener.start()
        try:
            assert ready.wait(PATIENCE), "no bench became ready"
            assert running.address, "\n".join(running.said)
            yield running
        finally:
            process.terminate()
            process.wait(PATIENCE)
            listener.join()


def _listen(running: Emulator, ready: threading.Event) -> None:
    """Take down what the bench says until it says no more."""
    assert running.process.stderr is not None
    for line in running.process.stderr:
        if line.startswith("{"):
            event = json.loads(line)
            running.runs += event["event"] == "run"
            running._events.put(event)
        else:
            running.said.append(line.rstrip())
        if line.startswith("ready: "):
            running.address = line.removeprefix("ready: ").strip()
            ready.set()
    ready.set()
