"""Free decay of one cart: logarithmic decrement, exponential fit, and why it may not be one."""

from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.decay.free_decay import FreeDecay, find_decay, fit_decay
from pipeline.estimation.noise import resolution
from pipeline.results import DecayLaw, LogDecrement, Record

_PEAKS_FOR_REGRESSION = 4  # enough for two amplitudes


@dataclass(frozen=True, kw_only=True, eq=False)
class _Peaks:
    """Turning points, and the decrement and damped frequency from them, with standard errors."""

    t: Array
    y: Array
    amplitude: Array
    delta: float
    delta_std: float
    omega_d: float
    omega_d_std: float

    @property
    def zeta(self) -> tuple[float, float]:
        """The damping ratio and its standard error."""
        length = float(np.hypot(2 * np.pi, self.delta))
        return self.delta / length, (2 * np.pi) ** 2 / length**3 * self.delta_std

    @property
    def omega_n(self) -> tuple[float, float]:
        """The natural frequency, rad/s, and its standard error."""
        zeta, zeta_std = self.zeta
        stretched = 1 / np.sqrt(1 - zeta**2)
        omega_n = self.omega_d * stretched
        std = np.hypot(self.omega_d_std * stretched, omega_n * zeta * zeta_std)
        return float(omega_n), float(std)


def fit_log_decrement(record: Record, *, cart: int) -> LogDecrement:
    """Estimate damping ratio and natural frequency of one cart from its free decay.

    The decay is searched for, because a hold, a hand or a driven part may precede it. There are two
    estimates: the classical one from the peaks, and an exponential sinusoid with a drifting rest
    point, fitted to every sample. If its residual exceeds the noise, damping and frequency are
    those of the law that the decay follows, unless it is dry friction. The method is valid for one
    free cart on at least one spring and damping ratios up to about 0.6.

    Raises
    ------
    DataError : there are no two turning points of one decay, or the motion is not a decaying
        oscillation.
    """
    t, y = record.t, record.position(cart)
    size = resolution(t, y, step=record.encoder_step(cart))
    floor = size / np.sqrt(12)
    step = record.encoder_step(cart)
    stretch, run = find_decay(record, cart=cart, size=size)
    decay = fit_decay(t, y, stretch=stretch, run=run, floor=floor, step=step)
    if decay.explained is None:
        raise DataError(
            f"{record.id}: log decrement needs a decaying oscillation of cart {cart}, found a "
            "motion that does not swing regularly"
        )
    fit, pole = decay.fit, complex(decay.fit.poles[0])
    law, fitted = _law(decay), _fitted(decay)
    unexplained = decay.rms(t, y) / float(np.ptp(y[decay.first : decay.stop]))
    # A fit with a larger residual belongs to another kind of motion. Real carts with dry friction
    # leave 1.3 to 2.1 % (ten runs).
    if not (0 < fitted.zeta < 1 and pole.imag > 0 and unexplained < 0.08):
        raise DataError(
            f"{record.id}: log decrement needs a decaying oscillation of cart {cart}, found "
            f"{_motion(fitted.zeta)} with {100 * unexplained:.0f} % of it unexplained"
        )
    peaks = _peaks(t, y, decay, floor=floor)
    (zeta_peaks, zeta_peaks_std), (omega_n_peaks, omega_n_peaks_std) = peaks.zeta, peaks.omega_n
    end = t[decay.stop - 1]
    n_figure = int(60 * pole.imag * (end - fit.t0) / (2 * np.pi)) + 2  # 60 points per period
    fit_t = np.linspace(fit.t0, end, min(n_figure, 3000))
    middle = fit.level + fit.slope * (fit_t - fit.t0)
    envelope = np.abs(fit.amplitudes[0]) * np.exp(pole.real * (fit_t - fit.t0))
    return LogDecrement(
        experiment=record.id,
        cart=cart,
        release=float(t[decay.first]),
        peak_t=peaks.t,
        peak_y=peaks.y,
        amplitude=peaks.amplitude,
        delta=peaks.delta,
        delta_std=peaks.delta_std,
        zeta_peaks=zeta_peaks,
        zeta_peaks_std=zeta_peaks_std,
        omega_n_peaks=omega_n_peaks,
        omega_n_peaks_std=omega_n_peaks_std,
        zeta=fitted.zeta,
        zeta_std=fitted.zeta_std,
        omega_n=fitted.omega_n,
        omega_n_std=fitted.omega_n_std,
        fit_t=fit_t,
        fit_y=decay.model(fit_t),
        envelope_upper=middle + envelope,
        envelope_lower=middle - envelope,
        law=law,
        zeta_at_amplitude=_zeta_at_amplitude(peaks.amplitude),
        note=_note(record, decay, n_peaks=peaks.t.size),
    )


@dataclass(frozen=True, kw_only=True)
class _Fitted:
    """Damping ratio and natural frequency (rad/s) with their standard errors."""

    zeta: float
    zeta_std: float
    omega_n: float
    omega_n_std: float


def _fitted(decay: FreeDecay) -> _Fitted:
    """Return the numbers of the law, or of the exponential if the law is dry friction or unknown.

    With dry friction no damping ratio holds for small swings, so the number is the usual one.
    """
    law = decay.explained.law if decay.explained else None
    return _of_exponential(decay) if law is None or law.name == "dry_friction" else _of_law(decay)


def _of_exponential(decay: FreeDecay) -> _Fitted:
    """Return the numbers of the exponential fit.

    Unlike noise, what the fit leaves beyond the noise does not average out, so it counts in full.
    """
    pole, explained = complex(decay.fit.poles[0]), decay.explained
    covariance = decay.fit.covariance[2:, 2:]
    if explained and (left := explained.left[0]):
        covariance = covariance * max(1.0, (explained.density + left) / decay.fit.variance)
    per_zeta = np.array([pole.imag**2, pole.real * pole.imag]) / abs(pole) ** 3
    per_omega = np.array([-pole.real, pole.imag]) / abs(pole)
    zeta_std, omega_n_std = (np.sqrt(per @ covariance @ per) for per in (per_zeta, per_omega))
    return _Fitted(
        zeta=-pole.real / abs(pole),
        zeta_std=float(zeta_std),
        omega_n=abs(pole),
        omega_n_std=float(omega_n_std),
    )


def _of_law(decay: FreeDecay) -> _Fitted:
    """Return the numbers that the law implies; a damping ratio is at least zero."""
    explained = decay.explained
    if explained is None or explained.law is None:
        return _of_exponential(decay)
    zeta, omega_n, _ = explained.law.values
    zeta_std, omega_n_std, _ = explained.errors
    return _Fitted(
        zeta=max(float(zeta), 0.0),
        zeta_std=float(zeta_std),
        omega_n=float(omega_n),
        omega_n_std=float(omega_n_std),
    )


def _law(decay: FreeDecay) -> DecayLaw:
    """Return the result of the test, and what the law implies."""
    explained, implied = decay.explained, _of_law(decay)
    assert explained is not None, "a decay that swings is tested"
    size = (float("nan"),) * 2
    if explained.law:
        size = float(explained.law.values[2]), float(explained.errors[2])
    return DecayLaw(
        name=explained.name,
        statistic=explained.departure.statistic,
        limit=explained.departure.limit,
        size=size[0],
        size_std=size[1],
        zeta=implied.zeta,
        zeta_std=implied.zeta_std,
        omega_n=implied.omega_n,
        omega_n_std=implied.omega_n_std,
    )


def _motion(zeta: float) -> str:
    """Return the motion that a damping ratio means."""
    return f"one with zeta = {zeta:.3g}" if zeta > 0 else "a motion that does not decay,"


# -------------------------------------------------------------------- the peaks


def _peaks(t: Array, y: Array, decay: FreeDecay, *, floor: float) -> _Peaks:
    """Locate the turning points between samples, and regress the log amplitude on their number.

    With fewer than four turning points, the values are those of the exponential fit.
    """
    pole = complex(decay.fit.poles[0])
    # Within half a radian of a turning point, a cosine is nearly a parabola.
    located = [_vertex(t, y, i, half_width=0.5 / pole.imag) for i in decay.turning]
    peak_t, peak_y = np.array(located).reshape(-1, 2).T
    n = peak_t.size
    swing = _half_swing(n)
    signed = swing @ peak_y
    amplitude = np.abs(signed)
    if n < _PEAKS_FOR_REGRESSION:
        decay_std, omega_d_std = np.sqrt(np.diag(decay.fit.covariance)[2:])
        return _Peaks(
            t=peak_t,
            y=peak_y,
            amplitude=amplitude,
            delta=-2 * np.pi * pole.real / pole.imag,
            delta_std=float(2 * np.pi * decay_std / pole.imag),
            omega_d=pole.imag,
            omega_d_std=float(omega_d_std),
        )
    # The noise of the amplitude A is constant, so ln A has the weight A². The standard errors
    # follow from the errors of the turning points, because neighbouring amplitudes share them.
    per_log = _slope(amplitude)
    loss = -float(per_log @ np.log(amplitude))  # per half cycle
    sigma = max(decay.fit.rms, floor)  # noise of one turning point, at most
    noise = sigma * float(np.linalg.norm((per_log / signed) @ swing))
    per_time = _slope(np.abs(np.gradient(peak_y)))
    interval = float(per_time @ peak_t)
    count = np.arange(n) - (n - 1) / 2
    late = peak_t - peak_t.mean() - interval * count
    interval_std = float(np.linalg.norm(per_time * late)) * np.sqrt(n / (n - 2))
    # Because samples meet the motion at any phase, the decrement can still differ by this relative
    # amount.
    return _Peaks(
        t=peak_t,
        y=peak_y,
        amplitude=amplitude,
        delta=2 * loss,
        delta_std=2 * float(np.hypot(noise, 1e-4 * loss)),
        omega_d=np.pi / interval,
        omega_d_std=np.pi / interval**2 * interval_std,
    )


def _slope(weight: Array) -> Array:
    """Return w (n,) such that w @ values is the slope, per step, of a weighted line fit."""
    line = np.vander(np.arange(float(weight.size)), 2)
    return (np.linalg.pinv(line * weight[:, None]) * weight)[0]


def _half_swing(n: int) -> Array:
    """Return the matrix (n - 2, n) from turning points to amplitudes about a moving middle."""
    if n < 3:
        return np.empty((0, n))
    return 0.5 * np.eye(n - 2, n, 1) - 0.25 * (np.eye(n - 2, n) + np.eye(n - 2, n, 2))


def _vertex(t: Array, y: Array, index: int, *, half_width: float) -> tuple[float, float]:
    """Return time and value of the local parabola's vertex at a turning point."""
    first, stop = np.searchsorted(t, t[index] + half_width * np.array([-1, 1]))
    first, stop = min(int(first), max(index - 1, 0)), max(int(stop), min(index + 2, t.size))
    tau = (t[first:stop] - t[index]) / half_width
    if tau.size < 3 or np.ptp(y[first:stop]) == 0:  # a crest of equal readings
        return float(t[index]), float(y[index])
    a, b, c = np.linalg.lstsq(np.vander(tau, 3), y[first:stop], rcond=None)[0]
    vertex = -b / (2 * a) if a else 0.0
    if abs(vertex) > 1:  # no turning point inside: the cart stops here
        return float(t[index]), float(y[index])
    return float(t[index] + vertex * half_width), float(c + b * vertex / 2)


def _zeta_at_amplitude(amplitude: Array) -> Array:
    """Return mean amplitudes and damping ratios (2, n - 1) from each amplitude to the next."""
    if amplitude.size < 2:
        return np.empty((2, 0))
    loss = np.log(amplitude[:-1] / amplitude[1:])
    return np.array([np.sqrt(amplitude[:-1] * amplitude[1:]), loss / np.hypot(np.pi, loss)])


# ------------------------------------------------------------------------ notes


def _note(record: Record, decay: FreeDecay, *, n_peaks: int) -> str:
    notes = []
    level = decay.stretch.level
    if level and record.u is not None and abs(level) > 0.02 * float(np.max(np.abs(record.u))):
        notes.append(f"the cart oscillates about its new rest point, at an input of {level:.4g}")
    if n_peaks < _PEAKS_FOR_REGRESSION:
        notes.append(
            f"{n_peaks} turning points are too few for a logarithmic decrement; the value is that "
            "of the exponential fit"
        )
    return "; ".join(notes)
