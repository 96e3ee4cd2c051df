"""Test whether a decay is exponential, and find the law that it follows if it is not.

The residual of the exponential is compared with the noise of the recording itself. The noise is the
residual of a flexible change of envelope, phase and rest point. If more is left than noise,
the known reasons compete by their BIC, with the effective number of samples.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import fdtri

from pipeline.arrays import Array, ComplexArray
from pipeline.estimation import least_squares
from pipeline.estimation.least_squares import MOST_GROWTH, Ringing
from pipeline.results import DecayCause

# ------------------------------------------------------------- the departure from an exponential

_CHANCE = 1e-4  # share of exponential decays that fail the test
_ORDERS = 3, 8  # least and most order of the flexible change; in between, one for each period
_BINS = 24  # frequencies near that of the decay that give the noise
SECOND = 0.3, 3.0  # frequencies where a second mode may be, relative to that of the first
UNKNOWNS = 6  # of an exponential decay with a drift


class Departure:
    """Whether the residual of an exponential fit to a decay exceeds the noise.

    Parameters
    ----------
    t, y : times and readings (n,) of the decay.
    fit : the exponential fit to them.
    step : the encoder step.
    floor : the noise between neighbouring samples (root mean square).
    friction : what a little dry friction adds to the decay, shape (n,). This one column shows less
        friction than the many of the flexible change.

    Attributes
    ----------
    statistic : F-statistic of the flexible change, or that of dry friction, another mode or too
        much noise if it says more.
    limit : what the statistic exceeds by chance in one of 10,000 exponential decays.
    columns : number of columns of the flexible change.
    left : residual (n,) of the exponential fit.
    noise : residual (n,) of the flexible change.
    """

    def __init__(
        self, t: Array, y: Array, fit: Ringing, *, step: float, floor: float, friction: Array
    ) -> None:
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
        self.left = left = residual - basis @ (basis.T @ residual)
        flexible /= np.linalg.norm(flexible, axis=0)
        flexible -= basis @ (basis.T @ flexible)
        added, sizes, _ = np.linalg.svd(flexible, full_matrices=False)
        # A column that lies outside the others by less than this adds nothing.
        added = added[:, sizes > 1e-3]
        along = added.T @ left
        self.columns = along.size
        self.noise = noise = left - added @ along
        density = noise_density(noise, angle=angle, step=step, unknowns=UNKNOWNS + along.size)
        freedom = min(2.0 * _BINS, max(n - UNKNOWNS - along.size, 2.0))
        self.limit = limit = float(fdtri(along.size, freedom, 1 - _CHANCE))
        friction = friction - basis @ (basis.T @ friction)
        # Friction only ever brakes, so chance has twice its share on this side.
        rubbed = max(float(friction @ left), 0.0) ** 2 / float(friction @ friction) / density
        # What may be left as noise: a share of the motion, or a multiple of the noise between
        # neighbouring samples. The flexible change cannot follow a second mode over many periods.
        most = max(0.01 * float(np.ptp(y)), 10.0 * floor)
        # By chance, no line reaches 25 times the power of the noise.
        self.statistic = max(
            float(along @ along) / along.size / density,
            limit / float(fdtri(1, freedom, 1 - 2 * _CHANCE)) * rubbed,
            limit / 25.0 * _highest_line(noise, angle=angle),
            limit * (float(np.std(noise)) / most) ** 2 if most > 0 else 0.0,
        )

    @property
    def present(self) -> bool:
        """Whether more is left than noise."""
        return self.statistic > self.limit


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
    # Sixteen samples per period are enough to tell the laws apart.
    size = int(2 * np.pi / omega / usual / 16)
    if size < 2 or np.max(np.abs(intervals - usual)) > 0.5 * usual:
        return t, y
    n = t.size // size * size
    t_mean, y_mean = (values[:n].reshape(-1, size).mean(axis=1) for values in (t, y))
    return t_mean, y_mean


# ---------------------------------------------------- dry friction: the exact piecewise solution
#
# With viscous damping and dry friction F, a cart that moves one way swings about a point d = F/k to
# one side of its rest. On the way back it swings about a point d to the other side. So successive
# amplitudes follow A_{j+1} = rho A_j - (1 + rho) d.
#
# Reference: B. F. Feeny and J. W. Liang, J. Sound and Vibration 195 (1996) 149-154.


class Swings:
    """A decay cut into half cycles at its turning points.

    In each half cycle, y = rest + drift + (amplitude kept + friction pushed) swing - friction side.
    Here friction means the friction band d.

    Parameters
    ----------
    t : times (n,) of the samples, s.
    p : turning point in s, decay rate and damped frequency in rad/s, shape (3,).
    direction : 1 or -1, in which the cart moves after the turning point.
    cycles : number of half cycles after which friction stops the cart.

    Attributes
    ----------
    since : time (n,) since the turning point, s.
    tau : time (n,) since the half cycle began, s.
    swing : cosine (n,) from 1 at the start of the half cycle to -1 at its end.
    sine : quadrature (n,) of `swing`.
    cycle : index (n,) of each sample's half cycle.
    number : numbers (n_cycles,) of the half cycles; 0 for the one after the turning point.
    kept, pushed, side : (n_cycles,), as in the equation above.
    held : whether the cart has stopped (n,); it then stays where the half cycle ended.
    """

    def __init__(self, t: Array, p: Array, *, direction: float, cycles: float = np.inf) -> None:
        turning, decay, omega_d = self.p = p
        self.since, half = t - turning, np.pi / omega_d
        k = np.floor(self.since / half)
        self.held = k >= cycles
        k = np.minimum(k, cycles - 1)
        self.tau = tau = np.minimum(self.since - k * half, half)
        self.number = number = np.arange(k.min(), k.max() + 1)
        self.cycle = (k - number[0]).astype(np.int64)
        loss = np.clip(decay * half, -MOST_GROWTH, MOST_GROWTH)  # rho = exp(-loss)
        lost = np.clip(-loss * number, -MOST_GROWTH, MOST_GROWTH)
        # (1 - rho^k) / (1 - rho), which is k without viscous damping
        geometric = np.expm1(lost) / np.expm1(-loss) if loss else number
        sign = np.where(number % 2 == 0, 1.0, -1.0)
        left = np.exp(np.clip(-decay * tau, -MOST_GROWTH, MOST_GROWTH))
        self.sine = left * np.sin(omega_d * tau)
        self.swing = left * np.cos(omega_d * tau) + decay / omega_d * self.sine
        self.kept = sign * np.exp(lost)
        self.pushed = direction * sign * (1 + (1 + np.exp(-loss)) * geometric)
        self.side = direction * sign

    @property
    def columns(self) -> Array:
        """The factors of rest point, drift, amplitude and friction band, (n, 4)."""
        kept, pushed, side = (part[self.cycle] for part in (self.kept, self.pushed, self.side))
        one = np.ones_like(self.tau)
        return np.array([one, self.since, kept * self.swing, pushed * self.swing - side]).T

    def derivatives(self, linear: Array) -> Array:
        """Return dy/dp (n, 3); p is turning point, decay rate and frequency."""
        _, drift, amplitude, band = linear
        _, decay, omega_d = self.p
        tau, swing, sine, ratio = self.tau, self.swing, self.sine, decay / omega_d
        per_tau = -(decay**2 + omega_d**2) / omega_d * sine
        per_decay = sine / omega_d - tau * swing
        per_omega_d = ratio * (tau * swing - sine / omega_d) - (1 + ratio**2) * tau * sine
        # The sizes of the half cycles depend on the logarithmic loss, pi decay / omega_d.
        rho, number = np.exp(-np.clip(np.pi * ratio, -MOST_GROWTH, MOST_GROWTH)), self.number
        geometric = (self.pushed / self.side - 1) / (1 + rho)
        per_loss = (
            (number * np.abs(self.kept) - rho * geometric) / (1 - rho)
            if rho != 1
            else -number * (number - 1) / 2
        )
        pushed_per_loss = self.side * ((1 + rho) * per_loss - rho * geometric)
        size = (amplitude * self.kept + band * self.pushed)[self.cycle]
        size_per_loss = (band * pushed_per_loss - amplitude * number * self.kept)[self.cycle]
        # Derivative of tau by omega_d; a stopped cart is at the end of its half cycle.
        longer = np.pi / omega_d**2 * np.where(self.held, -1.0, number[self.cycle])
        return np.array(
            [
                -drift - np.where(self.held, 0.0, size * per_tau),
                size * per_decay + np.pi / omega_d * size_per_loss * swing,
                size * (per_omega_d + longer * per_tau)
                - np.pi * ratio / omega_d * size_per_loss * swing,
            ]
        ).T


# -------------------------------------------- damping or frequency that depends on the amplitude
#
# With quadratic drag beta |v| v, averaging gives A' = -gamma A - (4 beta omega / 3 pi) A². With a
# spring that is not linear, the frequency changes in proportion to A². Both add a third harmonic.
#
# Reference: A. H. Nayfeh & D. T. Mook, Nonlinear Oscillations, 1979, chapters 2 and 3.

_LEAST = 1e-3  # bound of a divisor during the fit
_FLAT = 1e-3  # loss below which a series replaces a quotient of small numbers
# Drag also slows the oscillation a little. The second coefficient is from simulations with beta A
# from 0.02 to 0.4, which agree to 5 %.
_SLOWS, _SLOWS_SQUARED = 0.5, 0.092
_LEAD = 16  # points from the start to the first time, for the integrals
SHIFTS_AGAIN = 5 / 12  # of a cubic spring
DECAY, FREQUENCY, DRAG, SHIFT = range(4)


class Modulated:
    """A decay y = drift + Re(amplitude E e^{i phi}), with envelope E and phase phi.

    The envelope is E = e^{-gamma tau} / (B sqrt(R)) with B = 1 + b (1 - e^{-gamma tau}) / gamma.
    Because a stiffer spring stores more energy, R = 1 - (1 - e^{-2 gamma tau}) shift / omega.
    Further, phi' = omega + shift E² - (5/12 shift² E⁴ + b gamma E / 2 + 0.092 b² E²) / omega.

    Parameters
    ----------
    tau : times (n,) of the samples since the start, s.
    p : the unknowns (n_free,), 1/s: those of gamma, omega, b and shift that are in `free`.
    free : numbers (n_free,) of the unknowns; the others are zero.
    power : if positive, there is a third harmonic that follows E^power.
    bends : highest power of time in the drift.
    length : unit of time of these powers, s.

    Attributes
    ----------
    tau : time (n_lead + n,) since the start, s. The first times lead from the start to the samples.
    p : gamma, omega, b and shift (4,), 1/s.
    grown, below, bent : (1 - e^{-gamma tau}) / gamma, B and R (n_lead + n,).
    envelope, phase : E and phi (n_lead + n,).
    """

    def __init__(
        self,
        tau: Array,
        p: Array,
        *,
        free: Sequence[int],
        power: int = 0,
        bends: int = 1,
        length: float = 1.0,
    ) -> None:
        self.free, self.power, self.bends, self.length = free, power, bends, length
        self.p = np.zeros(4)
        self.p[list(free)] = p
        gamma, omega, b, shift = self.p
        self.tau = tau = np.append(np.linspace(0.0, tau[0], _LEAD), tau)
        left = np.exp(-np.clip(gamma * tau, -MOST_GROWTH, MOST_GROWTH))
        flat = abs(gamma) * np.max(np.abs(tau)) <= _FLAT
        self.grown = tau * (1 - gamma * tau / 2) if flat else (1 - left) / gamma
        self.below = np.maximum(1 + b * self.grown, _LEAST)
        self.bent = np.maximum(1 - (1 - left**2) * shift / omega, _LEAST)
        self.envelope = left / self.below / np.sqrt(self.bent)
        self.phase = omega * tau
        if b or shift:
            turning = shift * self.envelope**2 - _slowed(self.envelope, self.p) / omega
            self.phase = self.phase + _integral(turning, tau)

    @property
    def columns(self) -> Array:
        """The factors of drift, amplitude and harmonics, (n, n_linear)."""
        tau, envelope, phase = self.tau[_LEAD:], self.envelope[_LEAD:], self.phase[_LEAD:]
        drift = np.vander(tau / self.length, self.bends + 1, increasing=True).T
        waves = [
            part
            for power, order in self._waves
            for wave in [envelope**power * np.exp(1j * order * phase)]
            for part in (wave.real, wave.imag)
        ]
        return np.array([*drift, *waves]).T

    @property
    def _waves(self) -> list[tuple[int, int]]:
        """Power of the envelope and order of the harmonic of each wave."""
        return [(1, 1), (self.power, 3)] if self.power else [(1, 1)]

    def derivatives(self, linear: Array) -> Array:
        """Return dy/dp (n, n_free)."""
        slopes, turns = self._changes
        envelope, phase = self.envelope[_LEAD:], self.phase[_LEAD:]
        by_size, by_phase = np.zeros((2, envelope.size))
        for (power, order), (cosine, sine) in zip(
            self._waves, linear[self.bends + 1 :].reshape(-1, 2), strict=True
        ):
            wave = (cosine - 1j * sine) * envelope**power * np.exp(1j * order * phase)
            by_size += power * wave.real
            by_phase -= order * wave.imag
        return (by_size * slopes + by_phase * turns).T

    @property
    def _changes(self) -> tuple[Array, Array]:
        """The derivatives (n_free, n) of ln E and of the phase by the unknowns."""
        gamma, omega, b, shift = self.p
        tau, E, grown = self.tau, self.envelope, self.grown
        if not (b or shift or {DRAG, SHIFT} & set(self.free)):
            zero = np.zeros_like(tau)
            slopes, turns = np.array([-tau, zero]), np.array([zero, tau])
            return slopes[:, _LEAD:], turns[:, _LEAD:]
        left = np.exp(-np.clip(gamma * tau, -MOST_GROWTH, MOST_GROWTH))
        flat = abs(gamma) * np.max(np.abs(tau)) <= _FLAT
        per_gamma = -(tau**2) * (1 / 2 - gamma * tau / 3) if flat else (tau * left - grown) / gamma
        by_shift = (1 - left**2) / (2 * self.bent * omega)
        slopes = np.array(
            [
                shift / omega * tau * left**2 / self.bent - tau - b * per_gamma / self.below,
                -shift / omega * by_shift,
                -grown / self.below,
                by_shift,
            ]
        )[list(self.free)]
        slowing = _SLOWS * b * gamma * E, _SLOWS_SQUARED * (b * E) ** 2
        again = SHIFTS_AGAIN * (shift * E**2) ** 2
        per_size = 2 * shift * E**2 - (slowing[0] + 2 * slowing[1] + 4 * again) / omega
        direct = np.array(
            [
                -_SLOWS * b * E / omega,
                (slowing[0] + slowing[1] + again) / omega**2,
                -(_SLOWS * gamma * E + 2 * _SLOWS_SQUARED * b * E**2) / omega,
                E**2 - 2 * SHIFTS_AGAIN * shift * E**4 / omega,
            ]
        )[list(self.free)]
        turns = _integral(direct + per_size * slopes, tau)
        turns[self.free.index(FREQUENCY)] += tau
        return slopes[:, _LEAD:], turns[:, _LEAD:]


def _slowed(envelope: Array, p: Array) -> Array:
    """Return what second order takes from the square of the frequency, at an envelope (n,)."""
    gamma, _, b, shift = p
    return (
        _SLOWS * b * gamma * envelope
        + _SLOWS_SQUARED * (b * envelope) ** 2
        + SHIFTS_AGAIN * (shift * envelope**2) ** 2
    )


def _integral(values: Array, t: Array) -> Array:
    """Return the integral of `values` (…, n) from the first time on, by the trapezoidal rule.

    The envelope is slow, so this is exact enough between samples.
    """
    steps = np.diff(t) * (values[..., 1:] + values[..., :-1]) / 2
    return np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)


# ---------------------------------------------------------------------- the laws that compete

# Errors relative to the square of a shift, from simulated springs and pendulums.
_NEGLECTED = np.array([1.0, 0.1, 1.0])  # of damping ratio, frequency and shift


@dataclass(frozen=True, kw_only=True, eq=False)
class LawFit:
    """A law fitted to a decay.

    Attributes
    ----------
    p : nonlinear unknowns, a start for another fit of the same law.
    values : damping ratio, natural frequency and size of the cause.
    unit : their standard errors for noise of unit density.
    unknowns : number of unknowns, linear ones included.
    """

    name: DecayCause
    p: Array
    values: Array
    unit: Array
    unknowns: int
    residual: Array
    model: Callable[[Array], Array]

    @property
    def squares(self) -> float:
        """The sum of squares of the residual."""
        return float(self.residual @ self.residual)


@dataclass(frozen=True, kw_only=True, eq=False)
class Explained:
    """A decay's test, and the law that it follows.

    Attributes
    ----------
    name : "exponential", the law's name, or "unknown".
    law : the law if it is neither exponential nor unknown.
    density : density of the noise at the decay's frequency.
    left : sum of squares that is not noise, left by the exponential and by the law.
    """

    name: DecayCause
    departure: Departure
    law: LawFit | None
    density: float
    left: tuple[float, float]

    @property
    def errors(self) -> Array:
        """Standard errors of the law's damping ratio, natural frequency and size.

        Unlike noise, what the law leaves beyond the noise does not average out, so it counts in
        full. The averages behind a shift of frequency neglect its next power.
        """
        assert self.law is not None
        zeta, omega_n, size = self.law.values
        shift = abs(size) if self.law.name == "frequency_shift" else 0.0
        neglected = _NEGLECTED * np.array([zeta, omega_n, 1.0]) * shift**2
        return np.hypot(self.law.unit * np.sqrt(self.density + self.left[1]), neglected)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    """A law to try.

    Attributes
    ----------
    model : the model at times t and unknowns p.
    pole : which of p are the decay rate and the damped frequency.
    size : the size of the cause as weights of (p, linear), and whether the numbers make sense.
    """

    name: DecayCause
    model: Callable[[Array, Array], least_squares.SeparableModel]
    starts: Sequence[Array]
    scale: Array
    pole: Callable[[Array, Array], tuple[int, int]]
    size: Callable[[Array, Array, Array], tuple[Array, bool]]

    def fit(self, t: Array, y: Array) -> LawFit | None:
        """Return a rough fit from the best start, None if it makes no sense."""
        residuals = [
            least_squares.solve_linear(y, partial(self.model, t), p).residual for p in self.starts
        ]
        best = int(np.argmin([residual @ residual for residual in residuals]))
        # In the competition, a rough fit is enough.
        return self.fit_from(self.starts[best], t, y, precision=1e-4)

    def fit_from(self, start: Array, t: Array, y: Array, *, precision: float) -> LawFit | None:
        """Return the fit from a start, None if it makes no sense."""
        fit = least_squares.fit_separable(
            y,
            partial(self.model, t),
            start=start,
            scale=self.scale,
            precision=precision,
        )
        p, linear, at = fit.p, fit.linear, self.pole(fit.p, fit.linear)
        decay, omega_d = p[list(at)]
        weights, sound = self.size(t, p, linear)
        if not (fit.converged and omega_d > 0 and sound):
            return None
        omega_n, n = float(np.hypot(decay, omega_d)), p.size + linear.size
        gradient = np.zeros((3, n))
        gradient[0, list(at)] = np.array([omega_d**2, -decay * omega_d]) / omega_n**3
        gradient[1, list(at)] = decay / omega_n, omega_d / omega_n
        gradient[2] = weights
        covariance = least_squares.inverse_normal(fit.model, linear)
        size = float(gradient[2] @ np.concatenate([p, linear]))
        return LawFit(
            name=self.name,
            p=p,
            values=np.array([decay / omega_n, omega_n, size]),
            unit=np.sqrt(np.einsum("ij,jk,ik->i", gradient, covariance, gradient)),
            unknowns=n,
            residual=fit.residual,
            model=lambda at: self.model(at, p).columns @ linear,
        )


# ------------------------------------------------------------- the competition


def explain_decay(
    t: Array,
    y: Array,
    fit: Ringing,
    *,
    step: float,
    floor: float,
    turning: Array,
    falling: bool,
    only: DecayCause | None = None,
) -> Explained:
    """Test whether a decay is exponential, and find the law that it follows if it is not.

    Parameters
    ----------
    t, y : times and readings (n,) of one free decay.
    fit : the exponential fit to the same samples.
    step : the encoder step.
    floor : the noise between neighbouring samples (root mean square).
    turning : times of the turning points.
    falling : whether y decreases after the first turning point.
    only : the only law to try; by default all compete.
    """
    omega = float(fit.poles[0].imag)
    coarse_t, coarse_y = thinned(t, y, omega=omega)
    n, size = coarse_t.size, t.size // coarse_t.size
    angle = omega * float(coarse_t[-1] - coarse_t[0]) / (n - 1)
    density_of = partial(noise_density, angle=angle, step=step / np.sqrt(size))
    swings_at = partial(Swings, direction=-1.0 if falling else 1.0)
    around = np.array([turning[0], -fit.poles[0].real, omega])
    departure = Departure(
        coarse_t,
        coarse_y,
        fit,
        step=step / np.sqrt(size),
        floor=floor,
        friction=swings_at(coarse_t, around, cycles=np.inf).columns[:, 3],
    )
    noise, columns = departure.noise, departure.columns + UNKNOWNS
    density = density_of(noise, unknowns=columns)
    if not departure.present:
        return Explained(
            name="exponential",
            departure=departure,
            law=None,
            density=size * density,
            left=(0.0, 0.0),
        )
    tried = _candidates(coarse_t, coarse_y, fit, turning=turning, falling=falling, end=float(t[-1]))
    fits = [
        (law, one)
        for one in tried
        if only in (None, one.name) and (law := one.fit(coarse_t, coarse_y))
    ]
    for law, _ in fits:  # the residual of a law may be smaller than that of the flexible change
        other = density_of(law.residual, unknowns=law.unknowns)
        if other < density:
            noise, columns, density = law.residual, law.unknowns, other
    n_eff = max(float(noise @ noise) / density, 2.0)
    # Rounding leaves this much even if the fit follows it.
    # Share of the rounding error that any fit leaves
    least = n * (step**2 / size / 12) * 0.1

    def bic(squares: float, unknowns: int) -> float:
        return n_eff * float(np.log(max(squares, least) / n)) + unknowns * float(np.log(n_eff))

    def excess(squares: float) -> float:
        """Return what is left beyond the noise, zero if it is within chance."""
        more = squares - float(noise @ noise)
        return more if more > departure.limit * departure.columns * density else 0.0

    def is_determined(law: LawFit) -> bool:
        """Return whether the swings determine the law, or it leaves only noise.

        Each swing gives one number: its amplitude, its time or its middle. Dry friction also shows
        within a swing.
        """
        swings = n * angle / np.pi
        # A law may have three unknowns more than there are swings, unless it leaves only noise.
        few = law.unknowns <= swings + 3
        # With fewer than four swings, most laws leave only noise.
        exact = swings >= 4 and not excess(law.squares)
        return few or exact or law.name == "dry_friction"

    left = float(departure.left @ departure.left)
    bics: dict[str, float] = {"exponential": bic(left, UNKNOWNS)}
    best: tuple[LawFit, _Candidate] | None = None
    for law, tried_one in fits:
        if not is_determined(law):
            continue
        own = bic(law.squares, law.unknowns)
        if own < bics.get(law.name, np.inf):
            bics[law.name] = own
            if own <= min(bics.values()):
                best = law, tried_one
    name: DecayCause = "unknown"
    full, over = None, excess(left)
    if best and _is_clear(best[0], bics, density=density):
        law, tried_one = best
        # Share of what the exponential leaves that a law may leave. On real carts, dry friction
        # leaves 0.03 to 0.38; a wrong law may leave 0.23.
        most = 0.5 if law.name == "dry_friction" else 0.2
        if excess(law.squares) <= most * over:
            full = tried_one.fit_from(law.p, t, y, precision=least_squares.PRECISION)
            name, over = (law.name, excess(law.squares)) if full else (name, over)
    return Explained(
        name=name,
        departure=departure,
        law=full,
        density=size * density,
        left=(size * excess(left), size * over),
    )


def _is_clear(law: LawFit, bics: Mapping[str, float], *, density: float) -> bool:
    """Return whether the best law has a damping, and is clearly better than all others."""
    others = [bic for name, bic in bics.items() if name != law.name]
    # A damping ratio cannot be three standard errors below zero.
    undamped = law.values[0] < -3.0 * law.unit[0] * np.sqrt(density)
    # The BIC of the best law must be better than the next one's by six.
    return not undamped and bics[law.name] + 6.0 < min(others)


def _candidates(
    t: Array, y: Array, fit: Ringing, *, turning: Array, falling: bool, end: float
) -> Iterator[_Candidate]:
    """Yield all laws that may explain why a decay is not exponential."""
    pole = complex(fit.poles[0])
    decay, omega, start = -pole.real, pole.imag, float(t[0])
    length = float(t[-1] - t[0])

    def modulated(
        name: DecayCause,
        free: Sequence[int],
        p: Sequence[float],
        size: Callable[[Array, Array, Array], tuple[Array, bool]],
        *,
        power: int = 0,
        bends: int = 1,
    ) -> _Candidate:
        return _Candidate(
            name=name,
            model=lambda t, p: Modulated(
                t - start, p, free=free, power=power, bends=bends, length=length
            ),
            starts=[np.array(p)],
            scale=np.full(len(free), abs(pole)),
            pole=lambda p, linear: (0, 1),
            size=size,
        )

    # A cart that friction has stopped stays where it is: where it last turned, or one swing later.
    stopped = end > turning[-1] + np.pi / omega
    for cycles in [np.inf, *(turning.size - np.array([1.0, 0.0]) if stopped else [])]:
        yield _Candidate(
            name="dry_friction",
            model=partial(Swings, direction=-1.0 if falling else 1.0, cycles=cycles),
            starts=[np.array([turning[0], decay * share, omega]) for share in (1.0, 0.3)],
            scale=np.array([1 / omega, abs(pole), abs(pole)]),
            pole=lambda p, linear: (1, 2),
            size=lambda t, p, linear: (np.eye(7)[6], linear[3] > 0),
        )
    drag = [0.5 * decay, omega, 0.5 * decay]
    yield modulated("quadratic_drag", [DECAY, FREQUENCY, DRAG], drag, _drag_size)
    yield modulated("quadratic_drag", [DECAY, FREQUENCY, DRAG], drag, _drag_size, power=2)
    shift = [decay, omega, 0.0]
    yield modulated("frequency_shift", [DECAY, FREQUENCY, SHIFT], shift, _shift_size)
    yield modulated("frequency_shift", [DECAY, FREQUENCY, SHIFT], shift, _shift_size, power=3)
    for bends in (3, 6):
        if 2 * np.pi * bends <= omega * length:  # a drift is slower than the oscillation
            yield modulated("drift", [DECAY, FREQUENCY], [decay, omega], _bend_size, bends=bends)
    others = _other_frequencies(t, y - fit(t), pole)
    yield _Candidate(
        name="second_mode",
        model=lambda t, p: least_squares.Waves(
            t - start, p, level=np.array([np.ones_like(t), t - start])
        ),
        starts=[np.array([decay, decay, omega, other]) for other in others],
        scale=np.full(4, abs(pole)),
        pole=_main_mode,
        size=_second_size,
    )


def _drag_size(t: Array, p: Array, linear: Array) -> tuple[Array, bool]:
    """Return the weights of the drag coefficient beta."""
    amplitude = float(np.hypot(*linear[2:4]))
    return np.eye(p.size + linear.size)[2] * 3 * np.pi / (4 * p[1] * amplitude), p[2] > 0


def _shift_size(t: Array, p: Array, linear: Array) -> tuple[Array, bool]:
    """Return the weights of the relative change of frequency at the largest amplitude."""
    weights, shift = np.zeros(p.size + linear.size), float(p[2] / p[1])
    weights[2] = (1 - SHIFTS_AGAIN * shift) / p[1]
    # The changes of the waveform are of second order in the shift.
    amplitude, *others = np.hypot(*linear[2:].reshape(-1, 2).T)
    small = max(others, default=0.0) < abs(shift) * amplitude / 2
    # The series holds up to a relative shift of 0.3.
    return weights, abs(shift) < 0.3 and small


def _bend_size(t: Array, p: Array, linear: Array) -> tuple[Array, bool]:
    """Return the weights of the rest point's largest distance from a line from start to end."""
    share, bends = np.linspace(0, 1, 51)[:, None], np.arange(2, linear.size - 2)
    shapes = share**bends - share
    weights = np.zeros(p.size + linear.size)
    distance = shapes @ linear[2 : linear.size - 2]
    weights[p.size + bends] = shapes[int(np.argmax(np.abs(distance)))]
    return weights, True


def _main_mode(p: Array, linear: Array) -> tuple[int, int]:
    """Return where decay rate and frequency of the mode with the larger amplitude are."""
    return (0, 2) if np.hypot(*linear[[2, 4]]) >= np.hypot(*linear[[3, 5]]) else (1, 3)


def _second_size(t: Array, p: Array, linear: Array) -> tuple[Array, bool]:
    """Return the weights of the smaller mode's frequency; the modes must be apart."""
    rates, frequencies = p.reshape(2, 2)
    # The frequencies must differ by half of the larger decay rate.
    apart = abs(frequencies[1] - frequencies[0]) > 0.5 * np.max(np.abs(rates))
    turns = float(np.min(frequencies)) * (t[-1] - t[0]) > 2 * np.pi
    # The smaller decay rate must be a tenth of the larger one.
    decays = float(np.min(rates)) > 0.1 * float(np.max(rates))
    return np.eye(10)[3 if _main_mode(p, linear) == (0, 2) else 2], apart and turns and decays


def _other_frequencies(t: Array, residual: Array, pole: complex) -> Iterator[float]:
    """Yield frequencies to start from: the peak of the residual, and both sides of the first."""
    length, padded = float(t[-1] - t[0]), 4 * t.size
    omega = 2 * np.pi / length * (t.size - 1) / padded * np.arange(padded // 2 + 1)
    power = np.abs(np.fft.rfft(residual * np.hanning(t.size), padded))
    near = (omega > max(SECOND[0] * pole.imag, np.pi / length)) & (omega < SECOND[1] * pole.imag)
    peak = float(omega[near][np.argmax(power[near])])
    beside = np.pi / length
    if abs(peak - pole.imag) > beside:
        yield peak
    yield pole.imag + beside
    yield pole.imag - beside
