"""Turn a recording into orders to the bench: commands and limits in the bench's own counts."""

from dataclasses import dataclass, replace

from pipeline.errors import ConfigError, HardwareError
from pipeline.experiments.gains import (
    CountScales,
    LoopTrial,
    Table,
    controller_table,
)
from pipeline.experiments.plan import Plan, PlanLimits, Recording
from pipeline.protocol import (
    FULL_SCALE,
    ChirpEnd,
    Command,
    Description,
    PidGains,
    Reading,
    Start,
    StateGains,
    Tone,
    Wave,
    target_at,
)
from pipeline.submission import Submission, System
from pipeline.workflow import analyse


@dataclass(frozen=True, kw_only=True)
class Order:
    """A recording in the bench's counts.

    Attributes
    ----------
    commands : commands for the bench, in sending order; the last one starts the run.
    scales : factors from counts to `input_unit` and `position_unit`.
    most_duty : largest duty that a line may report, in duty counts.
    most_counts : largest distance of a cart from its zero, in encoder counts.
    """

    recording: Recording
    commands: tuple[Command, ...]
    scales: CountScales
    input_unit: str
    position_unit: str
    most_duty: float
    most_counts: float

    def rest(self) -> "Order":
        """Return an order with the same limits that keeps the motor off while the carts settle."""
        settle = self.recording.settle
        return replace(
            self,
            recording=self.recording.model_copy(update={"controller": None}),
            commands=(Start(wave=Wave.DELTA, frequency=1 / settle, amplitude=0),),
        )

    def strays(self, reading: Reading, *, period: float) -> bool:
        """Return whether a line's target is not the ordered one, as after a transmission error.

        A jump of the target may come one `period` (in ms) early or late. Rounding may change a
        target by one count.
        """
        start = self.commands[-1]
        assert isinstance(start, Start)
        end = next((c.frequency for c in self.commands if isinstance(c, ChirpEnd)), None)
        tones = tuple(c for c in self.commands if isinstance(c, Tone) and c.harmonic)

        def target(ms: float) -> int:
            return target_at(start, max(0.0, 1e-3 * ms), chirp_end=end, tones=tones)

        if abs(reading.target - target(reading.ms)) <= 1:
            return False
        near = [target(reading.ms + shift) for shift in (-period, 0.0, period)]
        return not min(near) - 1 <= reading.target <= max(near) + 1

    def drives_off(self, reading: Reading, *, before: Reading) -> bool:
        """Return whether the motor's duty differs from the target, which is a fault in open loop.

        After a jump of the target, the duty may follow one line later.
        """
        if self.recording.controller is not None:
            return False
        near = [min(max(r.target, -FULL_SCALE), FULL_SCALE) for r in (before, reading)]
        return not min(near) - 1 <= reading.duty <= max(near) + 1

    def passed(self, reading: Reading, *, carts: int) -> str:
        """Return a message about the limit that a line exceeds, or ""."""
        if abs(reading.duty) > self.most_duty:
            found, most = (abs(self.scales.input) * n for n in (reading.duty, self.most_duty))
            return f"the input was {found:.4g} {self.input_unit}, the limit is {most:.4g}"
        return self.too_far(reading, carts=carts)

    def too_far(self, reading: Reading, *, carts: int) -> str:
        """Return a message about a cart that is farther from its zero than the limit, or ""."""
        for cart, count in enumerate(reading.counts[:carts], start=1):
            if abs(count) > self.most_counts:
                found, most = (self.scales.position * n for n in (count, self.most_counts))
                return (
                    f"cart {cart} was {found:.4g} {self.position_unit} from its zero, "
                    f"the limit is {most:.4g}"
                )
        return ""


def order_on(
    recording: Recording, plan: Plan, submission: Submission, bench: Description
) -> tuple[Order, Table | None]:
    """Return the order of a recording, and its controller as written in submission.toml.

    The controller is None for an open loop.
    """
    system = submission.system
    scales = CountScales(
        input=system.input.per_count or bench.input_per_count,
        position=system.position.per_count or bench.position_per_count,
    )
    gains: PidGains | StateGains | None = None
    table: Table | None = None
    if recording.controller is not None:
        analysis = analyse(submission)
        trial = LoopTrial(
            recording=recording,
            submission=submission,
            analysis=analysis,
            bench=bench,
            limits=plan.limits,
        )
        scales, gains = trial.scales, trial.gains()
        cart = recording.controller.cart
        table = dict(controller_table(gains, cart=cart, scales=scales, carts=system.carts))
    order = make_order(
        recording, limits=plan.limits, scales=scales, system=system, bench=bench, gains=gains
    )
    return order, table


def make_order(
    recording: Recording,
    *,
    limits: PlanLimits,
    scales: CountScales,
    system: System,
    bench: Description,
    gains: PidGains | StateGains | None = None,
) -> Order:
    """Return the order of a recording: its commands, with amplitudes in counts.

    Raises
    ------
    ConfigError : the amplitude exceeds the limits or full scale, or is less than half a count.
    HardwareError : the bench does not know the wave or the controller.
    """
    amplitude = _count_amplitude(recording, limits=limits, scales=scales, system=system)
    commands = _list_commands(recording, bench=bench, gains=gains, amplitude=amplitude)
    return Order(
        recording=recording,
        commands=tuple(commands),
        scales=scales,
        input_unit=system.input.unit,
        position_unit=system.position.unit,
        # The half allows for rounding of the amplitude.
        most_duty=limits.input / abs(scales.input) + 0.5,
        most_counts=limits.travel / abs(scales.position),
    )


def _count_amplitude(
    recording: Recording, *, limits: PlanLimits, scales: CountScales, system: System
) -> int:
    """Return the amplitude, in duty counts for an open loop or encoder counts for a closed loop."""
    closed = recording.controller is not None
    limit, unit, per_count = (
        (limits.travel, system.position.unit, scales.position)
        if closed
        else (limits.input, system.input.unit, abs(scales.input))
    )
    where = f"plan.toml: amplitude {recording.amplitude:g} {unit}"
    if abs(recording.amplitude) > limit:
        raise ConfigError(f"{where} is above the limit of {limit:g} {unit}")
    full = FULL_SCALE * per_count
    if not closed and abs(recording.amplitude) > full + 0.5 * per_count:
        raise ConfigError(f"{where} is more than the bench can give: {full:g} {unit}; lower it")
    amplitude = round(recording.amplitude / per_count)
    if recording.amplitude and not amplitude:
        raise ConfigError(
            f"{where} is less than half a count of the bench ({per_count:g} {unit}); raise it"
        )
    return amplitude


def _list_commands(
    recording: Recording,
    *,
    bench: Description,
    gains: PidGains | StateGains | None,
    amplitude: int,
) -> list[Command]:
    """Return the commands of a recording, in order."""
    commands: list[Command] = []
    if gains is not None:
        if isinstance(gains, StateGains):
            _check_known("f", "state feedback", bench)
        # If a byte of the gains is lost on the line, the bench rejects the gains. It then uses the
        # zeros sent before, not the gains of an earlier run.
        commands += [PidGains(kp=0.0, ki=0.0, kd=0.0), gains]
    if recording.wave == "chirp":
        _check_known("c", "chirp", bench)
        if recording.frequency_end is not None:
            commands.append(ChirpEnd(frequency=recording.frequency_end))
    if recording.wave == "multisine":
        _check_known("m", "multisine", bench)
        commands += [Tone(harmonic=0), *recording.sines]
    commands.append(
        Start(
            wave=Wave[recording.wave.upper()],
            encoder=min(recording.controller.cart, 2) if recording.controller else None,
            frequency=recording.frequency,
            amplitude=amplitude,
            cycles=recording.cycles,
        )
    )
    return commands


def _check_known(letter: str, name: str, bench: Description) -> None:
    if letter not in bench.commands:
        raise HardwareError(
            f"the bench {bench.name!r} does not know the command {name}; remove this recording "
            "from plan.toml, or change it"
        )
