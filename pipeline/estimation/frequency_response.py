"""Measured frequency response, from dwells or from step and sweep records; peaks and nulls."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline import names
from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.noise import difference_gain
from pipeline.estimation.parametrisation import ASSUMED_ZETA
from pipeline.results import Estimate, FrequencyResponse, Record, SinePoint

# ---------------------------------------------------- the response from one step or sweep record
#
# If a record begins and ends at rest, even displaced, the ratio FT(y')/FT(u') of the derivatives'
# transforms is exact, without a data window. Any other record is evaluated by local polynomials.
# The unknown motion before and after the record adds a smooth term in frequency, which is fitted
# too.
#
# Reference: Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed.,
# section 7.2 (the local polynomial method).

# Least input, as a share of its strongest line. A weaker input does not excite the plant.
_LEAST_INPUT_SHARE = 0.01
_NEIGHBOURS = 2  # frequencies on each side
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
    # After a step at the first sample, a cart at rest moves by u t²/2m in two samples. This is 3 %
    # of its travel with samples 9 ms apart and a mode at 20 rad/s.
    starts_moving = np.any(np.ptp(run.y[:, :3], axis=1) > np.maximum(quiet, 0.03 * travel))
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
    # At a null of the input's spectrum (every second harmonic of a step on and off), the effect of
    # any nonlinearity would be divided by almost zero. So the input must be at least a quarter of
    # its strongest neighbour.
    excited = size > np.maximum(_LEAST_INPUT_SHARE * np.max(size), 0.25 * around)
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


# ---------------------------------------------------------------------- dwells

# No bench measures more accurately, and exact data would get infinite weight.
_SMALLEST_RELATIVE_STD = 1e-6


def dwell_fault(point: SinePoint) -> str:
    """Return why a dwell gives no point of a frequency response; "" if it does."""
    if not point.input_amplitude > 0:
        return "a frequency response needs a sinusoidal input, found none"
    if not all(np.isfinite(x) and x > 0 for x in (point.omega, point.gain, point.gain_std)):
        return (
            "a frequency response needs a frequency and an amplitude ratio with its error, found "
            f"{point.omega:.3g} rad/s and {point.gain:.3g} ± {point.gain_std:.3g}"
        )
    return ""


def collect_dwells(points: Sequence[SinePoint]) -> tuple[FrequencyResponse, ...]:
    """Collect dwells into one frequency response per cart; repeats become one point.

    Repeats are combined to their weighted mean. Its standard error grows if the repeats scatter by
    more than their own errors allow. A dwell with a `dwell_fault` is not used.

    Raises
    ------
    DataError : no dwell gives a point.
    """
    usable = [p for p in points if not dwell_fault(p)]
    if not usable:
        raise DataError(
            "frequency response: dwells need a sinusoidal input, found no dwell with one"
        )
    return tuple(
        _collect_cart([p for p in usable if p.cart == cart], cart=cart)
        for cart in sorted({p.cart for p in usable})
    )


def _collect_cart(points: Sequence[SinePoint], *, cart: int) -> FrequencyResponse:
    ordered = sorted(points, key=lambda p: p.omega)
    groups = [[ordered[0]]]
    for before, point in pairwise(ordered):
        # Two dwells are repeats if their frequencies differ by less than 0.1 %. A fitted frequency
        # is accurate to some 1e-4, and within this limit no response changes by more than its
        # error.
        if point.omega > before.omega * 1.001:
            groups.append([])
        groups[-1].append(point)
    rows = []
    for group in groups:
        magnitude, magnitude_std = _weighted_mean(
            np.array([p.gain for p in group]), np.array([p.gain_std for p in group])
        )
        around = group[0].phase
        turn, phase_std = _weighted_mean(
            _wrapped(np.array([p.phase for p in group]) - around),
            np.array([p.phase_std for p in group]),
        )
        omega = float(np.mean([p.omega for p in group]))
        phase = float(_wrapped(np.array(around + turn)))
        rows.append((omega, magnitude, magnitude_std, phase, phase_std))
    measured = tuple(p.experiment for p in ordered)
    return _response(rows, cart=cart, source="dwells", experiments=measured)


def _response(
    rows: Sequence[tuple[float, ...]],
    *,
    cart: int,
    source: Literal["dwells", "records"],
    experiments: tuple[str, ...],
) -> FrequencyResponse:
    """Return the response from rows of omega, magnitude, phase and their errors."""
    omega, magnitude, magnitude_std, phase, phase_std = np.array(rows).T
    return FrequencyResponse(
        cart=cart,
        omega=omega,
        magnitude=magnitude,
        magnitude_std=magnitude_std,
        phase=phase,
        phase_std=phase_std,
        source=source,
        experiments=experiments,
    )


def _wrapped(phase: Array) -> Array:
    return np.angle(np.exp(1j * phase))


def _weighted_mean(values: Array, std: Array) -> tuple[float, float]:
    """Return the weighted mean and its standard error, including scatter beyond `std` (Birge)."""
    floor = _SMALLEST_RELATIVE_STD * max(float(np.max(np.abs(values))), _SMALLEST_RELATIVE_STD)
    weight = 1.0 / np.maximum(std, floor) ** 2
    mean = float(np.sum(weight * values) / np.sum(weight))
    error = float(1.0 / np.sqrt(np.sum(weight)))
    if values.size == 1:
        return mean, error
    birge = float(np.sum(weight * (values - mean) ** 2) / (values.size - 1))
    return mean, error * max(1.0, birge**0.5)


# --------------------------------------------------------------------- records

# Largest relative standard error of a record's response; other frequencies are dropped.
_LARGEST_RELATIVE_STD = 0.2


def response_from_records(records: Sequence[Record]) -> tuple[FrequencyResponse, ...]:
    """Return the frequency response of each cart from step and sweep records with all carts free.

    Each record gives a ratio of transforms (`transfer_ratio`). These ratios are averaged with
    weights, and their scatter is included in the standard error. Only frequencies at which the
    input moves the cart are returned.

    Raises
    ------
    DataError : no record has an input that changes, or no record gives a usable frequency.
    """
    runs = [r for r in records if np.any(r.input != 0) and r.t.size > 16]
    if not runs:
        raise DataError("frequency response: needs a step or sweep with its input, found none")
    omega = _grid(runs)
    ratios = [transfer_ratio(run, omega=omega) for run in runs]
    responses = []
    for cart in sorted({cart for run in runs for cart in run.carts}):
        rows = [
            (ratio.G[run.carts.index(cart)], ratio.std[run.carts.index(cart)])
            for run, ratio in zip(runs, ratios, strict=True)
            if cart in run.carts
        ]
        if points := _combined(omega, rows):
            measured = tuple(run.id for run in runs if cart in run.carts)
            responses.append(_response(points, cart=cart, source="records", experiments=measured))
    if not responses:
        raise DataError(
            f"frequency response: the motion in {', '.join(run.id for run in runs)} is not above "
            "its noise at any frequency"
        )
    return tuple(responses)


def _grid(runs: Sequence[Record]) -> Array:
    """Return harmonics of the median record length, thinned to a logarithmic spacing."""
    base = 2 * np.pi / float(np.median([run.t[-1] - run.t[0] for run in runs]))
    top = max(int(max(visible_band(run) for run in runs) / base), 2)
    # This gives some five lines within the half-power width 2ζω of a mode with ζ = 0.05.
    count = int(np.log(top) / np.log(1.02)) + 2
    return base * np.unique(np.rint(np.geomspace(1, top, count)))


def _combined(omega: Array, rows: Sequence[tuple[ComplexArray, Array]]) -> list[tuple[float, ...]]:
    points = []
    for w in range(omega.size):
        G = np.array([row[0][w] for row in rows])
        std = np.array([row[1][w] for row in rows])
        good = std <= _LARGEST_RELATIVE_STD * np.abs(G)
        if not good.any():
            continue
        real, real_std = _weighted_mean(np.real(G[good]), std[good])
        imag, imag_std = _weighted_mean(np.imag(G[good]), std[good])
        magnitude, spread = abs(complex(real, imag)), max(real_std, imag_std)
        if spread <= _LARGEST_RELATIVE_STD * magnitude:
            phase = np.arctan2(imag, real)
            points.append((omega[w], magnitude, spread, phase, spread / magnitude))
    return points


# ------------------------------------------------------------- peaks and nulls

# Share of the first resonance. At a lower frequency, the magnitude gives the static gain.
_LOW_SHARE = 0.7


class _Extremum(NamedTuple):
    omega: float
    std: float
    prominence: float


def find_resonances(responses: Sequence[FrequencyResponse], *, n: int) -> dict[str, Estimate]:
    """Estimate resonances, nulls and gains from the measured magnitudes, as in Throne's paper.

    - Resonances are the peaks that the carts share. If one mode has too much damping for a peak, it
      is found from the fall of the last cart's response above the other modes. If fewer than n
      resonances are found, they get no names, because it is unknown which one is missing.
    - Nulls of cart 1 give omega_x and omega_y (three carts). Nulls of the last cart but one give
      the last cart's own frequency.
    - Gains are the magnitudes at the lowest frequency.
    - Dampings of modes and nulls are assumed.

    Only points above the noise count.
    """
    seen = [r.only(r.has_signal) for r in responses if r.has_signal.any()]
    by_cart = {response.cart: response for response in seen}
    wanted = set(names.parameter_names(n))
    found: dict[str, Estimate] = {}
    modes = _shared_peaks(seen, n=n)
    if len(modes) == n - 1 and n in by_cart:
        modes = _with_damped_mode(by_cart[n], modes)
    nulls = {cart: _between(_extrema(r, sign=-1), modes) for cart, r in by_cart.items()}
    symbols = names.mode_suffixes(n)
    if len(modes) == n:
        found |= _estimates(names.omega_names(symbols), modes)
    lowest = modes[0].omega if len(modes) == n else None
    for cart, response in sorted(by_cart.items()):
        gain = _low_frequency_gain(response, resonance=lowest)
        found |= {names.gain_name(cart, n=n): gain} if gain else {}
    if n > 1 and n - 1 in by_cart:
        found |= _estimates([names.own_omega(n, n=n)], _strongest(nulls[n - 1], 1))
    if n == 3 and 1 in by_cart:
        found |= _estimates(names.omega_names(names.NULLS), _strongest(nulls[1], 2))
    assumed = [names.mode_zeta(suffix) for suffix in (*symbols, *names.NULLS)]
    # The carts share the peaks, which also correct the gains.
    runs = tuple(dict.fromkeys(run for response in seen for run in response.experiments))
    measured = {name: replace(one, experiments=runs) for name, one in found.items()}
    return measured | {
        name: Estimate(value=ASSUMED_ZETA, std=None, source="assumed")
        for name in assumed
        if by_cart and name in wanted
    }


def _estimates(labels: Sequence[str], extrema: Sequence[_Extremum]) -> Mapping[str, Estimate]:
    """Name extrema in ascending order; {} if there are more or fewer extrema than labels."""
    if len(labels) != len(extrema):
        return {}
    return {
        name: Estimate(value=e.omega, std=e.std, source="frequency_response")
        for name, e in zip(labels, sorted(extrema), strict=True)
    }


def _between(extrema: Sequence[_Extremum], modes: Sequence[_Extremum]) -> list[_Extremum]:
    """Return the extrema below the highest mode, where a chain has its nulls."""
    top = max((mode.omega for mode in modes), default=np.inf)
    return [e for e in extrema if e.omega < top]


def _strongest(extrema: Sequence[_Extremum], count: int) -> list[_Extremum]:
    """Return the most prominent extrema, ascending in frequency."""
    return sorted(sorted(extrema, key=lambda e: -e.prominence)[:count])


def _extrema(response: FrequencyResponse, *, sign: int) -> list[_Extremum]:
    """Find the maxima (sign 1) or minima (sign -1) of ln|G| that exceed its standard errors."""
    seen = (response.omega > 0) & (response.magnitude > 0)
    omegas, magnitude = response.omega[seen], response.magnitude[seen]
    error = response.magnitude_std[seen] / magnitude
    level, position = sign * np.log(magnitude), np.log(omegas)
    found = []
    for i in range(1, level.size - 1):
        # A point with a larger relative error than 0.1 shows no peak.
        if not level[i - 1] < level[i] >= level[i + 1] or (sign > 0 and error[i] > 0.1):
            continue
        left, right = level[:i][::-1], level[i + 1 :]
        prominence = level[i] - max(_saddle(left, level[i]), _saddle(right, level[i]))
        # Least prominence of ln|G|: six standard errors, because noise alone reaches five in 40
        # points.
        if prominence < max(0.05, 6 * np.max(error[i - 1 : i + 2])):
            continue
        curve = np.polyfit(position[i - 1 : i + 2] - position[i], level[i - 1 : i + 2], 2)
        omega = omegas[i] * np.exp(-curve[1] / (2 * curve[0]))
        std = (omegas[i + 1] - omegas[i - 1]) / 2 / np.sqrt(12.0)
        found.append(_Extremum(float(omega), float(std), float(prominence)))
    return found


def _saddle(side: Array, peak: float) -> float:
    """Return the lowest level on one side before it rises above the peak."""
    higher = np.flatnonzero(side > peak)
    return float(np.min(side[: higher[0]] if higher.size else side))


def _shared_peaks(responses: Sequence[FrequencyResponse], *, n: int) -> list[_Extremum]:
    """Return up to n peaks: those that most carts show most clearly."""
    peaks = sorted((peak, r.cart) for r in responses for peak in _extrema(r, sign=1))
    clusters: list[dict[int, _Extremum]] = []  # at most one peak of each cart
    start = 0.0
    for peak, cart in peaks:
        # The carts share their resonances, so peaks within 0.15 in ln(omega) are one.
        if not clusters or np.log(peak.omega / start) > 0.15:
            clusters.append({})
            start = peak.omega
        rival = clusters[-1].get(cart)
        if rival is None or rival.prominence < peak.prominence:
            clusters[-1][cart] = peak
    merged = [
        max(cluster.values(), key=lambda peak: peak.prominence)._replace(
            prominence=sum(peak.prominence for peak in cluster.values())
        )
        for cluster in clusters
    ]
    return _strongest(merged, n)


def _with_damped_mode(response: FrequencyResponse, modes: Sequence[_Extremum]) -> list[_Extremum]:
    """Add the mode without a peak, from the decrease of the last cart above all other modes.

    Above the modes, |G_n| falls as K_n times the product of 1/|1 - (omega/omega_j)²|. Dividing by
    the factors of the known modes leaves 1/((omega/omega_0)² - 1).
    """
    top = max((mode.omega for mode in modes), default=0.0)
    above = (response.omega > 1.5 * top) & (response.magnitude > 0)
    starts_low = above.any() and response.omega[0] < _LOW_SHARE * response.omega[above][-1]
    if not starts_low or response.magnitude[0] <= 0:
        return list(modes)
    omega, magnitude = response.omega[above], response.magnitude[above]
    fall = np.log(response.magnitude[0] / magnitude)
    for mode in modes:
        fall -= np.log(np.abs(1 - (omega / mode.omega) ** 2))
    found = omega / np.sqrt(np.exp(np.maximum(fall, 0.0)) + 1)
    # Where the response has fallen to a third, a mode has been passed.
    usable = found[fall > np.log(3.0)]
    if usable.size == 0:
        return list(modes)
    std = float(np.std(usable)) + 0.1 * float(np.median(usable))
    return sorted([*modes, _Extremum(float(np.median(usable)), std, 0.0)])


def _low_frequency_gain(response: FrequencyResponse, *, resonance: float | None) -> Estimate | None:
    """Estimate K from the lowest frequency, corrected for the rise towards the first resonance."""
    if resonance is None or response.omega[0] > _LOW_SHARE * resonance:
        return None
    ratio = float(response.omega[0]) / resonance
    rise = abs(1 - ratio**2 + 2j * ASSUMED_ZETA * ratio)
    magnitude, std = float(response.magnitude[0]), float(response.magnitude_std[0])
    doubt = abs(rise - 1) / 2 * magnitude  # due to the assumed damping, and the modes above
    return Estimate(
        value=magnitude * rise, std=float(np.hypot(std, doubt)), source="frequency_response"
    )
