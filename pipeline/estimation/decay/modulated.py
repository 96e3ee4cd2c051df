"""Oscillations whose damping or frequency depends on their amplitude.

With quadratic drag beta |v| v, averaging gives A' = -gamma A - (4 beta omega / 3 pi) A². With a
spring that is not linear, the frequency changes in proportion to A². Both add a third harmonic.

Reference: A. H. Nayfeh & D. T. Mook, Nonlinear Oscillations, 1979, chapters 2 and 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array

_MOST_LOSS = 50.0  # bound of an exponent during the fit, against overflow
_FLAT = 1e-3  # loss below which a series replaces a quotient of small numbers
# Drag also slows the oscillation a little. The second coefficient is from simulations with beta A
# from 0.02 to 0.4, which agree to 5 %.
_SLOWS, _SLOWS_SQUARED = 0.5, 0.092
_LEAD = 16  # points from the start to the first time, for the integrals
_SHIFTS_AGAIN = 5 / 12  # of a cubic spring
DECAY, FREQUENCY, DRAG, SHIFT = range(4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Modulated:
    """A decay y = drift + Re(amplitude E e^{i phi}), with envelope E and phase phi.

    E = e^{-gamma tau} / (1 + b (1 - e^{-gamma tau}) / gamma), and phi' = omega + shift E² - (5/12
    shift² E⁴ + b gamma E / 2 + 0.092 b² E²) / omega.

    Attributes
    ----------
    tau : time (n,) since the start, s.
    free : the entries of (gamma, omega, b, shift) that are unknown. The others are zero.
    envelope, phase : E and phi (n,).
    slopes, turns : derivatives (n_free, n) of envelope and phase by the unknowns, which are in 1/s.
    power : if positive, there is a third harmonic that follows E^power.
    kept : whether the fundamental also has a part that follows E^power.
    bends : highest power of time in the drift.
    length : unit of time of these powers, s.
    """

    tau: Array
    free: Sequence[int]
    envelope: Array
    phase: Array
    slopes: Array
    turns: Array
    power: int
    kept: bool
    bends: int
    length: float

    @classmethod
    def at(
        cls,
        tau: Array,
        p: Array,
        *,
        free: Sequence[int],
        power: int = 0,
        kept: bool = False,
        bends: int = 1,
        length: float = 1.0,
    ) -> "Modulated":
        """Return the oscillation at the unknowns p (n_free,)."""
        full = np.zeros(4)
        full[list(free)] = p
        gamma, omega, b, shift = full
        n, tau = tau.size, np.append(np.linspace(0.0, tau[0], _LEAD), tau)
        loss = np.clip(gamma * tau, -_MOST_LOSS, _MOST_LOSS)
        left = np.exp(-loss)
        if abs(gamma) * np.max(np.abs(tau)) > _FLAT:
            grown = (1 - left) / gamma
            per_gamma = (tau * left - grown) / gamma
        else:
            grown, per_gamma = tau * (1 - loss / 2), -(tau**2) * (1 / 2 - loss / 3)
        below = np.maximum(1 + b * grown, 1e-3)
        envelope = left / below
        by = np.array([-envelope * (tau + b * per_gamma / below), -envelope * grown / below])
        # Powers 1, 2 and 4 of the envelope, integrated, and the derivatives by gamma and b. The
        # envelope is slow, so the trapezoidal rule is exact enough between samples.
        areas = _integral(np.array([envelope, envelope**2, envelope**4]), tau)
        turned = _integral(np.array([by, 2 * envelope * by, 4 * envelope**3 * by]), tau)
        squares = np.array([_SLOWS * b * gamma, _SLOWS_SQUARED * b**2, _SHIFTS_AGAIN * shift**2])
        weight = np.array([0.0, shift, 0.0]) - squares / omega
        by_gamma, by_drag = np.tensordot(weight, turned, axes=1)
        by_gamma = by_gamma - _SLOWS * b / omega * areas[0]
        by_drag = by_drag - (_SLOWS * gamma * areas[0] + 2 * _SLOWS_SQUARED * b * areas[1]) / omega
        by_shift = areas[1] - 2 * _SHIFTS_AGAIN * shift / omega * areas[2]
        turns = np.array([by_gamma, tau + squares @ areas / omega**2, by_drag, by_shift])
        slopes = np.zeros_like(turns)
        slopes[[DECAY, DRAG]] = by
        phase = omega * tau + weight @ areas
        return cls(
            tau=tau[-n:],
            free=free,
            envelope=envelope[-n:],
            phase=phase[-n:],
            slopes=slopes[list(free), -n:],
            turns=turns[list(free), -n:],
            power=power,
            kept=kept,
            bends=bends,
            length=length,
        )

    @property
    def columns(self) -> Array:
        """The factors of drift, amplitude and harmonics, (n, n_linear)."""
        drift = np.vander(self.tau / self.length, self.bends + 1, increasing=True).T
        waves = [
            part
            for power, order in self._waves
            for part in _parts(self.envelope**power * np.exp(1j * order * self.phase))
        ]
        return np.array([*drift, *waves]).T

    @property
    def _waves(self) -> list[tuple[int, int]]:
        """Power of the envelope and order of the harmonic of each wave."""
        waves = [(1, 1)]
        if self.kept:
            waves.append((self.power, 1))
        return [*waves, (self.power, 3)] if self.power else waves

    def derivatives(self, linear: Array) -> Array:
        """Return dy/dp (n, n_free)."""
        by_envelope, by_phase = np.zeros((2, self.tau.size))
        for (power, order), (cosine, sine) in zip(
            self._waves, linear[self.bends + 1 :].reshape(-1, 2), strict=True
        ):
            wave = (cosine - 1j * sine) * np.exp(1j * order * self.phase)
            by_envelope += power * self.envelope ** (power - 1) * wave.real
            by_phase -= order * self.envelope**power * wave.imag
        return (by_envelope * self.slopes + by_phase * self.turns).T


def _parts(wave: Array) -> tuple[Array, Array]:
    return wave.real, wave.imag


def _integral(values: Array, t: Array) -> Array:
    """Return the integral of `values` (…, n) from the first time on, by the trapezoidal rule."""
    steps = np.diff(t) * (values[..., 1:] + values[..., :-1]) / 2
    return np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)
