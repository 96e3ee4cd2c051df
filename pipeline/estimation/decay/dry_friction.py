"""Dry friction in a free decay: its exact piecewise solution.

With viscous damping and dry friction F, a cart that moves one way swings about a point d = F/k to
one side of its rest. On the way back it swings about a point d to the other side. So successive
amplitudes follow A_{j+1} = rho A_j - (1 + rho) d.

Reference: B. F. Feeny and J. W. Liang, J. Sound and Vibration 195 (1996) 149-154.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array

_MOST_LOSS = 50.0  # bound of an exponent during the fit, against overflow


@dataclass(frozen=True, kw_only=True, eq=False)
class Swings:
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
    held : whether the cart has stopped (n,); it then stays where the half cycle ended.
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
    held: NDArray[np.bool_]

    @classmethod
    def at(cls, t: Array, p: Array, *, direction: float, cycles: float = np.inf) -> "Swings":
        """Cut the samples `t`.

        After the turning point the cart moves in `direction` (1 or -1), for so many half `cycles`.
        """
        turning, decay, omega_d = p
        since, half = t - turning, np.pi / omega_d
        k = np.floor(since / half)
        held = k >= cycles
        k = np.minimum(k, cycles - 1)
        tau = np.minimum(since - k * half, half)
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
            held=held,
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
