"""A bench's controller between serial line and motor: a state machine with one step per period.

docs/protocol.md specifies the state machine in words and formulas.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from pipeline import protocol
from pipeline.plant.sampled_loop import VELOCITY_CORRECTION

# Limits of 32-bit firmware; no bench needs more.
_LONGEST_FIELD = 32  # characters
_LARGEST_NUMBER = 1e9
_LARGEST_AMPLITUDE = 1_000_000
_MOST_PHASE = 10.0  # rad; more than one turn
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d+", re.ASCII)


class CommandReader:
    """Split the bytes that arrive at a bench into commands; count and drop anything else.

    A field that does not fit ends the current command, and may begin a new one. A lost byte must
    never hide a stop. So a field that ends in the letter of a stop or a reset counts as that
    command, whatever noise precedes the letter. In a start, `s` means a sine; if the next field
    does not fit, this `s` counts as a stop.

    Parameters
    ----------
    encoders : number of encoders of the bench; state feedback has two gains for each.
    extensions : letters of the commands that the stock bench does not know. Without any, the bench
        has no query either.
    """

    def __init__(self, *, encoders: int, extensions: Collection[str] = protocol.EXTENSIONS) -> None:
        self._kinds = _field_kinds(encoders, extensions)
        self._halts = tuple(
            {protocol.Signal.STOP.value, protocol.Signal.RESET.value} & self._kinds.keys()
        )
        self._rest = ""
        self._letter = ""
        self._values: list[str | float] = []
        self.rejected = 0

    def feed(self, data: bytes) -> list[protocol.Command]:
        """Return the commands that are now complete, in order."""
        *whole, rest = (self._rest + data.decode("latin-1")).split(";")
        # if the field is longer, it is refused anyway
        self._rest = rest[-_LONGEST_FIELD - 1 :]
        return [command for field in whole for command in self._take(field.strip(" \t\r\n"))]

    def _take(self, field: str) -> list[protocol.Command]:
        broken_off: list[protocol.Command] = []
        if self._letter:
            try:
                self._values.append(self._kinds[self._letter][len(self._values)](field))
            except ValueError:
                broken_off = self._break_off()
        if not self._letter:
            if field not in self._kinds:
                self.rejected += bool(field)
                if not field.endswith(self._halts):
                    return broken_off
                field = field[-1]
            self._letter, self._values = field, []
        if len(self._values) < len(self._kinds[self._letter]):
            return broken_off
        letter, self._letter = self._letter, ""
        return [*broken_off, _command(letter, self._values)]

    def _break_off(self) -> list[protocol.Command]:
        self.rejected += 1
        self._letter = ""
        misread = protocol.Signal.STOP.value in self._halts and self._values == [protocol.Wave.SINE]
        return [protocol.Signal.STOP] if misread else []


_Reader: TypeAlias = Callable[[str], str | float]


def _one_of(letters: str) -> _Reader:
    def read(field: str) -> str:
        if len(field) != 1 or field not in letters:
            raise ValueError(field)
        return field

    return read


def _number_within(lowest: float, highest: float, form: re.Pattern[str] = _NUMBER) -> _Reader:
    def read(field: str) -> float:
        if len(field) > _LONGEST_FIELD or not form.fullmatch(field):
            raise ValueError(field)
        value = int(field) if form is _WHOLE else float(field)
        if not lowest <= value <= highest:
            raise ValueError(field)
        return value

    return read


def _whole_within(lowest: int, highest: int) -> _Reader:
    return _number_within(lowest, highest, _WHOLE)


def _field_kinds(encoders: int, extensions: Collection[str]) -> Mapping[str, tuple[_Reader, ...]]:
    """Return, for each letter, the kinds of the fields that follow it."""
    waves = "".join(
        w
        for w in protocol.Wave
        if w not in (protocol.Wave.CHIRP, protocol.Wave.MULTISINE) or w in extensions
    )
    frequency = _number_within(*protocol.FREQUENCIES)
    gain = _number_within(-_LARGEST_NUMBER, _LARGEST_NUMBER)
    amplitude = _whole_within(-_LARGEST_AMPLITUDE, _LARGEST_AMPLITUDE)
    cycles = _whole_within(1, 1_000_000)
    stock = {
        "d": (_one_of(waves), _one_of("oc"), _one_of("ot"), frequency, amplitude, cycles),
        "g": (gain,) * 3,
        "z": (),
    }
    further: dict[str, tuple[_Reader, ...]] = {
        "f": (gain,) * (2 * encoders + 1),
        "c": (frequency,),
        "m": (
            _whole_within(0, 10_000),
            _number_within(-1.0, 1.0),
            _number_within(-_MOST_PHASE, _MOST_PHASE),
        ),
        "h": (_whole_within(0, 2**encoders - 1), _whole_within(0, encoders)),
        "s": (),
        "k": (),
    }
    known = {letter: kinds for letter, kinds in further.items() if letter in extensions}
    return {**stock, **known, **({"?": ()} if known else {})}


def _command(letter: str, values: list[Any]) -> protocol.Command:
    match letter, values:
        case "d", [wave, loop, encoder, frequency, amplitude, cycles]:
            return protocol.Start(
                wave=protocol.Wave(wave),
                encoder=None if loop == "o" else 1 + (encoder == "t"),
                frequency=frequency,
                amplitude=amplitude,
                cycles=cycles,
            )
        case "g", [kp, ki, kd]:
            return protocol.PidGains(kp=kp, ki=ki, kd=kd)
        case "f", [*gains, prefilter]:
            return protocol.StateGains(gains=tuple(gains), prefilter=prefilter)
        case "c", [frequency]:
            return protocol.ChirpEnd(frequency=frequency)
        case "m", [harmonic, share, phase]:
            return protocol.Tone(harmonic=harmonic, share=share, phase=phase)
        case "h", [mask, released]:
            held = tuple(c + 1 for c in range(mask.bit_length()) if mask >> c & 1)
            return protocol.Hands(held=held, released=released)
    return protocol.Signal(letter)


class Core(Protocol):
    """A bench's controller without its hardware.

    The owner calls `receive` when bytes arrive, `tick` once per period while the bench has power,
    and `take` for bytes to send. The firmware and `ReferenceCore` have this interface.
    """

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; their commands act at the next tick."""
        ...

    def tick(self, counts: Sequence[int], *, stamp: int, now: int) -> int:
        """Return the duty that acts from now on, within ± FULL_SCALE.

        Parameters
        ----------
        counts : encoder counts since power-on. After a reset, the next counts become the zero.
        stamp : time of the bench's clock in whole ms, used for lines, waves and run times.
        now : wall time in whole ms, used only for the watchdog, because an emulation may run faster
            than real time.
        """
        ...

    def take(self) -> bytes:
        """Return the bytes to send since the last call: lines of readings, and answers."""
        ...


class ReferenceCore:
    """The controller in Python, written to be clear rather than fast.

    Parameters
    ----------
    description : the bench's answer to a query. The control laws use its period. A bench
        without `commands` is a stock bench, which does not answer queries.
    """

    def __init__(self, description: protocol.Description) -> None:
        self._description = description
        self._reader = CommandReader(encoders=description.encoders, extensions=description.commands)
        self._commands: list[protocol.Command] = []
        self._sent = bytearray()
        self._reset()

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; their commands act at the next tick."""
        self._commands += self._reader.feed(data)

    def take(self) -> bytes:
        """Return the bytes to send since the last call."""
        sent = bytes(self._sent)
        self._sent.clear()
        return sent

    def tick(self, counts: Sequence[int], *, stamp: int, now: int) -> int:
        """Return the duty that acts from now on."""
        for command in self._commands:
            self._obey(command, stamp=stamp, now=now)
        self._commands.clear()
        if self._zero is None:
            self._zero = tuple(counts)
        if self._heard is not None and now - self._heard >= 1e3 * protocol.WATCHDOG:
            self._run = None
        run = self._run
        if run is None:
            return 0
        ms = stamp - run.since
        if ms >= 1e3 * run.start.duration:
            self._run = None
            return 0
        y = tuple(count - zero for count, zero in zip(counts, self._zero, strict=True))
        target = protocol.target_at(run.start, 1e-3 * ms, chirp_end=run.chirp_end, tones=run.tones)
        duty = run.law(target, y)
        self._sent += protocol.format_reading(
            protocol.Reading(counts=y, target=target, duty=duty, ms=ms)
        )
        return duty

    def _reset(self) -> None:
        self._run: _Run | None = None
        self._gains: protocol.PidGains | protocol.StateGains = protocol.PidGains(
            kp=0.0, ki=0.0, kd=0.0
        )
        self._chirp_end: float | None = None
        self._tones: tuple[protocol.Tone, ...] = ()
        self._zero: tuple[int, ...] | None = None  # None if the next counts are the zero
        self._heard: int | None = None  # last heartbeat, ms of wall time; None before

    def _obey(self, command: protocol.Command, *, stamp: int, now: int) -> None:
        match command:
            case protocol.Start():
                self._run = _Run(
                    start=command,
                    since=stamp,
                    chirp_end=self._chirp_end,
                    tones=self._tones,
                    law=self._loop(command),
                )
            case protocol.PidGains() | protocol.StateGains():
                self._gains = command
            case protocol.ChirpEnd(frequency=frequency):
                self._chirp_end = frequency
            case protocol.Tone(harmonic=harmonic):
                self._tones = (*self._tones, command)[-protocol.MOST_TONES :] if harmonic else ()
            case protocol.Signal.RESET:
                self._reset()
            case protocol.Signal.STOP:
                self._run = None
            case protocol.Signal.HEARTBEAT:
                self._heard = now
            case protocol.Signal.QUERY:
                self._sent += protocol.format_description(self._description)
            case protocol.Hands():
                pass  # carried out by the virtual bench around this controller

    def _loop(self, start: protocol.Start) -> "_Law":
        if start.encoder is None:
            return lambda target, y: _clipped(target)
        if isinstance(self._gains, protocol.PidGains):
            return _Pid(self._gains, row=start.encoder - 1, period=self._description.period)
        return _StateFeedback(self._gains, period=self._description.period)


# Returns the duty that acts from now on, from target and positions; called at every tick of a run.
_Law: TypeAlias = Callable[[int, Sequence[int]], int]


@dataclass(frozen=True, kw_only=True)
class _Run:
    start: protocol.Start
    since: int  # ms of the bench's clock when it began
    chirp_end: float | None
    tones: tuple[protocol.Tone, ...]
    law: _Law


class _Pid:
    """The PID law of `pipeline.plant.sampled_loop`, which acts in the same tick."""

    def __init__(self, gains: protocol.PidGains, *, row: int, period: float) -> None:
        self._gains, self._row, self._period = gains, row, period
        self._integral = self._last = 0.0

    def __call__(self, target: int, y: Sequence[int]) -> int:
        error = float(target - y[self._row])
        self._integral += error * self._period
        slope, self._last = (error - self._last) / self._period, error
        gains = self._gains
        return _clipped(gains.kp * error + gains.ki * self._integral + gains.kd * slope)


class _StateFeedback:
    """The state feedback of `pipeline.plant.sampled_loop` without a model, one tick later."""

    def __init__(self, gains: protocol.StateGains, *, period: float) -> None:
        self._gains, self._period = gains, period
        self._predicted: list[tuple[float, float]] = []  # position and velocity of each encoder
        self._next = 0

    def __call__(self, target: int, y: Sequence[int]) -> int:
        predicted = self._predicted or [(float(count), 0.0) for count in y]
        acting, effort = self._next, self._gains.prefilter * target
        correction = VELOCITY_CORRECTION / self._period
        self._predicted = []
        for i, (count, (position, velocity)) in enumerate(zip(y, predicted, strict=True)):
            velocity += correction * (count - position)
            position = count + self._period * velocity
            self._predicted.append((position, velocity))
            gains = self._gains.gains
            effort -= gains[2 * i] * position + gains[2 * i + 1] * velocity
        self._next = _clipped(effort)
        return acting


def _clipped(effort: float) -> int:
    return protocol.nearest_count(min(max(effort, -protocol.FULL_SCALE), protocol.FULL_SCALE))
