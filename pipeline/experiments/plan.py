"""The plan of a session at the bench: what to record, within which limits; and its words."""

from collections.abc import Collection, Sequence
from itertools import groupby
from math import isclose
from typing import Annotated, Literal, Self

from pydantic import Field

from pipeline.protocol import Tone
from pipeline.submission import Submission
from pipeline.submission.models import TomlTable
from pipeline.words.numbers import count

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PlanLimits(TomlTable):
    """The limits of every run.

    Attributes
    ----------
    input : largest input, in input units.
    travel : largest distance of a cart from its zero, in position units.
    """

    input: Positive
    travel: Positive


class PidLoop(TomlTable):
    """Gains of the bench's own PID on one cart, from encoder counts to duty counts."""

    type: Literal["pid"] = "pid"
    kp: Finite
    ki: Finite = 0.0
    kd: Finite = 0.0
    cart: Literal[1, 2] = 1


class StateLoop(TomlTable):
    """State feedback in the submission's units; () and None stand for the gains of the design."""

    type: Literal["state_feedback"] = "state_feedback"
    gains: tuple[Finite, ...] = ()
    prefilter: Finite | None = None
    cart: int = 1


class Recording(TomlTable):
    """One experiment to record.

    Attributes
    ----------
    id : the id of the experiment in submission.toml. The data file has the same name.
    carts : the carts that are free to move; all others are held.
    wave : waveform of the input or, in closed loop, of the reference.
    amplitude : amplitude in input units or, in closed loop, in position units. Zero for a decay
        started by hand.
    frequency : frequency of the wave in Hz, at which a chirp starts.
    frequency_end : frequency in Hz at which a chirp ends.
    tones : the sines of a multisine. Each has the harmonic of `frequency`, its share of the
        amplitude and its phase in rad.
    cycles : number of periods. The run takes cycles/frequency seconds.
    release : the cart that is pulled out and released by hand; None if no cart is released.
    controller : the controller that closes the loop.
    settle : time of rest before the run, in s.
    aim : the goal for which cartlab chose the recording, such as "zeta_2" or "gap". It is empty for
        a standard recording, and for one that a person chose.
    """

    id: str
    kind: Literal["decay", "step", "sine", "sweep", "closed_loop"]
    carts: tuple[int, ...]
    wave: Literal["delta", "square", "sine", "triangle", "sawtooth", "chirp", "multisine"]
    amplitude: Finite
    frequency: Positive
    frequency_end: Positive | None = None
    tones: tuple[tuple[Annotated[int, Field(ge=1)], Finite, Finite], ...] = ()
    cycles: Annotated[int, Field(ge=1)] = 1
    release: int | None = None
    controller: Annotated[PidLoop | StateLoop, Field(discriminator="type")] | None = None
    settle: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3.0
    note: str = ""
    aim: str = ""

    @property
    def duration(self) -> float:
        """Duration of the run in s."""
        return self.cycles / self.frequency

    @property
    def sines(self) -> tuple[Tone, ...]:
        """The tones of a multisine in the bench's form."""
        return tuple(Tone(harmonic=h, share=share, phase=p) for h, share, p in self.tones)

    def resembles(self, other: Self) -> bool:
        """Return whether a person who refuses one of two recordings would refuse the other too."""
        words = (self.kind, self.wave, self.carts, self.release, self.controller)
        if words != (other.kind, other.wave, other.carts, other.release, other.controller):
            return False
        mine = (self.amplitude, self.frequency, self.frequency_end or 0.0)
        yours = (other.amplitude, other.frequency, other.frequency_end or 0.0)
        # The same proposal, made again after other recordings, may differ by 10 %.
        return all(isclose(a, b, rel_tol=0.1) for a, b in zip(mine, yours, strict=True))


class Plan(TomlTable):
    """Everything to record, in order.

    Attributes
    ----------
    baud : speed of the serial line.
    """

    version: Literal[1] = 1
    baud: Annotated[int, Field(ge=300)] = 115_200
    limits: PlanLimits
    recordings: tuple[Recording, ...] = ()


def plan_table(plan: Plan, submission: Submission, *, new: Collection[str] = ()) -> str:
    """Return the recordings in order, with a line whenever carts must be held or freed.

    Parameters
    ----------
    new : ids that were not in the plan before; each is marked with +.
    """
    n, done = submission.system.carts, recorded_ids(plan, submission)
    wide = max((len(recording.id) for recording in plan.recordings), default=0)
    lines = []
    for carts, group in groupby(plan.recordings, key=lambda recording: recording.carts):
        lines.append(f"{hold_words(carts, n=n)}:")
        for recording in group:
            mark = "✓" if recording.id in done else "+" if recording.id in new else " "
            lines.append(f" {mark} {recording.id:{wide}}  {what_words(recording, submission)}")
    limits, system = plan.limits, submission.system
    left = [recording for recording in plan.recordings if recording.id not in done]
    who = "the others" if done else "they"
    return "\n".join(
        [
            *lines,
            f"{count(len(plan.recordings), 'recording')}, {len(done)} done"
            + (f", {len(new)} new (+); " if new else "; ")
            + (f"{who} take {time_words(session_time(left))}" if left else "nothing to do"),
            f"limits: {limits.input:g} {system.input.unit}, "
            f"{limits.travel:g} {system.position.unit} from the zero",
        ]
    )


def plan_data(
    plan: Plan, submission: Submission, *, new: Collection[str] = ()
) -> dict[str, object]:
    """Return the plan with derived values for JSON; `new` as for `plan_table`."""
    done, everyone = recorded_ids(plan, submission), range(1, submission.system.carts + 1)
    recordings = [
        {
            **recording.model_dump(mode="json"),
            "held": [cart for cart in everyone if cart not in recording.carts],
            "duration": recording.duration,
            "recorded": recording.id in done,
            "new": recording.id in new,
        }
        for recording in plan.recordings
    ]
    left = [recording for recording in plan.recordings if recording.id not in done]
    units = {"input": submission.system.input.unit, "position": submission.system.position.unit}
    return {
        **plan.model_dump(mode="json"),
        "units": units,
        "recordings": recordings,
        "seconds_left": session_time(left),
    }


def recorded_ids(plan: Plan, submission: Submission) -> frozenset[str]:
    """Return the ids of the recordings that the submission already has."""
    return frozenset(r.id for r in plan.recordings) & {e.id for e in submission.experiments}


def session_time(recordings: Collection[Recording]) -> float:
    """Return the duration of recordings in s, with rests but without handling the carts."""
    return sum(recording.settle + recording.duration for recording in recordings)


def hold_words(carts: Sequence[int], *, n: int) -> str:
    """Return in words which carts to hold and which to free."""
    held = [cart for cart in range(1, n + 1) if cart not in carts]
    if not held:
        return "all carts free" if n > 1 else "cart 1 free"
    return f"hold {_carts(held)}, {_carts(carts)} free"


def _carts(carts: Sequence[int]) -> str:
    return ("cart " if len(carts) == 1 else "carts ") + " and ".join(map(str, carts))


def what_words(recording: Recording, submission: Submission) -> str:
    """Return the content of one recording and its duration, in words."""
    if recording.amplitude == 0:
        what = f"{recording.kind}: pull cart {recording.release} out, let it go"
    else:
        closed = recording.kind == "closed_loop"
        system = submission.system
        unit = system.position.unit if closed else system.input.unit
        what = f"{recording.kind.replace('_', ' ')}: {recording.wave}, "
        what += f"{recording.amplitude:g} {unit}, {recording.frequency:g} Hz"
        if recording.frequency_end is not None:
            what += f" to {recording.frequency_end:g} Hz"
        if recording.controller is not None:
            what += f", {recording.controller.type.replace('_', ' ')}"
            what += f" of cart {recording.controller.cart}"
    return f"{what}; {recording.duration:.0f} s, after {recording.settle:g} s of rest"


def time_words(seconds: float) -> str:
    """Return a duration as minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
