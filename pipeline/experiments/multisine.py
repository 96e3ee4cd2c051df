"""Many sines in one record, at the most informative frequencies and with a low peak.

The input is bounded by the carts' travel, so the peak of their motion is reduced.

References: M. R. Schroeder, IEEE Trans. Information Theory 16 (1970), 85-89, for the phases to
begin with; E. Van der Ouderaa, J. Schoukens, J. Renneboog, IEEE Trans. Instrumentation and
Measurement 37 (1988), 145-147, for the clipping.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.experiments.goal import Goal, choose
from pipeline.experiments.information import Knowledge

Tones = tuple[tuple[int, float, float], ...]
Lines = NDArray[np.int64]  # harmonics

_QUANTA = 16  # equal parts of the motion's power, placed where they are most informative
_LOW, _HIGH = 0.3, 1.6  # times the first and the last resonance, as limits of the lines
_CLIP_AT = 0.8  # of the peak
_DIGITS = 4  # of shares and phases, as written in a file


def optimal_tones(
    known: Knowledge, *, base: float, seconds: float, travel: float, goal: Goal
) -> Tones:
    """Return harmonic, share of the peak and phase (rad) of each line of a multisine.

    Parameters
    ----------
    base : Hz, of which the lines are harmonics.
    seconds, travel : duration, and limit of the motion, position units.
    """
    resonances = np.sort(np.abs(known.chain.poles)) / (2 * np.pi)
    low, high = _LOW * resonances[0], _HIGH * resonances[-1]
    lines = np.arange(max(1, round(low / base)), max(3, round(high / base)) + 1, dtype=np.int64)
    omega = np.asarray(2 * np.pi * base * lines, dtype=np.float64)
    G = known.chain.frequency_response(omega)
    reach = np.max(np.abs(G), axis=0)
    # The motion for each part of the power; the motion's peak is about 1.8 of its rms.
    each = travel / 1.8 * np.sqrt(2 / _QUANTA)
    told = known.of_lines(omega, amplitude=each / reach, seconds=seconds)
    chosen = choose(told, known.told, n=_QUANTA, goal=goal)
    which, count = np.unique(chosen, return_counts=True)
    size = np.sqrt(count) / reach[which]
    phase = low_peak_phases(lines[which], size, G[:, which])
    peak = _peak(lines[which], size * np.exp(1j * phase))
    shares, phases = np.round(size / peak, _DIGITS), np.round(phase % (2 * np.pi), _DIGITS)
    return tuple(zip(lines[which].tolist(), shares.tolist(), phases.tolist(), strict=True))


def schroeder_phases(size: Array) -> Array:
    """Return phases (n,) of lines of these sizes (n,) that keep their sum's peak low, rad."""
    power = size**2 / np.sum(size**2)
    return -2 * np.pi * np.cumsum(np.cumsum(power) - power)


def low_peak_phases(lines: Lines, size: Array, G: ComplexArray) -> Array:
    """Return phases (n,) with a low largest swing of the carts: clip, keep the phases, repeat.

    `G` (carts, n) is the response at the lines.
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
        # A sine here is -j times half the line there; each cart is weighted by its motion.
        phase = np.angle(np.sum(1j * spectrum * np.conj(motion), axis=0))
    return best


def _synthesise(lines: Lines, amplitude: ComplexArray) -> Array:
    """Return sums (…, points) over one period of sines of complex amplitude (…, n)."""
    points = 1 << int(np.ceil(np.log2(16 * lines[-1])))  # 16 a period of the highest line
    spectrum = np.zeros((*amplitude.shape[:-1], points // 2 + 1), dtype=np.complex128)
    spectrum[..., lines] = -0.5j * points * amplitude
    return np.fft.irfft(spectrum, points)


def _peak(lines: Lines, amplitude: ComplexArray) -> float:
    return float(np.max(np.abs(_synthesise(lines, amplitude))))
