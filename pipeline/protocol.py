"""The messages between host and bench: commands with their waves, and lines of text in reply.

docs/protocol.md specifies the messages in words. A command consists of fields that each end in a
semicolon; its first letter decides which fields follow. The stock bench knows `d`, `g` and `z`. A
bench that answers `?;` lists its extensions.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias, TypeVar

from pipeline.errors import DataError

FULL_SCALE = 4096  # duty counts: 5 V
HEARTBEAT_EVERY = 0.03  # s between heartbeats
WATCHDOG = 0.1  # s after the last heartbeat, at which the bench cuts the motor
PULSE = 0.05  # s; length of the pulse of a delta wave
NOMINAL_PERIOD = 1e-3  # s between lines
CHIRP_SPAN = 20.0  # end frequency of a chirp divided by its start frequency, by default
FREQUENCIES = (1e-3, 1e3)  # Hz; a command with a frequency outside this range is dropped
EXTENSIONS = frozenset("cfhkms")  # commands, except `?`, that the stock bench does not know

# Limits of 32-bit firmware; no bench needs more.
MOST_TONES = 64  # of a multisine
_Read = TypeVar("_Read")
_LONGEST_COUNT = 10  # digits of a count in a line

_LINE = re.compile(rf"(?:-?\d{{1,{_LONGEST_COUNT}}}:){{4,5}}\d{{1,{_LONGEST_COUNT}}}", re.ASCII)


class Wave(StrEnum):
    """The shape of the target over one period 1/FREQ.

    `delta` is a short pulse at the beginning of the period. `square` is zero for half a period,
    then the amplitude. `sine`, `triangle` and `sawtooth` start at zero and swing to both sides.
    `chirp` sweeps the frequency once over the whole run, logarithmically. `multisine` is the sum of
    the stored tones.
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
    """`d`: start a run that lasts cycles/frequency seconds.

    Attributes
    ----------
    encoder : the encoder that the controller follows, 1 or 2; None in open loop.
    frequency : frequency of the wave, in Hz.
    amplitude : duty counts in open loop, encoder counts in closed loop.
    cycles : number of periods of the wave.
    """

    wave: Wave
    encoder: int | None = None
    frequency: float
    amplitude: int
    cycles: int = 1

    @property
    def duration(self) -> float:
        """How long the bench sends lines, in s of its own clock."""
        return self.cycles / self.frequency


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """`g`: set the PID gains for later closed-loop runs.

    duty = kp e + ki ∫e dt + kd de/dt, with e in encoder counts.
    """

    kp: float
    ki: float
    kd: float


@dataclass(frozen=True, kw_only=True)
class StateGains:
    """`f`: set the state feedback for later closed-loop runs.

    duty = prefilter target - gains [x1, v1, x2, v2, …], in counts and counts/s.
    """

    gains: tuple[float, ...]
    prefilter: float


@dataclass(frozen=True, kw_only=True)
class ChirpEnd:
    """`c`: set the end frequency of later chirps, in Hz."""

    frequency: float


@dataclass(frozen=True, kw_only=True)
class Tone:
    """`m`: add one sine to later multisines; harmonic 0 removes all sines stored so far.

    Attributes
    ----------
    harmonic : multiple of the wave's frequency.
    share : amplitude of the sine, relative to that of the wave.
    phase : phase at the start, in rad.
    """

    harmonic: int
    share: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Hands:
    """`h`: let a virtual bench hold some carts by hand, and release one cart in the next run.

    Attributes
    ----------
    released : the cart that is pulled out and released; 0 for none.
    """

    held: tuple[int, ...] = ()
    released: int = 0


class Signal(StrEnum):
    """Commands without fields."""

    RESET = "z"  # stop, set counts and clock to zero, forget the gains
    STOP = "s"
    HEARTBEAT = "k"  # the first one after a reset turns the watchdog on
    QUERY = "?"


Command: TypeAlias = Start | PidGains | StateGains | ChirpEnd | Tone | Hands | Signal

# A stop for benches without `s`: start a run without motion, then reset.
STOCK_STOP: tuple[Command, ...] = (Start(wave=Wave.DELTA, frequency=1.0, amplitude=0), Signal.RESET)


def encode(command: Command) -> bytes:
    """Return the bytes of a command on the line."""
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
            # The first semicolon ends a field that lost its own; the empty field after it ends
            # a command that a lost byte left open.
            fields = ["", "", "s"] if command is Signal.STOP else [command.value]
    return "".join(f"{field};" for field in fields).encode("ascii")


def _number(value: float) -> str:
    return f"{value:.9g}"


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One line from the bench.

    Attributes
    ----------
    counts : the counts of two or three encoders.
    target : duty counts in open loop, encoder counts in closed loop.
    duty : duty counts that drive the motor from this line on.
    ms : whole milliseconds since the start of the run.
    """

    counts: tuple[int, ...]
    target: int
    duty: int
    ms: int


def format_reading(reading: Reading) -> bytes:
    """Return the bytes of a line, including its end."""
    fields = (*reading.counts, reading.target, reading.duty, reading.ms)
    return (":".join(map(str, fields)) + "\n").encode("ascii")


def parse_reading(line: bytes) -> Reading | None:
    """Return the content of a line, with or without a line end; None if it cannot be read."""
    text = line.decode("latin-1").rstrip("\r\n")
    if not _LINE.fullmatch(text):
        return None
    *counts, target, duty, ms = map(int, text.split(":"))
    return Reading(counts=tuple(counts), target=target, duty=duty, ms=ms)


@dataclass(frozen=True, kw_only=True)
class Description:
    """A bench's description of itself: its answer to `?;`, a line that starts with `?`.

    Attributes
    ----------
    name : name of the bench, one word.
    encoders : number of encoder counts in a line, two or three.
    carts : number of encoders that are on carts.
    period : nominal time between lines, in s.
    commands : letters of the commands that a stock bench lacks. With `c` the bench also knows the
        chirp, and with `m` the multisine.
    input_unit, input_per_count : unit of the input, and its value per duty count.
    position_unit, position_per_count : unit of the positions, and its value per encoder count.
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
    """Return the description in an answer to a query.

    Raises
    ------
    DataError : the line is not a description, or has a version that this program does not know.
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
    """Split text such as "0.00227cm" into number and unit."""
    digits = len(text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ/%"))
    # A scale of zero or infinity gives no useful limit.
    if not 0.0 < abs(number := float(text[:digits])) < math.inf:
        raise ValueError(repr(text))
    return number, text[digits:]


def target_at(
    start: Start, t: float, *, chirp_end: float | None = None, tones: Sequence[Tone] = ()
) -> int:
    """Return the target `t` s after the start, in duty counts (open loop) or encoder counts.

    Parameters
    ----------
    chirp_end : end frequency of a chirp, in Hz; by default `CHIRP_SPAN` times the start frequency.
    tones : sines of a multisine.
    """
    return nearest_count(start.amplitude * shape_at(start, t, chirp_end=chirp_end, tones=tones))


def nearest_count(value: float) -> int:
    """Round to a whole count, halves up."""
    return math.floor(value + 0.5)


def shape_at(
    start: Start, t: float, *, chirp_end: float | None = None, tones: Sequence[Tone] = ()
) -> float:
    """Return the wave for an amplitude of one; see `target_at`."""
    turns = t * start.frequency
    phase = turns - math.floor(turns)
    match start.wave:
        case Wave.DELTA:
            return float(phase < PULSE * start.frequency)
        case Wave.SQUARE:
            return float(phase >= 0.5)
        case Wave.SINE:
            return math.sin(2 * math.pi * phase)
        case Wave.TRIANGLE:
            return 1.0 - 4.0 * abs((phase + 0.25) % 1.0 - 0.5)
        case Wave.SAWTOOTH:
            return 2.0 * phase - (2.0 if phase >= 0.5 else 0.0)
        case Wave.CHIRP:
            return math.sin(2 * math.pi * _chirp_turns(start, t, chirp_end))
        case Wave.MULTISINE:
            return sum(
                tone.share * math.sin(2 * math.pi * tone.harmonic * phase + tone.phase)
                for tone in tones
            )


def _chirp_turns(start: Start, t: float, chirp_end: float | None) -> float:
    """Return the number of periods of a chirp until `t`; its frequency grows exponentially."""
    span = CHIRP_SPAN if chirp_end is None else chirp_end / start.frequency
    if span == 1.0:
        return start.frequency * t
    growth_time = start.duration / math.log(span)  # s in which the frequency grows e-fold
    return start.frequency * growth_time * math.expm1(t / growth_time)
