"""The target of a run over time."""

import math
from collections.abc import Sequence

from pipeline.bench.protocol.messages import CHIRP_SPAN, PULSE, Start, Tone, Wave


def target_at(
    start: Start, t: float, *, chirp_end: float | None = None, tones: Sequence[Tone] = ()
) -> int:
    """Return the target `t` s after the start, in duty counts (open loop) or encoder counts.

    Parameters
    ----------
    chirp_end : end frequency of a chirp, in Hz; by default `CHIRP_SPAN` times the start frequency.
    tones : sines of a multisine.
    """
    return nearest_count(start.amplitude * shape_at(start, t, chirp_end=chirp_end, tones=tones))


def nearest_count(value: float) -> int:
    """Round to a whole count, halves up."""
    return math.floor(value + 0.5)


def shape_at(
    start: Start, t: float, *, chirp_end: float | None = None, tones: Sequence[Tone] = ()
) -> float:
    """Return the wave for an amplitude of one; see `target_at`."""
    turns = t * start.frequency
    phase = turns - math.floor(turns)
    match start.wave:
        case Wave.DELTA:
            return float(phase < PULSE * start.frequency)
        case Wave.SQUARE:
            return float(phase >= 0.5)
        case Wave.SINE:
            return math.sin(2 * math.pi * phase)
        case Wave.TRIANGLE:
            return 1.0 - 4.0 * abs((phase + 0.25) % 1.0 - 0.5)
        case Wave.SAWTOOTH:
            return 2.0 * phase - (2.0 if phase >= 0.5 else 0.0)
        case Wave.CHIRP:
            return math.sin(2 * math.pi * _chirp_turns(start, t, chirp_end))
        case Wave.MULTISINE:
            return sum(
                tone.share * math.sin(2 * math.pi * tone.harmonic * phase + tone.phase)
                for tone in tones
            )


def _chirp_turns(start: Start, t: float, chirp_end: float | None) -> float:
    """Return the number of periods of a chirp until `t`; its frequency grows exponentially."""
    span = CHIRP_SPAN if chirp_end is None else chirp_end / start.frequency
    if span == 1.0:
        return start.frequency * t
    growth_time = start.duration / math.log(span)  # s in which the frequency grows e-fold
    return start.frequency * growth_time * math.expm1(t / growth_time)
