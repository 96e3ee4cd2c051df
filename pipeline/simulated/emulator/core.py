"""A bench's controller between serial line and motor: a state machine with one step per period.

docs/protocol.md specifies the state machine in words and formulas.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pipeline.bench.protocol.command_reader import CommandReader
from pipeline.bench.protocol.messages import (
    FULL_SCALE,
    MOST_TONES,
    WATCHDOG,
    ChirpEnd,
    Command,
    Description,
    Hands,
    PidGains,
    Reading,
    Signal,
    Start,
    StateGains,
    Tone,
    format_description,
    format_reading,
)
from pipeline.bench.protocol.waves import nearest_count, target_at
from pipeline.plant.sampled_loop import VELOCITY_CORRECTION


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

    def __init__(self, description: Description) -> None:
        self._description = description
        self._reader = CommandReader(encoders=description.encoders, extensions=description.commands)
        self._commands: list[Command] = []
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
        if self._heard is not None and now - self._heard >= 1e3 * WATCHDOG:
            self._run = None
        run = self._run
        if run is None:
            return 0
        ms = stamp - run.since
        if ms >= 1e3 * run.start.duration:
            self._run = None
            return 0
        y = tuple(count - zero for count, zero in zip(counts, self._zero, strict=True))
        target = target_at(run.start, 1e-3 * ms, chirp_end=run.chirp_end, tones=run.tones)
        duty = run.law.duty(target, y)
        self._sent += format_reading(Reading(counts=y, target=target, duty=duty, ms=ms))
        return duty

    def _reset(self) -> None:
        self._run: _Run | None = None
        self._gains: PidGains | StateGains = PidGains(kp=0.0, ki=0.0, kd=0.0)
        self._chirp_end: float | None = None
        self._tones: tuple[Tone, ...] = ()
        self._zero: tuple[int, ...] | None = None  # None if the next counts are the zero
        self._heard: int | None = None  # last heartbeat, ms of wall time; None before

    def _obey(self, command: Command, *, stamp: int, now: int) -> None:
        match command:
            case Start():
                self._run = _Run(
                    start=command,
                    since=stamp,
                    chirp_end=self._chirp_end,
                    tones=self._tones,
                    law=self._loop(command),
                )
            case PidGains() | StateGains():
                self._gains = command
            case ChirpEnd(frequency=frequency):
                self._chirp_end = frequency
            case Tone(harmonic=harmonic):
                self._tones = (*self._tones, command)[-MOST_TONES:] if harmonic else ()
            case Signal.RESET:
                self._reset()
            case Signal.STOP:
                self._run = None
            case Signal.HEARTBEAT:
                self._heard = now
            case Signal.QUERY:
                self._sent += format_description(self._description)
            case Hands():
                pass  # carried out by the virtual bench around this controller

    def _loop(self, start: Start) -> "_Law":
        if start.encoder is None:
            return _OpenLoop()
        if isinstance(self._gains, PidGains):
            return _Pid(self._gains, row=start.encoder - 1, period=self._description.period)
        return _StateFeedback(self._gains, period=self._description.period)


class _Law(Protocol):
    def duty(self, target: int, y: Sequence[int]) -> int:
        """Return the duty that acts from now on; called at every tick of a run."""
        ...


@dataclass(frozen=True, kw_only=True)
class _Run:
    start: Start
    since: int  # ms of the bench's clock when it began
    chirp_end: float | None
    tones: tuple[Tone, ...]
    law: _Law


class _OpenLoop:
    def duty(self, target: int, y: Sequence[int]) -> int:
        return _clipped(target)


class _Pid:
    """The PID law of `pipeline.plant.sampled_loop`, which acts in the same tick."""

    def __init__(self, gains: PidGains, *, row: int, period: float) -> None:
        self._gains, self._row, self._period = gains, row, period
        self._integral = self._last = 0.0

    def duty(self, target: int, y: Sequence[int]) -> int:
        error = float(target - y[self._row])
        self._integral += error * self._period
        slope, self._last = (error - self._last) / self._period, error
        gains = self._gains
        return _clipped(gains.kp * error + gains.ki * self._integral + gains.kd * slope)


class _StateFeedback:
    """The state feedback of `pipeline.plant.sampled_loop` without a model, one tick later."""

    def __init__(self, gains: StateGains, *, period: float) -> None:
        self._gains, self._period = gains, period
        self._predicted: list[tuple[float, float]] = []  # position and velocity of each encoder
        self._next = 0

    def duty(self, target: int, y: Sequence[int]) -> int:
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
    return nearest_count(min(max(effort, -FULL_SCALE), FULL_SCALE))
