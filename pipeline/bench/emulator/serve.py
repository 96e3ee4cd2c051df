"""A virtual bench: a controller, carts and a line, kept going at the pace of the clock."""

import gc
import time
from collections import Counter
from collections.abc import Callable

from pipeline.bench.emulator.carts import TRUE_PERIOD, VirtualCarts
from pipeline.bench.emulator.core import Core
from pipeline.bench.emulator.faults import Faults
from pipeline.bench.emulator.links import Link
from pipeline.bench.protocol.command_reader import CommandReader
from pipeline.bench.protocol.messages import (
    Command,
    Description,
    Hands,
    Signal,
    Start,
    Wave,
)

_LUMP = 2e-3  # s between two looks at the line: what was due meanwhile goes out together
_ASLEEP = 0.1  # s, where nothing moves and nobody listens
_REST = 10.0  # s of the bench's clock after the motor goes off until everything is still
_MOST_OWED = 1.0  # s of the bench's clock: what a computer was too busy for beyond that is left out
_SLICE = 0.01  # s at most until the line is looked at again
_MOST_UNSENT = 262_144  # bytes: a bench faster than its host waits for it


class Server:
    """One bench on one line, whoever comes to it.

    Parameters
    ----------
    core : the controller.
    description : of the bench, whose commands `core` knows.
    period : s from tick to tick.
    speed : how many times faster than real time it runs, as far as the computer can.
    tell : called with each event as it happens.

    Attributes
    ----------
    events : what happened; each has `event`: "client" (connected), "run" (lines, ended and the
        faults injected), "motor off" (ms_after_heartbeat).
    """

    def __init__(
        self,
        core: Core,
        carts: VirtualCarts,
        link: Link,
        *,
        description: Description,
        faults: Faults,
        period: float = TRUE_PERIOD,
        speed: float = 1.0,
        tell: Callable[[dict], None] = lambda event: None,
    ) -> None:
        self._core, self._carts, self._link, self._faults = core, carts, link, faults
        self._period, self._speed, self._tell = period, speed, tell
        self.description = description
        self._tap = CommandReader(encoders=carts.encoders, extensions=description.commands)
        self.events: list[dict] = []
        self._ticks = 0
        self._still_since = 0.0  # s of the bench's clock
        self._start = Start(wave=Wave.DELTA, frequency=1.0, amplitude=0)  # the last one heard
        self._ending = ""  # why its run will end; "": by itself
        self._lines = 0  # streamed in this run
        self._heard: float | None = None  # s of wall time, of the last heartbeat
        self._injected_before: Counter[str] = Counter()  # by the end of the last run
        self._connected = False
        self._pulled = False  # a fault wants the cable pulled

    def serve(self, *, until: Callable[[], bool]) -> None:
        """Keep the bench going until told otherwise."""
        gc.freeze()  # a look for garbage among all that is loaded would hold it up for 0.1 s
        owed, last = 0.0, time.monotonic()
        while not until():
            asleep = self._is_asleep()
            late = owed >= self._period and self._link.unsent < _MOST_UNSENT
            self._link.wait(_ASLEEP if asleep else 0.0 if late else _LUMP)
            self._listen()
            now = time.monotonic()
            owed = 0.0 if asleep else min(owed + (now - last) * self._speed, _MOST_OWED)
            last = now
            out = bytearray()
            while owed >= self._period and self._link.unsent < _MOST_UNSENT:
                out += self._tick()
                owed -= self._period
                if self._pulled or time.monotonic() - now > _SLICE:
                    break
            self._link.send(bytes(out))
            if self._pulled:
                self._link.hang_up()
                self._pulled = False

    @property
    def address(self) -> str:
        """What a host opens."""
        return self._link.address

    def close(self) -> None:
        """Leave the line."""
        self._link.close()

    @property
    def _clock(self) -> float:
        return self._ticks * self._period

    def _is_asleep(self) -> bool:
        """Whether nothing moves and nobody would see it."""
        resting = self._clock - self._still_since > _REST
        return resting and not self._connected and not self._lines

    def _listen(self) -> None:
        data = self._link.receive()
        if self._link.connected != self._connected:
            self._connected = self._link.connected
            self._log(event="client", connected=self._connected)
        if data:
            self._core.receive(data)
            for command in self._tap.feed(data):
                self._overhear(command)

    def _overhear(self, command: Command) -> None:
        """Note what the hands and the log need to know of what the controller is told."""
        match command:
            case Start():
                self._end_run("restarted")
                self._start, self._ending = command, ""
                self._carts.start()
            case Hands():
                self._carts.take_in_hand(command)
                self._still_since = self._clock
            case Signal.HEARTBEAT:
                self._heard = time.monotonic()
            case Signal.STOP:
                self._ending = "stopped"
            case Signal.RESET:
                self._ending, self._heard = "reset", None

    def _tick(self) -> bytes:
        """Move the bench on by one tick; returns what goes over the line."""
        now = int(1e3 * time.monotonic())
        duty = self._core.tick(self._carts.counts(), stamp=int(1e3 * self._clock), now=now)
        said = self._core.take().splitlines(keepends=True)
        readings = [line for line in said if not line.startswith(b"?")]
        answers = b"".join(line for line in said if line.startswith(b"?"))
        out = self._faults.behind(answers, clock=self._clock)
        for line in readings if self._connected else ():
            struck, kind = self._faults.strike(line, clock=self._clock)
            out += struck
            self._pulled |= kind == "disconnect"
        self._lines += len(readings)
        if not readings:
            self._end_run(self._ending)
            out += self._faults.idle(clock=self._clock)
        self._carts.move(duty)
        self._ticks += 1
        if duty:
            self._still_since = self._clock
        return out

    def _end_run(self, ending: str) -> None:
        """Log the run that streamed until now, if one did; "": ended by itself."""
        if not self._lines:
            return
        left = self._start.duration - self._lines * self._period
        if not ending:
            ending = "watchdog" if left > 2 * self._period else "done"
        if ending == "watchdog" and self._heard is not None:
            silence = round(1e3 * (time.monotonic() - self._heard))
            self._log(event="motor off", ms_after_heartbeat=silence)
        injected = self._faults.injected - self._injected_before
        self._injected_before = self._faults.injected.copy()
        self._log(event="run", lines=self._lines, ended=ending, injected=dict(injected))
        self._lines = 0

    def _log(self, **event: object) -> None:
        self.events.append(event)
        self._tell(event)
