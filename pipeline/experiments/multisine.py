"""Many sines in one record, at the most informative frequencies and with a low peak.

The carts' travel limits the amplitude, so the phases are chosen for a low peak of the motion.

References: M. R. Schroeder, IEEE Trans. Information Theory 16 (1970), 85-89, for the initial
phases; E. Van der Ouderaa, J. Schoukens, J. Renneboog, IEEE Trans. Instrumentation and Measurement
37 (1988), 145-147, for the clipping.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.experiments.goal import Goal, choose
from pipeline.experiments.information import Knowledge

Tones = tuple[tuple[int, float, float], ...]
Lines = NDArray[np.int64]  # numbers of harmonics

_QUANTA = 16  # The motion's power has so many equal parts; each goes to the most informative line.
# The lines lie between these multiples of the first and the last resonance.
_LOW, _HIGH = 0.3, 1.6
_CLIP_AT = 0.8  # clipping level, as a share of the peak
_DIGITS = 4  # digits of shares and phases in the file


def optimal_tones(
    known: Knowledge, *, base: float, seconds: float, travel: float, goal: Goal
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
