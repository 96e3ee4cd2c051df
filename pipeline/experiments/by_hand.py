"""Make a recording for the plan from the few numbers that a person types."""

from dataclasses import dataclass
from math import ceil, floor
from pathlib import Path
from typing import Literal, get_args

from pipeline.errors import ConfigError
from pipeline.experiments.plan import Plan, Recording
from pipeline.experiments.plan_file import add_recordings, recording_problems
from pipeline.experiments.propose import EDGES, current_plan, release_by_hand
from pipeline.protocol import FREQUENCIES
from pipeline.submission import Submission, load_submission

RecordingKind = Literal["step", "sweep", "sine", "decay"]
KINDS: tuple[RecordingKind, ...] = get_args(RecordingKind)

_WAVES: dict[RecordingKind, Literal["square", "chirp", "sine"]] = {
    "step": "square",
    "sweep": "chirp",
    "sine": "sine",
}
_SHORTEST = 1.0  # s
# s; with three carts at 1 kHz, 120 s take 1 s and 0.5 GB to evaluate, 600 s take 20 s and 2 GB
_LONGEST = 120.0
_ROUNDING = 1e-9  # relative rounding error that is ignored: 100 s at 0.07 Hz are exactly 7 periods
# The numbers that define a recording of each kind, as keys of plan.toml, and the words for them.
NEEDED: dict[RecordingKind, tuple[str, ...]] = {
    "step": ("amplitude",),
    "sweep": ("amplitude", "frequency", "frequency_end"),
    "sine": ("amplitude", "frequency"),
    "decay": (),
}
TYPED = {"frequency_end": "frequency at the end"}


@dataclass(frozen=True, kw_only=True)
class WantedRecording:
    """The few numbers with which a person describes a recording.

    Attributes
    ----------
    seconds : duration in s, 1 to 120. For a dwell or sweep it is rounded to whole periods.
    amplitude : amplitude in input units.
    frequency : frequency in Hz of a dwell, or at the start of a sweep.
    frequency_end : frequency in Hz at the end of a sweep.
    cart : the cart that is released for a decay.
    """

    kind: RecordingKind
    seconds: float
    amplitude: float = 0.0
    frequency: float = 0.0
    frequency_end: float | None = None
    cart: int = 1


def make_recording(wanted: WantedRecording, *, plan: Plan, submission: Submission) -> Recording:
    """Return the recording; all carts are free unless one is released by hand.

    A driven recording waits beforehand as long as the last driven recording of the plan.

    Raises
    ------
    ConfigError : the plan's limits do not allow it; the message names the number and the reason.
    """
    kind, seconds = wanted.kind, wanted.seconds
    everyone = tuple(range(1, submission.system.carts + 1))
    low, high = FREQUENCIES
    if not _SHORTEST <= seconds <= _LONGEST:
        expected = f"{_SHORTEST:g} to {_LONGEST:g} s"
        raise ConfigError(
            f"seconds: expected {expected}, found {seconds:g}; for longer ones edit plan.toml"
        )
    named = {"frequency": wanted.frequency, "frequency_end": wanted.frequency_end or 0.0}
    for key in [key for key in named if key in NEEDED[kind]]:
        if not low <= named[key] <= high:
            name = TYPED.get(key, key)
            raise ConfigError(f"{name}: expected {low:g} to {high:g} Hz, found {named[key]:g}")
    if kind == "decay":
        made = release_by_hand(wanted.cart, name=f"decay-{wanted.cart}", seconds=seconds)
    else:
        driven = [one.settle for one in plan.recordings if one.amplitude]
        cycles = _count_periods(seconds, wanted.frequency) if kind != "step" else EDGES // 2
        made = Recording(
            id=f"{kind}-1",
            kind=kind,
            carts=everyone,
            wave=_WAVES[kind],
            amplitude=wanted.amplitude,
            frequency=wanted.frequency if kind != "step" else cycles / seconds,
            frequency_end=wanted.frequency_end if kind == "sweep" else None,
            cycles=cycles,
            settle=driven[-1] if driven else 5.0,  # s, if the plan has no driven recording
        )
    for key, what in recording_problems(made, plan.limits, submission.system):
        raise ConfigError(f"{TYPED.get(key, key)}: {what}")
    return made


def _count_periods(seconds: float, frequency: float) -> int:
    """Return how many whole periods last `seconds` or slightly longer, within the limit."""
    most = floor(_LONGEST * frequency * (1 + _ROUNDING))
    if not most:
        raise ConfigError(
            f"frequency: expected at least {1 / _LONGEST:.2g} Hz, so that a period fits into "
            f"{_LONGEST:g} s, found {frequency:g}"
        )
    return min(ceil(seconds * frequency * (1 - _ROUNDING)), most)


def add_recording(folder: Path, recording: Recording) -> Recording:
    """Append a recording to a submission's plan; return the recording with its id in the plan.

    Raises
    ------
    ConfigError : the plan is broken; nothing is written.
    """
    plan = current_plan(load_submission(folder))
    return add_recordings(folder, [recording], otherwise=plan).recordings[-1]
