"""Sine dwell: amplitude and phase of the steady state, and where the steady state begins."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.noise import MIN_SAMPLES, relative_psd, resolution, rounding_left
from pipeline.results import Record, SinePoint

# ---------------------------------------------------------------------- independent columns


def inverse_of(columns: Array) -> Array:
    """Return the pseudo-inverse (p, n) of columns (n, p).

    For independent columns, it follows from the normal equations and one step of Newton's method,
    in a tenth of the time of numpy's singular values. These are used if columns depend on each
    other.
    """
    with np.errstate(all="ignore"):
        try:
            inverse = np.linalg.inv(columns.T @ columns) @ columns.T
        except np.linalg.LinAlgError:
            return np.linalg.pinv(columns).astype(np.float64)
        left = np.eye(len(inverse)) - inverse @ columns
        # The step of Newton's method squares the error.
        if not np.max(np.abs(left)) < 1e-6:
            return np.linalg.pinv(columns).astype(np.float64)
    return inverse + left @ inverse


# ---------------------------------------------------------------------- the stage

FEW_COUNTS = 20  # encoder steps; smaller amplitudes are known only to a few percent
_LAST_WINDOWS = 4


class _Part:
    """A range of samples with the columns to fit, prepared once for all signals.

    `columns` (n, p) are those of `_columns`, and `inverse` (p, n) is their pseudo-inverse. The
    phase of the sine advances by `angle` (rad) per sample.
    """

    def __init__(self, columns: Array, *, angle: float) -> None:
        self.columns, self.inverse, self.angle = columns, inverse_of(columns), angle


class _Sine:
    """A sine with offset and linear drift, fitted to y (n,): coefficients and residual."""

    def __init__(self, part: _Part, y: Array) -> None:
        self.part, self.coefficients = part, part.inverse @ y
        self.residual = y - part.columns @ self.coefficients

    @property
    def z(self) -> complex:
        """Complex amplitude against sin(omega t): a + jb for a sin(omega t) + b cos(omega t)."""
        return complex(self.coefficients[0], self.coefficients[1])

    @property
    def rms(self) -> float:
        """Root mean square of the residual."""
        return float(np.sqrt(self.residual @ self.residual / self.residual.size))

    @cached_property
    def std(self) -> float:
        """Standard error of |z|; the standard error of the phase is std / |z|."""
        return float(np.hypot(self.error(0), self.error(1)) / np.sqrt(2))

    def error(self, which: int) -> float:
        """Return the standard error of a coefficient, for a residual that may be correlated."""
        return self._sigma * float(np.linalg.norm(self.part.inverse[which]))

    @cached_property
    def _sigma(self) -> float:
        left = max(self.residual.size - self.coefficients.size, 1)
        variance = float(self.residual @ self.residual) / left
        return float(np.sqrt(variance * relative_psd(self.residual, angle=self.part.angle)))


@dataclass(frozen=True, kw_only=True)
class _Steady:
    """The first sample of the steady part; `left` is how much of a transient may remain in it."""

    start: int
    settled: bool
    left: float


class Dwell:
    """The sinusoidal steady state of a dwell: its frequency, and the columns shared by all fits.

    The last windows show whether there is a steady part. It extends back as far as the sine fitted
    to it explains the record. The input is fitted over the same part. If the input is held between
    samples, its amplitude is that of the held staircase. The method is valid for one frequency and
    at least one cycle.

    Reference: IEEE Std 1057-2017, section 4.6 (three- and four-parameter sine fits).

    Parameters
    ----------
    record : the dwell. Without `omega`, the frequency is fitted to the input.
    """

    def __init__(self, record: Record) -> None:
        self._record = record
        self._parts: dict[tuple[int, int], _Part] = {}

    def fit(self, *, cart: int) -> SinePoint:
        """Fit the steady state of one cart.

        Raises
        ------
        DataError : there is no input column, the input does not oscillate, or it has less than a
            full cycle.
        """
        record, driven = self._record, self._driven
        y, step = record.position(cart)[driven], record.encoder_step(cart)
        if np.ptp(y) == 0:
            raise DataError(f"{record.id}: a sine fit needs motion, cart {cart} does not move")
        omega, frequency_note = self._frequency
        cycles = omega * (self._t[-1] - self._t[0]) / (2 * np.pi)
        if cycles < 1:
            raise DataError(
                f"{record.id}: a sine fit needs a full cycle of driven motion, found {cycles:.2f}"
            )
        floor = resolution(self._t, y, step=step) / np.sqrt(12)
        steady = self._steady_part(y, floor=floor)
        t = self._t[steady.start :]
        position, drive = self._fit(y, steady.start), self._fit(self._u, steady.start)
        # A residual above half of the input's amplitude means that the input is another signal.
        if drive.rms >= 0.5 * abs(drive.z):
            raise DataError(
                f"{record.id}: a sine dwell needs an input of one frequency, found an amplitude of "
                f"{abs(drive.z):.3g} at {omega / (2 * np.pi):.4g} Hz and {drive.rms:.3g} (rms) "
                "at other frequencies"
            )
        amplitude, input_amplitude = abs(position.z), abs(drive.z)
        held = _held(t, omega=omega) if record.hold == "zero_order" else 1.0
        rounding = _rounding_std(position, step=step)  # does not affect the phase
        angle_std = _angle_std(position.z, float(np.hypot(position.std, steady.left)))
        notes = [
            frequency_note,
            "" if steady.settled else "no steady state is seen before the record ends",
            f"the amplitude is only {amplitude / step:.1f} encoder counts"
            if step and amplitude < FEW_COUNTS * step
            else "",
            # A residual below 1 % of the amplitude is good.
            f"{100 * position.rms / amplitude:.1f} % of the motion is not at the drive frequency"
            if position.rms > max(2 * floor, 0.01 * amplitude)
            else "",
        ]
        return SinePoint(
            experiment=record.id,
            cart=cart,
            omega=omega,
            amplitude=float(amplitude),
            amplitude_std=float(np.linalg.norm([position.std, rounding, steady.left])),
            phase=float(np.angle(position.z / (drive.z * held))),
            phase_std=float(np.hypot(angle_std, _angle_std(drive.z, drive.std))),
            input_amplitude=float(input_amplitude * abs(held)),
            input_amplitude_std=drive.std,
            steady_from=float(t[0]),
            settled=steady.settled,
            n_points=t.size,
            note="; ".join(note for note in notes if note),
        )

    @cached_property
    def _driven(self) -> slice:
        """The samples in which the input oscillates."""
        record, u = self._record, self._record.u
        if u is None:
            raise DataError(
                f"{record.id}: a sine dwell needs the input as well as the positions, found no "
                "input column: export it too, or name it under `columns`"
            )
        if np.ptp(u) == 0:
            raise DataError(
                f"{record.id}: a sine dwell needs an input that oscillates, found {u[0]:g} "
                "throughout"
            )
        offset = (np.max(u) + np.min(u)) / 2
        # The dwell runs from the first to the last sample beyond half of the input's amplitude.
        first, last = np.flatnonzero(np.abs(u - offset) > 0.5 * np.ptp(u) / 2)[[0, -1]]
        if last + 1 - first < MIN_SAMPLES:
            raise DataError(
                f"{record.id}: a sine fit needs {MIN_SAMPLES} samples of driven motion, found "
                f"{last + 1 - first}"
            )
        return slice(int(first), int(last) + 1)

    @cached_property
    def _t(self) -> Array:
        return self._record.t[self._driven]

    @cached_property
    def _u(self) -> Array:
        assert self._record.u is not None  # checked when the driven part was found
        return self._record.u[self._driven]

    @cached_property
    def _frequency(self) -> tuple[float, str]:
        return _frequency(self._t, self._u, stated=self._record.omega)

    @cached_property
    def _columns(self) -> Array:
        return _columns(self._t, omega=self._frequency[0])

    def _fit(self, y: Array, start: int, stop: int | None = None) -> _Sine:
        """Fit a sine to samples [start, stop) of y (n,), with columns shared by all carts."""
        span = start, self._t.size if stop is None else stop
        if span not in self._parts:
            t = self._t[slice(*span)]
            angle = self._frequency[0] * (t[-1] - t[0]) / (t.size - 1)
            self._parts[span] = _Part(self._columns[slice(*span)], angle=float(angle))
        return _Sine(self._parts[span], y[slice(*span)])

    # ------------------------------------------------------------------ the steady part

    def _steady_part(self, y: Array, *, floor: float) -> _Steady:
        """Find where the steady part starts, and whether there is one.

        The dwell has settled if the complex amplitudes of the last windows agree. Their sine is
        then extended back over the record for as long as it explains the record.
        """
        windows = _windows(self._t, omega=self._frequency[0])
        last = windows[-_LAST_WINDOWS:]
        fits = [self._fit(y, *window) for window in last]
        z = np.array([fit.z for fit in fits])
        latest, _ = last[-1]
        spread = float(np.max(np.abs(z - z.mean())))
        # The last windows must agree to half a percent of the amplitude, or to their noise.
        agree = spread <= max(0.005 * abs(z.mean()), floor)
        if len(last) < 2 or not (agree or spread <= 3 * max(fit.std for fit in fits)):
            return _Steady(start=latest, settled=False, left=spread)
        start = self._carry_back(y, latest, floor=floor, stretches=len(windows))
        if start > 0:
            # A third of the steady part is dropped, because it may hold the rest of the transient.
            start = min(start + (y.size - start) // 3, latest)
        start, left = self._drop_drifting(y, start, latest=latest, floor=floor)
        return _Steady(start=start, settled=True, left=left)

    def _carry_back(self, y: Array, start: int, *, floor: float, stretches: int) -> int:
        """Return the first sample from which the sine fitted from `start` explains the record."""
        # Three rounds of extending the sine back. Each roughly doubles the samples of the fit.
        for _ in range(3):
            steady = self._fit(y, start)
            square = np.cumsum((y - self._columns @ steady.coefficients) ** 2)
            hop = max((y.size - start) // stretches, MIN_SAMPLES)
            edges = np.arange(start, -1, -hop)
            mean = -np.diff(square[edges]) / hop  # of the stretches before `start`, going back
            # A stretch with a mean square residual above this limit is not steady.
            limit = max(steady.rms, floor) ** 2 * (1 + 4.0 * np.sqrt(2 / hop))
            worse = np.flatnonzero(mean > limit)
            reached = int(edges[worse[0]]) if worse.size else 0
            if reached == start:
                break
            start = reached
        return start

    def _drop_drifting(
        self, y: Array, start: int, *, latest: int, floor: float
    ) -> tuple[int, float]:
        """Return a start, at most `latest`, that makes both halves agree, and the error left.

        At a resonance, the transient has the frequency of the dwell and is hidden in its amplitude.
        If the difference between the halves exceeds the noise, half of it is still in the mean.
        """
        while True:
            middle = (start + y.size) // 2
            if y.size - middle < MIN_SAMPLES:
                return start, 0.0
            early = self._fit(y, start, middle)
            late = self._fit(y, middle)
            difference = abs(early.z - late.z)
            noise = max(np.hypot(early.std, late.std), floor / np.sqrt(y.size - start))
            # The two halves of the steady part may differ by three times the noise.
            if start == latest or difference <= 3.0 * noise:
                return start, float(np.sqrt(max(difference**2 - 4 * noise**2, 0.0))) / 2
            # Otherwise, a sixth of the part is dropped and the halves are compared again.
            start = min(start + (y.size - start) // 6, latest)


# ------------------------------------------------------------------- the fits


def _columns(t: Array, *, omega: float) -> Array:
    """Return the columns (n, 4): sin(omega t), cos(omega t), 1, and time from -1 to 1."""
    half = (t[-1] - t[0]) / 2
    tau = (t - (t[0] + half)) / half
    return np.array([np.sin(omega * t), np.cos(omega * t), np.ones_like(t), tau]).T


def _refined(t: Array, y: Array, *, omega: float) -> tuple[float, float]:
    """Return the frequency of the sine near `omega`, and its standard error, rad/s."""
    half, angle = (t[-1] - t[0]) / 2, omega * (t[-1] - t[0]) / (t.size - 1)
    X = _columns(t, omega=omega)
    fit = _Sine(_Part(X, angle=angle), y)
    for _ in range(20):
        # Change of the sine when omega changes by 1 rad at the ends of the record.
        turned = X[:, 3] * (fit.coefficients[0] * X[:, 1] - fit.coefficients[1] * X[:, 0])
        X = np.column_stack([_columns(t, omega=omega), turned])
        fit = _Sine(_Part(X, angle=angle), y)
        omega += fit.coefficients[4] / half
        # The change is below 1e-9 rad at the ends of the record.
        if abs(fit.coefficients[4]) < 1e-9:
            break
    return float(omega), fit.error(4) / float(half)


def _angle_std(z: complex, std: float) -> float:
    """Return the standard error of the phase, at most pi/sqrt(3) (a random angle)."""
    blind = np.pi / np.sqrt(3)
    return float(min(std / abs(z), blind)) if z else float(blind)


def _rounding_std(fit: _Sine, *, step: float) -> float:
    """Return the amplitude's rounding error that remains however many samples are averaged.

    Rounding offset + A sin adds sum_k (q / pi k) 2 J1(2 pi k A/q) cos(2 pi k offset/q) to the
    amplitude. The root mean square of this error over A and offset is 0.111 q sqrt(q/A). Noise
    removes it.
    """
    if step == 0:
        return 0.0
    # in encoder steps, times sqrt(step / amplitude): see the docstring
    scale = 0.111 * step * float(np.sqrt(step / max(abs(fit.z), step)))
    return scale * rounding_left(fit.rms, step=step)


def _held(t: Array, *, omega: float) -> complex:
    """Return the first harmonic of a held (staircase) sine, relative to the sampled sine."""
    dt = np.diff(t)
    # Intervals of more than three samples are gaps in the log.
    dt = dt[dt < 3.0 * np.median(dt)]  # the input during a gap is unknown
    return complex(np.sum(-np.expm1(-1j * omega * dt)) / (1j * omega * np.sum(dt)))


# -------------------------------------------------------- what the record holds


def _frequency(t: Array, u: Array, *, stated: float | None) -> tuple[float, str]:
    """Return the frequency, rad/s: as stated, unless the input clearly has a different one."""
    grid = np.linspace(t[0], t[-1], t.size)
    even = np.interp(grid, t, u - np.mean(u))
    n = 4 * t.size  # padded, so that the peak is found to a quarter of a line
    spectrum = np.abs(np.fft.rfft(even * np.hanning(t.size), n))
    line = 2 * np.pi / (n * (grid[1] - grid[0]))
    peak = line * (1 + int(np.argmax(spectrum[1:])))
    fitted, std = _refined(t, u, omega=peak)
    # The frequency of a sine is within four lines of the padded spectrum's peak.
    if abs(fitted - peak) > 4 * line:  # not a sine; the caller will notice
        fitted = peak
    if stated is None:
        return fitted, ""
    # A stated frequency is rejected if it is off by five standard errors, and by more than the
    # error of a clock.
    if abs(fitted - stated) <= max(5.0 * std, 2e-4 * stated):
        return stated, ""
    return fitted, (
        f"the input oscillates at {fitted / (2 * np.pi):.4g} Hz, not at the "
        f"stated {stated / (2 * np.pi):.4g} Hz; the frequency of the input is used"
    )


def _windows(t: Array, *, omega: float) -> list[tuple[int, int]]:
    """Return sliding windows [start, stop) over the record; the last one ends with it."""
    period = 2 * np.pi / omega
    duration = t[-1] - t[0]
    # A sliding window has three cycles or 0.6 s, whichever is longer.
    length = max(3.0 * period, 0.6)
    hop = max(period, 0.2)
    if length + (_LAST_WINDOWS - 1) * hop > duration:  # for a short record, single cycles
        length, hop = period, max(period / 2, (duration - period) / _LAST_WINDOWS)
    ends = t[-1] - hop * np.arange(int((duration - length) / hop + 1e-9) + 1)
    first, stop = np.searchsorted(t, ends - length), np.searchsorted(t, ends, side="right")
    whole = [(0, t.size)]
    return [
        (int(a), int(b))
        for a, b in zip(first[::-1], stop[::-1], strict=True)
        if b - a >= MIN_SAMPLES
    ] or whole
