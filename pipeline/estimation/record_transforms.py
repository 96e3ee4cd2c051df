"""The frequency response from one step or sweep record, whether or not the carts rest at its ends.

If a record begins and ends at rest, even displaced, the ratio FT(y')/FT(u') of the derivatives'
transforms is exact, without a data window. Any other record is evaluated by local polynomials. The
unknown motion before and after the record adds a smooth term in frequency, which is fitted too.

Reference: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed.,
section 7.2 (the local polynomial method).
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.estimation.noise import difference_gain
from pipeline.results import Record

# Least input, as a share of its strongest line. A weaker input does not excite the plant.
_LEAST_INPUT_SHARE = 0.01
# Least input, as a share of its strongest neighbour. At a null of the input's spectrum (every
# second harmonic of a step on and off), the effect of any nonlinearity would be divided by almost
# zero.
_LEAST_NEIGHBOUR_SHARE = 0.25
_NEIGHBOURS = 2  # frequencies on each side
# Largest share of its travel that a cart may move in the first three samples of a record that
# begins at rest. After a step at the first sample, it moves by u t²/2m in two samples. This is 3 %
# with samples 9 ms apart and a mode at 20 rad/s.
_START_SWING = 0.03
_HALF_WINDOWS, _DEGREE = (4, 6), 2  # lines on each side, and degree, of the local polynomials


class TransferRatio(NamedTuple):
    """G (n_carts, n_w), and its standard error per component; infinite where not excited."""

    G: ComplexArray
    std: Array


def transfer_ratio(run: Record, *, omega: Array) -> TransferRatio:
    """Return the frequency response of one driven record at `omega` (n_w,), rad/s."""
    if run.u is None:
        raise ValueError(f"{run.id}: a transfer ratio needs the input")
    return _at_rest_ratio(run, run.u, omega) or _local_ratio(run, run.u, omega)


def visible_band(run: Record) -> float:
    """Return the highest frequency, rad/s, at which some cart's motion exceeds its noise.

    It only limits a grid of frequencies, so the mean sample interval is accurate enough.
    """
    dt, duration = run.sample_time, run.t[-1] - run.t[0]
    omega = 2 * np.pi * np.fft.rfftfreq(run.t.size - 1, dt)
    floor = _noise(run)[:, None] * omega * np.sqrt(dt * duration)
    # At one frequency, noise alone exceeds three sigma with probability e^-9, too rarely to matter.
    visible = np.any(np.abs(np.fft.rfft(np.diff(run.y))) > 3 * floor, axis=0)
    # The encoders have no filter, so higher frequencies suffer from aliasing.
    visible &= omega <= 0.4 * np.pi / dt
    return float(np.max(omega[visible], initial=0.0))


def _derivative_transforms(
    run: Record, u: Array, omega: Array, *, u_before: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return FT(u') (n_w,) and FT(y') (n_carts, n_w) over the record, at its own sample times."""
    between = _turning((run.t[1:] + run.t[:-1]) / 2, omega)
    # Between the samples, y is assumed to be straight, so FT is the sum of increments times a sinc.
    # Division by sinc² restores the part of a smooth signal that straight lines lose.
    smooth = 1.0 / np.sinc(omega * run.sample_time / (2 * np.pi))
    y_transform = np.diff(run.y) @ between * smooth
    if run.hold == "band_limited":
        return np.diff(u) @ between * smooth, y_transform
    jumps = np.diff(u, prepend=u_before)
    at = np.flatnonzero(jumps)
    return jumps[at] @ _turning(run.t[at], omega), y_transform


def _turning(t: Array, omega: Array) -> ComplexArray:
    return np.exp(-1j * np.outer(t, omega)).astype(np.complex128)


def _at_rest_ratio(run: Record, u: Array, omega: Array) -> TransferRatio | None:
    """Return FT(y')/FT(u') of a record that begins and ends at rest; None for any other record."""
    travel = np.ptp(run.y, axis=1)
    noise = _noise(run)
    # The last tenth of the record must be at rest.
    tail = run.t >= run.t[-1] - 0.1 * (run.t[-1] - run.t[0])
    ring = np.ptp(run.y[:, tail], axis=1)
    quiet = np.maximum(8 * noise, 2 * run.resolution)  # largest range of a cart that stands still
    # A cart is also at rest if it moves by less than a hundredth of its whole travel.
    moving = np.ptp(u[tail]) > 0 or np.any(ring > np.maximum(quiet, 0.01 * travel))
    starts_moving = np.any(np.ptp(run.y[:, :3], axis=1) > np.maximum(quiet, _START_SWING * travel))
    if moving or starts_moving:
        return None
    first_change = int(np.argmax(u != u[0]))
    waits = first_change > 3 and np.all(np.ptp(run.y[:, :first_change], axis=1) <= quiet)
    U, Y = _derivative_transforms(run, u, omega, u_before=float(u[0]) if waits else 0.0)
    excess = np.maximum(ring - quiet, 0.0) / 2
    duration = run.t[-1] - run.t[0]
    # A remaining swing r at the end causes an error of up to r / 2ζ, here with ζ = 0.05.
    std = np.sqrt(
        noise[:, None] ** 2 * (2 + omega**2 * run.sample_time * duration) / 2
        + (10.0 * excess[:, None]) ** 2
    )
    return _ratio(Y, U, std=std)


def _ratio(Y: ComplexArray, U: ComplexArray, *, std: Array) -> TransferRatio:
    size = np.abs(U)
    around = sliding_window_view(np.pad(size, _NEIGHBOURS), 2 * _NEIGHBOURS + 1).max(axis=-1)
    excited = size > np.maximum(_LEAST_INPUT_SHARE * np.max(size), _LEAST_NEIGHBOUR_SHARE * around)
    U = np.where(excited, U, 1.0)
    return TransferRatio(G=Y / U, std=np.where(excited, std / np.abs(U), np.inf))


def _noise(run: Record) -> Array:
    """Return the standard deviation (n_carts,) of noise or encoder rounding, the larger one."""
    white = np.std(np.diff(run.y, n=3, axis=1), axis=1) / difference_gain(3)
    return np.maximum(white, run.resolution / np.sqrt(12.0))


def _local_ratio(run: Record, u: Array, omega: Array) -> TransferRatio:
    """Return G by local polynomials: FT(y') = G FT(u') + effect of the ends; both are smooth.

    The difference between the results for two widths of the polynomials is added to the standard
    error. Near a sharp resonance of a short record, it is the larger part.
    """
    base = 2 * np.pi / (run.t[-1] - run.t[0])
    lines = np.arange(1, int(omega[-1] / base) + max(_HALF_WINDOWS) + 2)
    U, Y = _line_transforms(run, u, lines)
    narrow, wide = (
        _local_polynomials(U, Y, place=omega / base, half=half) for half in _HALF_WINDOWS
    )
    excited = np.interp(omega, lines * base, np.abs(U)) > _LEAST_INPUT_SHARE * np.max(np.abs(U))
    std = np.hypot(narrow.std, np.abs(narrow.G - wide.G) / np.sqrt(2))
    return TransferRatio(G=narrow.G, std=np.where(excited, std, np.inf))


def _line_transforms(
    run: Record, u: Array, lines: NDArray[np.intp]
) -> tuple[ComplexArray, ComplexArray]:
    """Return FT(u') and FT(y') at harmonics of the record length; by FFT if time is uniform."""
    dt, base = run.sample_time, 2 * np.pi / (run.t[-1] - run.t[0])
    # Differences up to this share of an interval are rounding of a uniform time axis.
    if np.max(np.abs(np.diff(run.t) - dt)) > 1e-3 * dt:
        return _derivative_transforms(run, u, lines * base, u_before=float(u[0]))
    smooth = 1.0 / np.sinc(lines * base * dt / (2 * np.pi))
    U, Y = np.fft.rfft(np.diff(u))[lines], np.fft.rfft(np.diff(run.y))[:, lines] * smooth
    # A held input changes at the later sample of an interval, half an interval after its middle.
    half = smooth if run.hold == "band_limited" else np.exp(-0.5j * lines * base * dt)
    return U * half, Y


def _local_polynomials(
    U: ComplexArray, Y: ComplexArray, *, place: Array, half: int
) -> TransferRatio:
    """Fit local polynomials to the spectral lines near each `place` (n_w,), in line numbers.

    Line numbers begin at 1. A fit uses up to `half` lines on each side of the nearest one.
    """
    width = 2 * half + 1
    first = np.clip(np.rint(place).astype(int) - 1 - half, 0, U.size - width)
    window = first[:, None] + np.arange(width)  # (n_w, width)
    away = (window + 1 - place[:, None]) / half
    powers = away[:, :, None] ** np.arange(_DEGREE + 1)
    regressors = np.concatenate([powers * U[window][:, :, None], powers], axis=2)
    # Singular values below this share are rounding.
    inverse = np.linalg.pinv(regressors, rcond=1e-9)
    measured = Y[:, window]  # (n_carts, n_w, width)
    found = np.einsum("wpj,cwj->cwp", inverse, measured)
    misfit = measured - np.einsum("wjp,cwp->cwj", regressors, found)
    freedom = width - 2 * (_DEGREE + 1)
    variance = np.sum(np.abs(misfit) ** 2, axis=2) / freedom / 2  # per real or imaginary part
    gain = np.sum(np.abs(inverse[:, 0, :]) ** 2, axis=1)
    return TransferRatio(G=found[:, :, 0], std=np.sqrt(variance * gain))
