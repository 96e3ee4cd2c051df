"""Carry out runs on the bench, one at a time: rest, start, check every line, and always stop.

One loop carries out a run. Every few milliseconds it reads the port, writes the bytes to the raw
file, sends the heartbeat, and checks the lines against the limits and the wave. The period of rest
before a run works in the same way. The loop has no thread of its own: if the program hangs, the
heartbeat ends and the bench cuts its motor.
"""

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from pipeline.bench.events import Action, Buttons, Observer, RunOutcome, Stopped
from pipeline.bench.orders import Order
from pipeline.bench.raw import RawHeader, RawWriter
from pipeline.bench.serial_line import FIRST_LINE, LUMP, Runaway, SerialLine
from pipeline.bench.stamps import OTHER_PERIOD
from pipeline.bench.stream import Stream
from pipeline.errors import HardwareError
from pipeline.experiments.plan import PlanLimits, Recording, hold_words
from pipeline.protocol import HEARTBEAT_EVERY, WATCHDOG, Command, Hands, Reading, Signal, encode


class LineWatch:
    """Check each line against the limits and the wave of an order.

    Parameters
    ----------
    carts : number of carts whose travel is watched; 0 if the zero of the counts is not reliable.
    period : ms between lines; None for a stock bench, because its wave is not known to the ms.

    Attributes
    ----------
    is_astray : whether the motor's duty differed from the order.
    is_too_far : whether a cart was farther from its zero than the limit allows.
    is_unsafe : whether the run was stopped because it was not safe to continue.
    """

    def __init__(self, order: Order, *, carts: int, period: float | None) -> None:
        self._order = order
        self._carts = carts
        self._period = period
        self._strays, self._drives_off = _InARow(), _InARow()
        self._before: Reading | None = None
        self.is_astray = self.is_too_far = self.is_unsafe = False

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the run must stop, or ""."""
        for reading in batch:
            if trouble := self._trouble(reading):
                return trouble
        return ""

    def stop(self, why: str) -> str:
        """Mark the run as unsafe; return the message for its end."""
        self.is_unsafe = True
        return f"stopped: {why}"

    def _trouble(self, reading: Reading) -> str:
        order = self._order
        off = order.drives_off(reading, before=self._before or reading)
        self._before = reading
        if passed := order.passed(reading, carts=self._carts):
            self.is_too_far = bool(order.too_far(reading, carts=self._carts))
            self.is_astray = off
            return self.stop(passed)
        if self._period is not None:
            strays = order.strays(reading, period=self._period)
            if self._strays.lasts(strays, ms=reading.ms):
                return (
                    f"the bench does not follow the wave that was ordered: {reading.target} counts "
                    f"at {1e-3 * reading.ms:.3f} s; a digit changed on the line"
                )
        if self._drives_off.lasts(off, ms=reading.ms):
            self.is_astray = True
            return self.stop(
                f"the bench drives its motor with {reading.duty} duty counts instead "
                f"of {reading.target}, at {1e-3 * reading.ms:.3f} s"
            )
        return ""


class _InARow:
    """Distinguish a condition that lasts two or more lines from a single garbled line."""

    def __init__(self) -> None:
        self._since: int | None = None  # ms of the first line with the condition

    def lasts(self, shows: bool, *, ms: int) -> bool:
        """Return whether the condition has lasted for two or more lines.

        Parameters
        ----------
        shows : whether this line meets the condition.
        """
        if not shows:
            self._since = None
        elif self._since is None:
            self._since = ms
        else:
            return ms - self._since >= 4  # at least two lines, or five at 1 kHz
        return False


class RunWatch(LineWatch):
    """Check the lines of a run, and pass them to the observer in batches."""

    def __init__(
        self,
        order: Order,
        *,
        carts: int,
        period: float | None,
        stream: Stream,
        observer: Observer,
        let_in: Callable[[], None],
    ) -> None:
        super().__init__(order, carts=carts, period=period)
        self._stream = stream
        self._observer = observer
        self._let_in = let_in
        self._batch: list[Reading] = []
        self._forwarded = time.monotonic()

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the run must stop, or ""."""
        self._let_in()
        self._batch += batch
        if trouble := super().check(batch):
            return trouble  # the stop must be sent before any observer is informed
        now = time.monotonic()
        if now - self._forwarded > 0.05:
            self._forwarded = now
            self.forward(())
        return ""

    def forward(self, batch: Sequence[Reading]) -> None:
        """Pass the waiting lines and a new batch to the observer."""
        waiting, self._batch = [*self._batch, *batch], []
        if waiting:
            self._observer.readings(waiting, self._stream.anomalies())


class RestWatch(LineWatch):
    """Check the lines while the carts come to rest, and keep the last ones.

    Parameters
    ----------
    since : time in ms from which lines are kept.
    """

    def __init__(self, order: Order, *, carts: int, period: float | None, since: float) -> None:
        super().__init__(order, carts=carts, period=period)
        self._since = since
        self._readings: list[Reading] = []

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the wait must stop, or ""."""
        self._readings += [reading for reading in batch if reading.ms >= self._since]
        return super().check(batch)

    @property
    def last(self) -> Reading | None:
        """The last line kept; None before the first."""
        return self._readings[-1] if self._readings else None

    @property
    def swings(self) -> list[int]:
        """The range of each encoder in the kept lines, in counts."""
        columns = zip(*(reading.counts for reading in self._readings), strict=True)
        return [max(column) - min(column) for column in columns]


SILENCE = 0.5  # s without a byte during a run, after which the bench counts as gone
# ms of tolerance around the planned end: earlier silence is a fault, and so are later lines.
_NEARLY = 100.0
# Counts by which a resting cart may flicker; in a valid run a free cart moves more.
_STILL = 4
_LOOK = 0.003  # s between two reads of the port
_AFTER_END = 0.02  # s within which the last lines arrive


@contextmanager
def _no_collection() -> Iterator[None]:
    """Turn off Python's garbage collection, which takes 0.1 s with all lines of a run in memory."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class Session:
    """Carries out runs on one bench; remembers which carts are held and the bench's true period.

    Parameters
    ----------
    carts : number of carts in the submission. A bench that describes itself may have more carts;
        their travel is watched too.
    buttons : a person's buttons, checked before anything moves and at every read of the port.

    Attributes
    ----------
    wish : the button that ended the run or the wait before it; None if no button did.
    """

    def __init__(
        self,
        line: SerialLine,
        *,
        carts: int,
        limits: PlanLimits,
        observer: Observer,
        buttons: Buttons | None = None,
    ) -> None:
        self._line = line
        self._buttons = buttons or Buttons()
        self._carts = carts
        self._limits = limits
        self._observer = observer
        self._moving = max(carts, line.bench.carts) if line.bench.commands else carts
        self._period = 1e3 * line.bench.period
        self._zeroed_at = -1  # `resets` of the line when the carts were last zeroed at rest
        self._swings_out = False  # the last run moved a cart too far
        self._free: tuple[int, ...] | None = None  # the carts that a person was last asked to free
        self._beat = float("-inf")
        self._latest_beat = 0.0  # s; the longest time without a heartbeat in this run
        self.wish: Action | None = None

    def prepare(self, order: Order) -> str:
        """Have carts held as ordered, wait until all rest, and have a cart pulled out for release.

        Returns a message if the carts still move, or "".

        Raises
        ------
        HardwareError : the line failed, or the wait ended early.
        ConfigError : nobody can confirm that the carts are held.
        Runaway : the motor is on or a cart is too far out, although no run was ordered.
        """
        recording = order.recording
        self.wish = None
        self._buttons.offer("skip")
        held = tuple(cart for cart in range(1, self._carts + 1) if cart not in recording.carts)
        if self._line.knows("h"):
            self._line.send(Hands(held=held))
        elif recording.carts != self._free:
            words = hold_words(recording.carts, n=self._carts)
            self._observer.confirm(words[0].upper() + words[1:])
            self._free = recording.carts
        restless = self._rest(order)
        if self._line.knows("h"):
            if recording.release:
                self._line.send(Hands(held=held, released=recording.release))
                time.sleep(1.7)  # s that a virtual hand takes to pull a cart out
        elif recording.release:
            self._observer.confirm(
                f"Pull cart {recording.release} out, by less than limits.travel "
                f"({self._limits.travel:g}), and hold it still. Let it go once the recording has "
                "begun"
            )
        return restless

    def record(
        self, order: Order, path: Path, *, let_in: Callable[[], None] = lambda: None
    ) -> RunOutcome:
        """Carry out one run and write its raw file.

        A limit, a fault of the line, Ctrl-C or a signal may end the run early. In any case the
        bench is stopped and the data are in the file. Interrupts are raised again.

        Parameters
        ----------
        let_in : function that raises an interrupt that was held back; called while lines arrive.
            After the last line the run is complete, and interrupts are held.
        """
        recording = order.recording
        stream = self._stream(recording.carts, closed=recording.controller is not None)
        watch = RunWatch(
            order,
            carts=self._moving,
            period=self._stated,
            stream=stream,
            observer=self._observer,
            let_in=let_in,
        )

        def begin() -> None:
            self._buttons.offer("skip", "keep", "repeat")
            self._observer.started(recording)

        with RawWriter(path, self._header(order)) as raw:
            try:
                partial = self._carry_out(
                    order,
                    stream,
                    seconds=recording.duration,
                    begin=begin,
                    arrived=raw.write,
                    watch=watch,
                )
            except HardwareError as error:
                partial = str(error)
                watch.is_astray |= isinstance(error, Runaway)
        self._swings_out = watch.is_too_far
        watch.forward(stream.finish())
        if not partial and recording.controller is None and stream.widest <= _STILL:
            partial = "no free cart moved: is one held, is an encoder unplugged, is the motor off?"
        fit = stream.fit()
        if stream.lines > 1000 and not partial:  # enough to determine the period of a clock
            self._report_other_period(fit.period)
            self._period = fit.period
        return RunOutcome(
            recording=recording,
            lines=stream.lines,
            anomalies=stream.anomalies(fit),
            partial=partial,
            is_astray=watch.is_astray,
            is_unsafe=watch.is_unsafe,
            wish=self.wish,
        )

    def _header(self, order: Order) -> RawHeader:
        return RawHeader(
            recording=order.recording,
            limits=self._limits,
            commands=tuple(encode(command).decode() for command in order.commands),
            bench=self._line.bench,
            begun=datetime.now().astimezone().isoformat(timespec="seconds"),
        )

    @property
    def _stated(self) -> float | None:
        """The ms between lines, if the bench's wave is known to the ms; None for a stock bench."""
        return self._period if self._line.bench.commands else None

    def _report_other_period(self, period: float) -> None:
        """Report once if the measured `period` of the bench (ms) differs from the stated one."""
        stated = 1e3 * self._line.bench.period
        if not self._line.bench.commands or abs(self._period / stated - 1) > OTHER_PERIOD:
            return
        if abs(period / stated - 1) > OTHER_PERIOD:
            self._observer.remark(
                f"the bench states that it sends a line every {stated:.3g} ms, but it sends one "
                f"every {period:.3g} ms. The times in the data are right, but its controller uses "
                "the stated period: correct that period"
            )

    def _stream(self, free: Sequence[int], *, closed: bool = False) -> Stream:
        watched = tuple(cart for cart in free if cart <= self._carts)
        bench = self._line.bench
        return Stream(
            encoders=bench.encoders,
            period=self._period,
            stated=bool(bench.commands),
            free=watched,
            closed=closed,
        )

    def _rest(self, order: Order) -> str:
        """Wait until the carts rest, in a run with the motor off that reports their positions.

        Returns a message if the carts still move, or "".
        """
        recording = order.recording
        if recording.settle <= 0:
            return ""
        nothing, moving = order.rest(), dict[int, int]()
        for _ in range(4):
            self._observer.settling(recording, recording.settle)
            watch = RestWatch(
                nothing,
                # Carts that were moved too far swing back without an order.
                carts=0 if self._swings_out else self._zeroed,
                period=self._stated,
                # The last half second, in which the carts must be at rest.
                since=1e3 * recording.settle - 500,
            )
            self._watch_rest(nothing, watch)
            self._swings_out = False
            moving = {
                cart: swing
                for cart, swing in enumerate(watch.swings[: self._carts], start=1)
                if swing > _STILL
            }
            if not moving:
                if watch.last and (why := order.too_far(watch.last, carts=self._zeroed)):
                    raise Runaway(f"stopped: at rest, {why}")
                self._zero_at_rest(recording)
                return ""
        swings = ", ".join(f"cart {cart} moved by {swing} counts" for cart, swing in moving.items())
        return f"not at rest when the recording began: {swings} within half a second"

    def _watch_rest(self, nothing: Order, watch: LineWatch) -> None:
        """Wait for the carts to settle while `watch` checks the lines.

        Raises
        ------
        HardwareError : the wait ended early.
        Runaway : the wait ended early because the bench acted without an order.
        """
        settle = nothing.recording.settle
        trouble = self._carry_out(nothing, self._stream(()), seconds=settle, watch=watch)
        if trouble:
            kind = Runaway if watch.is_astray or watch.is_too_far else HardwareError
            raise kind(f"while the carts came to rest, {trouble}")

    @property
    def _zeroed(self) -> int:
        """The number of carts with a reliable zero: all after a reset at rest, otherwise 0."""
        return self._moving if self._line.resets == self._zeroed_at else 0

    def _zero_at_rest(self, recording: Recording) -> None:
        """Set the counts to zero before the motor's first run on this line, while the carts rest.

        The carts may have been swinging when the line was opened, so their positions at that
        moment cannot be the zeros for the travel limit. Before a release by hand, the counts are
        not set to zero, because a cart held by hand is never exactly at rest.
        """
        if self._zeroed or not recording.amplitude:
            return
        self._line.send(Signal.RESET)
        self._line.drain()
        # A reset disarms the watchdog, so a heartbeat must follow at once.
        self._beat = float("-inf")
        self._zeroed_at = self._line.resets

    def _read_buttons(self) -> str:
        """Return why a person wants to end this run, or "".

        Raises
        ------
        Stopped : the person wants to end the whole session.
        """
        self.wish = self._buttons.pressed
        match self.wish:
            case "stop":
                raise Stopped("by hand")
            case "skip":
                return "skipped by hand"
            case "keep":
                return "ended by hand"
            case "repeat":
                return "ended by hand, to be repeated"
            case None:
                return ""

    def _carry_out(
        self,
        order: Order,
        stream: Stream,
        *,
        seconds: float,
        watch: LineWatch,
        begin: Callable[[], None] = lambda: None,
        arrived: Callable[[bytes], None] = lambda data: None,
    ) -> str:
        """Start a run and read its lines to the end; return why it ended early, or "".

        The bench is stopped in any case.
        """
        partial = "stopped"
        try:
            self._start(order.commands)
            begin()
            partial = self._listen(stream, seconds=seconds, arrived=arrived, watch=watch)
        finally:
            self._stop(always=bool(partial))
        return partial

    def _start(self, commands: Sequence[Command]) -> None:
        if why := self._read_buttons():
            raise HardwareError(why)
        self._line.clear()  # discard lines of an earlier run
        self._heartbeat()
        self._latest_beat = 0.0
        self._line.send(*commands)

    def _heartbeat(self) -> None:
        now = time.monotonic()
        if self._line.knows("k") and now - self._beat > HEARTBEAT_EVERY - _LOOK:
            self._line.send(Signal.HEARTBEAT)
            self._latest_beat = max(self._latest_beat, now - self._beat)
            self._beat = now

    def _lateness(self) -> str:
        """Return a message if heartbeats were so late that the bench cut its motor, or ""."""
        if self._latest_beat < WATCHDOG:
            return ""
        return (
            f": this computer was too busy and sent no heartbeat for {1e3 * self._latest_beat:.0f} "
            "ms, so the bench cut its motor; close other programs"
        )

    def _stop(self, *, always: bool) -> None:
        """Stop the bench and discard the lines that still arrive.

        On a stock bench, a stop also sets the counts to zero, so it is sent only after a run that
        ended early.
        """
        try:
            try:
                if always or self._line.knows("s"):
                    self._line.stop()
            except KeyboardInterrupt:  # pressed a second time: stop the bench first
                self._line.stop()
                raise
        except HardwareError as error:
            guard = "" if self._line.knows("k") else "; the motor may be on: switch it off"
            self._observer.remark(f"the stop could not be sent: {error}{guard}")
            return
        with suppress(HardwareError):  # the next start reports the error
            self._line.clear(queries=1)

    @_no_collection()
    def _listen(
        self,
        stream: Stream,
        *,
        seconds: float,
        watch: LineWatch,
        arrived: Callable[[bytes], None],
    ) -> str:
        """Read lines until the run has ended; return why it ended early, or ""."""
        end = 1e3 * seconds
        since = last = time.monotonic()
        first: int | None = None  # ms of the first line
        # When lines stopped being valid, in s; None while they are valid.
        unread: float | None = None
        while True:
            self._heartbeat()
            now = time.monotonic()
            if data := self._line.receive():
                arrived(data)
                last = now
                lines = stream.feed(data, since=since, now=now)
                if trouble := watch.check(lines):
                    return trouble
                if stream.broken:
                    return stream.broken
                if lines:
                    first, unread = lines[0].ms if first is None else first, None
                    if lines[-1].ms - first > end + _NEARLY:
                        return watch.stop("the bench went on past the end of the recording")
                else:
                    unread = now if unread is None else unread
                    if now - unread > 0.25:  # s; the motor may be on while nothing is checked
                        return watch.stop(
                            "the bench's lines cannot be read, so no limit is watched"
                        )
            if why := self._read_buttons():  # after the limits, whose messages are more important
                return why
            quiet = now - last
            if stream.latest >= end - 2 * self._period and quiet > _AFTER_END:
                return ""
            if stream.latest >= end - _NEARLY and quiet > 2 * _AFTER_END + SILENCE / 2:
                return ""
            if quiet > (SILENCE if stream.latest >= 0 else FIRST_LINE):
                return (
                    f"the bench fell silent after {1e-3 * stream.latest:.3f} s{self._lateness()}"
                    if stream.latest >= 0
                    else "the bench did not begin to stream"
                )
            if len(data) < LUMP:  # no more bytes are waiting
                since = now
                time.sleep(_LOOK)
