"""The virtual bench: a controller, carts and a line, run in step with the clock."""

import gc
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import protocol
from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.plant.augmented import SteppedBench
from pipeline.plant.effect import AugmentedChain
from pipeline.simulated.bench import ReleasingHand, SimulatedBench, before_stop
from pipeline.simulated.controller import CommandReader, Core, ReferenceCore
from pipeline.simulated.links import open_link
from pipeline.submission.toml import nearest

# ----------------------------------- the carts: a preset with hidden effects, hands and encoders

TRUE_PERIOD = 1.0024e-3  # s between ticks, although the controller assumes 1 ms
REACH = 12.0  # full duty moves the carts by this many travels, so 1 cm is some 300 duty counts
FEWEST_ENCODERS = 2  # a line has two counts, even for a single cart

_ENCODER_NOISE = 0.2  # counts of noise on a free cart's encoder, which flickers between two counts


class VirtualCarts:
    """Carts that move under a motor and hands, one tick at a time.

    The readings of a run depend on the commands so far. They do not depend on the number of ticks
    between runs, which changes if the computer is busy.

    Parameters
    ----------
    seed : seed of the encoders' noise, the hands' tremor and the times of release.
    period : s between ticks.

    Attributes
    ----------
    encoders : number of encoders, at least two. Those without a cart stay at zero.
    """

    def __init__(self, bench: SimulatedBench, *, seed: int, period: float = TRUE_PERIOD) -> None:
        self._bench, self._period = bench, period
        self._model = AugmentedChain(chain=bench.chain, terms=bench.effects)
        self._noise_rng, self._hand_rng = np.random.default_rng(seed).spawn(2)
        n = bench.chain.n
        self.encoders = max(FEWEST_ENCODERS, n)
        self.input_per_count = input_per_count(bench)
        # At power-on, an encoder is at a random position between two counts.
        self._phase = self._noise_rng.uniform(-0.5, 0.5, size=n)
        self.take_in_hand(protocol.Hands())
        self.renew_noise()

    def counts(self) -> tuple[int, ...]:
        """Return the encoder counts since power-on."""
        noise = _ENCODER_NOISE * next(self._noise) * self._shaken
        exact = self._plant.readings / self._bench.count + self._phase + noise
        spare = self.encoders - exact.size
        return (*np.rint(exact).astype(int).tolist(), *(0,) * spare)

    def move(self, duty: int) -> None:
        """Advance by one tick under the motor's duty.

        Raises
        ------
        DataError : the hidden effects make the simulation diverge.
        """
        if self._hand is not None:
            try:
                next(self._hand)
                return
            except StopIteration:
                self._hand = None
        u = duty * self.input_per_count
        self._plant.step(u, following=u, interval=self._period)

    def take_in_hand(self, hands: protocol.Hands) -> None:
        """Bring all carts to rest; hold some, and pull one out for release in the next run."""
        self._started = self._is_out = False
        n = self._bench.chain.n
        free = [cart for cart in range(1, n + 1) if cart not in hands.held]
        self._shaken = np.isin(np.arange(1, n + 1), free).astype(float)
        self._plant = SteppedBench(self._model, free=free)
        self._hand = self._lead(hands.released) if hands.released in free else None

    def start(self) -> None:
        """Tell the hands that a run starts; a cart to be released is then out in any case."""
        while self._hand is not None and not self._is_out:
            next(self._hand)
        self._started = True
        self.renew_noise()

    def renew_noise(self) -> None:
        """Continue with new noise, however much of the old one was used."""
        self._noise = _draw_noise(*self._noise_rng.spawn(1), size=self._phase.size)

    def _lead(self, cart: int) -> Generator[None]:
        """Pull a cart out, hold it until a run has begun, then let go; one tick per step."""
        rng = self._hand_rng
        tremor = rng.uniform(0.0, 2 * np.pi, size=3)
        hand = before_stop(
            ReleasingHand(
                cart=cart,
                position=rng.choice([-1.0, 1.0]) * rng.uniform(1.2, 1.8) * self._bench.travel,
                release=float(rng.uniform(0.3, 0.6)),  # s after the start of a run
                fade=float(rng.uniform(0.01, 0.03)),  # s in which its force falls
                tremor=(float(tremor[0]), float(tremor[1]), float(tremor[2])),
            ),
            self._model,
        )
        out, _ = hand.hold(np.zeros(1))
        for angle in np.linspace(0.0, math.pi, math.ceil(1.5 / self._period)):
            yield self._carry(cart, out * (1.0 - math.cos(angle)) / 2.0)
        self._is_out, held = True, np.zeros(1)
        while held[0] < hand.release:
            held += self._period * self._started
            yield self._carry(cart, hand.hold(held)[0])
        force = self._plant.release(cart, velocity=float(hand.hold(held)[1][0]))
        ticks = math.ceil(hand.fade / self._period)
        for tick in range(ticks):
            # The force of a tick is the mean of the linear fall over this tick.
            push = force * (1.0 - (tick + 0.5) / ticks)
            self._plant.push(cart, push)
            yield self._plant.step(0.0, following=0.0, interval=self._period)
            self._plant.push(cart, -push)

    def _carry(self, cart: int, to: Array) -> None:
        self._plant.move_by_hand(cart, to=float(to[0]), interval=self._period)


def _draw_noise(rng: np.random.Generator, *, size: int) -> Iterator[Array]:
    """Yield standard normal numbers (size,) without end."""
    while True:
        yield from rng.standard_normal((1024, size))


def input_per_count(bench: SimulatedBench) -> float:
    """Return input units per duty count: full scale is 5 times a power of ten.

    Full-scale input would hold the carts at some ten times the travel, so the travel is hundreds of
    duty counts.
    """
    hold = bench.travel / float(np.max(np.abs(bench.chain.static_gains())))
    return 5.0 * 10.0 ** round(math.log10(REACH * hold / 5.0)) / protocol.FULL_SCALE


# ---------------------------------------------------------------------- faults of the line

HOLD = 0.05  # s of the bench's clock for which a late chunk is held back

KINDS = {
    "drop": "the line never comes",
    "garble": "one character of the line becomes one that no line contains",
    "merge": "the line's end is lost, so the next line follows without a break",
    "delay": f"this line and those after it arrive together, {1e3 * HOLD:g} ms late",
    "reset": "the bench's clock restarts during the recording",
    "disconnect": "the cable is pulled: the connection ends",
    "stuck": "from then on the encoder no longer changes",
}
_SYNTAX = re.compile(r"(?P<kind>[a-z]+)(?:=(?P<value>[0-9.e-]+))?(?:@(?P<at>[0-9.]+))?")
_NOISE = b"#?xZ~ \x80\xff"  # no line has these, so a garbled line is always recognised


@dataclass(frozen=True, kw_only=True)
class LineFault:
    """One kind of fault.

    Attributes
    ----------
    rate : share of the lines affected.
    at : time of streaming in s after which the fault occurs once; None for random faults.
    encoder : the encoder that is stuck; 0 for other faults.
    """

    kind: str
    rate: float = 0.0
    at: float | None = None
    encoder: int = 0


def read_fault(text: str) -> LineFault:
    """Read one fault as the user writes it.

    Raises
    ------
    ConfigError : the text is not a fault.
    """
    where = f"--fault {text}"
    match = _SYNTAX.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"{where}: write KIND=RATE, KIND@SECONDS or stuck=ENCODER@SECONDS")
    kind = match["kind"]
    if kind not in KINDS:
        raise ConfigError(f"{where}: no fault {kind!r}{nearest(kind, list(KINDS))}")
    try:
        value = None if match["value"] is None else float(match["value"])
        at = None if match["at"] is None else float(match["at"])
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    if kind == "stuck":
        if value not in (1, 2, 3):
            raise ConfigError(f"{where}: say which encoder and when, as in stuck=1@5")
        return LineFault(kind=kind, at=at or 0.0, encoder=int(value))
    if (value is None) == (at is None):
        raise ConfigError(f"{where}: give a rate, {kind}=0.01, or a time, {kind}@5")
    if value is not None and not 0 <= value <= 1:
        raise ConfigError(f"{where}: a rate is between 0 and 1")
    return LineFault(kind=kind, rate=value or 0.0, at=at)


class Faults:
    """Applies faults to passing lines, at most one fault per line.

    Parameters
    ----------
    period : s between lines.

    Attributes
    ----------
    injected : number of faults of each kind. `late` counts the lines held back by a delay.
    """

    def __init__(self, faults: Sequence[LineFault] = (), *, seed: int, period: float) -> None:
        self._random = [fault for fault in faults if fault.rate > 0]
        timed = [(fault.at, fault) for fault in faults if fault.at is not None]
        self._timed = sorted(timed, key=lambda entry: entry[0])
        self._rng = np.random.default_rng(seed)
        self.injected: Counter[str] = Counter()
        self._period, self._streamed = period, 0.0  # s
        self._stuck: dict[int, bytes | None] = {}  # frozen readings; None: freeze the next one
        self._ms = -1  # stamp of the last line
        self._clock_began = 0  # ms of the run, at the last reset
        self._open = False  # whether the last line has lost its end
        self._held = bytearray()
        self._until = 0.0  # s of the bench's clock, the end of the hold

    def strike(self, line: bytes, *, clock: float) -> tuple[bytes, str]:
        """Return the bytes to send instead of a line, and the kind of fault ("" if none).

        Parameters
        ----------
        clock : time of the bench's clock, s.
        """
        kind = self._choose()
        self._open = kind == "merge"
        line = self._rewritten(line, reset=kind == "reset")
        if kind == "garble":
            at = int(self._rng.integers(len(line) - 1))
            line = line[:at] + bytes([int(self._rng.choice(list(_NOISE)))]) + line[at + 1 :]
        elif kind == "merge":
            line = line[:-1]
        elif kind == "delay":
            self._until = clock + HOLD
        elif kind in ("drop", "disconnect"):
            line = b""
        if clock < self._until:
            self.injected["late"] += bool(line)
        return self.hold(line, clock=clock), kind

    def idle(self, *, clock: float) -> bytes:
        """Return bytes still due while the bench sends no line: a late chunk, a lost line end."""
        end, self._open = b"\n" * self._open, False
        return self.hold(end, clock=clock)

    def hold(self, data: bytes, *, clock: float) -> bytes:
        """Return the bytes to send now: the held data and the new data, or nothing yet.

        An answer must not overtake a delayed line.
        """
        self._held += data
        if not self._held or clock < self._until:
            return b""
        out = bytes(self._held)
        self._held.clear()
        return out

    def _choose(self) -> str:
        """Return the kind of fault for the next line; "" if none."""
        self._streamed += self._period
        while self._timed and self._timed[0][0] <= self._streamed:
            _, fault = self._timed.pop(0)
            self.injected[fault.kind] += 1
            if not fault.encoder:
                return fault.kind
            self._stuck[fault.encoder] = None
        if self._open or not self._random:  # the line after a lost line end is lost already
            return ""
        draw = self._rng.random()
        for fault in self._random:
            if draw < fault.rate:
                if fault.kind == "delay" and self._held:  # the line is late already
                    return ""
                self.injected[fault.kind] += 1
                return fault.kind
            draw -= fault.rate
        return ""

    def _rewritten(self, line: bytes, *, reset: bool) -> bytes:
        """Return the line as changed by stuck encoders and a restarted clock."""
        *counts, target, duty, stamp = line.rstrip().split(b":")
        ms = int(stamp)
        if reset or ms < self._ms:  # or another run has begun
            self._clock_began = ms if reset else 0
        self._ms = ms
        for encoder, shown in self._stuck.items():
            if encoder <= len(counts):
                self._stuck[encoder] = shown = counts[encoder - 1] if shown is None else shown
                counts[encoder - 1] = shown
        return b":".join([*counts, target, duty, b"%d" % (ms - self._clock_began)]) + b"\n"


# ---------------------------------------------------------------------- the bench

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
        core: Callable[[protocol.Description], Core] = ReferenceCore,
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
        self.description = protocol.Description(
            name=re.sub(r"[^\w.-]", "_", bench.name, flags=re.ASCII),
            encoders=self._carts.encoders,
            carts=bench.chain.n,
            period=max(1, round(1e3 * options.period)) / 1e3,
            commands=frozenset() if options.stock else protocol.EXTENSIONS,
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
        self._run_began = 0, 0  # stamp and tick
        self._still_since = 0.0  # s of the bench's clock
        self._start = protocol.Start(
            wave=protocol.Wave.DELTA, frequency=1.0, amplitude=0
        )  # the last start received
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

    @property
    def _stamp(self) -> int:
        """The bench's clock in whole ms, rounded by the ticks since the last start of a run."""
        stamp, tick = self._run_began
        return stamp + int(1e3 * (self._ticks - tick) * self._period)

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
                self._note_command(command)

    def _note_command(self, command: protocol.Command) -> None:
        """Note a command to the controller that concerns the hands or the log."""
        match command:
            case protocol.Start():
                self._end_run("restarted")
                self._start, self._ending = command, ""
                self._run_began = self._stamp, self._ticks
                self._carts.start()
            case protocol.Hands():
                self._carts.take_in_hand(command)
                self._still_since = self._clock
            case protocol.Signal.HEARTBEAT:
                self._heard = time.monotonic()
            case protocol.Signal.STOP:
                self._ending = "stopped"
            case protocol.Signal.RESET:
                self._ending, self._heard = "reset", None
                self._carts.renew_noise()  # this noise decides where the zero is

    def _tick(self) -> bytes:
        """Advance the bench by one tick; return the bytes to send."""
        now = int(1e3 * time.monotonic())
        duty = self._core.tick(self._carts.counts(), stamp=self._stamp, now=now)
        output = self._core.take().splitlines(keepends=True)
        readings = [line for line in output if not line.startswith(b"?")]
        answers = b"".join(line for line in output if line.startswith(b"?"))
        out = self._faults.hold(answers, clock=self._clock)
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
