"""The messages between host and bench: one command or one line of text at a time.

docs/protocol.md specifies it in words. Commands are fields that each end in a semicolon; the first
letter defines the others. The stock bench knows `d`, `g` and `z`; a bench that answers `?;` lists
its extensions.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias, TypeVar

from pipeline.errors import DataError

FULL_SCALE = 4096  # duty counts: 5 V
HEARTBEAT_EVERY = 0.03  # s
WATCHDOG = 0.1  # s after the last heartbeat the motor is cut
PULSE = 0.05  # s a delta wave is on
NOMINAL_PERIOD = 1e-3  # s between lines
CHIRP_SPAN = 20.0  # the default ratio of a chirp's end frequency to its start
FREQUENCIES = (1e-3, 1e3)  # Hz, of a wave; a command with another frequency is dropped
EXTENSIONS = frozenset("cfhkms")  # the commands, except `?`, that the stock bench does not know

# The limits of 32-bit firmware; no bench needs more.
MOST_TONES = 64  # of a multisine
_Read = TypeVar("_Read")
_LONGEST_COUNT = 10  # digits of a field of a line

_LINE = re.compile(rf"(?:-?\d{{1,{_LONGEST_COUNT}}}:){{4,5}}\d{{1,{_LONGEST_COUNT}}}", re.ASCII)


class Wave(StrEnum):
    """The shape of the target over one period 1/FREQ.

    delta is a short pulse as the period begins; square is zero for half a period, then the
    amplitude; sine, triangle and sawtooth start at zero and swing to both sides; chirp sweeps once,
    logarithmically, over the whole run; multisine is the sum of the stored tones.
    `pipeline.bench.protocol.waves` has the formulas.
    """

    DELTA = "d"
    SQUARE = "q"
    SINE = "s"
    TRIANGLE = "t"
    SAWTOOTH = "w"
    CHIRP = "c"
    MULTISINE = "m"


@dataclass(frozen=True, kw_only=True)
class Start:
    """`d`: start a run of cycles/frequency seconds.

    Attributes
    ----------
    encoder : 1 or 2, whose count a PID follows; None: open loop.
    frequency : Hz.
    amplitude : duty counts in open loop, encoder counts in closed loop.
    cycles : periods of the wave.
    """

    wave: Wave
    encoder: int | None = None
    frequency: float
    amplitude: int
    cycles: int = 1

    @property
    def duration(self) -> float:
        """How long the bench streams, s of its clock."""
        return self.cycles / self.frequency


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """`g`: the PID gains of later closed-loop starts.

    duty = kp e + ki ∫e dt + kd de/dt, with e in encoder counts.
    """

    kp: float
    ki: float
    kd: float


@dataclass(frozen=True, kw_only=True)
class StateGains:
    """`f`: duty = prefilter target - gains [x1, v1, x2, v2, …], counts and counts/s."""

    gains: tuple[float, ...]
    prefilter: float


@dataclass(frozen=True, kw_only=True)
class ChirpEnd:
    """`c`: the end frequency of later chirps, Hz."""

    frequency: float


@dataclass(frozen=True, kw_only=True)
class Tone:
    """`m`: one sine of later multisines; harmonic 0 clears those stored so far.

    Attributes
    ----------
    harmonic : of the wave's frequency.
    share : its amplitude relative to the wave's.
    phase : rad, at the start.
    """

    harmonic: int
    share: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Hands:
    """`h`: a virtual bench's hands hold some carts and, in the next run, release one.

    Attributes
    ----------
    held : the held carts.
    released : the cart pulled out and released; 0: none.
    """

    held: tuple[int, ...] = ()
    released: int = 0


class Signal(StrEnum):
    """Commands without fields."""

    RESET = "z"  # stop, count and clock from zero, forget gains
    STOP = "s"
    HEARTBEAT = "k"  # the first one after a reset arms the watchdog
    QUERY = "?"


Command: TypeAlias = Start | PidGains | StateGains | ChirpEnd | Tone | Hands | Signal

# A bench without `s` is stopped by a run that does nothing, then reset.
STOCK_STOP: tuple[Command, ...] = (Start(wave=Wave.DELTA, frequency=1.0, amplitude=0), Signal.RESET)


def encode(command: Command) -> bytes:
    """Return a command as it is sent over the line."""
    match command:
        case Start(wave=wave, encoder=encoder):
            loop = "o" if encoder is None else "c"
            fields = ["d", wave, loop, "t" if encoder == 2 else "o"]
            fields += [_number(command.frequency), str(command.amplitude), str(command.cycles)]
        case PidGains(kp=kp, ki=ki, kd=kd):
            fields = ["g", *map(_number, (kp, ki, kd))]
        case StateGains(gains=gains, prefilter=prefilter):
            fields = ["f", *map(_number, (*gains, prefilter))]
        case ChirpEnd(frequency=frequency):
            fields = ["c", _number(frequency)]
        case Tone(harmonic=harmonic, share=share, phase=phase):
            fields = ["m", str(harmonic), _number(share), _number(phase)]
        case Hands(held=held, released=released):
            fields = ["h", str(sum(1 << (cart - 1) for cart in held)), str(released)]
        case Signal():
            # The empty field ends a command left open by a lost byte; stock benches have no stop.
            fields = ["", "s"] if command is Signal.STOP else [command.value]
    return "".join(f"{field};" for field in fields).encode("ascii")


def _number(value: float) -> str:
    return f"{value:.9g}"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One line of the stream.

    Attributes
    ----------
    counts : of the encoders, two or three.
    target : duty counts in open loop, encoder counts in closed loop.
    duty : duty counts that act from now on.
    ms : whole milliseconds since the start of the run.
    """

    counts: tuple[int, ...]
    target: int
    duty: int
    ms: int


def format_reading(reading: Reading) -> bytes:
    """Return the line, its end included."""
    fields = (*reading.counts, reading.target, reading.duty, reading.ms)
    return (":".join(map(str, fields)) + "\n").encode("ascii")


def parse_reading(line: bytes) -> Reading | None:
    """Return the content of a line, with or without its end; None: not a line of the stream."""
    text = line.decode("latin-1").rstrip("\r\n")
    if not _LINE.fullmatch(text):
        return None
    *counts, target, duty, ms = map(int, text.split(":"))
    return Reading(counts=tuple(counts), target=target, duty=duty, ms=ms)


@dataclass(frozen=True, kw_only=True)
class Description:
    """A bench's answer to `?;`: its description, on one line that starts with a question mark.

    Attributes
    ----------
    name : in one word.
    encoders : number of fields that are counts: two or three.
    carts : how many of them are carts.
    period : nominal s between lines.
    baud : of the line.
    commands : the letters known beyond the stock ones, with `c` also for the chirp and `m` for the
        multisine.
    input_unit, input_per_count : the input in its unit is this times the duty counts.
    position_unit, position_per_count : likewise of the encoders.
    """

    name: str
    encoders: int
    carts: int
    period: float = NOMINAL_PERIOD
    baud: int = 115_200
    commands: frozenset[str] = frozenset()
    input_unit: str = "V"
    input_per_count: float = 5.0 / FULL_SCALE
    position_unit: str = "count"
    position_per_count: float = 1.0


def format_description(bench: Description) -> bytes:
    """Return the answer to a query."""
    entries = {
        "name": bench.name,
        "encoders": bench.encoders,
        "carts": bench.carts,
        "period": repr(bench.period),
        "baud": bench.baud,
        "commands": "".join(sorted(bench.commands)),
        "input": f"{bench.input_per_count!r}{bench.input_unit}",
        "position": f"{bench.position_per_count!r}{bench.position_unit}",
    }
    text = " ".join(f"{key}={value}" for key, value in entries.items())
    return f"?cartlab/1 {text}\n".encode("ascii")


def parse_description(line: bytes) -> Description:
    """Read the answer to a query.

    Raises
    ------
    DataError : it is not a description, or of a version this program does not know.
    """
    text = line.decode("ascii", "replace").strip()
    head, *words = text.split(" ")
    entries = {key: value for key, _, value in (word.partition("=") for word in words)}
    if head != "?cartlab/1":
        raise DataError(f"the bench answers {text[:60]!r}, which is not a description of a bench")

    def read(key: str, kind: Callable[[str], _Read]) -> _Read:
        try:
            return kind(entries[key])
        except (KeyError, ValueError) as error:
            why = f"{key}: {str(error)[:60]} is wrong"
            raise DataError(f"the bench describes itself as {text[:200]!r}: {why}") from None

    input_per_count, input_unit = read("input", _scaled)
    position_per_count, position_unit = read("position", _scaled)
    return Description(
        name=read("name", str),
        encoders=read("encoders", {"2": 2, "3": 3}.__getitem__),
        carts=read("carts", {"1": 1, "2": 2, "3": 3}.__getitem__),
        period=abs(read("period", _scaled)[0]),
        baud=read("baud", int),
        commands=read("commands", frozenset),
        input_unit=input_unit,
        input_per_count=input_per_count,
        position_unit=position_unit,
        position_per_count=position_per_count,
    )


def _scaled(text: str) -> tuple[float, str]:
    """Split "0.00227cm" into the number and the unit."""
    digits = len(text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ/%"))
    if not 0.0 < abs(number := float(text[:digits])) < math.inf:  # of no use to a limit
        raise ValueError(repr(text))
    return number, text[digits:]
