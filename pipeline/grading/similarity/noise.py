"""Compare the noise of two recordings at a time shift, and of all recordings of two submissions.

A copy has the noise of its original. So if one noise is regressed on the other, at the same scale,
the slope is one. This only suggests where to look for equal rows, which prove a copy.

The noise of one recording may agree by chance, or because the bench knocks and its encoder rounds
in the same way in every run. So the noise of most recordings counts together, beyond what other
teams share with them, and no further than to one in a thousand. The rest of the proof is what a
hand did in the decays: their noise, and the instants of their releases (see `releases`).

Noise is whitened, so that a filter, a scale or further noise in a copy only weakens the agreement.
It is compared in three bands, because smoothing may reverse the sign of one of them. A single line
of its spectrum, such as the rounding of a steady sine, counts no more than a line of noise.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.grading.similarity.fingerprints import EVERY, PASSED, STEPS_PER_SIGMA, Fingerprint
from pipeline.grading.similarity.releases import Delay, is_decay, shifted_products

LEAST_OVERLAP = 80  # smallest number of samples in which both recordings have noise
LEAST_SLOPE = 0.5
# Smallest noise from which the scale between two recordings is estimated.
_LEAST_NOISE = 0.5 * STEPS_PER_SIGMA
# Residuals are stored as whole steps, so each may be wrong by half a step.
_SAME_STEPS, _SAME_PART = 1.0, 0.003
_EQUAL_PART = 0.5  # share of the shorter recording that must be equal
_DIFFERENT_STEPS = 4  # encoder steps; readings closer than this count as equal


@dataclass(frozen=True, kw_only=True)
class Match:
    """The similarity of two recordings.

    Attributes
    ----------
    times : start and end of the compared or equal part, in s, in each recording.
    slope : slope of one noise on the other.
    sigmas : agreement of the noise, in standard deviations above chance.
    equal_rows : number of consecutive rows that are equal up to a factor; 0 if not significant.
    different : number of different readings in these rows.
    delay : samples between two decays that are one motion, None if this is not known.
    """

    experiments: tuple[str, str]
    times: tuple[tuple[float, float], tuple[float, float]]
    slope: float = 0.0
    sigmas: float = 0.0
    equal_rows: int = 0
    different: int = 0
    delay: float | None = None


def compare(a: Fingerprint, b: Fingerprint, *, shift: int) -> Match:
    """Compare the noise of two recordings.

    Parameters
    ----------
    shift : shift between the recordings: sample i of `a` corresponds to sample i + shift of `b`.
    """
    first, last = _overlap(a, b, shift)
    found = _match(a, b, shift, first, last)
    if last - first < LEAST_OVERLAP:
        return found
    # All carts are scaled to units of b's noise, so that each of them counts.
    of_a, of_b = a.spread(first, last), b.spread(first + shift, last + shift)
    factor = of_b / of_a * a.step / b.step if of_a * of_b > 0 else np.ones(len(a.step))
    in_a = a.noise[:, first:last] * factor[:, None]
    in_b = b.noise[:, first + shift : last + shift]
    both = in_a * in_b != 0
    n = np.count_nonzero(both, axis=1)
    if n.sum() < LEAST_OVERLAP:
        return found
    in_a, in_b = in_a * both, in_b * both
    for row in range(len(a.measured), len(n)):  # the input has another scale than the carts
        in_a[row] *= np.linalg.norm(in_b[row]) / max(np.linalg.norm(in_a[row]), 1e-30)
    x = np.stack([in_a, in_b], axis=1)
    left = x @ x.transpose(0, 2, 1)
    # Signs may be reversed in a copy: of all carts together, and of the input.
    product = sum(abs(float(part[:, 0, 1].sum())) for part in np.split(left, [len(a.measured)]))
    of_a, of_b = np.diag(left.sum(axis=0)).tolist()
    if not of_a * of_b > 0:
        return found
    chance = float(np.sqrt(of_a * of_b / (PASSED * n.sum())))
    return replace(found, slope=product / min(of_a, of_b), sigmas=product / chance)


def _overlap(a: Fingerprint, b: Fingerprint, shift: int) -> tuple[int, int]:
    """Return the first sample of `a` that `b` contains too, and the one after the last."""
    return max(0, -shift), min(a.residual.shape[1], b.residual.shape[1] - shift)


def _match(a: Fingerprint, b: Fingerprint, shift: int, first: int, last: int) -> Match:
    """Return a result for a part of `a`, with experiments and times but without similarity."""
    return Match(
        experiments=(a.experiment, b.experiment),
        times=(a.times(first, last), b.times(first + shift, last + shift)),
    )


def equal_rows(a: Fingerprint, b: Fingerprint, *, shift: int) -> Match | None:
    """Return the longest stretch in which two recordings are equal, up to a factor per channel.

    Repeated readings, as from a cart at rest, count once. Returns None if too few remain to be
    significant.
    """
    first, last = _overlap(a, b, shift)
    if last - first < LEAST_OVERLAP:
        return None
    in_a = a.measured[:, first:last].astype(np.float64)
    in_b = b.measured[:, first + shift : last + shift].astype(np.float64)
    equal = np.ones(last - first, dtype=bool)
    for of_a, of_b in zip(in_a, in_b, strict=True):
        loud = np.abs(of_a) >= _LEAST_NOISE
        factor = float(np.median(of_b[loud] / of_a[loud])) if np.any(loud) else 0.0
        most = _SAME_STEPS * (1 + abs(factor)) + _SAME_PART * np.abs(of_b)
        equal &= np.abs(of_b - factor * of_a) <= most
    ends = np.flatnonzero(np.diff(equal, prepend=False, append=False)).reshape(-1, 2)
    if not ends.size:
        return None
    start, stop = ends[np.argmax(ends[:, 1] - ends[:, 0])].tolist()
    rows = np.round(in_b[:, start:stop].T / _DIFFERENT_STEPS)
    different = len(np.unique(np.hstack([rows[:-1], rows[1:]]), axis=0)) * len(in_b)
    shorter = min(a.residual.shape[1], b.residual.shape[1])
    if different < LEAST_OVERLAP or stop - start < _EQUAL_PART * shorter:
        return None
    match = _match(a, b, shift, first + start, first + stop)
    return replace(match, equal_rows=stop - start, different=different)


_BANDS = ((0.2, 0.3), (0.3, 0.4), (0.4, 0.5))  # cycles per sample, above the fingerprint's corner
_BANDWIDTH = 0.2  # of each band, as a share of the Nyquist frequency
_SMOOTHED = 33  # lines of the spectrum over which its level is averaged
_LOUDEST = 1.3  # times this level; a line counts no more
_LEAST_SHARE = 0.6  # of the shorter recording
_MOST = 4.0  # sigmas in a band that count, so that no recording decides alone
# Sum of three squared sigmas by which any time shift must exceed those that the motion suggests;
# chance gives 19 among 2,000 shifts.
_ANYWHERE = 15.0
_LEAST_SPREAD = 1.5  # sigmas; in honest pairs the recordings spread by this much or more
_PEAKS = 3  # time shifts that the motion of two recordings may suggest
_MOST_EACH = 12  # recordings of one kind of a submission that are compared
_FEWEST = 6  # recordings of two submissions that are enough to compare
_LEAST_SIGMAS = 1.0  # of a recording that is named
# Knocks agree in honest recordings too, so noise alone proves no more than this.
_LEAST_CHANCE, _LEAST_CHANCE_OF_DECAYS = 1e-3, 1e-6
_FALSE = 1e-3  # share of honest classes in which a pair is accused


@dataclass(frozen=True, kw_only=True, eq=False)
class Heard:
    """A recording with the spectra of its whitened noise.

    Attributes
    ----------
    length : number of samples to which the recordings of its group are padded.
    spectra : (3, n_carts, n_lines) of the noise in each band, with unit variance. Lines below the
        first band are omitted.
    """

    print: Fingerprint
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
    shift : sample i of the first corresponds to sample i + shift of the second.
    delay : the same for two decays that are one motion, to a part of a sample.
    """

    fingerprints: tuple[Fingerprint, Fingerprint]
    sigmas: Array
    shift: int
    delay: Delay | None = None

    @property
    def is_decay(self) -> bool:
        """Whether a hand released the cart."""
        return is_decay(self.fingerprints[0].group)

    def match_of(self, sigmas: float) -> Match:
        """Return the agreement as a similarity of two recordings."""
        a, b = self.fingerprints
        match = _match(a, b, self.shift, *_overlap(a, b, self.shift))
        delay = None if self.delay is None else self.delay.samples
        return replace(match, sigmas=sigmas, delay=delay)

    @property
    def match_strength(self) -> float:
        """How likely it is that the two recordings correspond."""
        return float(self.sigmas @ self.sigmas) + 2 * _ANYWHERE * (self.delay is not None)

    def of(self, side: int) -> str:
        """Return the name of one of the recordings."""
        return self.fingerprints[side].experiment


def _first_line(length: int) -> int:
    return int(_BANDS[0][0] * length)


def padded_length(prints: Sequence[Fingerprint]) -> int:
    """Return the length to which recordings of one group are padded."""
    from scipy.fft import next_fast_len

    return next_fast_len(2 * max(one.residual.shape[1] for one in prints), real=True) or 1


def agreements(
    a: Mapping[str, Sequence[Heard]], b: Mapping[str, Sequence[Heard]], delays: Iterable[Delay]
) -> list[Agreement]:
    """Return the recordings of two submissions that correspond, each at most once.

    Parameters
    ----------
    delays : the decays of the two that are one motion.
    """
    released = {tuple(map(id, one.fingerprints)): one for one in delays}
    found: list[Agreement] = []
    for group in sorted(a.keys() & b.keys()):
        pairs = [
            _compared(one, other, released.get((id(one.print), id(other.print))))
            for one in a[group][:_MOST_EACH]
            for other in b[group][:_MOST_EACH]
        ]
        used: set[int] = set()
        for pair in sorted(pairs, key=lambda pair: -pair.match_strength):
            if used.isdisjoint(map(id, pair.fingerprints)):
                used.update(map(id, pair.fingerprints))
                found.append(pair)
    return found


def _compared(a: Heard, b: Heard, delay: Delay | None) -> Agreement:
    """Compare two recordings at the time shift that their motion suggests best, or their noise."""
    from scipy.fft import irfft

    spectrum = np.sum(np.conj(a.spectra) * b.spectra, axis=1)
    spectrum = np.pad(spectrum, ((0, 0), (_first_line(a.length), 0)))
    products = np.asarray(irfft(spectrum, a.length, axis=1))
    least = round(_LEAST_SHARE * min(a.n, b.n))
    shifts = np.arange(least - a.n, b.n - least + 1)
    overlap = np.minimum(a.n, b.n - shifts) - np.maximum(0, -shifts)
    sigmas = products[:, shifts] * np.sqrt(_BANDWIDTH / (overlap * a.spectra.shape[1]))
    total = np.sum(sigmas * sigmas, axis=0)
    if delay is None:
        near = [s + k for s in _motion_shifts(a.print.motion, b.print.motion) for k in (-1, 0, 1)]
    else:
        near = [round(delay.samples)]
    likely = [0, b.n - a.n, *near]
    likely = [shift - shifts[0] for shift in likely if shifts[0] <= shift <= shifts[-1]]
    at = max(likely, key=lambda at: total[at], default=int(np.argmax(total)))
    if not is_decay(a.print.group) and total.max() > total[at] + _ANYWHERE:
        at = int(np.argmax(total))
    return Agreement(
        fingerprints=(a.print, b.print),
        sigmas=np.clip(sigmas[:, at].astype(float), -_MOST, _MOST),
        shift=int(shifts[at]),
        delay=delay,
    )


def _motion_shifts(a: Array, b: Array) -> list[int]:
    """Return the shifts in samples at which two motions, stored coarsely, agree best.

    An oscillation agrees again after half a period.
    """
    a, b = a - a.mean(), b - b.mean()
    least = max(1, round(_LEAST_SHARE * min(a.size, b.size)))
    shifts, first, last, products = shifted_products(a, b, least=least)
    means: list[Array] = []
    n, power = last - first, np.ones(shifts.size)
    for x, start, end in ((a, first, last), (b, first + shifts, last + shifts)):
        total, squares = np.append(0.0, np.cumsum(x)), np.append(0.0, np.cumsum(x * x))
        mean = (total[end] - total[start]) / n
        power *= np.maximum(squares[end] - squares[start] - n * mean**2, 1e-30)
        means.append(mean)
    alike = np.abs(products - n * means[0] * means[1]) / np.sqrt(power)
    inner = alike[1:-1]
    peaks = 1 + np.flatnonzero((inner >= alike[:-2]) & (inner > alike[2:]))
    found = []
    for at in peaks[np.argsort(-alike[peaks], kind="stable")[:_PEAKS]].tolist():
        before, here, after = alike[at - 1 : at + 2].tolist()  # on a parabola
        between = (before - after) / (2 * (before - 2 * here + after))
        found.append(round(EVERY * (int(shifts[at]) + between)))
    return found or [int(EVERY * shifts[np.argmax(alike)])]


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
    found: Sequence[Agreement],
    common: tuple[Mapping[str, Array], Mapping[str, Array]] = ({}, {}),
    *,
    releases: float,
    pairs: int,
) -> list[tuple[Agreement, float]]:
    """Return the recordings that are copies, each with its sigmas; empty without proof.

    Parameters
    ----------
    common : what the recordings of both submissions share with most other teams; see `usual`.
    releases : how probable it is that honest releases agree as well; see `releases.chance`.
    pairs : number of pairs of submissions in which chance could have made a match.
    """
    if len(found) < _FEWEST:
        return []
    raw = np.array([one.sigmas for one in found])
    signs = np.where(raw.sum(axis=0) < 0, -1.0, 1.0) / np.sqrt(len(_BANDS))
    shared = np.array([np.mean([common[s].get(one.of(s), 0.0 * signs) for s in (0, 1)], axis=0)
                       for one in found])  # fmt: skip
    own = raw - np.clip(shared, np.minimum(raw, 0.0), np.maximum(raw, 0.0))
    sigmas = own @ signs
    decays = np.array([one.is_decay for one in found])
    chance = (
        max(_chance(sigmas[~decays]), _LEAST_CHANCE)
        * max(_chance(sigmas[decays]), _LEAST_CHANCE_OF_DECAYS)
        * releases
    )
    if not decays.any() or pairs * _of_product(chance) > _FALSE:
        return []
    return [
        (one, float(s))
        for one, s in zip(found, sigmas, strict=True)
        if s >= _LEAST_SIGMAS or one.delay
    ]


def _chance(sigmas: Array) -> float:
    """Return how probable it is that honest noise agrees as well on average."""
    from scipy.special import ndtr

    if sigmas.size == 0:
        return 1.0
    spread = max(_LEAST_SPREAD, float(sigmas.std(ddof=1)) if sigmas.size > 1 else 0.0)
    return float(ndtr(-sigmas.mean() * np.sqrt(sigmas.size) / spread))


def _of_product(product: float) -> float:
    """Return how probable a product of three independent probabilities is that is no larger."""
    log = -np.log(max(product, 1e-300))
    return product * float(1 + log + log**2 / 2)
