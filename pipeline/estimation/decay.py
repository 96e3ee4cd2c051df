"""Free decay of one cart: logarithmic decrement, exponential fit, and why it may not be one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation import noise
from pipeline.estimation.decay_laws import Explained, explain_decay
from pipeline.estimation.least_squares import Ringing, fit_ringing
from pipeline.results import DecayLaw, LogDecrement, Record

# -------------------------------------------------------------------- the free decay in a record

# Ratio of residual to noise below which a model is complete. With 50 samples, chance changes the
# ratio by a tenth.
_ADEQUATE = 1.5
# Smallest swing to count, in grains. A grain is the encoder step, or the step whose rounding error
# equals the noise if this is larger.
_SMALLEST_SWING = 8.0
# Extended back in time, a fit may miss the record by this many of its own residuals. A share of the
# amplitude is added while only the smaller swings were fitted, or if the residual exceeds the noise
# anyway.
_BACK_SIGMAS = 4.0
_BACK_SHARES = (0.05, 0.0, 0.0, 0.0)
_REAL_SHARE = 0.15


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """Samples [first, stop) of a record; `level` is their constant input.

    It is None for a whole record, whose input may vary or be missing.
    """

    first: int
    stop: int
    level: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeDecay:
    """Samples [first, stop) of one free decay, its turning points, and the fits to it.

    `fit` is the exponential fit, and `explained` the test of it, None if it was not tested.
    """

    stretch: Stretch
    first: int
    stop: int
    turning: list[int]
    fit: Ringing
    explained: Explained | None

    @property
    def model(self) -> Callable[[Array], Array]:
        """The law that the decay follows, as a function of time, or the exponential fit."""
        law = self.explained.law if self.explained else None
        return law.model if law else self.fit

    def residual(self, t: Array, y: Array) -> Array:
        """Return what the model leaves of the decay; `t` and `y` (n,) cover the record."""
        window = slice(self.first, self.stop)
        return y[window] - self.model(t[window])

    def rms(self, t: Array, y: Array) -> float:
        """Return the root-mean-square residual over the decay; `t`, `y` (n,) cover the record."""
        return float(np.sqrt(np.mean(self.residual(t, y) ** 2)))


def find_decay(record: Record, *, cart: int, size: float) -> tuple[Stretch, list[int]]:
    """Return the turning points of the record's largest free decay, and the stretch around it.

    `size` is the smallest significant change. Stretches without input are preferred.

    Raises
    ------
    DataError : no stretch has two turning points of one decay.
    """
    y = record.position(cart)
    most = 0
    for group in _stretches(record):
        found = [(stretch, _decaying_run(record.t, y, stretch, size=size)) for stretch in group]
        stretch, run = max(found, key=lambda pair: _score(y, pair[1]), default=(None, []))
        most = max(most, len(run))
        if stretch and len(run) >= 2:
            return stretch, run
    raise DataError(
        f"{record.id}: log decrement needs 3 turning points of a free decay of cart {cart} (the "
        f"release and two more) with swings over {_SMALLEST_SWING:.0f} encoder steps, found "
        f"{most}"
    )


def _stretches(record: Record) -> list[list[Stretch]]:
    """Return groups of stretches to search, in order: with zero input, and with constant input.

    For a decay, or without an input, the whole record comes last.
    """
    whole = Stretch(first=0, stop=record.t.size, level=None)
    if record.u is None:
        return [[whole]]
    u = record.u
    parts = [
        Stretch(first=a, stop=b, level=float(np.mean(u[a:b])))
        for a, b in noise.plateaus(u)
        if b - a >= noise.MIN_SAMPLES
    ]
    largest = float(np.max(np.abs(u)))
    # Below 2 % of the largest input, the input counts as zero.
    off = [part for part in parts if abs(part.level or 0.0) <= 0.02 * largest]
    on = [part for part in parts if part not in off]
    return [off, on, [whole]] if record.kind == "decay" else [off, on]


def _decaying_run(t: Array, y: Array, stretch: Stretch, *, size: float) -> list[int]:
    """Return the turning points of the largest run of decreasing swings at regular times."""
    part = y[stretch.first : stretch.stop]
    # The first point is the start of the stretch, not a turning point. The last one is where the
    # cart came to rest; it counts if the cart came to rest in time.
    turning = [i + stretch.first for i in noise.extrema(part, prominence=noise.PROMINENCE * size)][
        1:
    ]
    swings = np.abs(np.diff(y[turning]))
    times = np.diff(t[turning])
    best: list[int] = []
    start = 0
    while start < swings.size:
        end = start + 1
        # A swing may exceed the one before by 2 %. Each interval must be within 30 % of the median
        # of the earlier intervals, because motion by hand is less regular.
        while (
            end < swings.size
            and _SMALLEST_SWING * size <= swings[end] <= 1.02 * swings[end - 1]
            and abs(times[end] / np.median(times[start:end]) - 1) <= 0.3
        ):
            end += 1
        best = max(best, turning[start : end + 1], key=lambda run: _score(y, run))
        start = end
    return best


def _score(y: Array, run: list[int]) -> float:
    """Rank a run: first by whether it has several swings, then by size."""
    if len(run) < 2:
        return 0.0
    travelled = float(np.sum(np.abs(np.diff(y[run]))))
    return travelled if len(run) > 2 else 1e-3 * travelled


def fit_decay(
    t: Array, y: Array, *, stretch: Stretch, run: list[int], floor: float, step: float
) -> FreeDecay:
    """Fit the free decay from its release to its last turning point.

    The later swings are fitted first. The fit is then extended back over the earlier ones as long
    as they agree. This finds where the hand lets go. If not even the later swings fit down to the
    noise (real friction is not ideal), all swings are used.

    Parameters
    ----------
    run : the turning points.
    floor : the smallest significant residual (root mean square).
    step : the encoder step.
    """
    interval = float(np.median(np.diff(t[run])))
    stop = run[-1] + 1
    # With fewer turning points, the fit also needs the rest that follows them.
    if len(run) < 5:
        stop = int(np.searchsorted(t[: stretch.stop], t[run[-1]] + 2 * interval))
    pole = complex(-np.log(_ratio(y, run)) / interval, np.pi / interval)

    def fit_from(
        first: int, *, after: FreeDecay | None = None, last: bool = False, rough: bool = False
    ) -> FreeDecay:
        """Fit on from the fit `after`, whose law is kept until all compete again in the `last` fit.

        The exponential is tested only if its residual exceeds the noise, unless it is `rough`.
        """
        near = complex(after.fit.poles[0]) if after else pole
        known = after.explained.law if after and after.explained and not last else None
        own = slice(first, stop)
        fit = fit_ringing(t[own], y[own], poles=np.array([near]), drift=True)
        explained = None
        # A fit that does not turn within the record follows noise.
        turns = fit.poles[0].imag * float(t[own][-1] - t[own][0]) > np.pi
        if turns and (last or (not rough and fit.rms > _ADEQUATE * floor)):
            explained = explain_decay(
                t[own],
                y[own],
                fit,
                step=step,
                floor=floor,
                turning=t[run],
                falling=bool(y[run[1]] < y[run[0]]),
                only=known.name if known else None,
            )
        turning = [i for i in run if i > first]
        return FreeDecay(
            stretch=stretch, first=first, stop=stop, turning=turning, fit=fit, explained=explained
        )

    enough = max(stop - noise.MIN_SAMPLES, stretch.first)
    # Two turning points are skipped for the hand, if four others follow them.
    latest = min(run[min(2, max(len(run) - 4, 0))], enough)
    decay = fit_from(latest)
    if decay.rms(t, y) > _ADEQUATE * floor:
        # The model does not cover the start of a real cart's motion, so the fit begins at the first
        # passage through rest.
        decay = fit_from(min(run[0], enough))
        passage = int(np.searchsorted(t, t[run[0]] - interval / 2))
        held = _carried_back(t, y, decay, latest=decay.first, share=_REAL_SHARE, floor=floor)
        return fit_from(passage if held <= passage < decay.first else decay.first, last=True)
    for share in _BACK_SHARES:
        first = _carried_back(t, y, decay, latest=latest, share=share, floor=floor)
        if first == decay.first:
            break
        rough = share > 0 and decay.explained is None
        decay = fit_from(first, after=decay, rough=rough)
    first = decay.first
    if first > stretch.first:
        # The fingers leave the cart within a fortieth of a period.
        margin = t[first] + 0.05 * interval
        first = min(int(np.searchsorted(t, margin)), latest)
    return fit_from(first, after=decay, last=True)


def _carried_back(
    t: Array, y: Array, decay: FreeDecay, *, latest: int, share: float, floor: float
) -> int:
    """Return the first sample from which the decay's model holds, at most `latest`."""
    head = slice(decay.stretch.first, latest)
    size = abs(decay.fit.amplitudes[0]) * decay.fit.growth(t[head])[0]
    # The median ignores a hold that the fit includes by mistake.
    spread = noise.MEDIAN_TO_SIGMA * float(np.median(np.abs(decay.residual(t, y))))
    tolerance = _BACK_SIGMAS * max(spread, floor) + share * size
    bad = np.flatnonzero(np.abs(y[head] - decay.model(t[head])) > tolerance)
    return head.start + (int(bad[-1]) + 1 if bad.size else 0)


def _ratio(y: Array, run: list[int]) -> float:
    """Return the mean ratio of each swing to the one before, or a guess if there is only one."""
    swings = np.abs(np.diff(y[run]))
    return float((swings[-1] / swings[0]) ** (1 / (swings.size - 1))) if swings.size > 1 else 0.3


# ---------------------------------------------------------------------- the stage

_PEAKS_FOR_REGRESSION = 4  # enough for two amplitudes


class _Peaks:
    """Turning points, and the decrement and damped frequency from them, with standard errors.

    The turning points are located between samples, and the log amplitude is regressed on their
    number. With fewer than four turning points, the values are those of the exponential fit.
    """

    def __init__(self, t: Array, y: Array, decay: FreeDecay, *, floor: float) -> None:
        pole = complex(decay.fit.poles[0])
        # Within half a radian of a turning point, a cosine is nearly a parabola.
        located = [_vertex(t, y, i, half_width=0.5 / pole.imag) for i in decay.turning]
        self.t, self.y = np.array(located).reshape(-1, 2).T
        n = self.t.size
        swing = _half_swing(n)
        signed = swing @ self.y
        self.amplitude = np.abs(signed)
        if n < _PEAKS_FOR_REGRESSION:
            decay_std, omega_d_std = np.sqrt(np.diag(decay.fit.covariance)[2:])
            self.delta = -2 * np.pi * pole.real / pole.imag
            self.delta_std = float(2 * np.pi * decay_std / pole.imag)
            self.omega_d, self.omega_d_std = pole.imag, float(omega_d_std)
            return
        # The noise of the amplitude A is constant, so ln A has the weight A². The standard errors
        # follow from the errors of the turning points, because neighbouring amplitudes share them.
        per_log = _slope(self.amplitude)
        loss = -float(per_log @ np.log(self.amplitude))  # per half cycle
        sigma = max(decay.fit.rms, floor)  # noise of one turning point, at most
        loss_std = sigma * float(np.linalg.norm((per_log / signed) @ swing))
        per_time = _slope(np.abs(np.gradient(self.y)))
        interval = float(per_time @ self.t)
        count = np.arange(n) - (n - 1) / 2
        late = self.t - self.t.mean() - interval * count
        interval_std = float(np.linalg.norm(per_time * late)) * np.sqrt(n / (n - 2))
        # Because samples meet the motion at any phase, the decrement can still differ by 1e-4 of
        # it.
        self.delta, self.delta_std = 2 * loss, 2 * float(np.hypot(loss_std, 1e-4 * loss))
        self.omega_d, self.omega_d_std = np.pi / interval, np.pi / interval**2 * interval_std

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
    size = noise.resolution(t, y, step=record.encoder_step(cart))
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
    exponential = _of_exponential(fit, decay.explained)
    law = _law(decay.explained, exponential)
    # With dry friction no damping ratio holds for small swings, so the number is the usual one.
    fitted = exponential if law.is_friction else law
    unexplained = decay.rms(t, y) / float(np.ptp(y[decay.first : decay.stop]))
    # A fit with a larger residual belongs to another kind of motion. Real carts with dry friction
    # leave 1.3 to 2.1 % (ten runs).
    if not (0 < fitted.zeta < 1 and pole.imag > 0 and unexplained < 0.08):
        raise DataError(
            f"{record.id}: log decrement needs a decaying oscillation of cart {cart}, found "
            f"{_motion(fitted.zeta)} with {100 * unexplained:.0f} % of it unexplained"
        )
    peaks = _Peaks(t, y, decay, floor=floor)
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
        zeta_peaks=peaks.zeta[0],
        zeta_peaks_std=peaks.zeta[1],
        omega_n_peaks=peaks.omega_n[0],
        omega_n_peaks_std=peaks.omega_n[1],
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


class _Fitted(NamedTuple):
    """Damping ratio and natural frequency (rad/s) with their standard errors."""

    zeta: float
    zeta_std: float
    omega_n: float
    omega_n_std: float


def _of_exponential(fit: Ringing, explained: Explained) -> _Fitted:
    """Return the numbers of the exponential fit.

    Unlike noise, what the fit leaves beyond the noise does not average out, so it counts in full.
    """
    pole, covariance = complex(fit.poles[0]), fit.covariance[2:, 2:]
    if left := explained.left[0]:
        covariance = covariance * max(1.0, (explained.density + left) / fit.variance)
    per_zeta = np.array([pole.imag**2, pole.real * pole.imag]) / abs(pole) ** 3
    per_omega = np.array([-pole.real, pole.imag]) / abs(pole)
    zeta_std, omega_n_std = (np.sqrt(per @ covariance @ per) for per in (per_zeta, per_omega))
    return _Fitted(-pole.real / abs(pole), float(zeta_std), abs(pole), float(omega_n_std))


def _law(explained: Explained, exponential: _Fitted) -> DecayLaw:
    """Return the result of the test, and what the law implies; a damping ratio is at least zero."""
    implied, size, size_std = exponential, np.nan, np.nan
    if explained.law:
        (zeta, omega_n, size), (*errors, size_std) = explained.law.values, explained.errors
        implied = _Fitted(max(zeta, 0.0), errors[0], omega_n, errors[1])
    return DecayLaw(
        name=explained.name,
        statistic=explained.departure.statistic,
        limit=explained.departure.limit,
        size=float(size),
        size_std=float(size_std),
        **{name: float(value) for name, value in implied._asdict().items()},
    )


def _motion(zeta: float) -> str:
    """Return the motion that a damping ratio means."""
    return f"one with zeta = {zeta:.3g}" if zeta > 0 else "a motion that does not decay,"


# -------------------------------------------------------------------- the peaks


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
    if level and abs(level) > 0.02 * float(np.max(np.abs(record.input))):
        notes.append(f"the cart oscillates about its new rest point, at an input of {level:.4g}")
    if n_peaks < _PEAKS_FOR_REGRESSION:
        notes.append(
            f"{n_peaks} turning points are too few for a logarithmic decrement; the value is that "
            "of the exponential fit"
        )
    return "; ".join(notes)
