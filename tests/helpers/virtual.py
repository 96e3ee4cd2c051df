"""Make recordings on a virtual bench as fast as they can be computed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.bench.experiments import add_experiment, data_file, log_text, recorded_entry
from pipeline.bench.orders import make_order
from pipeline.experiments.exploration import Recorded
from pipeline.experiments.gains import CountScales
from pipeline.experiments.plan import (
    PlanLimits,
    Recording,
    load_plan,
    plan_path,
    save_plan,
    session_time,
)
from pipeline.experiments.propose import propose_plan
from pipeline.output import write_file
from pipeline.plant.augmented import simulate_augmented
from pipeline.protocol import EXTENSIONS, Description, Hands, Reading, Start, encode, parse_reading
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.controller import ReferenceCore
from pipeline.simulated.emulator import (
    _ENCODER_NOISE as _NOISE,
)
from pipeline.simulated.emulator import (
    TRUE_PERIOD,
    VirtualCarts,
    input_per_count,
)
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import NAME

_PULL_OUT = 1700  # ticks that a virtual hand takes


class LimitPassed(AssertionError):
    """A recording passed a limit of its plan, which a proposed recording must never do."""


class VirtualBench:
    """A bench whose host never waits: ticks are computed one after the other."""

    def __init__(self, bench: SimulatedBench, *, seed: int) -> None:
        self.carts = VirtualCarts(bench, seed=seed)
        self.description = Description(
            name=bench.name,
            encoders=self.carts.encoders,
            carts=bench.chain.n,
            commands=EXTENSIONS,
            input_unit=bench.input_unit,
            input_per_count=self.carts.input_per_count,
            position_unit=bench.position_unit,
            position_per_count=bench.count,
        )
        self.scales = CountScales(input=input_per_count(bench), position=bench.count)
        self._core, self._ticks = ReferenceCore(self.description), 0
        self.seconds = 0.0  # s of the bench's clock, in total

    def _tick(self) -> list[Reading]:
        duty = self._core.tick(
            self.carts.counts(), stamp=int(1e3 * self._ticks * TRUE_PERIOD), now=0
        )
        self.carts.move(duty)
        self._ticks += 1
        return [r for line in self._core.take().splitlines() if (r := parse_reading(line))]

    def _driven(self, *, held: Sequence[int], ticks: int) -> list[Reading]:
        """Return the lines of this many ticks from rest, with all motion computed at once.

        Without feedback the controller never reads the counts, so they are inserted afterwards.
        """
        duties, lines, spare = np.zeros(ticks), [], (0,) * self.description.encoders
        for tick in range(ticks):
            now = int(1e3 * self._ticks * TRUE_PERIOD)
            duties[tick] = self._core.tick(spare, stamp=now, now=0)
            self._ticks += 1
            lines += [(tick, r) for r in map(parse_reading, self._core.take().splitlines()) if r]
        counts = _counts(self.carts, duties, held=held)
        return [replace(line, counts=tuple(counts[tick].tolist())) for tick, line in lines]

    def carry_out(
        self, recording: Recording, *, submission: Submission, limits: PlanLimits
    ) -> list[Reading]:
        """Return the lines of one recording.

        Raise LimitPassed if the recording passes a limit.
        """
        n = submission.system.carts
        order = make_order(
            recording,
            limits=limits,
            scales=self.scales,
            system=submission.system,
            bench=self.description,
        )
        held = tuple(cart for cart in range(1, n + 1) if cart not in recording.carts)
        # A person who holds the carts brings them to rest, so nothing happens meanwhile.
        self.carts.take_in_hand(Hands(held=held, released=recording.release or 0))
        self._ticks += round(recording.settle / TRUE_PERIOD)
        self.seconds += recording.settle
        if recording.release:
            for _ in range(_PULL_OUT):
                self._tick()
            self.seconds += _PULL_OUT * TRUE_PERIOD
        for command in order.commands:
            self._core.receive(encode(command))
            if isinstance(command, Start):
                self.carts.start()
        ticks = round(recording.duration / TRUE_PERIOD) + 2
        if recording.release or recording.controller:
            lines = [line for _ in range(ticks) for line in self._tick()]
        else:
            lines = self._driven(held=held, ticks=ticks)
        self.seconds += recording.duration
        for line in lines:
            if why := order.passed(line, carts=n):
                raise LimitPassed(f"{recording.id}: {why}")
        return lines

    def record(self, folder: Path, recordings: Sequence[Recording], *, limits: PlanLimits) -> None:
        """Make recordings and add them to a submission, as `cartlab acquire` does."""
        submission = load_submission(folder)
        for recording in recordings:
            lines = self.carry_out(recording, submission=submission, limits=limits)
            text = log_text(lines, carts=submission.system.carts, reference=False)
            (folder / "data").mkdir(exist_ok=True)
            write_file(folder / data_file(recording), text)
            entry = recorded_entry(
                recording, file=data_file(recording), controller=None, remarks=()
            )
            submission = add_experiment(submission, entry)


def _counts(
    carts: VirtualCarts, duties: NDArray[np.float64], *, held: Sequence[int]
) -> NDArray[np.int64]:
    """Return the encoder counts at each tick for these duties, starting at zero."""
    hidden = carts._bench
    free = [cart for cart in range(1, hidden.chain.n + 1) if cart not in held]
    t = np.asarray(TRUE_PERIOD * np.arange(duties.size), dtype=np.float64)
    x = simulate_augmented(carts._model, t, carts.input_per_count * duties, free=free)
    noise = carts._noise_rng.standard_normal((duties.size, hidden.chain.n)) * carts._shaken
    exact = x.T / hidden.count + carts._phase + _NOISE * noise
    counts = np.zeros((duties.size, carts.encoders), dtype=np.int64)
    counts[:, : hidden.chain.n] = np.rint(exact)
    return counts - counts[0]


def new_folder(folder: Path, bench: VirtualBench, *, springs: Sequence[bool]) -> Path:
    """Write a submission without records for a bench."""
    described = bench.description
    folder.mkdir(parents=True)
    there = ", ".join("true" if one else "false" for one in springs)
    (folder / NAME).write_text(
        f"version = 1\n\n[system]\ncarts = {described.carts}\nsprings = [{there}]\n"
        f'input = {{ unit = "{described.input_unit}", sign = 1, '
        f"per_count = {described.input_per_count!r} }}\n"
        f'position = {{ unit = "{described.position_unit}", '
        f"per_count = {described.position_per_count!r} }}\n",
        encoding="utf-8",
    )
    return folder


class VirtualSession:
    """A recorder for an exploration; its first call makes the bench's folder."""

    def __init__(
        self, folder: Path, bench: VirtualBench, *, springs: Sequence[bool] | None = None
    ) -> None:
        """Assume that all springs exist, unless `springs` is given."""
        self.folder, self.bench = folder, bench
        self.springs = springs or [True] * (bench.description.carts + 1)

    def __call__(self, ids: Sequence[str]) -> Recorded:
        """Make recordings of the plan; write submission and plan first if they are missing."""
        if not (self.folder / NAME).exists():
            new_folder(self.folder, self.bench, springs=self.springs)
        submission = load_submission(self.folder)
        if not plan_path(submission).exists():
            save_plan(propose_plan(submission, bench=self.bench.description), submission)
        plan = load_plan(submission)
        wanted = [recording for recording in plan.recordings if recording.id in ids]
        self.bench.record(self.folder, wanted, limits=plan.limits)
        ids = tuple(recording.id for recording in wanted)
        return Recorded(ids=ids, seconds=session_time(wanted))
