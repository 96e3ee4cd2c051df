"""Test whether a decay is exponential, and find the law that it follows if it is not.

The residual of the exponential is compared with the noise of the recording itself. The noise is the
residual of a flexible change of envelope, phase and rest point. If more is left than noise,
the known reasons compete by their BIC, with the effective number of samples.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.decay.departure import (
    SECOND,
    UNKNOWNS,
    Departure,
    find_departure,
    noise_density,
    thinned,
)
from pipeline.estimation.decay.dry_friction import Swings
from pipeline.estimation.decay.modulated import (
    DECAY,
    DRAG,
    FREQUENCY,
    SHIFT,
    SHIFTS_AGAIN,
    Modulated,
)
from pipeline.estimation.decay.ringing import Ringing, Waves
from pipeline.estimation.decay.separable import (
    PRECISION,
    SeparableModel,
    fit_separable,
    inverse_normal,
    squares_at,
)
from pipeline.results import DecayCause

_MARGIN = 6.0  # BIC by which the best law must be better than the next
# Share of what the exponential leaves that a law may leave. On real carts, dry friction leaves 0.03
# to 0.38; a wrong law may leave 0.23.
_MOST_LEFT, _MOST_LEFT_BY_FRICTION = 0.2, 0.5
# Unknowns that a law may have beyond the number of swings, unless it leaves only noise.
_MORE_UNKNOWNS = 3
_FEWEST_SWINGS = 4  # with fewer, most laws leave only noise
_MAX_EVALUATIONS = 100
_ROUGH = 1e-4  # relative tolerance of the squares in the competition
_SIGMAS = 3.0  # a damping ratio further below zero is impossible
_LEAST_ROUNDING = 0.1  # share of the rounding error that any fit leaves
_LEAST_RATE = 0.1  # smaller decay rate of two modes, in the larger
# Errors relative to the square of a shift, from simulated springs and pendulums.
_NEGLECTED = np.array([1.0, 0.1, 1.0])  # of damping ratio, frequency and shift
_MOST_SHIFT = 0.3  # relative shift of frequency up to which the series holds
_APART = 0.5  # distance of two modes, in the larger decay rate


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
    model: Callable[[Array, Array], SeparableModel]
    starts: Sequence[Array]
    scale: Array
    pole: Callable[[Array, Array], tuple[int, int]]
    size: Callable[[Array, Array, Array], tuple[Array, bool]]

    def fit(self, t: Array, y: Array) -> LawFit | None:
        """Return a rough fit from the best start, None if it makes no sense."""
        start = min(self.starts, key=lambda p: squares_at(y, self.model(t, p)))
        return self.fit_from(start, t, y, precision=_ROUGH)

    def fit_from(self, start: Array, t: Array, y: Array, *, precision: float) -> LawFit | None:
        """Return the fit from a start, None if it makes no sense."""
        fit = fit_separable(
            y,
            partial(self.model, t),
            start=start,
            max_evaluations=_MAX_EVALUATIONS,
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
        covariance = inverse_normal(self.model(t, p), linear)
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
    swings_at = partial(Swings.at, direction=-1.0 if falling else 1.0)
    around = np.array([turning[0], -fit.poles[0].real, omega])
    departure = find_departure(
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
    least = n * (step**2 / size / 12) * _LEAST_ROUNDING

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
        few = law.unknowns <= swings + _MORE_UNKNOWNS
        exact = swings >= _FEWEST_SWINGS and not excess(law.squares)
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
        most = _MOST_LEFT_BY_FRICTION if law.name == "dry_friction" else _MOST_LEFT
        if excess(law.squares) <= most * over:
            full = tried_one.fit_from(law.p, t, y, precision=PRECISION)
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
    undamped = law.values[0] < -_SIGMAS * law.unit[0] * np.sqrt(density)
    return not undamped and bics[law.name] + _MARGIN < min(others)


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
            model=lambda t, p: Modulated.at(
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
            model=partial(Swings.at, direction=-1.0 if falling else 1.0, cycles=cycles),
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
        model=lambda t, p: Waves.at(t - start, p, level=np.array([np.ones_like(t), t - start])),
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
    return weights, abs(shift) < _MOST_SHIFT and small


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
    apart = abs(frequencies[1] - frequencies[0]) > _APART * np.max(np.abs(rates))
    turns = float(np.min(frequencies)) * (t[-1] - t[0]) > 2 * np.pi
    decays = float(np.min(rates)) > _LEAST_RATE * float(np.max(rates))
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
