"""Split the bytes that arrive at a bench into commands; noise and lost bytes never hide a stop."""

import re
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeAlias

from pipeline.bench.protocol.messages import (
    EXTENSIONS,
    FREQUENCIES,
    ChirpEnd,
    Command,
    Hands,
    PidGains,
    Signal,
    Start,
    StateGains,
    Tone,
    Wave,
)

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

    def __init__(self, *, encoders: int, extensions: Collection[str] = EXTENSIONS) -> None:
        self._kinds = _field_kinds(encoders, extensions)
        self._halts = tuple({Signal.STOP.value, Signal.RESET.value} & self._kinds.keys())
        self._rest = ""
        self._letter = ""
        self._values: list[str | float] = []
        self.rejected = 0

    def feed(self, data: bytes) -> list[Command]:
        """Return the commands that are now complete, in order."""
        *whole, rest = (self._rest + data.decode("latin-1")).split(";")
        # if the field is longer, it is refused anyway
        self._rest = rest[-_LONGEST_FIELD - 1 :]
        return [command for field in whole for command in self._take(field.strip(" \t\r\n"))]

    def _take(self, field: str) -> list[Command]:
        broken_off: list[Command] = []
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

    def _break_off(self) -> list[Command]:
        self.rejected += 1
        self._letter = ""
        misread = Signal.STOP.value in self._halts and self._values == [Wave.SINE]
        return [Signal.STOP] if misread else []


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
    waves = "".join(w for w in Wave if w not in (Wave.CHIRP, Wave.MULTISINE) or w in extensions)
    frequency = _number_within(*FREQUENCIES)
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


def _command(letter: str, values: list[Any]) -> Command:
    match letter, values:
        case "d", [wave, loop, encoder, frequency, amplitude, cycles]:
            return Start(
                wave=Wave(wave),
                encoder=None if loop == "o" else 1 + (encoder == "t"),
                frequency=frequency,
                amplitude=amplitude,
                cycles=cycles,
            )
        case "g", [kp, ki, kd]:
            return PidGains(kp=kp, ki=ki, kd=kd)
        case "f", [*gains, prefilter]:
            return StateGains(gains=tuple(gains), prefilter=prefilter)
        case "c", [frequency]:
            return ChirpEnd(frequency=frequency)
        case "m", [harmonic, share, phase]:
            return Tone(harmonic=harmonic, share=share, phase=phase)
        case "h", [mask, released]:
            held = tuple(c + 1 for c in range(mask.bit_length()) if mask >> c & 1)
            return Hands(held=held, released=released)
    return Signal(letter)
