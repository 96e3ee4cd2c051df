"""The plan of a session at the bench: what to record, within which limits; and its file."""

import re
from collections.abc import Collection, Iterator, Sequence
from itertools import groupby
from math import isclose
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationError

from pipeline.errors import ConfigError
from pipeline.lock import lock_when_free
from pipeline.output import DEVICE, write_file
from pipeline.protocol import FREQUENCIES, MOST_TONES, Tone
from pipeline.submission import Submission, System, load_submission, toml
from pipeline.submission.models import TomlTable
from pipeline.words.numbers import count

# ----------------------------------------------------------- recordings, limits, and their words

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
    cycles : number of periods. The recording takes cycles/frequency seconds.
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


# ------------------------------------------- plan.toml; each mistake gives a message of one line

NAME = "plan.toml"
LONGEST_RUN = 600.0  # s; limits the time of a simulation and the size of a file

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,60}")  # a data file has the same name
_HEAD = """\
# What to record, in this order. `cartlab acquire` makes the recordings. Change what you like.
# `cartlab plan` does not touch the entries below. It adds tables at the end as soon as the data
# allow it: dwells after the sweep, the closed loop after the dwells. To start again, delete this
# file.
#
# carts          free to move; the others are held
# release        the cart that is pulled out and let go by hand
# wave           "square" is off for half a period, then on; "chirp" sweeps from frequency to
#                frequency_end; "multisine" is the sum of its tones. Further waves are "sine",
#                "triangle", "sawtooth" and "delta", a short pulse.
# amplitude      {input}; in closed loop {position}. Zero if a hand starts a decay.
# frequency      Hz, of the wave. The recording takes cycles/frequency seconds.
# settle         s of rest beforehand
"""
_CHECK = """\
# CHECK these two limits before you switch the motor on. A recording that passes one is stopped;
# then divide its amplitude by four and record it again.
#   input    {input}. The largest input of the motor.
#   travel   {position}. The largest distance of a cart from its zero; recordings aim at 40 % of it.
"""


def plan_path(submission: Submission) -> Path:
    """Return the path of a submission's plan, which may not exist yet."""
    return submission.folder / NAME


def load_plan(submission: Submission) -> Plan:
    """Read and check the plan of a submission.

    Raises
    ------
    ConfigError : the plan is wrong; the message has the file, the key, what was expected and what
        was found.
    """
    path = plan_path(submission)
    where = f"{submission.folder.resolve().name}/{NAME}"
    if path.is_symlink():
        raise ConfigError(f"{where}: is a link; put the file itself there")
    text = toml.read_text(path, where=where, limit=1_000_000, error=ConfigError)
    return _parse(text, where=where, system=submission.system)


def save_plan(plan: Plan, submission: Submission) -> Path:
    """Write the plan, or add its new recordings to the file; the same plan gives the same bytes.

    Raises
    ------
    ConfigError : the existing file is broken, or would be afterwards; nothing is written.
    ValueError : the plan does not begin with the recordings of the file, which are never
        overwritten.
    """
    path = plan_path(submission)
    if path.exists() or path.is_symlink():
        old = load_plan(submission)
        n = len(old.recordings)
        if plan.recordings[:n] != old.recordings or plan.limits != old.limits:
            raise ValueError(f"{path}: the plan is not an extension of the file")
        if n == len(plan.recordings):
            return path
        text = path.read_bytes().decode("utf-8-sig").rstrip("\r\n") + "\n\n"
        text += "\n".join(_recording_text(r) for r in plan.recordings[n:])
    else:
        text = plan_text(plan, submission.system)
    where = f"{submission.folder.resolve().name}/{NAME} cannot be written"
    _parse(text, where=where, system=submission.system)
    write_file(path, text)
    return path


def add_recordings(folder: Path, proposed: Sequence[Recording], *, otherwise: Plan) -> Plan:
    """Append recordings to the current plan of a submission; return the new plan.

    The plan is read again, because someone may have added recordings while the proposal was
    computed. An id that is already taken is changed.

    Parameters
    ----------
    otherwise : the plan to extend if there is no file.

    Raises
    ------
    ConfigError : the plan is broken, or would be afterwards; nothing is written.
    """
    with lock_when_free(folder):
        submission = load_submission(folder)
        plan = load_plan(submission) if plan_path(submission).exists() else otherwise
        taken = [one.id for one in (*submission.experiments, *plan.recordings)]
        new = (*plan.recordings, *renamed(proposed, taken=taken))
        plan = plan.model_copy(update={"recordings": new})
        save_plan(plan, submission)
        return plan


def renamed(proposed: Sequence[Recording], *, taken: Sequence[str]) -> tuple[Recording, ...]:
    """Return the recordings with unique ids: "step-3" if there is already a "step-2"."""
    used, renamed = set(taken), []
    for recording in proposed:
        name = recording.id
        while name in used:
            stem, dash, number = name.rpartition("-")
            counted = dash and number.isdecimal()
            width = len(number)
            name = f"{stem}-{int(number) + 1:0{width}d}" if counted else f"{name}-2"
        used.add(name)
        renamed.append(recording.model_copy(update={"id": name}))
    return tuple(renamed)


def plan_text(plan: Plan, system: System) -> str:
    """Return the text of a whole `plan.toml`, with comments."""
    units = {"input": system.input.unit, "position": system.position.unit}
    return "\n".join(
        [
            _HEAD.format(**units),
            toml.toml_section("", {"version": plan.version, "baud": plan.baud}),
            _CHECK.format(**units) + toml.toml_section("[limits]", plan.limits.model_dump()),
            *(_recording_text(recording) for recording in plan.recordings),
        ]
    )


def _recording_text(recording: Recording) -> str:
    entries = recording.model_dump(mode="json", exclude_defaults=True)
    if recording.controller is not None:
        entries["controller"]["type"] = recording.controller.type
    return toml.toml_section("[[recordings]]", entries)


# ----------------------------------------------------------------------- reading


def _parse(text: str, *, where: str, system: System) -> Plan:
    document = toml.parse_toml(text, where=where, error=ConfigError, root=Plan)
    try:
        plan = Plan.model_validate(document, strict=True)
    except ValidationError as error:
        problems = [
            toml.explain(e, document, root=Plan) for e in toml.relevant_errors(error.errors())
        ]
    else:
        found = list(_problems(plan, system))
        problems = [f"{toml.dotted(at, document)}: {what}" for at, what in found]
        if not problems:
            return plan
    raise ConfigError(toml.list_faults(where, problems))


# ------------------------------------------------- consistency of several keys


def _problems(plan: Plan, system: System) -> Iterator[tuple[toml.Location, str]]:
    """Yield (location, problem) for problems that involve several values."""
    first: dict[str, int] = {}
    for i, recording in enumerate(plan.recordings):
        name = recording.id.lower()  # some file systems ignore case
        if name in first:
            yield ("recordings", i, "id"), f"used before, by recordings[{first[name] + 1}]"
        first.setdefault(name, i)
        for key, what in recording_problems(recording, plan.limits, system):
            yield ("recordings", i, *key.split(".")), what


def recording_problems(
    recording: Recording, limits: PlanLimits, system: System
) -> Iterator[tuple[str, str]]:
    """Yield (key, problem) for problems that involve several values of a recording."""
    n, carts, wave = system.carts, recording.carts, recording.wave
    if not _ID.fullmatch(recording.id):
        wanted = "letters, digits, dots, dashes; its data files are named after it"
        yield "id", f"expected {wanted}, found {toml.quote(recording.id)}"
    if DEVICE.fullmatch(recording.id):
        yield "id", f"{recording.id} is a device on Windows, not a file; choose another id"
    if not carts or len(set(carts)) < len(carts) or not all(1 <= cart <= n for cart in carts):
        yield "carts", f"expected some of the carts 1 to {n}, each once, found {list(carts)}"
    if recording.release is not None and recording.release not in carts:
        yield "release", f"expected a cart that is free, found {recording.release}"
    yield from _time_problems(recording)
    if recording.duration > LONGEST_RUN:
        yield (
            "cycles",
            f"the recording takes {recording.duration:,.0f} s; the limit is {LONGEST_RUN:g} s",
        )
    yield from _amplitude_problems(recording, limits, system)
    if (recording.kind == "sine") != (wave == "sine"):
        yield "wave", f'a dwell of kind "sine" and the wave "sine" go together, found {wave!r}'
    if wave != "chirp" and recording.frequency_end is not None:
        yield "frequency_end", "belongs to a chirp"
    if wave == "chirp" and recording.frequency_end in (None, recording.frequency):
        yield "frequency_end", "a chirp must end at a different frequency from the one it starts at"
    if (wave == "multisine") != bool(recording.tones) or len(recording.tones) > MOST_TONES:
        found = len(recording.tones)
        yield "tones", f"expected 1 to {MOST_TONES} for a multisine, else none, found {found}"
    elif recording.tones and _peak(recording) > 1.01:  # the true peak may lie between the points
        yield "tones", f"their sum reaches {_peak(recording):.3g} times `amplitude`; 1 is the limit"
    yield from _loop_problems(recording, n)


def _peak(recording: Recording) -> float:
    """Return the peak of a multisine of amplitude 1."""
    h, share, phase = (column[:, None] for column in np.array(recording.tones).T)
    # 16 points per period of the highest tone.
    turns = np.linspace(0.0, 1.0, 16 * int(h.max()), endpoint=False)
    return float(np.max(np.abs((share * np.sin(2 * np.pi * h * turns + phase)).sum(axis=0))))


def _time_problems(recording: Recording) -> Iterator[tuple[str, str]]:
    """Yield problems with times for which a bench would ignore the command and send no data."""
    low, high = FREQUENCIES
    for key in ("frequency", "frequency_end"):
        hertz = getattr(recording, key)
        if hertz is not None and not low <= hertz <= high:
            yield key, f"expected {low:g} to {high:g} Hz, found {hertz:g}"
    # A rest is a run of one period, so the same limits apply.
    if recording.settle and not 1 / high <= recording.settle <= LONGEST_RUN:
        expected = f"0, or {1 / high:g} to {LONGEST_RUN:g} s"
        yield "settle", f"expected {expected}, found {recording.settle:g}"


def _amplitude_problems(
    recording: Recording, limits: PlanLimits, system: System
) -> Iterator[tuple[str, str]]:
    closed = recording.kind == "closed_loop"
    limit, unit = (
        (limits.travel, system.position.unit) if closed else (limits.input, system.input.unit)
    )
    size = recording.amplitude
    if abs(size) > limit:
        yield "amplitude", f"expected at most the limit of {limit:g} {unit}, found {size:g}"
    if size == 0 and recording.release is None:
        yield "amplitude", "0 moves nothing; a decay started by hand needs `release`"
    if size != 0 and 1 not in recording.carts:
        yield "amplitude", "the motor drives cart 1, which is held: expected 0"


def _loop_problems(recording: Recording, n: int) -> Iterator[tuple[str, str]]:
    loop, closed = recording.controller, recording.kind == "closed_loop"
    if closed != (loop is not None):
        needed = "a closed loop needs one" if closed else "belongs to a closed loop"
        yield "controller", needed
    if isinstance(loop, StateLoop):
        if len(loop.gains) not in (0, 2 * n):
            yield "controller.gains", f"expected {2 * n} gains or none, found {len(loop.gains)}"
        if bool(loop.gains) != (loop.prefilter is not None):
            yield "controller", "state both gains and prefilter, or neither to use the design"
    if loop is not None and not 1 <= loop.cart <= n:
        yield "controller.cart", f"there is no cart {loop.cart}, the system has {n}"
    if closed and recording.carts != tuple(range(1, n + 1)):
        yield "carts", "a closed loop needs all carts free"
