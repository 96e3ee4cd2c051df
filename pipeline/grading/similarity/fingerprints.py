"""Fingerprints of recordings: the part that is different in every run on a bench.

Two honest teams that step the same bench get the same motion, so motion proves nothing. Noise and
encoder rounding are different in every run; a high-pass filter isolates them. They survive when a
recording is cut, shifted in time, rescaled, renamed or covered with further noise.
"""

import json
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.noise import MEDIAN_TO_SIGMA
from pipeline.results import Record

# The filter passes frequencies above 0.4 of the Nyquist frequency. On a bench logged at 113 Hz,
# motion is below 12 Hz. A Kaiser window with β = 7 lets less than 1e-3 of the motion through.
PASSED = 0.6  # share of the frequency band that passes
_TAPS, _WINDOW = 41, 7.0
MARGIN = _TAPS // 2  # samples lost at each end of a recording

# Residuals are stored in steps this fine, to keep a sensor's noise in a recording with much larger
# knocks.
STEPS_PER_SIGMA = 100.0
_STORED = np.dtype("<i2")
_MOST_STEPS = np.iinfo(_STORED).max
# Standard deviations; a larger residual is a sudden change of the motion (a step, a stop), not
# noise.
_KINK = 4.5
_JUMP = 30.0  # standard deviations; only an input that jumps has a larger residual
_NOTHING = 1e-7  # share of the travel; a smaller residual is a rounding error of the filter

# Parts of the spectrum, in cycles per sample, and the largest ratio of power between them, in a
# recording with interpolated samples. Linear interpolation gives 0.02, the moving average of five
# samples 0.5.
_LOWER, _UPPER, _INTERPOLATED = (0.12, 0.22), (0.35, 0.5), 0.06
_START = 1024  # samples from which the spectrum is computed

_LEAST_SWING = 0.25  # share of the largest swing; noise affects smaller ones
# If a motion has at most this many turning points, these parts of each swing are used as anchors.
_FEW_TURNS, _PARTS = 5, (0.5, 0.3, 0.7)
_MOST_ANCHORS = 12  # most anchors from the motion of one recording
# Most anchors from the noise, and the fewest samples between two of them.
_NOISE_ANCHORS, _APART = 12, 5
_FEWEST_SAMPLES = 60
EVERY = 4  # the motion is stored at every 4th sample
_MOST_SAMPLES = 8192  # samples stored of one recording; more do not make the comparison surer
# Largest number of values stored for a submission: sixty recordings of four carts.
_MOST_VALUES = 2_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Fingerprint:
    """The fingerprint of one recording.

    Attributes
    ----------
    group : the kind of run; only recordings of the same group are compared.
    residual : the filtered signals as whole numbers, shape (n_rows, n), with one row for each free
        cart, and one for the input of a closed loop.
    step : how much 1 is worth in each row of the residual, in the recording's position or input
        unit; shape (n_rows,).
    anchors : lists of samples that can be found again in a copy, the most reliable first; they give
        the shift of the copy. One list has midpoints between two extrema of the motion, which noise
        does not affect. The others have maxima of the noise, which cutting does not affect.
    motion : motion of the first cart, at every n-th sample; it gives the scale between two
        recordings.
    start : time of the first sample, in s.
    interval : time between samples, in s.
    """

    experiment: str
    group: str
    residual: np.ndarray
    step: Array
    anchors: list[list[int]]
    motion: Array
    start: float
    interval: float

    @property
    def measured(self) -> np.ndarray:
        """The rows of positions in the residual, without the input that the controller computed."""
        return self.residual[: -1 if self.group.startswith("closed_loop") else None]

    @cached_property
    def noise(self) -> np.ndarray:
        """The residual (n_rows, n) in standard deviations.

        It is 0 near sudden changes of motion or input.
        """
        sigmas = self.residual.astype(np.float32) / STEPS_PER_SIGMA
        for row in sigmas:
            rings = np.convolve(np.abs(row) > _JUMP, np.ones(_TAPS), "same") > 0
            row[rings | (np.abs(row) >= _KINK)] = 0.0
        return sigmas

    def times(self, first: int, last: int) -> tuple[float, float]:
        """Return the times of two samples, in s."""
        start, end = (round(self.start + at * self.interval, 3) for at in (first, last - 1))
        return start, end

    def spread(self, first: int, last: int) -> float:
        """Return the standard deviation of the motion between two samples; 0 if noise hides it."""
        part = self.motion[first // EVERY : last // EVERY + 1]
        noise = (STEPS_PER_SIGMA * self.step[0]) ** 2
        spread = float(np.mean((part - part.mean()) ** 2)) - (1 / PASSED - 1) * noise
        return spread**0.5 if spread > noise else 0.0


def fingerprint(records: Sequence[Record]) -> bytes:
    """Return the fingerprints of a submission's recordings, packed; b"" without recordings."""
    rows = sum(len(record.carts) + 1 for record in records)
    most = min(_MOST_SAMPLES, _MOST_VALUES // max(rows, 1))
    prints = [found for record in records for found in _prints(record, most=most)]
    if not prints:
        return b""
    heads = [
        {
            "experiment": one.experiment,
            "group": one.group,
            "shape": one.residual.shape,
            "step": one.step.tolist(),
            "start": one.start,
            "interval": one.interval,
            "anchors": one.anchors,
            "motion": [float(f"{x:.4g}") for x in one.motion],
            "every": EVERY,
        }
        for one in prints
    ]
    body = b"".join(one.residual.tobytes() for one in prints)
    return zlib.compress(json.dumps(heads).encode() + b"\0" + body)


def unpack(packed: bytes) -> tuple[Fingerprint, ...]:
    """Return the fingerprints that `fingerprint` packed; those of an older version are ignored."""
    if not packed:
        return ()
    head, _, body = zlib.decompress(packed).partition(b"\0")
    prints, at = [], 0
    for entry in json.loads(head):
        if entry.pop("every", None) != EVERY:
            return ()
        rows, columns = entry.pop("shape")
        residual = np.frombuffer(body, _STORED, rows * columns, at).reshape(rows, columns)
        at += residual.nbytes
        arrays = {name: np.array(entry.pop(name)) for name in ("step", "motion")}
        prints.append(Fingerprint(residual=residual, **arrays, **entry))
    return tuple(prints)


def _prints(record: Record, *, most: int) -> Iterator[Fingerprint]:
    """Yield the fingerprint of a recording, unless it is too short or a cart does not move.

    In closed loop the controller passes the noise of the measured positions to the input. If
    somebody adds noise to the positions later, the input still has the old noise.
    """
    carts = [cart for cart in record.free if cart in record.carts]
    if not carts or record.t.size < _FEWEST_SAMPLES + 2 * MARGIN:
        return
    frequency = "" if record.omega is None else f"{record.omega / (2 * np.pi):.3g} Hz"
    signals = [record.position(cart) for cart in carts]
    if record.kind == "closed_loop":
        signals.append(np.zeros_like(record.t) if record.u is None else record.u)
    t, y = _without_interpolated(record.t, np.array(signals))
    if t.size < _FEWEST_SAMPLES + 2 * MARGIN:
        return
    y = y[:, : most + 2 * MARGIN]
    noise = np.array([np.convolve(row, _high_pass(), "valid") for row in y])
    sigma = np.array(
        [_sigma(one, travel=float(np.ptp(row))) for one, row in zip(noise, y, strict=True)]
    )
    if not np.all(sigma[: len(carts)] > 0):
        return
    noise[sigma == 0], sigma[sigma == 0] = 0.0, 1.0
    sigmas = noise / sigma[:, None]
    motion = y[0, MARGIN:-MARGIN] - noise[0]
    parts = np.split(np.abs(sigmas), [len(carts)])
    steps = np.clip(np.round(STEPS_PER_SIGMA * sigmas), -_MOST_STEPS, _MOST_STEPS)
    yield Fingerprint(
        experiment=record.id,
        group=f"{record.kind} {','.join(map(str, carts))} {frequency}",
        residual=steps.astype(_STORED),
        step=sigma / STEPS_PER_SIGMA,
        anchors=[
            _motion_anchors(motion),
            *(_noise_anchors(x.sum(axis=0)) for x in parts if x.any()),
        ],
        motion=motion[::EVERY],
        start=float(t[MARGIN]),
        interval=float((t[-1] - t[0]) / (t.size - 1)),
    )


def _without_interpolated(t: Array, y: Array) -> tuple[Array, Array]:
    """Return times (n,) and signals (n_rows, n) without every other sample, if it was interpolated.

    Interpolated samples contain no noise of their own, so that there is hardly any in the upper
    half of the spectrum.
    """
    bend = np.diff(y, 2, axis=1)  # at samples 1, 2, ...
    start = bend[:, :_START]
    power = np.abs(np.fft.rfft(start * np.hanning(start.shape[1]), axis=1)) ** 2
    frequency = np.linspace(0.0, 0.5, power.shape[1])
    power = power / np.maximum(np.sin(np.pi * frequency) ** 4, 1e-12)  # undo the differences
    upper = np.median(power[:, frequency > _UPPER[0]], axis=1)
    lower = np.median(power[:, (frequency > _LOWER[0]) & (frequency < _LOWER[1])], axis=1)
    if not np.all(upper <= _INTERPOLATED * lower):
        return t, y
    power = np.sum(bend**2, axis=0)
    first = int(power[::2].sum() > power[1::2].sum())  # linear interpolation does not bend
    return t[first::2], y[:, first::2]


def _sigma(noise: Array, *, travel: float) -> float:
    """Return the standard deviation of the nonzero samples of a residual (n,); 0 if they are few.

    While a cart is at rest, its residual is zero, which says nothing about the noise.
    """
    there = np.abs(noise[np.abs(noise) > _NOTHING * travel])
    return MEDIAN_TO_SIGMA * float(np.median(there)) if there.size >= _FEWEST_SAMPLES else 0.0


@cache
def _high_pass() -> Array:
    """Return the taps of the filter: 1 minus a low pass, without response to a constant."""
    cut = 1 - PASSED
    lag = np.arange(_TAPS) - MARGIN
    taps = -cut * np.sinc(cut * lag) * np.kaiser(_TAPS, _WINDOW)
    taps[MARGIN] += 1.0
    return taps - taps.mean()


def _noise_anchors(loudness: Array) -> list[int]:
    """Return the samples with the largest residual (n,), including sudden changes of motion."""
    peak = np.max(np.lib.stride_tricks.sliding_window_view(loudness, 2 * _APART + 1), axis=1)
    peaks = _APART + np.flatnonzero(loudness[_APART:-_APART] == peak)
    return peaks[np.argsort(-loudness[peaks], kind="stable")[:_NOISE_ANCHORS]].tolist()


def _motion_anchors(motion: Array) -> list[int]:
    """Return the samples at which the motion (n,) passes through the middle of its larger swings.

    If there are few swings, two more samples of each swing are returned.
    """
    turns = _turning_points(motion, least=_LEAST_SWING * float(np.ptp(motion)))
    parts = (0.5,) if turns.size > _FEW_TURNS else _PARTS
    places = []
    for start, end in pairwise(turns.tolist()):
        swing = float(motion[end] - motion[start])
        done = (motion[start : end + 1] - motion[start]) / swing
        places += [(-abs(swing), start + int(np.argmax(done >= part))) for part in parts]
    return [at for _, at in sorted(places, key=lambda one: one[0])[:_MOST_ANCHORS]]


def _turning_points(motion: Array, *, least: float) -> np.ndarray:
    """Return the extrema between which the motion changes by at least `least`."""
    if not least > 0:
        return np.zeros(0, dtype=np.int64)
    slope = np.sign(np.diff(motion))
    extrema = np.flatnonzero(slope[:-1] * slope[1:] <= 0) + 1
    turns: list[int] = []
    for at in (0, *extrema.tolist(), motion.size - 1):
        if (
            len(turns) > 1
            and (motion[at] - motion[turns[-1]]) * (motion[turns[-1]] - motion[turns[-2]]) > 0
        ):
            turns[-1] = at  # the same swing continues
        elif not turns or abs(motion[at] - motion[turns[-1]]) >= least:
            turns.append(at)
    return np.array(turns, dtype=np.int64)
