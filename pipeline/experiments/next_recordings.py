"""Which recordings next: the candidates within the limits, and the choice for a goal.

For a parameter, the candidates are weighed here by their information; for a gap, `discriminate`
weighs them by how well they tell its explanations apart.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil, isclose

import numpy as np
from numpy.typing import NDArray

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
    largest_amplitude,
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
from pipeline.experiments.propose import (
    FURTHEST,
    current_plan,
    release_by_hand,
    rounded,
    rounded_down,
)
from pipeline.gap.types import Proposal, read_gap
from pipeline.ingest.read import read_data
from pipeline.names import parameter_names
from pipeline.plant.chain import Chain
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

TRIAL_PERIOD = 5e-3  # s between samples of a trial
# samples per period, for periods at this multiple of the highest resonance
_PER_CYCLE, _BEYOND = 10, 2.0
_TRIAL_TIME = 12.0  # approximate duration of a trial in s


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
    free = _free(known.chain)
    made = list(
        _dwells(known, free) if known.dwells else _broadband(known, free, limits, commands, goal)
    )
    candidates = []
    for recording in made:
        size = largest_amplitude(
            known.chain, recording, limits=limits, share=FURTHEST, period=known.sample_time
        )
        if size > 0:
            candidates.append(recording.model_copy(update={"amplitude": rounded_down(size)}))
    if not candidates:
        raise DataError(
            "no next experiment: the limits of plan.toml allow none"
            if made
            else "no next experiment: dwells of these carts take too long to settle"
        )
    return candidates


def _free(chain: Chain) -> Callable[..., Recording]:
    """Return a function that makes recordings at unit amplitude with all carts free, from rest."""
    return partial(
        Recording,
        kind="sweep",
        carts=tuple(range(1, chain.n + 1)),
        amplitude=1.0,
        settle=rounded(settling_wait(chain, time_constants=SETTLED)),
    )


def _resonances(chain: Chain) -> Array:
    """Return the resonances in Hz, the lowest first."""
    return np.sort(np.abs(chain.poles)) / (2 * np.pi)


def _dwells(known: FisherInformation, free: Callable[..., Recording]) -> Iterator[Recording]:
    """Yield dwells; each lasts twice as long as the carts need to reach the steady state.

    If the steady state takes too long to reach, no dwell is yielded. A transient would be mistaken
    for a steady state.
    """
    wait = settling_wait(known.chain, time_constants=SETTLED_DWELL)
    if wait * np.min(-known.chain.poles.real) < SETTLED:
        return
    for hertz in dwell_frequencies(known.chain, n=_DWELLS):
        cycles = ceil(2 * wait * hertz)
        yield free(id="sine-01", kind="sine", wave="sine", frequency=hertz, cycles=cycles)


def _broadband(
    known: FisherInformation,
    free: Callable[..., Recording],
    limits: PlanLimits,
    commands: Collection[str],
    goal: Goal,
) -> Iterator[Recording]:
    low, high = _resonances(known.chain)[[0, -1]]
    seconds = rounded(max(20.0, 20 / low))  # 20 s, or 20 of the slowest periods
    for hertz in np.geomspace(0.1 * low, high, 8):
        f = rounded(float(hertz))
        yield free(id="square-1", wave="square", frequency=f, cycles=ceil(seconds * f))
    if "c" in commands:
        edges = [rounded(float(f)) for f in np.geomspace(_BAND[0] * low, _BAND[1] * high, 6)]
        for f, end in ((a, b) for a in edges for b in edges if a < b):
            cycles = ceil(seconds * f)
            yield free(id="sweep-1", wave="chirp", frequency=f, frequency_end=end, cycles=cycles)
    if "m" in commands:
        base = rounded(_PERIODS / seconds)
        travel = FURTHEST * limits.travel
        tones = optimal_tones(known, base=base, seconds=seconds, travel=travel, goal=goal)
        yield free(id="multisine-1", wave="multisine", frequency=base, cycles=_PERIODS, tones=tones)


def propose_trials(
    chain: Chain, *, limits: PlanLimits, without: Sequence[Recording] = ()
) -> Iterator[tuple[Recording, float]]:
    """Yield steps in both directions, triangles, chirps and releases, in several sizes.

    With each recording comes the position from which a cart is released, in position units. It is
    zero if no cart is released. No recording resembles one of those in `without`.
    """
    free, resonances = _free(chain), _resonances(chain)
    slow, low, resonance, high, fastest = (
        rounded(float(f))
        for f in (
            1.5 / _TRIAL_TIME,
            0.5 * resonances[0],
            resonances[0],
            1.3 * resonances[-1],
            max(_BEYOND * resonances[-1], 1 / (_PER_CYCLE * TRIAL_PERIOD)),
        )
    )
    trials: list[tuple[Recording, float]] = []
    for wave, kind, f, end in (
        ("square", "step", slow, None),
        ("square", "sweep", resonance, None),
        ("triangle", "sweep", slow, None),
        ("triangle", "sweep", resonance, None),
        ("chirp", "sweep", low, high),
        # At high frequencies the carts move little, even with the motor's full input. This shows
        # delays, and laws that matter only for small motions.
        ("chirp", "sweep", high, fastest),
        ("chirp", "sweep", rounded(float(np.sqrt(high * fastest))), fastest),
    ):
        whole = free(
            id=f"apart-{wave}",
            kind=kind,
            wave=wave,
            frequency=f,
            frequency_end=end,
            cycles=ceil(_TRIAL_TIME * f),
            aim=GAP,
        )
        largest = largest_amplitude(
            chain, whole, limits=limits, share=FURTHEST, period=TRIAL_PERIOD
        )
        # Several sizes, because laws differ in how they grow with the motion.
        for size in (1.0, 0.5, 0.2):
            for sign in (1, -1) if wave == "square" else (1,):
                amplitude = sign * rounded_down(size * largest)
                trials.append((whole.model_copy(update={"amplitude": amplitude}), 0.0))
    for cart in whole.carts:
        if chain.k[cart - 1] + chain.k[cart] <= 0:
            continue
        for share in (0.6, 0.2):  # shares of the travel limit, for a release by hand
            height = rounded(share * limits.travel)
            release = release_by_hand(cart, name=f"apart-decay-{cart}", seconds=_TRIAL_TIME)
            note = f"let go at {share:.0%} of the travel limit, {height:g} from the zero"
            trials.append((release.model_copy(update={"note": note, "aim": GAP}), height))
    return (one for one in trials if not any(one[0].resembles(other) for other in without))


def far_sweep(chain: Chain, limits: PlanLimits) -> Recording:
    """Return a sweep through the resonances that moves the carts as far as allowed."""
    every = (recording for recording, _ in propose_trials(chain, limits=limits))
    return next(one for one in every if one.wave == "chirp").model_copy(update={"id": "sweep"})


# ---------------------------------------------------------------------- the choice

_ALONE = 4  # most planned recordings whose own benefit is listed
CALIBRATION = 1e-3  # relative error; encoders and motor of a bench are not known more accurately
STATISTICAL = (
    "these errors include only noise; no bench is calibrated to better than "
    f"{100 * CALIBRATION:g} %"
)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The chosen recordings, and the expected error after each of them.

    Attributes
    ----------
    words : the error that they reduce, such as "the error of zeta_2"; "gap" for a gap.
    now : present relative error.
    errors : (n + 1,) relative error after the open recordings of the plan, then after each chosen
        recording.
    planned : relative error after each open recording of the plan alone, by the recording's id.
    separation : only for "gap": distance between the two explanations that the recording separates
        best, in standard deviations of the noise.
    doubt : why the errors are not reliable, whatever is recorded; empty if they are reliable.
    """

    words: str
    recordings: tuple[Recording, ...]
    now: float = float("nan")
    errors: tuple[float, ...] = ()
    planned: dict[str, float] = field(default_factory=dict)
    separation: float | None = None
    doubt: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The benefit of the recordings, with notes."""
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


def choose_next(
    analysis: Analysis,
    plan: Plan,
    *,
    n: int,
    goal: str,
    commands: frozenset[str],
    without: Sequence[Recording] = (),
) -> Choice:
    """Choose the `n` next recordings, and predict the error after each.

    Parameters
    ----------
    commands : the extensions of the protocol that the bench knows.
    without : recordings that the chosen ones must not resemble.

    Raises
    ------
    DataError : the recorded data do not identify the carts, or no candidate helps.
    ConfigError : there is no such goal.
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
    recordings = []
    for one, before, after in zip(chosen, errors, errors[1:], strict=False):
        note = f"{words}: ± {_percent(before)} before, ± {_percent(after)} expected"
        note += f"; {STATISTICAL}" if after < CALIBRATION else ""
        recordings.append(candidates[one].model_copy(update={"aim": wanted.name, "note": note}))
    return Choice(
        words=words,
        recordings=tuple(recordings),
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
    most = largest_amplitude(
        known.chain, recording, limits=limits, share=1.0, period=known.sample_time
    )
    if abs(recording.amplitude) > most:
        return (
            f"it would be stopped at the travel limit; with an amplitude up to {most:.2g} it would "
            "not be stopped"
        )
    return ""


def _words(goal: Goal, known: FisherInformation, *, after: Array) -> str:
    if goal.name != WORST:
        return goal.words
    names = list(known.chain.parameters())
    now, then = (names[goal.worst(information)] for information in (known.information, after))
    which = now if now == then else f"now {now}, then {then}"
    return f"{goal.words} ({which})"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


# The fit treats the error of each sample as independent, but for a cart that hardly moves the
# rounding error is the same in many samples.
_WHY_WORSE = (
    "the fit would be worse: the rounding errors of encoders do not average out while carts rest, "
    "or move by few counts; try a larger motion, or a shorter recording"
)


def compare_recordings(
    analysis: Analysis, proposed: Recording, plan: Plan, *, goal: str, commands: frozenset[str]
) -> tuple[Choice, float, str]:
    """Compare a recording with the best recording for a goal that the plan's limits allow.

    Returns the best one, the error after only the proposed one, and why that does not help, or even
    does harm; "" if it helps.

    Raises
    ------
    DataError, ConfigError : see `choose_next`.
    """
    nothing_open = plan.model_copy(update={"recordings": ()})
    best = choose_next(analysis, nothing_open, n=1, goal=goal, commands=commands)
    known = FisherInformation.of(analysis)
    error = find_goal(goal, known, feedback=analysis.feedback).of
    if why := why_useless(proposed, known, limits=plan.limits):
        return best, best.now, why
    after = float(error(known.information + known.of_recording(proposed)))
    return best, after, _WHY_WORSE if after > 1.01 * best.now else ""  # 1 % shows in two digits


# ---------------------------------------------------------------------- `cartlab plan --next`


def plan_next(
    submission: Submission,
    *,
    n: int,
    goal: str = WORST,
    commands: frozenset[str],
    progress: Progress,
) -> tuple[Choice, str]:
    """Choose the `n` next recordings of a submission and add them to its plan.toml.

    Returns the recordings as the plan has them, and the change of plan.toml in words.

    Raises
    ------
    DataError : see `choose_next`; or there is no gap to decide.
    ConfigError : there is no such goal, or gap.json is broken or was made from other data or
        limits.
    """
    path, old = plan_path(submission), current_plan(submission)
    new = not path.exists()
    if goal == GAP:
        if n != 1:
            raise ConfigError(f"--for gap chooses one recording: expected --next 1, found {n}")
        decides = _read_proposal(submission, old.limits)
        recording = decides.recording
        found = Choice(words=GAP, recordings=(recording,), separation=decides.separation)
        done = {experiment.id for experiment in submission.experiments}
        open_ = [one for one in old.recordings if one.id not in done and one.resembles(recording)]
        if open_ and not new:
            return replace(found, recordings=(open_[0],)), f"{path}: has {open_[0].id} already"
    else:
        system = submission.system
        check_goal(goal, names=parameter_names(system.carts, rigid=not system.bench.tied))
        progress("evaluating the data")
        analysis = analyse(submission)
        progress("weighing the next experiments")
        found = choose_next(analysis, old, n=n, goal=goal, commands=commands)
        if (fit := analysis.fit) and not fit.explains_data:  # no predicted error counts this
            doubt = (
                f"the linear carts leave a residual above the noise (χ² per degree of freedom "
                f"{fit.chi_square_per_dof:.3g}), so parameters may be off by more than these "
                f"errors; `cartlab gap {submission.folder}` looks for the missing effect"
            )
            found = replace(found, doubt=doubt)
    plan = add_recordings(submission.folder, found.recordings, otherwise=old)
    wrote = f"{path}: {count(n, 'recording')} added"
    if new and old.recordings:
        usual = count(len(old.recordings), "recording")
        chosen = count(n, "chosen recording")
        wrote = f"wrote {path}: the {usual} that every plan begins with, and {chosen}"
    return replace(found, recordings=plan.recordings[-n:]), wrote


def _read_proposal(submission: Submission, limits: PlanLimits) -> Proposal:
    """Return the recording that `cartlab gap` proposes for these data and limits.

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
        gap = read_gap(text)
    except ConfigError:
        raise ConfigError(
            f"--for gap: gap/gap.json is not what cartlab gap writes: run {command} again"
        ) from None
    if gap.proposal is None:
        raise DataError(
            "--for gap: gap/gap.json proposes no recording, because there is nothing to decide "
            f'(its verdict is "{gap.verdict}")'
        )
    system, kept = submission.system, gap.proposal.limits
    of = (gap.bench.n, gap.bench.units.position, gap.bench.units.input)
    here = (system.carts, system.position.unit, system.input.unit)
    if of != here or gap.provenance.files != read_data(submission).files:
        raise ConfigError(f"--for gap: gap/gap.json was made from other data: run {command} again")
    # gap.json has only ten digits.
    if not kept or not all(
        isclose(getattr(kept, name), limit, rel_tol=1e-9) for name, limit in limits
    ):
        raise ConfigError(
            f"--for gap: the limits in plan.toml are not those of gap/gap.json: run {command} again"
        )
    return gap.proposal
