"""Dry friction in a free decay: fit and test its exact piecewise solution.

With viscous damping and dry friction F, a cart that moves one way swings about a point d = F/k to
one side of its rest. On the way back it swings about a point d to the other side. So successive
amplitudes follow A_{j+1} = rho A_j - (1 + rho) d.

Reference: B. F. Feeny and J. W. Liang, J. Sound and Vibration 195 (1996) 149-154.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.estimation.colour import colour
from pipeline.estimation.decay.ringing import Ringing
from pipeline.estimation.decay.separable import fit_separable
from pipeline.results import FrictionTest

_THRESHOLD = 10.8  # F-statistic exceeded by 1 in 1000 decays without friction
_UNKNOWNS = 7
_MOST_LOSS = 50.0  # bound of an exponent during the fit, against overflow
_LESS_DAMPING = (1.0, 0.3)  # starts: shares of the damping that stay viscous


@dataclass(frozen=True, kw_only=True, eq=False)
class FrictionFit:
    """The outcome of the friction test, and the decay with friction as a function of time."""

    test: FrictionTest
    model: Callable[[Array], Array]


def fit_friction(
    t: Array, y: Array, *, viscous: Ringing, turning: float, falling: bool, floor: float
) -> FrictionFit | None:
    """Fit a decay with viscous damping and dry friction; compare with viscous damping alone.

    The search is over turning point, decay rate and frequency. Rest point, drift, first amplitude
    and friction band are linear. The F-statistic allows for a correlated residual.

    Parameters
    ----------
    t, y : times and readings (n,) of one free decay.
    viscous : the fit without friction, to the same samples.
    turning : approximate time of a turning point, s.
    falling : whether y decreases after the turning point.
    floor : the smallest significant residual (root mean square). A smaller friction band does not
        count as present.

    Returns
    -------
    None if there are too few samples, or if the fit does not converge.
    """
    pole = complex(viscous.poles[0])
    if t.size <= _UNKNOWNS + 1 or pole.imag <= 0:
        return None
    cut = partial(_Swings.at, direction=-1.0 if falling else 1.0)
    # If the viscous fit already leaves at most 1.5 times the noise, there is little friction or
    # none.
    fits = [
        fit_separable(
            y,
            partial(cut, t),
            start=np.array([turning, -pole.real * share, pole.imag]),
            max_evaluations=200,  # some 30 are usual
            scale=np.array([1 / pole.imag, abs(pole), abs(pole)]),
        )
        for share in (_LESS_DAMPING if viscous.rms > 1.5 * floor else _LESS_DAMPING[:1])
    ]
    best = min(fits, key=lambda fit: float(fit.residual @ fit.residual))
    if not best.converged or best.p[2] <= 0:
        return None
    linear, residual = best.linear, best.residual
    left, angle = float(residual @ residual), best.p[2] * (t[-1] - t[0]) / (t.size - 1)
    variance = max(left / (t.size - _UNKNOWNS), floor**2) * colour(residual, angle=angle)
    gained = viscous.rms**2 * t.size - left
    covariance = variance * _inverse_normal(cut(t, best.p), linear)
    (_, decay, omega_d), omega_n = best.p.tolist(), float(np.hypot(*best.p[1:]))
    per_pole = np.array([omega_d**2, -decay * omega_d]) / omega_n**3  # gradient of decay / omega_n
    statistic = max(gained / variance, 0.0)
    test = FrictionTest(
        f_statistic=statistic,
        threshold=_THRESHOLD,
        present=statistic > _THRESHOLD and bool(linear[3] > floor),
        drop=float(linear[3]),
        drop_std=float(np.sqrt(covariance[6, 6])),
        zeta=decay / omega_n,
        zeta_std=float(np.sqrt(per_pole @ covariance[1:3, 1:3] @ per_pole)),
    )
    return FrictionFit(test=test, model=lambda at: cut(at, best.p).columns @ linear)


def _inverse_normal(fitted: "_Swings", linear: Array) -> Array:
    """Return the inverse (7, 7) of J'J; J has the nonlinear unknowns first."""
    full = np.column_stack([fitted.derivatives(linear), fitted.columns])
    size = np.maximum(np.linalg.norm(full, axis=0), np.finfo(float).tiny)
    inverse = np.linalg.pinv(np.linalg.qr(full / size, mode="r")) / size[:, None]
    return inverse @ inverse.T


@dataclass(frozen=True, kw_only=True, eq=False)
class _Swings:
    """A decay cut into half cycles at its turning points.

    In each half cycle, y = rest + drift + (amplitude kept + friction pushed) swing - friction side.
    Here friction means the friction band d.

    Attributes
    ----------
    p : turning point in s, decay rate and damped frequency in rad/s.
    since : time (n,) since the turning point, s.
    tau : time (n,) since the half cycle began, s.
    swing : cosine (n,) from 1 at the start of the half cycle to -1 at its end.
    sine : quadrature (n,) of `swing`.
    cycle : index (n,) of each sample's half cycle.
    number : numbers (n_cycles,) of the half cycles; 0 for the one after the turning point.
    kept, pushed, side : (n_cycles,), as in the equation above.
    """

    p: Array
    since: Array
    tau: Array
    swing: Array
    sine: Array
    cycle: NDArray[np.int64]
    number: Array
    kept: Array
    pushed: Array
    side: Array

    @classmethod
    def at(cls, t: Array, p: Array, *, direction: float) -> "_Swings":
        """Cut the samples `t`; after the turning point the cart moves in `direction` (1 or -1)."""
        turning, decay, omega_d = p
        since, half = t - turning, np.pi / omega_d
        k = np.floor(since / half)
        tau = since - k * half
        number = np.arange(k.min(), k.max() + 1)
        loss = np.clip(decay * half, -_MOST_LOSS, _MOST_LOSS)  # rho = exp(-loss)
        lost = np.clip(-loss * number, -_MOST_LOSS, _MOST_LOSS)
        # (1 - rho^k) / (1 - rho), which is k without viscous damping
        geometric = np.expm1(lost) / np.expm1(-loss) if loss else number
        sign = np.where(number % 2 == 0, 1.0, -1.0)
        left = np.exp(np.clip(-decay * tau, -_MOST_LOSS, _MOST_LOSS))
        sine = left * np.sin(omega_d * tau)
        return cls(
            p=p,
            since=since,
            tau=tau,
            swing=left * np.cos(omega_d * tau) + decay / omega_d * sine,
            sine=sine,
            cycle=(k - number[0]).astype(np.int64),
            number=number,
            kept=sign * np.exp(lost),
            pushed=direction * sign * (1 + (1 + np.exp(-loss)) * geometric),
            side=direction * sign,
        )

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
        rho, number = np.exp(-np.clip(np.pi * ratio, -_MOST_LOSS, _MOST_LOSS)), self.number
        geometric = (self.pushed / self.side - 1) / (1 + rho)
        per_loss = (
            (number * np.abs(self.kept) - rho * geometric) / (1 - rho)
            if rho != 1
            else -number * (number - 1) / 2
        )
        pushed_per_loss = self.side * ((1 + rho) * per_loss - rho * geometric)
        size = (amplitude * self.kept + band * self.pushed)[self.cycle]
        size_per_loss = (band * pushed_per_loss - amplitude * number * self.kept)[self.cycle]
        longer = np.pi / omega_d**2 * number[self.cycle]  # derivative of tau by omega_d
        return np.array(
            [
                -drift - size * per_tau,
                size * per_decay + np.pi / omega_d * size_per_loss * swing,
                size * (per_omega_d + longer * per_tau)
                - np.pi * ratio / omega_d * size_per_loss * swing,
            ]
        ).T
