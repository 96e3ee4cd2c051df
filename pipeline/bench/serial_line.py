"""The serial line to a bench: open it, identify the bench, send, receive.

No other module uses a port. Every arriving line is checked: during a run by the session, and
between runs, when the motor must be off, by `poll_idle`.
"""

import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Self

import serial
from serial.tools import list_ports

from pipeline.errors import DataError, HardwareError
from pipeline.protocol import (
    STOCK_STOP,
    Command,
    Description,
    Signal,
    Start,
    Wave,
    encode,
    parse_description,
    parse_reading,
)

# Attempts to open the port, and s between them; a bench just plugged in takes a moment to appear.
_TRIES, _BETWEEN = 5, 0.4
LUMP = 8192  # bytes to read at most at once; far fewer arrive between two heartbeats
# Queries, and s to wait for each answer; some boards restart for two seconds when opened.
_QUERIES, _ANSWER = 4, 0.6
_LOOK = 0.005  # s between two reads of the port
FIRST_LINE = 2.0  # s that a bench may take to send the first line
_NETWORK = re.compile(r"[\w.-]+:\d+|\d+|\[.*\]:\d+")  # a host and a port, or only a port
_QUIET = 0.05  # s without a byte, after which all bytes have arrived


class Runaway(HardwareError):
    """The bench acted without an order; no more orders may be sent to it."""


class SerialLine:
    """An open serial line to a bench.

    Attributes
    ----------
    bench : description of the bench; one that sends no description counts as a stock bench.
    resets : number of resets sent; each sets all counts to zero.
    """

    def __init__(self, port: "serial.SerialBase", *, name: str) -> None:
        self._port = port
        self._name = name
        self.bench = Description(name="stock", encoders=2, carts=2)
        self._described = b""  # the bench's description; b"" for a stock bench, which sends none
        self._asked = 0  # queries whose answers may still arrive
        self.resets = 0
        self._lock = threading.RLock()  # for the port, which `watched` also reads, in a thread
        self._in_run = False
        self._is_cleared = False  # whether all lines that arrive now were sent after the last run
        self._ear = _MotorOnDetector()
        self._runaway: Runaway | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port."""
        socket = getattr(self._port, "_socket", None)
        self._port.close()
        if socket is not None:  # pyserial does not close it if the other end has hung up
            socket.close()

    def knows(self, letter: str) -> bool:
        """Return whether the bench knows a command beyond the stock ones."""
        return letter in self.bench.commands

    def send(self, *commands: Command) -> None:
        """Send commands in order.

        Raises
        ------
        HardwareError : the line is gone.
        Runaway : a run is to start, but the bench has acted without an order before.
        """
        if self._runaway is not None and any(isinstance(c, Start) for c in commands):
            raise self._runaway
        self._write(commands)

    def _write(self, commands: Sequence[Command]) -> None:
        data = b"".join(map(encode, commands))
        with self._lock:
            for command in commands:
                if isinstance(command, Start):
                    self._in_run, self._ear = True, _MotorOnDetector()
                elif command in (Signal.STOP, Signal.RESET):
                    self._in_run = False
                    self.resets += command is Signal.RESET
                self._is_cleared &= not self._in_run
            try:
                self._port.write(data)
            except (serial.SerialException, OSError) as error:
                raise self._gone(error) from None

    def receive(self) -> bytes:
        """Return the bytes that have arrived, or b"".

        Raises
        ------
        HardwareError : the line is gone.
        """
        with self._lock:
            try:
                return self._port.read(LUMP)
            except (serial.SerialException, OSError, TypeError) as error:
                # pyserial raises a TypeError on POSIX if the port is closed during a read.
                raise self._gone(error) from None

    def poll_idle(self) -> bytes:
        """Return the bytes that arrived between runs; if the motor is on, stop it.

        Before `clear`, the motor may seem to be on for a harmless reason: lines of the last run may
        still arrive, or a stop was lost. Then the bench is only stopped again.

        Raises
        ------
        HardwareError : the line is gone.
        Runaway : the motor is on between runs, after `clear`.
        """
        with self._lock:
            data = self.receive()
            if self._in_run or not (duty := self._ear.hear(data)):
                return data
            proven = self._is_cleared
            self.stop()
            if proven:
                self._run_away(f"drives its motor with {duty} duty counts although it should rest")
            return data

    def _run_away(self, why: str) -> None:
        """Raise `Runaway`: the bench acted without an order. Any later start raises it again."""
        self._runaway = Runaway(f"stopped: the bench {why}; switch its motor off and find out why")
        raise self._runaway

    @contextmanager
    def watched(self, report: Callable[[str], None]) -> Iterator[None]:
        """Watch the line in a thread between runs, while a person or the program is busy.

        The thread sends no heartbeat. So if a run hangs, the bench still cuts the motor. At the end
        the bench is stopped once more.

        Parameters
        ----------
        report : called once from the thread, with a message, if the bench acts without an order.
        """
        over = threading.Event()

        def watch() -> None:
            reported = False
            while not over.wait(_LOOK):
                try:
                    with self._lock:
                        if not self._in_run:
                            self.poll_idle()
                except Runaway as runaway:
                    if not reported:
                        report(str(runaway))
                    reported = True
                except HardwareError:  # the next use of the line reports the error
                    return

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            with suppress(HardwareError):
                self.stop()

    def part(self) -> None:
        """Stop the bench at the end of a session, and check that the motor is off.

        Raises
        ------
        HardwareError : the bench is gone.
        Runaway : the motor is on, or has been on since the last run.
        """
        self.stop()
        self.clear()
        self.drain()
        if self._runaway is not None:
            raise self._runaway

    def stop(self) -> None:
        """Stop the motor and the stream of lines.

        Raises
        ------
        HardwareError : the line is gone.
        """
        self._write([Signal.STOP] if self.knows("s") else STOCK_STOP)

    def drain(self, *, longest: float = 1.0) -> bytes:
        """Return the bytes that arrive until the line is quiet.

        Parameters
        ----------
        longest : longest time to wait, in s.
        """
        received, end = bytearray(), time.monotonic() + longest
        quiet_at = time.monotonic() + _QUIET
        while True:
            data, now = self.poll_idle(), time.monotonic()
            if data:
                received += data
                quiet_at = now + _QUIET
            # `now` was read before the port, because this computer may pause between the two.
            if now > min(end, quiet_at):
                return bytes(received)
            time.sleep(_LOOK)

    def clear(self, *, queries: int = _QUERIES) -> None:
        """Discard all that the bench has sent, so that the next bytes answer the next command.

        A silent line proves nothing, because a busy computer may hold bytes back. But bytes that
        follow the answer to a query were sent after the query. A stock bench does not answer
        queries.

        Raises
        ------
        HardwareError : the line or the bench is gone.
        Runaway : the motor is on between runs.
        """
        with self._lock:
            self._in_run = False
            if not self._described:
                self.drain()
            elif all(self._answer(self._described) is None for _ in range(queries)):
                raise HardwareError(
                    f"{self._name}: the bench no longer answers; is it still switched on?"
                )
            self._is_cleared = True

    def identify(self) -> None:
        """Stop the bench, set its counts to zero, and find out what bench it is.

        Raises
        ------
        HardwareError : nothing at the port speaks this protocol.
        Runaway : the motor is on between runs.
        """
        self.send(*STOCK_STOP)
        before: bytes | None = None
        for _ in range(_QUERIES):
            self.drain()
            if (answer := self._answer()) is None:
                continue
            self._is_cleared = True
            # The bench must describe itself twice, because one wrong digit of a scale would change
            # every limit.
            if answer == before:
                self._believe(answer)
                return
            before = answer
        if before is not None:
            raise HardwareError(
                f"{self._name}: the bench describes itself differently each time, last as "
                f"{before[:200]!r}; the line is unreliable: check cable and baud rate"
            )
        self._try_stock()

    def _believe(self, description: bytes) -> None:
        try:
            self.bench = parse_description(description)
        except DataError as error:
            raise HardwareError(f"{self._name}: {error}") from None
        self._described = description
        self.send(Signal.RESET)

    def _answer(self, beginning: bytes = b"?") -> bytes | None:
        """Send a query; return the last answer, or None.

        Answers to earlier queries may arrive first. If no answer arrives for a while, those still
        missing count as lost.

        Parameters
        ----------
        beginning : first bytes of a line that is an answer.
        """
        self.send(Signal.QUERY)
        self._asked += 1
        received, answers, end = b"", [], time.monotonic() + _ANSWER
        while len(answers) < self._asked:
            now = time.monotonic()
            received += self.poll_idle()
            lines = [line for line in received.split(b"\n")[:-1] if line.startswith(beginning)]
            if len(lines) > len(answers):
                answers, end = lines, now + _ANSWER
            # `now` was read before the port, because this computer may pause between the two.
            elif now > end:
                break
            else:
                time.sleep(_LOOK)
        if not answers:
            return None
        self._asked = 0
        return answers[-1]

    def _try_stock(self) -> None:
        """Let a stock bench send lines for a moment, to count its encoders."""
        # A run of 0.1 s without motion makes a stock bench send lines.
        self.send(Start(wave=Wave.DELTA, frequency=1 / 0.1, amplitude=0))
        self._in_run, self._is_cleared = False, True  # the motor must stay off in this run
        received, end = b"", time.monotonic() + FIRST_LINE
        while not received and time.monotonic() < end:
            time.sleep(_LOOK)
            received = self.poll_idle()
        received += self.drain()
        self.send(Signal.RESET)
        readings = [parse_reading(line) for line in received.split(b"\n")]
        encoders = [len(reading.counts) for reading in readings if reading is not None]
        if not encoders:
            what = f"{received[:40]!r}, which is not a line of a bench" if received else "nothing"
            raise HardwareError(
                f"{self._name}: answers {what}. Check that this is the bench's port, the bench is "
                "on, its baud rate is that in plan.toml, and no other program uses the port"
            )
        usual = max(set(encoders), key=encoders.count)
        self.bench = Description(name="stock", encoders=usual, carts=usual)

    def _gone(self, error: Exception) -> HardwareError:
        return HardwareError(f"{self._name}: the line to the bench is gone ({_plain(error)})")


class _MotorOnDetector:
    """Detect that the motor is on, from two lines in a row; a single line may be garbled."""

    def __init__(self) -> None:
        self._tail, self._on = b"", False

    def hear(self, data: bytes) -> int:
        """Return the duty counts that drive the motor; 0 if it is off."""
        if not data:
            return 0
        *lines, self._tail = (self._tail + data).split(b"\n")
        self._tail = self._tail[-512:]  # bytes; more without a line end is noise
        for reading in filter(None, map(parse_reading, lines)):
            before, self._on = self._on, reading.duty != 0
            if before and self._on:
                return reading.duty
        return 0


def open_line(port: str, *, baud: int) -> SerialLine:
    """Open a port and identify the bench.

    Parameters
    ----------
    port : a device, or any URL that pyserial knows.

    Raises
    ------
    HardwareError : there is no such port, another program uses it, or no bench answers.
    """
    line = SerialLine(_opened(port, baud=baud), name=port)
    try:
        line.identify()
    except BaseException:
        line.close()
        raise
    return line


def _opened(port: str, *, baud: int) -> "serial.SerialBase":
    if _NETWORK.fullmatch(port):
        raise HardwareError(f"{port}: a bench on the network is written socket://HOST:PORT")
    failure = ""
    for attempt in range(_TRIES):
        if attempt:
            time.sleep(_BETWEEN)
        try:
            opened = serial.serial_for_url(port, do_not_open=True)
            opened.baudrate = baud
            opened.timeout = 0  # a read returns what has arrived
            opened.write_timeout = 0.5  # s
            opened.exclusive = True if "://" not in port else None
            opened.open()
        except (serial.SerialException, ValueError, OSError) as error:
            failure = _plain(error)
            if isinstance(error, ValueError):  # an unknown kind of URL: another try cannot help
                break
            continue
        return opened
    raise HardwareError(f"{port}: {_why(failure)}; {_say_ports()}")


def _why(failure: str) -> str:
    small = failure.casefold()
    if any(word in small for word in ("lock", "busy", "resource temporarily")):
        return "another program has this port open; close it (a serial monitor, a second cartlab)"
    if any(word in small for word in ("access", "permission", "denied")):
        return f"you may not open this port, or another program has it open ({failure})"
    if any(word in small for word in ("no such file", "filenotfound", "cannot find", "not exist")):
        return "there is no such port; is the bench plugged in?"
    if "refused" in small:
        return "no bench listens there; start one (cartlab emulate) first"
    return f"cannot be opened ({failure})"


def _say_ports() -> str:
    ports = port_names()
    return f"ports here: {', '.join(ports)}" if ports else "no serial port was found here"


def port_names() -> Sequence[str]:
    """Return the serial ports of this computer, each with the name of its device."""
    return [
        f"{port.device} ({port.description})" if port.description != "n/a" else port.device
        for port in sorted(list_ports.comports())
    ]


def _plain(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
