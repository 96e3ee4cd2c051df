"""A virtual bench: a controller, carts and a line, run in step with the clock."""

import gc
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipeline.bench.protocol.command_reader import CommandReader
from pipeline.bench.protocol.messages import (
    EXTENSIONS,
    Command,
    Description,
    Hands,
    Signal,
    Start,
    Wave,
)
from pipeline.errors import ConfigError
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.emulator.carts import TRUE_PERIOD, VirtualCarts
from pipeline.simulated.emulator.core import Core, ReferenceCore
from pipeline.simulated.emulator.faults import Faults, read_fault
from pipeline.simulated.emulator.links import open_link

_MOST_UNSENT = 262_144  # bytes. A bench that is faster than its host waits for it


@dataclass(frozen=True, kw_only=True)
class EmulatorOptions:
    """Options of a virtual bench.

    Attributes
    ----------
    port, remote : as in `open_link`.
    speed : speed relative to real time, if the computer can keep up.
    period : true time between ticks, s; the controller assumes whole ms.
    stock : whether the bench has no extension of the protocol and answers no query.
    faults : faults to inject, each written as for `read_fault`.
    seed : random seed of noise, hands and faults.
    """

    port: str = "socket://127.0.0.1:0"
    remote: bool = False
    speed: float = 1.0
    period: float = TRUE_PERIOD
    stock: bool = False
    faults: Sequence[str] = ()
    seed: int = 0


class Server:
    """A simulated bench on an open line; `serve` keeps it running for all its hosts.

    Parameters
    ----------
    core : function that makes the controller for a description.
    on_event : function that is called with each event as it happens.

    Attributes
    ----------
    description : the bench's answer to a query.
    events : all events so far. `event` is "client" (with `connected`), "run" (with `lines`, `ended`
        and `injected`, the faults) or "motor off" (with `ms_after_heartbeat`).

    Raises
    ------
    ConfigError : the port or a fault is invalid, or the simulation would take too long.
    DataError : no spring ties the carts to a wall, or hidden effects make the simulation diverge.
    """

    def __init__(
        self,
        bench: SimulatedBench,
        options: EmulatorOptions,
        *,
        core: Callable[[Description], Core] = ReferenceCore,
        on_event: Callable[[dict], None] = lambda event: None,
    ) -> None:
        bench.refuse_endless()
        self._period, self._speed, self._on_event = options.period, options.speed, on_event
        struck = [read_fault(text) for text in options.faults]
        self._faults = Faults(struck, seed=options.seed, period=options.period)
        if options.port == "pty" and any(fault.kind == "disconnect" for fault in struck):
            raise ConfigError(
                "--fault disconnect: a pty cannot be pulled out; take --port socket://…"
            )
        self._carts = VirtualCarts(bench, seed=options.seed, period=options.period)
        self._carts.move(0)  # compiles the simulation before a host waits for it
        self.description = Description(
            name=re.sub(r"[^\w.-]", "_", bench.name, flags=re.ASCII),
            encoders=self._carts.encoders,
            carts=bench.chain.n,
            period=max(1, round(1e3 * options.period)) / 1e3,
            commands=frozenset() if options.stock else EXTENSIONS,
            input_unit=bench.input_unit,
            input_per_count=self._carts.input_per_count,
            position_unit=bench.position_unit,
            position_per_count=bench.count,
        )
        self._core = core(self.description)
        self._tap = CommandReader(
            encoders=self.description.encoders, extensions=self.description.commands
        )
        self._link = open_link(options.port, remote=options.remote)
        self.events: list[dict] = []
        self._ticks = 0
        self._still_since = 0.0  # s of the bench's clock
        self._start = Start(wave=Wave.DELTA, frequency=1.0, amplitude=0)  # the last start received
        self._ending = ""  # why the run will end; "" if by itself
        self._lines = 0  # lines sent in this run
        self._heard: float | None = None  # s of wall time of the last heartbeat
        self._injected_before: Counter[str] = Counter()  # at the end of the last run
        self._connected = False
        self._pulled = False  # whether a fault disconnects the line

    def serve(self, *, until: Callable[[], bool]) -> None:
        """Keep the bench running until `until` returns true."""
        gc.freeze()  # otherwise a search for garbage would stop the bench for 0.1 s
        owed, last = 0.0, time.monotonic()
        while not until():
            asleep = self._is_asleep()
            late = owed >= self._period and self._link.unsent < _MOST_UNSENT
            # Bytes that are due between two checks of the line are sent together.
            self._link.wait(0.1 if asleep else 0.0 if late else 2e-3)
            self._listen()
            now = time.monotonic()
            # If the computer falls behind by more than 1 s of the bench's clock, the rest is
            # skipped.
            owed = 0.0 if asleep else min(owed + (now - last) * self._speed, 1.0)
            last = now
            out = bytearray()
            while owed >= self._period and self._link.unsent < _MOST_UNSENT:
                out += self._tick()
                owed -= self._period
                if self._pulled or time.monotonic() - now > 0.01:  # s. Check the line again
                    break
            self._link.send(bytes(out))
            if self._pulled:
                self._link.hang_up()
                self._pulled = False

    @property
    def address(self) -> str:
        """The address for hosts."""
        return self._link.address

    def close(self) -> None:
        """Close the line."""
        self._link.close()

    @property
    def _clock(self) -> float:
        return self._ticks * self._period

    def _is_asleep(self) -> bool:
        """Return whether nothing moves and no host is connected."""
        # 10 s of the bench's clock after the motor goes off, everything is at rest.
        resting = self._clock - self._still_since > 10.0
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
        """Note a command to the controller that concerns the hands or the log."""
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
        """Advance the bench by one tick; return the bytes to send."""
        now = int(1e3 * time.monotonic())
        duty = self._core.tick(self._carts.counts(), stamp=int(1e3 * self._clock), now=now)
        output = self._core.take().splitlines(keepends=True)
        readings = [line for line in output if not line.startswith(b"?")]
        answers = b"".join(line for line in output if line.startswith(b"?"))
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
        """Log the run that ends now, if there was one; `ending` is "" if it ended by itself."""
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
        self._on_event(event)
