"""The designed loop as a python-control system, and its distance from instability.

The loop is that of `sampled_loop`. The gains multiply the state that the observer predicts for the
moment at which the input acts; the delay is one sample.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.json_files import Number, result, written
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import StateFeedback, broken_loop, discretise

if TYPE_CHECKING:
    import control  # takes half a second, so it is imported only where needed

_SLOWER = 1e-2  # the band begins at this multiple of the slowest pole
_NEAREST, _AROUND = 1e-6, 30  # near a mode: least relative distance; frequencies on each side


@result()
class Margins:
    """How much the designed loop, cut at the motor, may change before it becomes unstable.

    Reference: K. J. Astrom, R. M. Murray, Feedback Systems, 2nd ed., section 10.3.
    """

    gain: float | None = written(
        "factor on the loop's gain, the nearest to 1, that makes the loop unstable; below 1, the "
        "loop needs more gain than this; null if there is no such factor"
    )
    phase_deg: float | None = written(
        "phase lag (or lead, if negative), the nearest to 0, that makes the loop unstable; null if "
        "the loop's gain is never 1"
    )
    modulus: Number = written(
        "least distance of the Nyquist curve from -1, which is one over the peak of the sensitivity"
    )
    omega_gain: float | None = written("frequency to which `gain` refers, rad/s")
    omega_phase: float | None = written("frequency to which `phase_deg` refers, rad/s")

    @classmethod
    def of(cls, gm: float, pm: float, sm: float, wpc: float, wgc: float, _wms: float) -> "Margins":
        """Return what `stability_margins` returned, by the keys of `results.json`."""
        gain, phase = np.isfinite(gm), np.isfinite(pm)
        return cls(
            gain=gm if gain else None,
            phase_deg=pm if phase else None,
            modulus=sm,
            omega_gain=wpc if gain else None,
            omega_phase=wgc if phase else None,
        )


def closed_loop(
    chain: Chain, controller: StateFeedback, *, sample_time: float
) -> "control.StateSpace":
    """Return the loop from the set point `r` to the positions, sampled every `sample_time` s.

    Its states are those of the carts and the acting input `u`. The input was computed one sample
    earlier, which gives the pole at z = 0. The observer knows the plant, so its poles do not
    appear.
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
) -> tuple[float, float, float, float, float, float]:
    """Return gm, pm, sm, wpc, wgc, wms of the loop cut at the motor.

    They mean the same as those of `control.stability_margins`. The margins are that of the gain (a
    factor), that of the phase in degrees, and the least distance of the Nyquist curve from -1. At
    the frequencies (rad/s) the phase is -180°, the gain is 1, and the curve is nearest to -1.
    A margin without a limit is infinite, and its frequency is NaN. A limit at
    frequency 0 counts: beyond it, the loop drifts away.

    Raises
    ------
    DataError : the loop is unstable; or a mode of the carts is undamped, for example because a fit
        held its damping at zero.
    """
    A, B, C = broken_loop(chain, controller, sample_time=sample_time)
    opened, closed = np.linalg.eigvals(A), np.linalg.eigvals(A - np.outer(B, C))
    if np.abs(closed).max() >= 1:
        where = " on cartlab's bench, whose observer has no model," if not controller.model else ""
        raise DataError(f"no margins: the loop{where} is unstable")
    if np.any((np.abs(np.abs(opened) - 1) < 1e-9) & (opened.imag != 0)):
        raise DataError("no margins: a mode of the carts has no damping")
    poles = np.append(opened, closed).astype(np.complex128)
    omega = _frequencies(poles, sample_time=sample_time)

    def response(omega: Array) -> ComplexArray:
        shifted = np.exp(1j * sample_time * omega)[:, None, None] * np.eye(B.size) - A
        return (C @ np.linalg.solve(shifted, B[:, None]))[:, 0].astype(np.complex128)

    at_180 = _crossings(lambda omega: response(omega).imag, omega)
    # At both ends of the band the response is real. If it is negative there, the phase is -180°.
    # Without a spring to a wall, the band has no lower end.
    at_180 = np.append(at_180, [0.0, np.pi / sample_time] if chain.is_tied else np.pi / sample_time)
    real = response(at_180).real
    at_180, gain = at_180[real < 0], -1 / real[real < 0]
    at_one = _crossings(lambda omega: np.log(np.abs(response(omega))), omega)
    phase = np.degrees(np.angle(-response(at_one)))
    sm, wms = _least(lambda omega: np.abs(1 + response(omega)), np.append(omega, at_180))
    gm, wpc = _nearest(gain, at_180, away=np.abs(np.log(gain)))
    pm, wgc = _nearest(phase, at_one, away=np.abs(phase))
    return gm, pm, sm, wpc, wgc, wms


def _nearest(margins: Array, omega: Array, *, away: Array) -> tuple[float, float]:
    """Return the margin with the least `away`, and its frequency; infinite and NaN without any."""
    if not margins.size:
        return np.inf, np.nan
    i = int(away.argmin())
    return float(margins[i]), float(omega[i])


def _crossings(curve: Callable[[Array], Array], omega: Array) -> Array:
    """Return where a real curve crosses zero; `omega` must separate the crossings."""
    from scipy.optimize import brentq  # takes a fifth of a second, so it is imported here

    sign = np.sign(curve(omega))
    between = np.flatnonzero(sign[1:] * sign[:-1] < 0)

    def value(at: float) -> float:
        return float(curve(np.array([at]))[0])

    found = [brentq(value, omega[i], omega[i + 1]) for i in between]
    return np.append(omega[sign == 0], np.array(found, dtype=np.float64))


def _least(curve: Callable[[Array], Array], omega: Array) -> tuple[float, float]:
    """Return the least value of a curve and its frequency, searched around the least of `omega`."""
    from scipy.optimize import fminbound

    def value(at: float) -> float:
        return float(curve(np.array([at]))[0])

    omega = np.unique(omega)
    values = curve(omega)
    i = int(values.argmin())
    found = fminbound(value, omega[max(i - 1, 0)], omega[min(i + 1, omega.size - 1)])
    at = cast("float", found)
    return min((value(at), at), (float(values[i]), float(omega[i])))


def _frequencies(z: ComplexArray, *, sample_time: float) -> Array:
    """Return frequencies up to the Nyquist frequency, rad/s, denser near a pole."""
    nyquist = np.pi / sample_time
    s = np.log(z[np.abs(z) > np.exp(-np.pi)]) / sample_time  # faster poles need no dense grid
    slowest = np.abs(s[np.abs(s) > _NEAREST * nyquist]).min(initial=nyquist)
    lowest = min(_SLOWER * slowest, _SLOWER * nyquist)
    # 60 frequencies per decade, plus some around each mode.
    count = int(60 * np.log10(nyquist / lowest))
    band = np.geomspace(lowest, nyquist, count, endpoint=False)
    modes = s[s.imag > 0]
    width = np.maximum(-modes.real, _NEAREST * modes.imag)[:, None]
    away = 0.1 * width * (nyquist / (0.1 * width)) ** np.linspace(0.0, 1.0, _AROUND)
    near = np.concatenate([modes.imag[:, None] + away, modes.imag[:, None] - away])
    omega = np.unique(np.append(band, near))
    return omega[(omega >= lowest) & (omega < nyquist)]
