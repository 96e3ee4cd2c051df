"""The candidate experiments, each as large as the travel limit allows."""

from collections.abc import Collection, Iterator
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.experiments.goal import Goal, choose
from pipeline.experiments.information import FisherInformation
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.experiments.propose import FURTHEST, rounded, rounded_down
from pipeline.plant.simulate import SETTLED, SETTLED_DWELL, dwell_frequencies, settling_wait

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
