"""Compare how two teams released their carts, to a hundredth of a sample.

A hand releases a cart at any instant, so between two honest decays the delay is any part of a
sample. Between a decay and its copy it is a whole number of samples, often none. Noise, a scale, a
sign, smoothing and cutting leave this as it is. How small such parts are among the other teams
shows what they prove: a release that starts the recording proves nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.grading.similarity.fingerprints import EVERY, Fingerprint

_LEAST_OVERLAP = 0.6  # of the shorter decay
_AT_REST = 8  # stored values at the end of a decay that give its rest point
_FEWEST = 8  # stored values in common that determine a delay
_SAME_SCALE = 0.05  # relative difference of a decay's scale from that of the other recordings
_NEAR_SCALE, _NEAR_MOTION = 0.08, 0.9  # the same, and the correlation, before the delay is refined
_SAME_MOTION = 0.96  # squared correlation of two decays that are one motion
_MOST_DELAYS = 2  # of two decays, which agree again after each half period
_STEPS = 2  # of the refinement, which converges quadratically
_FINEST = 0.005  # samples; noise moves the delay of a copy by this much
_BY_CHANCE = 0.2  # share of honest decays that agree at some delay; 0.1 to 0.2 if simulated
_FEWEST_DELAYS = 6  # of other teams, which show what is usual


def is_decay(group: str) -> bool:
    """Return whether a hand released the cart in recordings of a group."""
    return group.startswith("decay")


def shifted_products(
    x: Array, y: Array, *, least: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Array]:
    """Return the sums of products of two signals at every shift, by the convolution theorem.

    Parameters
    ----------
    least : smallest number of samples in which both signals overlap.

    Returns
    -------
    The shifts, for each of them the first sample of `x` that overlaps and the one after the last,
    and the sum of x_i y_(i + shift).
    """
    from scipy.fft import irfft, next_fast_len, rfft

    length = next_fast_len(x.size + y.size, real=True) or 1
    of_x, of_y = (np.asarray(rfft(z, length)) for z in (x, y))
    shifts = np.arange(least - x.size, y.size - least + 1)
    products = np.asarray(irfft(np.conj(of_x) * of_y, length))[shifts]
    return shifts, np.maximum(0, -shifts), np.minimum(x.size, y.size - shifts), products


@dataclass(frozen=True, kw_only=True, eq=False)
class Delay:
    """Two decays that are one motion, with the time between them.

    Attributes
    ----------
    samples : sample i of the first corresponds to sample i + `samples` of the second.
    """

    fingerprints: tuple[Fingerprint, Fingerprint]
    samples: float

    @property
    def parts(self) -> Array:
        """The size of the delay, and its distance from a whole number, in samples."""
        return np.abs([self.samples, self.samples - round(self.samples)])


class Motion:
    """The motion of a decay, which is read between the stored values."""

    def __init__(self, print_: Fingerprint):
        self.print = print_
        self.at = np.arange(print_.motion.size) * float(EVERY)
        self.values = print_.motion - print_.motion[-_AT_REST:].mean()

    @cached_property
    def between(self):  # a spline of scipy, which is imported late
        """The spline through the stored values, and its derivative."""
        from scipy.interpolate import make_interp_spline

        spline = make_interp_spline(self.at, self.values, k=5)
        return spline, spline.derivative()

    def delays_to(self, other: "Motion", *, scale: float) -> list[Delay]:
        """Return the delays at which another decay is this one, at a scale of known size."""
        found = []
        for start in self._near(other, scale=scale)[:_MOST_DELAYS]:
            delay, at_scale, alike = self._refined(other, start)
            if alike > _SAME_MOTION and abs(abs(at_scale) / scale - 1) < _SAME_SCALE:
                found.append(Delay(fingerprints=(self.print, other.print), samples=delay))
        return found

    def _near(self, other: "Motion", *, scale: float) -> list[float]:
        """Return the delays at which the stored values correspond, the best scale first."""
        x, y = self.values, other.values
        least = max(_FEWEST, round(_LEAST_OVERLAP * min(x.size, y.size)))
        if x.size + y.size - 2 * least < 2:  # fewer than three shifts
            return []
        shifts, first, last, products = shifted_products(x, y, least=least)
        in_x, in_y = (np.append(0.0, np.cumsum(z * z)) for z in (x, y))
        squares = in_x[last] - in_x[first] + 1e-30
        others = in_y[last + shifts] - in_y[first + shifts] + 1e-30
        alike = np.abs(products) / np.sqrt(squares * others)
        off = np.abs(np.sqrt(others / squares) / scale - 1)
        before, inner, after = alike[:-2], alike[1:-1], alike[2:]
        peaks = np.flatnonzero((inner >= before) & (inner > after) & (off[1:-1] < _NEAR_SCALE))
        # A parabola through three values has its vertex near the peak of a sine.
        slope = (after - before)[peaks] / 2
        between = slope / (2 * inner - before - after)[peaks]
        sure = inner[peaks] + slope * between / 2 > _NEAR_MOTION
        order = np.argsort(off[1 + peaks[sure]], kind="stable")
        return (EVERY * (shifts[1 + peaks] + between))[sure][order].tolist()

    def _refined(self, other: "Motion", delay: float) -> tuple[float, float, float]:
        """Return the delay, the scale and the squared correlation, by Gauss–Newton steps."""
        spline, slope = other.between
        scale = alike = 0.0
        for _ in range(_STEPS):
            at = self.at + delay
            inside = (at >= 0) & (at <= other.at[-1])
            if np.count_nonzero(inside) < _FEWEST:
                return delay, 0.0, 0.0
            y, x = spline(at[inside]), self.values[inside]
            columns = np.array([x, -slope(at[inside]), np.ones_like(x)]).T
            solution = np.linalg.lstsq(columns, y, rcond=None)[0]
            left = y - columns @ solution
            scale, alike = float(solution[0]), 1 - float(left @ left) / float(y @ y + 1e-30)
            if alike < _NEAR_MOTION:
                break
            delay += float(np.clip(solution[1], -EVERY, EVERY))
        return delay, scale, alike


class Releases:
    """The decays of a submission, and the size of its other motions.

    Parameters
    ----------
    prints : the submission's recordings by group.
    """

    def __init__(self, prints: Mapping[str, Sequence[Fingerprint]]):
        self.decays = {
            group: [Motion(one) for one in found]
            for group, found in prints.items()
            if is_decay(group)
        }
        self.sizes = {
            group: float(np.median([one.motion.std() for one in found]))
            for group, found in prints.items()
            if not is_decay(group)
        }

    def delays_to(self, other: "Releases") -> list[Delay]:
        """Return the decays of two submissions that are one motion, each at most once."""
        ratios = [
            other.sizes[group] / size
            for group, size in self.sizes.items()
            if size > 0 and group in other.sizes
        ]
        if not ratios or not (scale := float(np.median(ratios))):
            return []
        found = [
            delay
            for group in self.decays.keys() & other.decays.keys()
            for one in self.decays[group]
            for another in other.decays[group]
            for delay in one.delays_to(another, scale=scale)
        ]
        chosen: list[Delay] = []
        for delay in sorted(found, key=lambda delay: np.min(delay.parts)):
            if not any(
                x is y
                for c in chosen
                for x, y in zip(c.fingerprints, delay.fingerprints, strict=True)
            ):
                chosen.append(delay)
        return chosen


def usual_parts(delays: Sequence[Delay]) -> Array | None:
    """Return what is usual for `Delay.parts` in a class, None if too few are known."""
    if len(delays) < _FEWEST_DELAYS:
        return None
    return np.median([one.parts for one in delays], axis=0)


def chance(found: Sequence[Delay], *, of: int, usual: Array | None) -> float:
    """Return how probable it is that honest releases agree as well as those found.

    Parameters
    ----------
    of : number of decays that could have agreed.
    usual : what is usual for the parts of a delay; see `usual_parts`.
    """
    from scipy.special import gammaincc

    if not found or usual is None:
        return 1.0
    # Honest delays are spread evenly, up to about twice their median. The better part counts.
    least = np.min(
        [np.maximum(one.parts, _FINEST) / (2 * usual + _FINEST) for one in found], axis=1
    )
    logs = np.log(2 * _BY_CHANCE * np.minimum(least, 1.0))
    return float(gammaincc(max(of, len(found)), -np.sum(logs)))
