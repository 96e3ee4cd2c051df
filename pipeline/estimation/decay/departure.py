"""Test whether a free decay is exponential within the noise of its own recording.

The residual of the exponential is compared with the spectrum of the noise. The noise is the
residual of a flexible change of envelope, phase and rest point.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import fdtri

from pipeline.arrays import Array, ComplexArray
from pipeline.estimation.decay.ringing import Ringing

_CHANCE = 1e-4  # share of exponential decays that fail the test
_PER_PERIOD = 16  # samples per period that are enough to tell the laws apart
_ORDERS = 3, 8  # least and most order of the flexible change; in between, one for each period
_SAME = 1e-3  # share of a column outside the others, below which it adds nothing
_LINE = 25.0  # power of a line above the noise that chance does not reach
_BINS = 24  # frequencies near that of the decay that give the noise
# What may be left as noise: a share of the motion, or a multiple of the noise between neighbouring
# samples. The flexible change cannot follow a second mode over many periods.
_NOISE_SHARE, _NOISE_RATIO = 0.01, 10.0
SECOND = 0.3, 3.0  # frequencies where a second mode may be, relative to that of the first
UNKNOWNS = 6  # of an exponential decay with a drift


@dataclass(frozen=True, kw_only=True, eq=False)
class Departure:
    """The residual of an exponential fit to a decay, relative to the noise.

    Attributes
    ----------
    statistic : F-statistic of the flexible change, or that of dry friction, another mode or too
        much noise if it says more.
    limit : what the statistic exceeds by chance in one of 10,000 exponential decays.
    columns : number of columns of the flexible change.
    left : residual (n,) of the exponential fit.
    noise : residual (n,) of the flexible change.
    """

    statistic: float
    limit: float
    columns: int
    left: Array
    noise: Array

    @property
    def present(self) -> bool:
        """Whether more is left than noise."""
        return self.statistic > self.limit


def find_departure(
    t: Array, y: Array, fit: Ringing, *, step: float, floor: float, friction: Array
) -> Departure:
    """Test whether the residual of an exponential exceeds the noise of the decay `y`.

    Parameters
    ----------
    step : the encoder step.
    floor : the noise between neighbouring samples (root mean square).
    friction : what a little dry friction adds to the decay, shape (n,). This one column shows less
        friction than the many of the flexible change.
    """
    tau, residual, pole = t - t[0], y - fit(t), complex(fit.poles[0])
    n, angle = t.size, pole.imag * float(t[-1] - t[0]) / (t.size - 1)
    orders = int(np.clip(angle * n / (2 * np.pi), *_ORDERS))
    slow = legvander(2 * tau / tau[-1] - 1, orders).T
    turning, decaying = np.exp(1j * pole.imag * tau), np.exp(pole.real * tau)
    own = _columns(slow[:2], slow[:2] * decaying * turning)
    flexible = _columns(
        slow[2:4], slow * turning, slow[2:4] * decaying * turning, turning[None] ** 2,
        turning[None] ** 3,
    )  # fmt: skip
    basis = np.linalg.qr(own)[0]
    left = residual - basis @ (basis.T @ residual)
    flexible /= np.linalg.norm(flexible, axis=0)
    flexible -= basis @ (basis.T @ flexible)
    added, sizes, _ = np.linalg.svd(flexible, full_matrices=False)
    added = added[:, sizes > _SAME]
    along = added.T @ left
    noise = left - added @ along
    density = noise_density(noise, angle=angle, step=step, unknowns=UNKNOWNS + along.size)
    freedom = min(2.0 * _BINS, max(n - UNKNOWNS - along.size, 2.0))
    limit = float(fdtri(along.size, freedom, 1 - _CHANCE))
    friction = friction - basis @ (basis.T @ friction)
    # Friction only ever brakes, so chance has twice its share on this side.
    rubbed = max(float(friction @ left), 0.0) ** 2 / float(friction @ friction) / density
    most = max(_NOISE_SHARE * float(np.ptp(y)), _NOISE_RATIO * floor)
    return Departure(
        statistic=max(
            float(along @ along) / along.size / density,
            limit / float(fdtri(1, freedom, 1 - 2 * _CHANCE)) * rubbed,
            limit / _LINE * _highest_line(noise, angle=angle),
            limit * (float(np.std(noise)) / most) ** 2 if most > 0 else 0.0,
        ),
        limit=limit,
        columns=along.size,
        left=left,
        noise=noise,
    )


def _highest_line(residual: Array, *, angle: float) -> float:
    """Return the highest power of another mode, relative to the usual power at its frequency."""
    n = residual.size
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(residual * window)) ** 2 / (window @ window)
    first, last = (int(share * angle * n / (2 * np.pi)) for share in SECOND)
    near = power[max(first, 2) : min(last, n // 2) + 1]
    usual = float(np.median(near)) / np.log(2) if near.size >= _BINS else 0.0
    return float(np.max(near)) / usual if usual > 0 else 0.0


def _columns(*parts: Array | ComplexArray) -> Array:
    """Return real columns (n, …) of real and complex rows."""
    halves = [np.concatenate([p.real, p.imag]) if np.iscomplexobj(p) else p.real for p in parts]
    return np.concatenate(halves).T


def noise_density(residual: Array, *, angle: float, step: float, unknowns: int) -> float:
    """Return the variance of the noise near a frequency of `angle` rad per sample.

    It is the mean of the spectrum at the nearest frequencies, but for those that a fit to the decay
    and its harmonics follows, and at least that of white noise or of the rounding.
    """
    n = residual.size
    freedom = max(n - unknowns, 1)
    white = max(float(residual @ residual) / freedom, step**2 / 12)
    power = np.abs(np.fft.rfft(residual)) ** 2 / n
    bins = np.arange(1, power.size - 1)
    at = angle * n / (2 * np.pi)
    apart = np.min(np.abs(bins - at * np.arange(4.0)[:, None]), axis=0)
    usable = bins[apart > _ORDERS[1] / 2 + 1]
    nearest = usable[np.argsort(np.abs(usable - at), kind="stable")[:_BINS]]
    return max(white, float(np.mean(power[nearest]))) if nearest.size == _BINS else white


def thinned(t: Array, y: Array, *, omega: float) -> tuple[Array, Array]:
    """Return means of neighbouring samples, as many as a decay at `omega` rad/s allows.

    A constant sine keeps its frequency and damping, and its amplitude changes by one factor.
    Samples at uneven times are returned as they are.
    """
    intervals = np.diff(t)
    usual = float(np.median(intervals))
    size = int(2 * np.pi / omega / usual / _PER_PERIOD)
    if size < 2 or np.max(np.abs(intervals - usual)) > 0.5 * usual:
        return t, y
    n = t.size // size * size
    t_mean, y_mean = (values[:n].reshape(-1, size).mean(axis=1) for values in (t, y))
    return t_mean, y_mean
