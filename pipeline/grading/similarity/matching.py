"""Compare two recordings at a known time shift: which rows are equal, and how similar the noise is.

A copy has the noise of its original. So if one noise is regressed on the other, at the same scale,
the slope is one. This only suggests where to look for equal rows, which prove a copy.
"""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.grading.similarity.fingerprints import PASSED, STEPS_PER_SIGMA, Fingerprint

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
    first, last = max(0, -shift), min(a.residual.shape[1], b.residual.shape[1] - shift)
    found = _between(a, b, shift=shift, first=first, last=last)
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


def _between(a: Fingerprint, b: Fingerprint, *, shift: int, first: int, last: int) -> Match:
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
    first, last = max(0, -shift), min(a.residual.shape[1], b.residual.shape[1] - shift)
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
    return replace(
        _between(a, b, shift=shift, first=first + start, last=first + stop),
        equal_rows=stop - start,
        different=different,
    )
