"""Propose recordings: cautious runs first, then runs chosen with the identified carts.

At first nothing is known, so inputs are a few percent of the motor's range, and carts are released
by hand. After a sweep, the identified carts determine the dwell frequencies and inputs. After the
dwells, the designed controller is run.
"""

from collections.abc import Callable, Sequence
from math import ceil, floor, log10
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from pipeline.errors import ConfigError, DataError
from pipeline.experiments.gains import LoopTrial, rounded
from pipeline.experiments.plan import (
    Plan,
    PlanLimits,
    Recording,
    StateLoop,
    add_recordings,
    load_plan,
    plan_path,
    recording_problems,
    renamed,
)
from pipeline.ingest.read import DUTY_COUNT
from pipeline.plant import simulate
from pipeline.plant.chain import Chain
from pipeline.protocol import CHIRP_SPAN, FREQUENCIES, FULL_SCALE, Description
from pipeline.results import Analysis, Stage
from pipeline.submission import Design, Submission, System, load_submission
from pipeline.words.numbers import count
from pipeline.words.progress import Progress
from pipeline.workflow import analyse

# ---------------------------------------------------------------------- proposals

AIM = 0.4  # the intended motion of the carts, as a share of the travel limit
# The motion allowed for a transient, as a share of the travel limit; the first model may be wrong.
FURTHEST = 0.8

# About 1 cm in common units; an ECP 210 has 440 counts per centimetre.
_ABOUT_1_CM = {"m": 0.01, "cm": 1.0, "mm": 10.0, "in": 0.4, "count": 440.0, "counts": 440.0}

# Shares of the input limit while nothing is known. A bench's motor moves its carts some 5 to 15 cm
# at full scale, and at a resonance several times as far.
_FIRST_STEP = 0.04
_REPEATS = "ab"  # one decay for each letter
EDGES = 4  # half periods of a step: off, on, off, on
_SWEEP_TIME = 20.0  # s
_FIRST_SETTLE = 5.0  # s
FIRST_SWEEP_TIME = _SWEEP_TIME + _FIRST_SETTLE  # s, the same on every bench

_DWELLS = 24
_STEP = 0.9  # final level of a step, as a share of the aim; the step overshoots up to twice as far


def current_plan(submission: Submission, *, bench: Description | None = None) -> Plan:
    """Return the plan of a submission, or a proposal if the file is missing."""
    there = plan_path(submission).exists()
    return load_plan(submission) if there else propose_plan(submission, bench=bench)


def make_plan(
    submission: Submission, *, stock: bool = False, progress: Progress
) -> tuple[str, str]:
    """Write plan.toml, or add the recordings that the data make possible.

    Returns what was written, in one sentence, and why the data could not be used; "" if they were
    used, or if there are no data.

    Parameters
    ----------
    stock : whether the bench knows only the stock commands.
    """
    carts = submission.system.carts
    bench = Description(name="stock", encoders=2, carts=carts) if stock else None
    there, old = plan_path(submission).exists(), current_plan(submission, bench=bench)
    progress("choosing further recordings")
    try:
        new, trouble = extend_plan(old, submission, bench=bench), ""
    except DataError as error:  # if the data cannot be used, the plan stays as it is
        new, trouble = old, str(error)
    added = new.recordings[len(old.recordings) :]
    add_recordings(submission.folder, added, otherwise=old)
    path = plan_path(submission)
    if there:
        return f"{path}: {count(len(added), 'recording')} added", trouble
    return f"wrote {path}: check its [limits]", trouble


def propose_plan(submission: Submission, *, bench: Description | None = None) -> Plan:
    """Propose the first recordings from the submission's statements about the bench, without data.

    Recordings that the submission already has are not proposed. `extend_plan` adds later ones.

    Parameters
    ----------
    bench : the bench's own description; None for a bench that knows every command.
    """
    system, recorded = submission.system, submission.experiments
    limits = _limits(system, submission.design, bench)
    kinds = {e.kind for e in recorded if len(e.carts) == system.carts}
    proposed: list[Recording] = []
    for cart in range(1, system.carts + 1):
        moves_back = system.springs[cart - 1] or system.springs[cart]
        if moves_back and not any(e.kind == "decay" and e.carts == (cart,) for e in recorded):
            names = [f"decay-{cart}{repeat}" for repeat in _REPEATS]
            proposed += [release_by_hand(cart, name=name, seconds=10.0) for name in names]
    if system.bench.tied and not kinds & {"step", "sine", "bode"}:
        proposed += _steps(
            [sign * _FIRST_STEP * limits.input for sign in (1, -1)],
            carts=system.carts,
            edge=5.0,  # s between edges of the first steps
            settle=_FIRST_SETTLE,
        )
    if not kinds & {"sweep", "sine", "bode"}:
        proposed.append(_sweep(system, limits, chirps=bench is None or "c" in bench.commands))
    recordings = renamed(proposed, taken=[e.id for e in recorded])
    plan = Plan(limits=limits, recordings=recordings)
    return plan.model_copy(update={"baud": bench.baud}) if bench else plan


def extend_plan(plan: Plan, submission: Submission, *, bench: Description | None = None) -> Plan:
    """Add what the recorded data make possible: dwells after a sweep, the loop after dwells.

    Existing entries stay unchanged and in place. Dwells and loops are added only if no such
    recording exists yet. A bench without state feedback gets a PID on cart 1.

    Raises
    ------
    DataError : the data do not identify the carts, or no loop can be closed on them.
    """
    stages: list[Callable[[Analysis], list[Recording]]] = []
    if _wants_dwells(plan, submission):
        stages.append(lambda analysis: _driven(identified_chain(analysis), plan.limits))
    if _wants_loop(plan, submission):
        stages.append(lambda analysis: [_loop(analysis, submission, plan.limits, bench)])
    if not stages:
        return plan
    analysis = analyse(submission)
    proposed = [recording for stage in stages for recording in stage(analysis)]
    taken = [entry.id for entry in (*plan.recordings, *submission.experiments)]
    return plan.model_copy(
        update={"recordings": (*plan.recordings, *renamed(proposed, taken=taken))}
    )


def _wants_dwells(plan: Plan, submission: Submission) -> bool:
    """Return whether dwells should be added: no dwell exists, and a sweep is recorded.

    If no sweep is planned, a recorded step is enough.
    """
    n, recorded = submission.system.carts, submission.experiments
    kinds = {e.kind for e in recorded if len(e.carts) == n}
    if any(r.aim for r in plan.recordings):  # these replace the standard dwells
        return False
    if kinds & {"sine", "bode"} or any(r.kind == "sine" for r in plan.recordings):
        return False
    ids = {e.id for e in recorded}
    sweep_to_come = any(r.kind == "sweep" and r.id not in ids for r in plan.recordings)
    return "sweep" in kinds or ("step" in kinds and not sweep_to_come)


def _wants_loop(plan: Plan, submission: Submission) -> bool:
    """Return whether to add a loop: no loop exists, and all planned dwells are recorded."""
    ids = {e.id for e in submission.experiments}
    kinds = {e.kind for e in submission.experiments}
    kinds_planned = {r.kind for r in plan.recordings}
    dwells_to_come = any(r.kind == "sine" and r.id not in ids for r in plan.recordings)
    return (
        bool(kinds & {"sine", "bode"})
        and not dwells_to_come
        and "closed_loop" not in kinds | kinds_planned
    )


# --------------------------------------------------------- before anything is known


def _limits(system: System, design: Design | None, bench: Description | None) -> PlanLimits:
    """Return the stated limits, or usual ones that a person must check."""
    per_count = system.input.per_count or (bench.input_per_count if bench else None)
    if per_count is None and system.input.unit == "V":
        per_count = DUTY_COUNT
    stated = design.input_limit if design else None
    # In an unknown unit, nobody knows which input the motor takes, so a usual value is proposed.
    most = FULL_SCALE * per_count if per_count else stated or 5.0
    asked = abs(design.reference) if design else 1.0
    travel = _ABOUT_1_CM.get(system.position.unit, asked or 1.0) / AIM
    if design:
        travel = max(travel, asked / FURTHEST)
    return PlanLimits(input=min(most, stated or most), travel=rounded(travel))


def release_by_hand(cart: int, *, name: str, seconds: float) -> Recording:
    """Return the recording of one cart that is released by hand while the others are held."""
    return Recording(
        id=name,
        kind="decay",
        carts=(cart,),
        wave="delta",
        amplitude=0.0,
        frequency=1 / seconds,
        release=cart,
        settle=1.0,
    )


def _steps(
    amplitudes: Sequence[float], *, carts: int, edge: float, settle: float
) -> list[Recording]:
    return [
        Recording(
            id=f"step-{number}",
            kind="step",
            carts=tuple(range(1, carts + 1)),
            wave="square",
            amplitude=rounded_down(amplitude),
            frequency=rounded_down(0.5 / edge),
            cycles=EDGES // 2,
            settle=settle,
        )
        for number, amplitude in enumerate(amplitudes, start=1)
    ]


def _sweep(system: System, limits: PlanLimits, *, chirps: bool) -> Recording:
    """Return one chirp over the usual frequencies, or without chirps a long square wave."""
    # A chirp ends at 20 times this frequency. The edges of the square wave are 2.5 s apart.
    frequency = 0.5 if chirps else 0.5 / 2.5
    return Recording(
        id="sweep",
        kind="sweep",
        carts=tuple(range(1, system.carts + 1)),
        wave="chirp" if chirps else "square",
        amplitude=rounded_down(0.02 * limits.input),
        frequency=frequency,
        frequency_end=CHIRP_SPAN * frequency if chirps else None,
        cycles=round(_SWEEP_TIME * frequency),
        settle=_FIRST_SETTLE,
    )


# ------------------------------------------------------- from the identified carts


def identified_chain(analysis: Analysis) -> Chain:
    """Return the identified carts.

    Raises
    ------
    DataError : the carts are not identified; the message gives the reason.
    """
    fit = analysis.fit
    if fit is None or not fit.converged:
        why = fit.message if fit else _reason(analysis, Stage.FINAL_ESTIMATES, Stage.BODE_FIT)
        raise DataError(
            f"the next recordings need identified carts, but the carts are not identified: {why}"
        )
    if not fit.chain.is_tied:
        raise DataError(
            "no dwells can be proposed: no spring ties the carts to a wall, so they drift; add "
            "sweeps to plan.toml instead"
        )
    return fit.chain


def _reason(analysis: Analysis, *stages: Stage) -> str:
    return "; ".join(s.reason for s in analysis.skipped if s.stage in stages) or "see the report"


def large_steps(chain: Chain, limits: PlanLimits) -> list[Recording]:
    """Return steps in both directions, as large as intended or as the input limit allows."""
    settle = rounded(simulate.settling_wait(chain, time_constants=simulate.SETTLED))
    hold = AIM * limits.travel / float(np.max(np.abs(chain.static_gains())))
    size = min(_STEP * hold, limits.input)
    return _steps([size, -size], carts=chain.n, edge=settle, settle=settle)


def _driven(chain: Chain, limits: PlanLimits) -> list[Recording]:
    """Return steps and dwells in which the carts move as far as intended."""
    aim, furthest = AIM * limits.travel, FURTHEST * limits.travel
    settle = rounded(simulate.settling_wait(chain, time_constants=simulate.SETTLED))
    recordings = large_steps(chain, limits)
    wait = simulate.settling_wait(chain, time_constants=simulate.SETTLED_DWELL)
    for number, hertz in enumerate(simulate.dwell_frequencies(chain, n=_DWELLS), start=1):
        cycles = ceil(hertz * (wait + simulate.steady_time(hertz)))
        t = np.arange(0.0, cycles / hertz, min(0.005, 1 / (40 * hertz)))
        shape = np.sin(2 * np.pi * hertz * t)
        steady, most = simulate.largest_motion(chain, t, shape=shape, wait=wait)
        amplitude = min(aim / steady, furthest / most, limits.input)
        recordings.append(
            Recording(
                id=f"sine-{number:02d}",
                kind="sine",
                carts=tuple(range(1, chain.n + 1)),
                wave="sine",
                amplitude=rounded_down(amplitude),
                frequency=hertz,
                cycles=cycles,
                settle=settle,
            )
        )
    return recordings


def _loop(
    analysis: Analysis, submission: Submission, limits: PlanLimits, bench: Description | None
) -> Recording:
    """Return a closed-loop recording in which the set point steps on and off.

    It uses the designed controller or, on a stock bench, a PID.

    Raises
    ------
    DataError : no controller was designed, or no PID is possible; the message gives the reason.
    """
    feedback = analysis.feedback
    if feedback is None:
        raise DataError(
            f"no closed loop can be proposed: {_reason(analysis, Stage.STATE_FEEDBACK)}"
        )
    task = submission.design or Design(cart=feedback.cart)
    # Carts between the motor and the controlled cart may move further than the controlled cart.
    furthest = float(np.max(np.abs(feedback.y)) / abs(feedback.reference))
    size = min(abs(task.reference), FURTHEST * limits.travel / furthest)
    edge = max(3.0 * task.settling_time, 2.0)  # s between steps of the set point
    recording = Recording(
        id="control",
        kind="closed_loop",
        carts=tuple(range(1, submission.system.carts + 1)),
        wave="square",
        amplitude=rounded_down(size) if size < abs(task.reference) else task.reference,
        frequency=rounded_down(0.5 / edge),
        cycles=EDGES // 2,
        controller=StateLoop(cart=feedback.cart),
        settle=rounded(
            simulate.settling_wait(identified_chain(analysis), time_constants=simulate.SETTLED)
        ),
    )
    if bench is None or "f" in bench.commands:
        return recording
    trial = LoopTrial(
        recording=recording, submission=submission, analysis=analysis, bench=bench, limits=limits
    )
    return recording.model_copy(update={"controller": trial.propose_pid()})


def rounded_down(value: float) -> float:
    """Return the number with two significant digits, rounded towards zero."""
    size = 10.0 ** (floor(log10(abs(value))) - 1)
    return float(f"{floor(abs(value) / size * (1 + 1e-12)) * size:.2g}") * (1 if value > 0 else -1)


# ------------------------------------------ a recording from the few numbers that a person types

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


def make_recording(
    kind: RecordingKind,
    *,
    seconds: float,
    amplitude: float = 0.0,
    frequency: float = 0.0,
    frequency_end: float = 0.0,
    cart: int = 1,
    plan: Plan,
    submission: Submission,
) -> Recording:
    """Return a recording from its few numbers; all carts are free unless one is released by hand.

    A driven recording waits beforehand as long as the last driven recording of the plan.

    Parameters
    ----------
    seconds : duration, 1 to 120. For a dwell or sweep it is rounded to whole periods.
    amplitude : in input units.
    frequency, frequency_end : in Hz, of a dwell, or at the start and the end of a sweep.
    cart : the cart that is released for a decay.

    Raises
    ------
    ConfigError : the plan's limits do not allow it; the message names the number and the reason.
    """
    everyone = tuple(range(1, submission.system.carts + 1))
    low, high = FREQUENCIES
    if not _SHORTEST <= seconds <= _LONGEST:
        expected = f"{_SHORTEST:g} to {_LONGEST:g} s"
        raise ConfigError(
            f"seconds: expected {expected}, found {seconds:g}; for longer ones edit plan.toml"
        )
    named = {"frequency": frequency, "frequency_end": frequency_end}
    for key in [key for key in named if key in NEEDED[kind]]:
        if not low <= named[key] <= high:
            name = TYPED.get(key, key)
            raise ConfigError(f"{name}: expected {low:g} to {high:g} Hz, found {named[key]:g}")
    if kind == "decay":
        made = release_by_hand(cart, name=f"decay-{cart}", seconds=seconds)
    else:
        driven = [one.settle for one in plan.recordings if one.amplitude]
        cycles = _count_periods(seconds, frequency) if kind != "step" else EDGES // 2
        made = Recording(
            id=f"{kind}-1",
            kind=kind,
            carts=everyone,
            wave=_WAVES[kind],
            amplitude=amplitude,
            frequency=frequency if kind != "step" else cycles / seconds,
            frequency_end=frequency_end if kind == "sweep" else None,
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
