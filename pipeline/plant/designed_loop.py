"""The designed loop as systems of python-control, and how far it is from the edge.

The loop is that of `pipeline.plant.loop`: gains on the state predicted for the moment the effort
begins to act, the observer's prediction, one sample of delay.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.plant.chain import Array, Chain, ComplexArray
from pipeline.plant.loop import StateFeedback, broken_loop, discretise

if TYPE_CHECKING:
    import control  # half a second: imported where it is used

_SPREAD = 200  # frequencies of the whole band, to which each mode adds its own
_NEAR_A_MODE = np.tan(np.linspace(-1.5, 1.5, 61))  # in half widths: equal steps of its phase
_SLOWEST = 1e-3  # of the Nyquist frequency, where the band begins


@dataclass(frozen=True, kw_only=True)
class Margins:
    """How much the loop, cut at the motor, may change before it is unstable.

    Attributes
    ----------
    gain : factor on the loop's gain that makes it unstable, the nearest to 1 (below 1: the least
        gain it needs); None where no factor does.
    phase_deg : lag in degrees that makes it unstable, or lead where below zero; None where the
        gain never is 1.
    modulus : the least distance of the Nyquist curve from -1, one over the peak of the sensitivity.
    omega_gain, omega_phase : rad/s, where `gain` and `phase_deg` are met.

    Reference: K. J. Astrom, R. M. Murray, Feedback Systems, 2nd ed., section 10.3.
    """

    gain: float | None
    phase_deg: float | None
    modulus: float
    omega_gain: float | None
    omega_phase: float | None


def closed_loop(
    chain: Chain, controller: StateFeedback, *, sample_time: float
) -> "control.StateSpace":
    """Return the loop from the set point `r` to the positions, sampled every `sample_time` s.

    The states are those of the carts and the effort `u` that acts: it was computed a sample ago,
    so it makes the one pole at z = 0. The observer knows the plant, so nothing of it shows.
    """
    import control

    phi, gamma = discretise(chain, sample_time)
    plant = chain.to_control()
    moved = np.hstack([phi, gamma[:, None]])
    return control.StateSpace(
        np.vstack([moved, -controller.gains @ moved]),
        np.append(np.zeros(gamma.size), controller.prefilter)[:, None],
        np.hstack([plant.C, np.zeros((chain.n, 1))]),
        np.zeros((chain.n, 1)),
        sample_time,
        inputs=["r"],
        outputs=plant.output_labels,
        states=[*plant.state_labels, "u"],
        name="closed loop",
    )


def stability_margins(
    chain: Chain, controller: StateFeedback, *, sample_time: float
) -> Margins | None:
    """Return the margins of the loop cut at the motor, or None where it is not stable."""
    import control

    A, B, C = broken_loop(chain, controller, sample_time=sample_time)
    if np.abs(np.linalg.eigvals(A - np.outer(B, C))).max() >= 1:
        return None
    nyquist = np.pi / sample_time
    omega = _frequencies(np.linalg.eigvals(A).astype(np.complex128), sample_time=sample_time)
    # At both ends of the band the response is real, and where it is negative crosses -180° too;
    # carts that no spring ties to a wall have none at the lower end.
    ends = np.array([0.0, nyquist] if chain.is_tied else [nyquist])
    L = _response(A, B, C, z=np.exp(1j * sample_time * np.append(omega, ends)))
    inside, at_ends = L[: omega.size], L[omega.size :].real
    gain, phase, distance, omega_gain, omega_phase, _ = control.stability_margins(
        (np.abs(inside), np.degrees(np.angle(inside)), omega), returnall=True
    )
    gain = np.append(gain, -1 / at_ends[at_ends < 0])
    omega_gain = np.append(omega_gain, ends[at_ends < 0])
    nearest, least = np.argsort(np.abs(np.log(gain))), np.argsort(np.abs(phase))
    return Margins(
        gain=float(gain[nearest[0]]) if gain.size else None,
        phase_deg=float(phase[least[0]]) if phase.size else None,
        modulus=float(min(distance.min(initial=np.inf), np.abs(1 + at_ends).min())),
        omega_gain=float(omega_gain[nearest[0]]) if gain.size else None,
        omega_phase=float(omega_phase[least[0]]) if phase.size else None,
    )


def _response(A: Array, B: Array, C: Array, *, z: ComplexArray) -> ComplexArray:
    shifted = z[:, None, None] * np.eye(B.size) - A
    return (C @ np.linalg.solve(shifted, B[:, None]))[:, 0]


def _frequencies(z: ComplexArray, *, sample_time: float) -> Array:
    """Return frequencies up to Nyquist's, rad/s, close where a pole makes the response turn."""
    nyquist = np.pi / sample_time
    s = np.log(z[z.imag > 0]) / sample_time
    modes = s.imag[:, None] + np.abs(s.real)[:, None] * _NEAR_A_MODE
    omega = np.append(np.geomspace(_SLOWEST * nyquist, nyquist, _SPREAD, endpoint=False), modes)
    return np.unique(omega[(omega >= _SLOWEST * nyquist) & (omega < nyquist)])
