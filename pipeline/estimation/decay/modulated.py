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
_LEAST = 1e-3  # bound of a divisor during the fit
_FLAT = 1e-3  # loss below which a series replaces a quotient of small numbers
# Drag also slows the oscillation a little. The second coefficient is from simulations with beta A
# from 0.02 to 0.4, which agree to 5 %.
_SLOWS, _SLOWS_SQUARED = 0.5, 0.092
_LEAD = 16  # points from the start to the first time, for the integrals
SHIFTS_AGAIN = 5 / 12  # of a cubic spring
DECAY, FREQUENCY, DRAG, SHIFT = range(4)


@dataclass(frozen=True, kw_only=True, eq=False)
class Modulated:
    """A decay y = drift + Re(amplitude E e^{i phi}), with envelope E and phase phi.

    E = e^{-gamma tau} / (B sqrt(R)) with B = 1 + b (1 - e^{-gamma tau}) / gamma and, because a
    stiffer spring stores more energy, R = 1 - (1 - e^{-2 gamma tau}) shift / omega. Further, phi' =
    omega + shift E² - (5/12 shift² E⁴ + b gamma E / 2 + 0.092 b² E²) / omega.

    Attributes
    ----------
    tau : time (n_lead + n,) since the start, s. The first times lead from the start to the samples.
    p : gamma, omega, b and shift, 1/s.
    free : which of p are unknown. The others are zero.
    grown, below, bent : (1 - e^{-gamma tau}) / gamma, B and R (n_lead + n,).
    envelope, phase : E and phi (n_lead + n,).
    power : if positive, there is a third harmonic that follows E^power.
    bends : highest power of time in the drift.
    length : unit of time of these powers, s.
    """

    tau: Array
    p: Array
    free: Sequence[int]
    grown: Array
    below: Array
    bent: Array
    envelope: Array
    phase: Array
    power: int
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
        bends: int = 1,
        length: float = 1.0,
    ) -> "Modulated":
        """Return the oscillation at the unknowns p (n_free,)."""
        full = np.zeros(4)
        full[list(free)] = p
        gamma, omega, b, shift = full
        tau = np.append(np.linspace(0.0, tau[0], _LEAD), tau)
        left = np.exp(-np.clip(gamma * tau, -_MOST_LOSS, _MOST_LOSS))
        flat = abs(gamma) * np.max(np.abs(tau)) <= _FLAT
        grown = tau * (1 - gamma * tau / 2) if flat else (1 - left) / gamma
        below = np.maximum(1 + b * grown, _LEAST)
        bent = np.maximum(1 - (1 - left**2) * shift / omega, _LEAST)
        envelope = left / below / np.sqrt(bent)
        phase = omega * tau
        if b or shift:
            turning = shift * envelope**2 - _slowed(envelope, full) / omega
            phase = phase + _integral(turning, tau)
        return cls(
            tau=tau,
            p=full,
            free=free,
            grown=grown,
            below=below,
            bent=bent,
            envelope=envelope,
            phase=phase,
            power=power,
            bends=bends,
            length=length,
        )

    @property
    def columns(self) -> Array:
        """The factors of drift, amplitude and harmonics, (n, n_linear)."""
        tau, envelope, phase = self.tau[_LEAD:], self.envelope[_LEAD:], self.phase[_LEAD:]
        drift = np.vander(tau / self.length, self.bends + 1, increasing=True).T
        waves = [
            part
            for power, order in self._waves
            for part in _parts(envelope**power * np.exp(1j * order * phase))
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
        left = np.exp(-np.clip(gamma * tau, -_MOST_LOSS, _MOST_LOSS))
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


def _parts(wave: Array) -> tuple[Array, Array]:
    return wave.real, wave.imag


def _integral(values: Array, t: Array) -> Array:
    """Return the integral of `values` (…, n) from the first time on, by the trapezoidal rule.

    The envelope is slow, so this is exact enough between samples.
    """
    steps = np.diff(t) * (values[..., 1:] + values[..., :-1]) / 2
    return np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)
