"""A bench on a pseudo-terminal that misbehaves in one state of a session.

The bench has its own clock, which advances by one millisecond at a time and waits for a host that
is a few lines behind. So the host's reaction can be measured in ms of this clock on any machine.
"""

import os
import select
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest.mock import patch

from pipeline.bench.serial_line import SerialLine
from pipeline.protocol import (
    EXTENSIONS,
    STOCK_STOP,
    Command,
    Description,
    Hands,
    Reading,
    Signal,
    Start,
    encode,
    format_reading,
    parse_reading,
)
from pipeline.simulated.controller import CommandReader, ReferenceCore

PER_COUNT = 0.002  # cm
BENCH = Description(
    name="runaway",
    encoders=2,
    carts=2,
    commands=EXTENSIONS,
    input_per_count=0.5 / 4096,
    position_unit="cm",
    position_per_count=PER_COUNT,
)
_MOST_UNREAD = 64  # bytes of four lines, as many as arrive between two reads of a host
_PAUSE = 0.001  # s


class RunawayBench(threading.Thread):
    """A bench that keeps to the protocol, except while `wrong` returns True.

    Use it as a context manager. Cart 1's position is a fifth of the present duty, and
    cart 2's is half of it.

    Parameters
    ----------
    wrong : function that is called each ms and returns whether the bench misbehaves at that time.
    duty : motor's duty while the bench misbehaves; by default the commanded duty.
    out : counts added to the reading of cart 1 while the bench misbehaves.
    mute : function that is called each ms and returns whether the bench's lines are lost.

    Attributes
    ----------
    run_on : start command of the present run, or None between runs.
    starts : all start commands, except those that only stop a stock bench.
    resets, lines : number of resets received, and number of lines sent.
    is_stopped : whether the last command was a stop.
    is_pulled : whether the virtual hand was ever told to pull a cart out.
    offence : time in ms of the first line that shows the fault, or None so far.
    stopped_at : time in ms of the first stop command after `offence`, or None so far.
    started_after : start commands received after `offence`.
    """

    def __init__(
        self,
        wrong: Callable[["RunawayBench"], bool],
        *,
        duty: int | None = None,
        out: int = 0,
        mute: Callable[["RunawayBench"], bool] = lambda bench: False,
        commands: frozenset[str] = BENCH.commands,
    ) -> None:
        super().__init__(daemon=True)
        self._wrong, self._duty, self._out, self._mute = wrong, duty, out, mute
        self._description = replace(BENCH, commands=commands)
        self._core = ReferenceCore(self._description)
        self._reader = CommandReader(encoders=2, extensions=commands)
        self._over = threading.Event()
        self._held = 0  # the duty that is applied now
        self._unread = 0  # bytes that the host has not read yet
        self.ms = 0
        self.run_on: Start | None = None
        self.starts: list[Start] = []
        self.resets = self.lines = 0
        self.is_stopped = self.is_pulled = False
        self.offence: int | None = None
        self.stopped_at: int | None = None
        self.started_after: list[Start] = []

    def __enter__(self) -> "RunawayBench":
        import tty  # absent on Windows

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.address = os.ttyname(self._slave)
        self._meter = patch.object(SerialLine, "receive", self._metered(SerialLine.receive))
        self._meter.start()
        self.start()
        return self

    def _metered(self, receive: Callable[[SerialLine], bytes]) -> Callable[[SerialLine], bytes]:
        """Wrap the host's `receive` so that the bytes it reads are counted."""

        def metered(line: SerialLine) -> bytes:
            data = receive(line)
            self._unread = max(0, self._unread - len(data))
            return data

        return metered

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self.join()
        self._meter.stop()
        os.close(self._master)
        os.close(self._slave)

    def run(self) -> None:
        """Advance by one ms at a time until the block ends."""
        while not self._over.wait(_PAUSE):
            self._listen()
            if self._unread < _MOST_UNREAD:
                self._tick()
        self._listen()

    def _listen(self) -> None:
        while select.select([self._master], [], [], 0)[0]:
            for command in self._reader.feed(os.read(self._master, 4096)):
                self._hear(command)

    def _hear(self, command: Command) -> None:
        is_stop = command in (Signal.STOP, Signal.RESET)
        if is_stop and self.offence is not None and self.stopped_at is None:
            self.stopped_at = self.ms
        self.resets += command is Signal.RESET
        self.is_stopped = is_stop or (self.is_stopped and not isinstance(command, Start))
        self.is_pulled |= isinstance(command, Hands) and command.released > 0
        if isinstance(command, Start):
            self.run_on = command
            if command == STOCK_STOP[0]:  # the line was just opened, so unread bytes are gone
                self._unread = 0
            else:
                self.starts.append(command)
                if self.offence is not None:
                    self.started_after.append(command)
        elif is_stop:
            self.run_on = None
        self._core.receive(encode(command))

    def _tick(self) -> None:
        counts = (self._held // 5, self._held // 2)
        self._held = self._core.tick(counts, stamp=self.ms, now=0)
        said = self._core.take().splitlines(keepends=True)
        readings = [reading for line in said if (reading := parse_reading(line))]
        if not readings:
            self.run_on = None
        if self._wrong(self):
            readings = self._spoilt(readings)
        self.lines += len(readings)
        out = b"".join(line for line in said if line.startswith(b"?"))
        out += b"".join(map(format_reading, readings))
        if out and not self._mute(self):
            self._unread += len(out)
            os.write(self._master, out)
        self.ms += 1

    def _spoilt(self, readings: Sequence[Reading]) -> list[Reading]:
        """Return the lines that the misbehaving bench sends, even if there is no run."""
        if not readings and (self._duty is not None):
            readings = [Reading(counts=(0, 0), target=0, duty=0, ms=self.ms)]
        if readings and self.offence is None:
            self.offence = self.ms
        return [
            replace(
                reading,
                duty=reading.duty if self._duty is None else self._duty,
                counts=(reading.counts[0] + self._out, *reading.counts[1:]),
            )
            for reading in readings
        ]
