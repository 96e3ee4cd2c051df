"""Implement `cartlab plan --next`: choose the most useful experiments and predict the benefit."""

import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, isclose
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import ConfigError, DataError
from pipeline.experiments.information import (
    GAP,
    WORST,
    FisherInformation,
    Goal,
    check_goal,
    choose,
    find_goal,
)
from pipeline.experiments.plan import (
    Plan,
    PlanLimits,
    Recording,
    add_recordings,
    plan_path,
    session_time,
    time_words,
)
from pipeline.experiments.propose import FURTHEST, current_plan, rounded, rounded_down
from pipeline.gap.types import read_gap
from pipeline.ingest.read import read_data
from pipeline.names import parameter_names
from pipeline.plant.limits import CALIBRATION
from pipeline.plant.simulate import SETTLED, SETTLED_DWELL, dwell_frequencies, settling_wait
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.submission.toml import read_text
from pipeline.words.numbers import count, first_few
from pipeline.words.progress import Progress
from pipeline.workflow import analyse

# ---------------------------------------------------------------------- multisines with a low peak

Tones = tuple[tuple[int, float, float], ...]
Lines = NDArray[np.int64]  # numbers of harmonics

_QUANTA = 16  # The motion's power has so many equal parts; each goes to the most informative line.
# The lines lie between these multiples of the first and the last resonance.
_LOW, _HIGH = 0.3, 1.6
_CLIP_AT = 0.8  # clipping level, as a share of the peak
_DIGITS = 4  # digits of shares and phases in the file


def optimal_tones(
    known: FisherInformation, *, base: float, seconds: float, travel: float, goal: Goal
) -> Tones:
    """Return harmonic, share of the peak and phase (rad) of each line of a multisine.

    Parameters
    ----------
    base : fundamental frequency in Hz.
    seconds, travel : duration in s, and limit of the motion in position units.
    """
    resonances = np.sort(np.abs(known.chain.poles)) / (2 * np.pi)
    low, high = _LOW * resonances[0], _HIGH * resonances[-1]
    lines = np.arange(max(1, round(low / base)), max(3, round(high / base)) + 1, dtype=np.int64)
    omega = np.asarray(2 * np.pi * base * lines, dtype=np.float64)
    G = known.chain.frequency_response(omega)
    reach = np.max(np.abs(G), axis=0)
    # Amplitude of the motion for one part of the power; the peak is about 1.8 times the rms.
    each = travel / 1.8 * np.sqrt(2 / _QUANTA)
    information = known.of_lines(omega, amplitude=each / reach, seconds=seconds)
    chosen = choose(information, known.information, n=_QUANTA, goal=goal)
    which, count = np.unique(chosen, return_counts=True)
    size = np.sqrt(count) / reach[which]
    phase = low_peak_phases(lines[which], size, G[:, which])
    peak = _peak(lines[which], size * np.exp(1j * phase))
    shares, phases = np.round(size / peak, _DIGITS), np.round(phase % (2 * np.pi), _DIGITS)
    return tuple(zip(lines[which].tolist(), shares.tolist(), phases.tolist(), strict=True))


def schroeder_phases(size: Array) -> Array:
    """Return phases (n,) in rad that keep the peak low for lines of sizes `size` (n,)."""
    power = size**2 / np.sum(size**2)
    return -2 * np.pi * np.cumsum(np.cumsum(power) - power)


def low_peak_phases(lines: Lines, size: Array, G: ComplexArray) -> Array:
    """Return phases (n,) for which the largest swing of the carts is small.

    Repeatedly, the motion is clipped and the phases of the clipped motion are used for the next
    round. `G` (carts, n) is the frequency response at the lines.
    """
    motion = size * G
    phase = schroeder_phases(np.max(np.abs(motion), axis=0))
    best, lowest = phase, np.inf
    for _ in range(200):
        x = _synthesise(lines, motion * np.exp(1j * phase))
        top = float(np.max(np.abs(x)))
        if top < lowest:
            best, lowest = phase, top
        spectrum = np.fft.rfft(np.clip(x, -_CLIP_AT * top, _CLIP_AT * top))[:, lines]
        # A sine is -j times half its line in the spectrum. The carts are weighted by their motion.
        phase = np.angle(np.sum(1j * spectrum * np.conj(motion), axis=0))
    return best


def _synthesise(lines: Lines, amplitude: ComplexArray) -> Array:
    """Return sums (…, points) of sines of complex amplitude (…, n), over one period."""
    points = 1 << int(np.ceil(np.log2(16 * lines[-1])))  # 16 points in a period of the highest line
    spectrum = np.zeros((*amplitude.shape[:-1], points // 2 + 1), dtype=np.complex128)
    spectrum[..., lines] = -0.5j * points * amplitude
    return np.fft.irfft(spectrum, points)


def _peak(lines: Lines, amplitude: ComplexArray) -> float:
    return float(np.max(np.abs(_synthesise(lines, amplitude))))


# ----------------------------------------------- candidates, as large as the travel limit allows

_PERIODS = 2  # periods of a multisine in a record
_BAND = (0.4, 1.6)  # lowest and highest frequency, as multiples of the first and the last resonance
_DWELLS = 40  # number of frequencies for dwells


def propose_candidates(
    known: FisherInformation, *, limits: PlanLimits, commands: Collection[str], goal: Goal
) -> list[Recording]:
    """Return the recordings that could come next, with all carts free.

    These are dwells if the carts are identified from dwells. Otherwise they are chirps, square
    waves and multisines, if the bench knows the `commands` for them.

    Raises
    ------
    DataError : the limits allow no candidate, or dwells would take too long to settle.
    """
    made = list(_dwells(known) if known.dwells else _broadband(known, limits, commands, goal))
    settle = rounded(settling_wait(known.chain, time_constants=SETTLED))
    carts = tuple(range(1, known.chain.n + 1))
    candidates = []
    for recording in made:
        whole = recording.model_copy(update={"carts": carts, "settle": settle})
        size = known.at_its_limits(whole, limits=limits, share=FURTHEST)
        if size > 0:
            candidates.append(whole.model_copy(update={"amplitude": rounded_down(size)}))
    if not candidates:
        raise DataError(
            "no next experiment: the limits of plan.toml allow none"
            if made
            else "no next experiment: dwells of these carts take too long to settle"
        )
    return candidates


def _dwells(known: FisherInformation) -> Iterator[Recording]:
    """Yield dwells; each lasts twice as long as the carts need to reach the steady state.

    If the steady state takes too long to reach, no dwell is yielded. A transient would be mistaken
    for a steady state.
    """
    wait = settling_wait(known.chain, time_constants=SETTLED_DWELL)
    if wait * np.min(-known.chain.poles.real) < SETTLED:
        return
    for hertz in dwell_frequencies(known.chain, n=_DWELLS):
        cycles = ceil(2 * wait * hertz)
        yield _free("sine-01", "sine", frequency=hertz, cycles=cycles)


def _broadband(
    known: FisherInformation, limits: PlanLimits, commands: Collection[str], goal: Goal
) -> Iterator[Recording]:
    resonances = np.sort(np.abs(known.chain.poles)) / (2 * np.pi)
    seconds = float(rounded(max(20.0, 20 / resonances[0])))  # 20 s, or 20 of the slowest periods
    for hertz in np.geomspace(0.1 * resonances[0], resonances[-1], 8):
        f = rounded(float(hertz))
        yield _free("square-1", "square", frequency=f, cycles=ceil(seconds * f))
    if "c" in commands:
        edges = [
            rounded(float(f))
            for f in np.geomspace(_BAND[0] * resonances[0], _BAND[1] * resonances[-1], 6)
        ]
        for low, high in ((a, b) for a in edges for b in edges if a < b):
            cycles = ceil(seconds * low)
            yield _free("sweep-1", "chirp", frequency=low, end=high, cycles=cycles)
    if "m" in commands:
        base = rounded(_PERIODS / seconds)
        travel = FURTHEST * limits.travel
        tones = optimal_tones(known, base=base, seconds=seconds, travel=travel, goal=goal)
        yield _free("multisine-1", "multisine", frequency=base, cycles=_PERIODS, tones=tones)


def _free(name, wave, *, frequency, cycles, end=None, tones=()) -> Recording:
    return Recording(
        id=name,
        kind="sine" if wave == "sine" else "sweep",
        carts=(1,),
        wave=wave,
        amplitude=1.0,
        frequency=frequency,
        frequency_end=end,
        cycles=cycles,
        tones=tones,
    )


# ---------------------------------------------------------------------- the choice

_ALONE = 4  # most planned recordings whose own benefit is listed
STATISTICAL = (
    "these errors include only noise; no bench is calibrated to better than "
    f"{100 * CALIBRATION:g} %"
)


@dataclass(frozen=True, kw_only=True)
class NextPlan:
    """The chosen experiments, and the expected error after each of them.

    Attributes
    ----------
    now : present relative error.
    errors : (n + 1,) relative error after the open recordings of the plan, then after each chosen
        experiment.
    planned : relative error after each open recording of the plan alone, by the recording's id.
    separation : only for "gap": distance between the two explanations that the recording separates
        best, in standard deviations of the noise.
    wrote : the change of plan.toml, in words.
    doubt : why the errors are not reliable, whatever is recorded; empty if they are reliable.
    """

    words: str
    plan: Plan
    path: Path | None
    recordings: tuple[Recording, ...]
    now: float = float("nan")
    errors: tuple[float, ...] = ()
    planned: dict[str, float] = field(default_factory=dict)
    separation: float | None = None
    wrote: str = ""
    doubt: str = ""

    @property
    def summary(self) -> str:
        """The benefit of the experiments in one sentence."""
        return "; ".join(self.sentences)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The benefit of the experiments, with notes."""
        if self.separation is not None:
            return (
                f"{self.recordings[0].id} tells two explanations of the gap apart by "
                f"{self.separation:.2g} times the noise",
            )
        these = "these are" if len(self.recordings) > 1 else "this one is"
        done = "recorded"
        steps = [f"{self.words}: ± {_percent(self.now)} now"]
        if self.planned:
            steps.append(f"± {_percent(self.errors[0])} once the plan so far is recorded")
            done = "too"
        steps.append(
            f"± {_percent(self.errors[-1])} once {these} {done} "
            f"({time_words(session_time(self.recordings))} at the bench)"
        )
        alone = [f"{name} alone ± {_percent(error)}" for name, error in self.planned.items()]
        notes = (
            ", ".join(steps),
            f"recordings of the plan so far: {first_few(alone, _ALONE)}" if alone else "",
            STATISTICAL if self.errors[-1] < CALIBRATION else "",
            self.doubt,
        )
        return tuple(sentence for sentence in notes if sentence)


def plan_next(
    submission: Submission,
    *,
    n: int,
    goal: str = WORST,
    commands: frozenset[str],
    progress: Progress,
) -> NextPlan:
    """Choose the `n` next experiments of a submission and add them to its plan.toml.

    Parameters
    ----------
    commands : the extensions of the protocol that the bench knows.

    Raises
    ------
    DataError : the recorded data do not identify the carts, so nothing can be predicted.
    ConfigError : there is no such goal, or gap.json is broken or was made from other data or
        limits.
    """
    path = plan_path(submission)
    old, new = current_plan(submission), not path.exists()
    if goal == GAP:
        if n != 1:
            raise ConfigError(f"--for gap chooses one recording: expected --next 1, found {n}")
        recording, separation = _decisive(submission, old.limits)
        found = NextPlan(
            words="gap", plan=old, path=path, recordings=(recording,), separation=separation
        )
        done = {experiment.id for experiment in submission.experiments}
        open_ = [one for one in old.recordings if one.id not in done]
        if not new and (there := next((o for o in open_ if o.resembles(recording)), None)):
            return replace(found, recordings=(there,), wrote=f"{path}: has {there.id} already")
    else:
        system = submission.system
        check_goal(goal, names=parameter_names(system.carts, rigid=not system.bench.tied))
        progress("evaluating the data")
        analysis = analyse(submission)
        progress("weighing the next experiments")
        found = choose_next(analysis, old, n=n, goal=goal, commands=commands)
        found = replace(found, path=path, doubt=_doubt(analysis, submission.folder))
    plan = add_recordings(submission.folder, found.recordings, otherwise=old)
    wrote = f"{path}: {count(n, 'recording')} added"
    if new and old.recordings:
        usual = count(len(old.recordings), "recording")
        chosen = count(n, "chosen recording")
        wrote = f"wrote {path}: the {usual} that every plan begins with, and {chosen}"
    return replace(found, plan=plan, recordings=plan.recordings[-n:], wrote=wrote)


def _doubt(analysis: Analysis, folder: Path) -> str:
    """Return a warning if the residual exceeds the noise, which predicted errors do not count."""
    fit = analysis.fit
    if fit is None or fit.explains_data:
        return ""
    return (
        f"the linear carts leave a residual above the noise (χ² per degree of freedom "
        f"{fit.chi_square_per_dof:.3g}), so parameters may be off by more than these errors; "
        f"`cartlab gap {folder}` looks for the missing effect"
    )


def choose_next(
    analysis: Analysis,
    plan: Plan,
    *,
    n: int,
    goal: str,
    commands: frozenset[str],
    without: Sequence[Recording] = (),
) -> NextPlan:
    """Choose the `n` next experiments, and predict the error after each.

    Parameters
    ----------
    without : recordings that the chosen experiments must not resemble.

    Raises
    ------
    DataError, ConfigError : see `plan_next`.
    """
    known = FisherInformation.of(analysis)
    wanted = find_goal(goal, known, feedback=analysis.feedback)
    candidates = [
        one
        for one in propose_candidates(known, limits=plan.limits, commands=commands, goal=wanted)
        if not any(one.resembles(other) for other in without)
    ]
    if not candidates:
        raise DataError("every useful recording was refused before")
    information = np.array([known.of_recording(candidate) for candidate in candidates])
    done = {record.id for record in analysis.records}
    still = {
        one.id: known.of_recording(one)
        for one in plan.recordings
        if one.id not in done and not why_useless(one, known, limits=plan.limits)
    }
    start = known.information + sum(still.values())
    chosen = choose(information, start, n=n, goal=wanted)
    sums = np.concatenate([start[None], information[list(chosen)]]).cumsum(axis=0)
    errors = wanted.of(sums)
    if not errors[-1] < errors[0]:
        raise DataError(f"no experiment that the limits allow makes {wanted.words} smaller")
    words = _words(wanted, known, after=sums[-1])
    recordings = tuple(
        candidates[one].model_copy(
            update={"aim": wanted.name, "note": _promise(words, before, after)}
        )
        for one, before, after in zip(chosen, errors, errors[1:], strict=False)
    )
    return NextPlan(
        words=words,
        plan=plan,
        path=None,
        recordings=recordings,
        now=float(wanted.of(known.information)),
        errors=tuple(errors.tolist()),
        planned={name: float(wanted.of(known.information + one)) for name, one in still.items()},
    )


def why_useless(recording: Recording, known: FisherInformation, *, limits: PlanLimits) -> str:
    """Return why a recording would not improve the carts' parameters; "" if it would."""
    kinds = ("sine",) if known.dwells else ("step", "sweep")
    if recording.kind not in kinds:
        used = "dwells" if known.dwells else "steps and sweeps"
        what = "dwell" if recording.kind == "sine" else recording.kind.replace("_", " ")
        return f"the carts are identified from {used} here, but this is a {what}"
    if len(recording.carts) < known.chain.n:
        return "the carts are identified from records with all of them free"
    most = known.at_its_limits(recording, limits=limits, share=1.0)
    if abs(recording.amplitude) > most:
        return (
            f"it would be stopped at the travel limit; with an amplitude up to {most:.2g} it would "
            "not be stopped"
        )
    return ""


def _decisive(submission: Submission, limits: PlanLimits) -> tuple[Recording, float]:
    """Return the recording that `cartlab gap` proposes, and its predicted separation.

    Raises
    ------
    DataError : there is no gap.json, or it contains no proposal.
    ConfigError : gap.json is broken, or was made from other data or limits.
    """
    path = submission.folder / "gap" / "gap.json"
    command = f"`cartlab gap {submission.folder}`"
    if not path.is_file():
        raise DataError(f"--for gap: there is no {path}: run {command} first")
    text = read_text(path, where="gap/gap.json", limit=10_000_000, error=ConfigError)
    try:
        found = read_gap(text)
        if found.proposal is None:
            raise DataError(
                "--for gap: gap/gap.json proposes no recording, because there is nothing to decide "
                f'(its verdict is "{found.verdict}")'
            )
        recording = Recording.model_validate_json(json.dumps(found.proposal.recording))
    except (ConfigError, ValidationError):
        raise ConfigError(
            f"--for gap: gap/gap.json is not what cartlab gap writes: run {command} again"
        ) from None
    system = submission.system
    of = (found.bench.n, found.bench.units.position, found.bench.units.input)
    here = (system.carts, system.position.unit, system.input.unit)
    if of != here or found.provenance.files != read_data(submission).files:
        raise ConfigError(f"--for gap: gap/gap.json was made from other data: run {command} again")
    kept = found.proposal.limits
    # gap.json has only ten digits.
    if not all(isclose(kept.get(name, 0.0), limit, rel_tol=1e-9) for name, limit in limits):
        raise ConfigError(
            f"--for gap: the limits in plan.toml are not those of gap/gap.json: run {command} again"
        )
    return recording, found.proposal.separation


def _words(goal: Goal, known: FisherInformation, *, after: Array) -> str:
    if goal.name != WORST:
        return goal.words
    names = list(known.chain.parameters())
    now, then = (names[goal.worst(information)] for information in (known.information, after))
    which = now if now == then else f"now {now}, then {then}"
    return f"{goal.words} ({which})"


def _promise(words: str, before: float, after: float) -> str:
    """Return the predicted benefit of one recording in words, for its note."""
    doubt = f"; {STATISTICAL}" if after < CALIBRATION else ""
    return f"{words}: ± {_percent(before)} before, ± {_percent(after)} expected{doubt}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


# The fit treats the error of each sample as independent, but for a cart that hardly moves the
# rounding error is the same in many samples.
_WHY_WORSE = (
    "the fit would be worse: the rounding errors of encoders do not average out while carts rest, "
    "or move by few counts; try a larger motion, or a shorter run"
)


@dataclass(frozen=True, kw_only=True)
class ComparedRecordings:
    """Relative errors: now, after only the proposed recording, and after only the best recording.

    Attributes
    ----------
    words : the error to reduce, such as "the error of zeta_2".
    why : why the proposed recording does not help, or even does harm; empty if it helps.
    """

    words: str
    now: float
    proposed: float
    why: str
    chosen: Recording
    best: float


def compare_recordings(
    analysis: Analysis, proposed: Recording, plan: Plan, *, goal: str, commands: frozenset[str]
) -> ComparedRecordings:
    """Compare a recording with the best recording for a goal that the plan's limits allow.

    Raises
    ------
    DataError, ConfigError : see `choose_next`.
    """
    nothing_open = plan.model_copy(update={"recordings": ()})
    found = choose_next(analysis, nothing_open, n=1, goal=goal, commands=commands)
    known = FisherInformation.of(analysis)
    error = find_goal(goal, known, feedback=analysis.feedback).of
    why = why_useless(proposed, known, limits=plan.limits)
    after = found.now if why else float(error(known.information + known.of_recording(proposed)))
    if after > 1.01 * found.now:  # 1 % is visible in two digits
        why = _WHY_WORSE
    return ComparedRecordings(
        words=found.words,
        now=found.now,
        proposed=after,
        why=why,
        chosen=found.recordings[0],
        best=found.errors[-1],
    )
