"""The serial line to a bench: open it, shake hands, send, receive. Nobody else touches a port."""

import re
import time
from collections.abc import Sequence
from typing import Self

import serial
from serial.tools import list_ports

from pipeline.bench.protocol.messages import (
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
from pipeline.errors import DataError, HardwareError

_TRIES, _BETWEEN = 5, 0.4  # s; a bench just plugged in is not there at once
LUMP = 8192  # bytes read at most at a time: what is read within one heartbeat, many times over
_WRITE_TIMEOUT = 0.5  # s
_QUERIES, _ANSWER = 4, 0.6  # s; some boards boot for two seconds when the port is opened
_LOOK = 0.005  # s between looks at the port
FIRST_LINE = 2.0  # s a bench may take to begin
_TRIAL = 0.1  # s of a run that does nothing, to see whether a stock bench is there at all
_NETWORK = re.compile(r"[\w.-]+:\d+|\d+|\[.*\]:\d+")  # a host and a port, or a port, alone
_QUIET = 0.05  # s without a byte: what was under way has arrived


class SerialLine:
    """An open serial line with a bench at its other end.

    Attributes
    ----------
    bench : as it describes itself, or a stock bench.
    """

    def __init__(self, port: "serial.SerialBase", *, name: str) -> None:
        self._port = port
        self._name = name
        self.bench = Description(name="stock", encoders=2, carts=2)
        self._described = b""  # the line in which it describes itself; b"": a stock bench does not
        self._asked = 0  # queries whose answers may still be under way

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the port back."""
        socket = getattr(self._port, "_socket", None)
        self._port.close()
        if socket is not None:  # which pyserial forgets where the other end has hung up
            socket.close()

    def knows(self, letter: str) -> bool:
        """Tell whether the bench knows one of the commands beyond the stock ones."""
        return letter in self.bench.commands

    def send(self, *commands: Command) -> None:
        """Send commands, in order.

        Raises
        ------
        HardwareError : the line is gone.
        """
        data = b"".join(map(encode, commands))
        try:
            self._port.write(data)
        except (serial.SerialException, OSError) as error:
            raise self._gone(error) from None

    def receive(self) -> bytes:
        """Return what has arrived; b"" where nothing has.

        Raises
        ------
        HardwareError : the line is gone.
        """
        try:
            return self._port.read(LUMP)
        except (serial.SerialException, OSError, TypeError) as error:
            # pyserial's POSIX port, closed under a read, raises a TypeError.
            raise self._gone(error) from None

    def stop(self) -> None:
        """Stop whatever the bench does.

        Raises
        ------
        HardwareError : the line is gone.
        """
        self.send(*([Signal.STOP] if self.knows("s") else STOCK_STOP))

    def drain(self, *, longest: float = 1.0) -> bytes:
        """Return what still comes until the line is quiet, s."""
        heard, end = bytearray(), time.monotonic() + longest
        quiet_at = time.monotonic() + _QUIET
        while True:
            data, now = self.receive(), time.monotonic()
            if data:
                heard += data
                quiet_at = now + _QUIET
            if now > min(end, quiet_at):  # seen after a look at the port: this computer may pause
                return bytes(heard)
            time.sleep(_LOOK)

    def clear(self) -> None:
        """Read away all that the bench has sent: what comes from now on answers what is sent next.

        Silence tells nothing, for a busy computer keeps bytes for any while; but what comes behind
        the answer to a query was sent after it. A stock bench answers nothing.

        Raises
        ------
        HardwareError : the line or the bench is gone.
        """
        if not self._described:
            self.drain()
            return
        for _ in range(_QUERIES):
            if self._answer(self._described) is not None:
                return
        raise HardwareError(f"{self._name}: the bench answers no more; is it still switched on?")

    def shake_hands(self) -> None:
        """Stop and zero the bench, and find out what it is.

        Raises
        ------
        HardwareError : nothing there speaks this protocol.
        """
        self.send(*STOCK_STOP)
        before: bytes | None = None
        for _ in range(_QUERIES):
            self.drain()
            if (answer := self._answer()) is None:
                continue
            if answer == before:  # a changed digit of a scale would move every limit
                self._believe(answer)
                return
            before = answer
        if before is not None:
            raise HardwareError(
                f"{self._name}: the bench never describes itself twice alike, last as "
                f"{before[:200]!r}; the line changes what it carries: check cable and baud rate"
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
        """Send a query; return the line that answers it, which begins so, or None.

        Answers to earlier queries may still come, before it; where some came and then none for a
        while, the others are lost.
        """
        self.send(Signal.QUERY)
        self._asked += 1
        heard, answers, end = b"", [], time.monotonic() + _ANSWER
        while len(answers) < self._asked:
            now = time.monotonic()
            heard += self.receive()
            lines = [line for line in heard.split(b"\n")[:-1] if line.startswith(beginning)]
            if len(lines) > len(answers):
                answers, end = lines, now + _ANSWER
            elif now > end:  # seen before a look at the port: this computer may pause
                break
            else:
                time.sleep(_LOOK)
        if not answers:
            return None
        self._asked = 0
        return answers[-1]

    def _try_stock(self) -> None:
        """Have a stock bench stream for a moment, which tells how many encoders it has."""
        self.send(Start(wave=Wave.DELTA, frequency=1 / _TRIAL, amplitude=0))
        heard, end = b"", time.monotonic() + FIRST_LINE
        while not heard and time.monotonic() < end:
            time.sleep(_LOOK)
            heard = self.receive()
        heard += self.drain()
        self.send(Signal.RESET)
        readings = [parse_reading(line) for line in heard.split(b"\n")]
        encoders = [len(reading.counts) for reading in readings if reading is not None]
        if not encoders:
            what = "nothing" if not heard else f"{heard[:40]!r}, which is no line of a bench"
            raise HardwareError(
                f"{self._name}: answers {what}; is this the bench's port, is the bench switched "
                "on, is the baud rate of plan.toml its own, is another program connected to it?"
            )
        usual = max(set(encoders), key=encoders.count)
        self.bench = Description(name="stock", encoders=usual, carts=usual)

    def _gone(self, error: Exception) -> HardwareError:
        return HardwareError(f"{self._name}: the line to the bench is gone ({_plain(error)})")


def open_line(port: str, *, baud: int) -> SerialLine:
    """Open a port and shake hands; `port` is a device or any URL that pyserial knows.

    Raises
    ------
    HardwareError : there is no such port, another program has it, or no bench answers.
    """
    line = SerialLine(_opened(port, baud=baud), name=port)
    try:
        line.shake_hands()
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
            opened.timeout = 0  # a read returns what is there
            opened.write_timeout = _WRITE_TIMEOUT
            opened.exclusive = True if "://" not in port else None
            opened.open()
        except (serial.SerialException, ValueError, OSError) as error:
            failure = _plain(error)
            if isinstance(error, ValueError):  # an URL of no known form: trying again is no use
                break
            continue
        return opened
    raise HardwareError(f"{port}: {_why(failure)}; {_say_ports()}")


def _why(failure: str) -> str:
    small = failure.casefold()
    if any(word in small for word in ("lock", "busy", "resource temporarily")):
        return "another program has this port open; close it (a serial monitor, a second cartlab)"
    if any(word in small for word in ("access", "permission", "denied")):
        return f"this port may not be opened by you or is open in another program ({failure})"
    if any(word in small for word in ("no such file", "filenotfound", "cannot find", "not exist")):
        return "there is no such port; is the bench plugged in?"
    if "refused" in small:
        return "nobody listens there; start the bench (cartlab emulate) first"
    return f"cannot be opened ({failure})"


def _say_ports() -> str:
    ports = port_names()
    return f"ports here: {', '.join(ports)}" if ports else "this machine shows no serial port"


def port_names() -> Sequence[str]:
    """Return the serial ports of this machine, each with what is plugged in there."""
    return [
        f"{port.device} ({port.description})" if port.description != "n/a" else port.device
        for port in sorted(list_ports.comports())
    ]


def _plain(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
