"""Free decay of one cart: logarithmic decrement, exponential fit, dry friction."""

from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.decay.free_decay import FreeDecay, find_decay, fit_decay
from pipeline.estimation.noise import grain
from pipeline.results import LogDecrement, Record

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
    point, fitted to every sample. Dry friction is tested for. The method is valid for one free cart
    on at least one spring and damping ratios up to about 0.6.

    Raises
    ------
    DataError : there are no two turning points of one decay, or the motion is not a decaying
        oscillation.
    """
    t, y = record.t, record.position(cart)
    size = grain(t, y, step=record.encoder_step(cart))
    floor = size / np.sqrt(12)
    stretch, run = find_decay(record, cart=cart, size=size)
    decay = fit_decay(t, y, stretch=stretch, run=run, floor=floor)
    fit, pole = decay.fit, complex(decay.fit.poles[0])
    omega_n, zeta = abs(pole), -pole.real / abs(pole)
    unexplained = fit.rms / float(np.ptp(y[decay.first : decay.stop]))
    # A fit with a larger residual belongs to another kind of motion. Real carts with dry friction
    # leave 1.3 to 2.1 % (ten runs).
    if not (0 < zeta < 1 and pole.imag > 0 and unexplained < 0.08):
        raise DataError(
            f"{record.id}: log decrement needs a decaying oscillation of cart {cart}, found "
            f"zeta = {zeta:.3g} with {100 * unexplained:.0f} % of the motion unexplained"
        )
    zeta_std, omega_n_std = _pole_errors(pole, fit.covariance[2:, 2:])
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
        zeta=zeta,
        zeta_std=zeta_std,
        omega_n=omega_n,
        omega_n_std=omega_n_std,
        fit_t=fit_t,
        fit_y=fit(fit_t),
        envelope_upper=middle + envelope,
        envelope_lower=middle - envelope,
        friction=decay.friction.test if decay.friction else None,
        zeta_at_amplitude=_zeta_at_amplitude(peaks.amplitude),
        note=_note(record, decay, zeta=zeta, n_peaks=peaks.t.size),
    )


def _pole_errors(pole: complex, covariance: Array) -> tuple[float, float]:
    """Return the standard errors of zeta and omega_n.

    `covariance` (2, 2) belongs to decay rate and damped frequency.
    """
    per_zeta = np.array([pole.imag**2, pole.real * pole.imag]) / abs(pole) ** 3
    per_omega = np.array([-pole.real, pole.imag]) / abs(pole)
    zeta_std, omega_n_std = (np.sqrt(per @ covariance @ per) for per in (per_zeta, per_omega))
    return float(zeta_std), float(omega_n_std)


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


def _note(record: Record, decay: FreeDecay, *, zeta: float, n_peaks: int) -> str:
    notes = []
    level = decay.stretch.level
    if level and record.u is not None and abs(level) > 0.02 * float(np.max(np.abs(record.u))):
        notes.append(f"the cart oscillates about its new rest point, at an input of {level:.4g}")
    if n_peaks < _PEAKS_FOR_REGRESSION:
        notes.append(
            f"{n_peaks} turning points are too few for a logarithmic decrement; the value is that "
            "of the exponential fit"
        )
    test = decay.friction.test if decay.friction else None
    if test and test.present:
        notes.append(
            "the decay is not exponential: dry friction stops the cart within "
            f"{test.drop:.3g} of its rest point. Without the friction, zeta would be "
            f"{test.zeta:.3g}; the fitted {zeta:.3g} holds for these amplitudes only"
        )
    # It is worth a note if the damping of large amplitudes is larger by 5 %.
    elif test and test.f_statistic > test.threshold and test.zeta > 1.05 * zeta:
        notes.append(
            "the decay is not exponential: the damping grows with the amplitude, and zeta is a mean"
        )
    return "; ".join(notes)
