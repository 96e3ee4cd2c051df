"""Compare the noise of two submissions, all recordings together.

The noise of one recording may agree by chance, or because the bench knocks and its encoder rounds
in the same way in every run. Only two things cannot agree by honest work: the noise of most of the
recordings, beyond what other teams share with them, and what a hand did in the decays.

Noise is whitened, so that a filter, a scale or further noise in a copy only weakens the agreement.
It is compared in three bands, because smoothing may reverse the sign of one of them. A single line
of its spectrum, such as the rounding of a steady sine, counts no more than a line of noise.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.grading.similarity.likeness import Likeness
from pipeline.grading.similarity.prints import EVERY, Print

_BANDS = ((0.2, 0.3), (0.3, 0.4), (0.4, 0.5))  # cycles per sample, above the fingerprint's corner
_BANDWIDTH = 0.2  # of each band, as a share of the Nyquist frequency
_SMOOTHED = 33  # lines of the spectrum over which its level is averaged
_LOUDEST = 1.3  # times this level; a line counts no more
_LEAST_OVERLAP = 0.6  # of the shorter recording
_MOST = 4.0  # sigmas in a band that count, so that no recording decides alone
# Sum of three squared sigmas by which any time shift must exceed those that the motion suggests;
# chance gives 19 among 2,000 shifts.
_ANYWHERE = 15.0
_LEAST_SPREAD = 1.5  # sigmas; in honest pairs the recordings spread by this much or more
_PEAKS = 3  # time shifts that the motion of two recordings may suggest
_MOST_EACH = 12  # recordings of one kind of a submission that are compared
_FEWEST = 6  # recordings of two submissions that are enough to compare
LEAST_T = 4.5  # honest pairs reach 4.2, copies with a count of noise 8 to 25
_LEAST_MEDIAN = 1.0  # sigmas that half of the recordings must exceed
_LEAST_BY_HAND = 6.0  # sigmas of all decays together
_SAME_SCALE = 0.02  # relative difference of a decay's scale from that of the other recordings
_FEWEST_MOTION = 8  # stored values of two motions that are enough to compare
_ALIKE = 0.9  # squared correlation of motions from which a scale is taken
_SAME_MOTION = 0.98  # correlation of two decays that count as one


@dataclass(frozen=True, kw_only=True, eq=False)
class Heard:
    """A recording with the spectra of its whitened noise.

    Attributes
    ----------
    length : number of samples to which the recordings of its group are padded.
    spectra : (3, n_carts, n_lines) of the noise in each band, with unit variance. Lines below the
        first band are omitted.
    """

    print: Print
    length: int

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.print.residual.shape[1]

    @cached_property
    def spectra(self) -> np.ndarray:
        """The spectra; they are computed when a recording is first compared."""
        from scipy.fft import irfft, next_fast_len, rfft

        noise = self.print.noise[: len(self.print.measured)]
        padded = next_fast_len(self.n, real=True) or 1
        lines = np.array(rfft(noise, padded, axis=1))
        size = np.abs(lines)
        summed = np.cumsum(np.pad(size**2, ((0, 0), (_SMOOTHED, _SMOOTHED - 1)), "reflect"), axis=1)
        middle = _SMOOTHED // 2
        level = summed[:, _SMOOTHED:] - summed[:, :-_SMOOTHED]
        level = np.sqrt(level[:, middle : middle + size.shape[1]] / _SMOOTHED) + 1e-30
        lines *= np.minimum(1 / level, _LOUDEST / (size + 1e-30))
        frequency = np.arange(lines.shape[1]) / padded
        bands = [(frequency >= low) & (frequency < high) for low, high in _BANDS]
        white = np.array([irfft(lines * band, padded, axis=1) for band in bands])[..., : self.n]
        white /= white.std(axis=2, keepdims=True) + 1e-30
        padded = np.asarray(rfft(white.astype(np.float32), self.length, axis=2))
        return padded[..., _first_line(self.length) :]


@dataclass(frozen=True, kw_only=True, eq=False)
class Agreement:
    """Two recordings that correspond most closely.

    Attributes
    ----------
    sigmas : (3,) agreement of the noise in each band; negative if it is reversed.
    shift, motion_shift : sample i of the first corresponds to sample i + shift of the second, by
        noise and by motion.
    """

    prints: tuple[Print, Print]
    sigmas: Array
    shift: int
    motion_shift: int

    @property
    def is_decay(self) -> bool:
        """Whether a hand released the cart."""
        return _is_decay(self.prints[0].group)

    @property
    def scale(self) -> float:
        """Scale of the second motion on the first."""
        return self._fit[0]

    @property
    def correlation(self) -> float:
        """Correlation of the two motions."""
        return self._fit[1]

    def likeness_of(self, sigmas: float) -> Likeness:
        """Return the agreement as a similarity of two recordings."""
        a, b = self.prints
        first = max(0, -self.shift)
        last = min(a.residual.shape[1], b.residual.shape[1] - self.shift)
        return Likeness(
            experiments=(a.experiment, b.experiment),
            times=(a.times(first, last), b.times(first + self.shift, last + self.shift)),
            sigmas=sigmas,
        )

    def is_motion(self, scale: float) -> bool:
        """Return whether the second motion is the first one, at a known scale."""
        off = abs(self.scale - scale)
        return abs(self.correlation) > _SAME_MOTION and off < _SAME_SCALE * abs(scale)

    def likeness(self, scale: float) -> float:
        """Return how likely it is that two recordings correspond; for decays, see `is_motion`."""
        same = self.is_decay and self.is_motion(scale)
        return float(self.sigmas @ self.sigmas) + 2 * _ANYWHERE * same

    @cached_property
    def _fit(self) -> tuple[float, float]:
        a, b = (one.motion for one in self.prints)
        return _same_motion(a, b, shift=self.motion_shift)

    def of(self, side: int) -> str:
        """Return the name of one of the recordings."""
        return self.prints[side].experiment


def _first_line(length: int) -> int:
    return int(_BANDS[0][0] * length)


def padded_length(prints: Sequence[Print]) -> int:
    """Return the length to which recordings of one group are padded."""
    from scipy.fft import next_fast_len

    return next_fast_len(2 * max(one.residual.shape[1] for one in prints), real=True) or 1


def agreements(
    a: Mapping[str, Sequence[Heard]], b: Mapping[str, Sequence[Heard]]
) -> list[Agreement]:
    """Return the recordings of two submissions that correspond, each at most once.

    Decays come last, because their motion is judged by the scale of the other recordings.
    """
    found: list[Agreement] = []
    scale = 0.0
    for group in sorted(a.keys() & b.keys(), key=lambda group: (_is_decay(group), group)):
        if _is_decay(group) and not scale:
            scale = _common_scale(found)
        pairs = [
            max(_compared(one, other), key=lambda pair: pair.likeness(scale))
            for one in a[group][:_MOST_EACH]
            for other in b[group][:_MOST_EACH]
        ]
        used: set[int] = set()
        for pair in sorted(pairs, key=lambda pair: -pair.likeness(scale)):
            if used.isdisjoint(map(id, pair.prints)):
                used.update(map(id, pair.prints))
                found.append(pair)
    return found


def _is_decay(group: str) -> bool:
    return group.startswith("decay")


def _common_scale(found: Sequence[Agreement]) -> float:
    """Return the signed scale of most recordings of two submissions; 0 if they differ."""
    scales = [one.scale for one in found if one.correlation**2 > _ALIKE and not one.is_decay]
    return float(np.median(scales)) if scales else 0.0


def _compared(a: Heard, b: Heard) -> Iterator[Agreement]:
    """Compare two recordings at each time shift that their motion suggests, or their noise."""
    from scipy.fft import irfft

    spectrum = np.sum(np.conj(a.spectra) * b.spectra, axis=1)
    spectrum = np.pad(spectrum, ((0, 0), (_first_line(a.length), 0)))
    products = np.asarray(irfft(spectrum, a.length, axis=1))
    least = round(_LEAST_OVERLAP * min(a.n, b.n))
    shifts = np.arange(least - a.n, b.n - least + 1)
    overlap = np.minimum(a.n, b.n - shifts) - np.maximum(0, -shifts)
    sigmas = products[:, shifts] * np.sqrt(_BANDWIDTH / (overlap * a.spectra.shape[1]))
    total = np.sum(sigmas * sigmas, axis=0)
    for motion_shift in _motion_shifts(a.print.motion, b.print.motion):
        likely = [0, b.n - a.n, motion_shift - 1, motion_shift, motion_shift + 1]
        likely = [shift - shifts[0] for shift in likely if shifts[0] <= shift <= shifts[-1]]
        at = max(likely, key=lambda at: total[at], default=int(np.argmax(total)))
        if not _is_decay(a.print.group) and total.max() > total[at] + _ANYWHERE:
            at = int(np.argmax(total))
        yield Agreement(
            prints=(a.print, b.print),
            sigmas=np.clip(sigmas[:, at].astype(float), -_MOST, _MOST),
            shift=int(shifts[at]),
            motion_shift=motion_shift,
        )


def _motion_shifts(a: Array, b: Array) -> list[int]:
    """Return the shifts in samples at which two motions, stored coarsely, agree best.

    An oscillation agrees again after half a period.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    length = next_fast_len(a.size + b.size, real=True) or 1
    a, b = a - a.mean(), b - b.mean()
    of_a, of_b = (np.asarray(rfft(x, length)) for x in (a, b))
    products = np.asarray(irfft(np.conj(of_a) * of_b, length))
    least = max(1, round(_LEAST_OVERLAP * min(a.size, b.size)))
    shifts = np.arange(least - a.size, b.size - least + 1)
    first, last = np.maximum(0, -shifts), np.minimum(a.size, b.size - shifts)
    means: list[Array] = []
    n, power = last - first, np.ones(shifts.size)
    for x, start, end in ((a, first, last), (b, first + shifts, last + shifts)):
        total, squares = np.append(0.0, np.cumsum(x)), np.append(0.0, np.cumsum(x * x))
        mean = (total[end] - total[start]) / n
        power *= np.maximum(squares[end] - squares[start] - n * mean**2, 1e-30)
        means.append(mean)
    alike = np.abs(products[shifts] - n * means[0] * means[1]) / np.sqrt(power)
    inner = alike[1:-1]
    peaks = 1 + np.flatnonzero((inner >= alike[:-2]) & (inner > alike[2:]))
    found = []
    for at in peaks[np.argsort(-alike[peaks], kind="stable")[:_PEAKS]].tolist():
        before, here, after = alike[at - 1 : at + 2].tolist()  # on a parabola
        between = (before - after) / (2 * (before - 2 * here + after))
        found.append(round(EVERY * (int(shifts[at]) + between)))
    return found or [int(EVERY * shifts[np.argmax(alike)])]


def _same_motion(a: Array, b: Array, *, shift: int) -> tuple[float, float]:
    """Return the scale and the correlation of the second motion, stored coarsely, on the first."""
    whole, part = divmod(shift, EVERY)
    at = np.arange(a.size) + whole
    inside = (at >= 1) & (at < b.size - 2)
    if np.count_nonzero(inside) < _FEWEST_MOTION:
        return 0.0, 0.0
    at, r = at[inside], part / EVERY
    # Cubic interpolation through four stored values (Lagrange).
    x = a[inside]
    y = (
        b[at - 1] * (-r * (r - 1) * (r - 2) / 6)
        + b[at] * ((r + 1) * (r - 1) * (r - 2) / 2)
        + b[at + 1] * (-(r + 1) * r * (r - 2) / 2)
        + b[at + 2] * ((r + 1) * r * (r - 1) / 6)
    )
    x, y = x - x.mean(), y - y.mean()
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    return (xy / xx, xy / np.sqrt(xx * yy)) if xx * yy > 0 else (0.0, 0.0)


def usual(pairs: Iterable[tuple[Sequence[Agreement], int]]) -> dict[str, Array]:
    """Return the agreement (3,) of a submission's recordings with those of most other teams.

    Parameters
    ----------
    pairs : agreements with each other team, and the submission's side (0 or 1) in them.
    """
    found: dict[str, list[Array]] = defaultdict(list)
    for pair, side in pairs:
        for one in pair:
            found[one.of(side)].append(one.sigmas)
    return {name: np.median(sigmas, axis=0) for name, sigmas in found.items()}


def copied(
    found: Sequence[Agreement], common: tuple[Mapping[str, Array], Mapping[str, Array]] = ({}, {})
) -> list[tuple[Agreement, float]]:
    """Return the recordings that are copies, each with its sigmas; empty without proof.

    Parameters
    ----------
    common : what the recordings of both submissions share with most other teams; see `usual`.
    """
    if len(found) < _FEWEST:
        return []
    raw = np.array([one.sigmas for one in found])
    signs = np.where(raw.sum(axis=0) < 0, -1.0, 1.0) / np.sqrt(len(_BANDS))
    shared = np.array([np.mean([common[s].get(one.of(s), 0.0 * signs) for s in (0, 1)], axis=0)
                       for one in found])  # fmt: skip
    own = raw - np.clip(shared, np.minimum(raw, 0.0), np.maximum(raw, 0.0))
    sigmas = own @ signs
    if t_value(sigmas) < LEAST_T or np.median(sigmas) < _LEAST_MEDIAN:
        return []
    decays = np.array([one.is_decay for one in found])
    if not _by_one_hand([one for one in found if one.is_decay], sigmas[decays], found):
        return []
    return [(one, float(s)) for one, s in zip(found, sigmas, strict=True) if s >= _LEAST_MEDIAN]


def t_value(sigmas: Array) -> float:
    """Return how far the mean of the recordings' agreement lies above zero."""
    return float(sigmas.mean() * np.sqrt(sigmas.size) / max(_LEAST_SPREAD, sigmas.std(ddof=1)))


def _by_one_hand(decays: Sequence[Agreement], sigmas: Array, found: Sequence[Agreement]) -> bool:
    """Return whether one hand made both sets of decays, which no bench can repeat.

    Either their noise agrees, or most of them have the same motion at the scale of the other
    recordings: two hands do not pull a cart equally far.
    """
    if not decays:
        return False
    if sigmas.sum() >= _LEAST_BY_HAND * np.sqrt(len(decays)):
        return True
    scale = _common_scale(found)
    return 2 * sum(one.is_motion(scale) for one in decays) > len(decays)
