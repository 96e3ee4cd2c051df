"""Measured frequency response, from dwells or from step and sweep records; peaks and nulls."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.parametrisation import ASSUMED_ZETA
from pipeline.estimation.record_transforms import transfer_ratio, visible_band
from pipeline.names import (
    NULLS,
    gain_name,
    mode_suffixes,
    mode_zeta,
    omega_names,
    own_omega,
    parameter_names,
)
from pipeline.results import Estimate, FrequencyResponse, Record, SinePoint

# Largest relative standard error of a record's response; other frequencies are dropped.
_LARGEST_RELATIVE_STD = 0.2
# Two dwells are repeats if their frequencies differ by less than this. A fitted frequency is
# accurate to some 1e-4. Within this limit, no response changes by more than its standard error.
_SAME_FREQUENCY = 1e-3
# No bench measures more accurately, and exact data would get infinite weight.
_SMALLEST_RELATIVE_STD = 1e-6


# A mode has been passed where the response has fallen by this factor from low frequencies.
_CLEAR_FALL = 3.0
# Share of the first resonance. At a lower frequency, the magnitude gives the static gain.
_LOW_SHARE = 0.7


# ---------------------------------------------------------------------- dwells


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
        if point.omega > before.omega * (1 + _SAME_FREQUENCY):
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
    omega, magnitude, magnitude_std, phase, phase_std = np.array(rows).T
    return FrequencyResponse(
        cart=cart,
        omega=omega,
        magnitude=magnitude,
        magnitude_std=magnitude_std,
        phase=phase,
        phase_std=phase_std,
        source="dwells",
        experiments=tuple(p.experiment for p in ordered),
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


def response_from_records(records: Sequence[Record]) -> tuple[FrequencyResponse, ...]:
    """Return the frequency response of each cart from step and sweep records with all carts free.

    Each record gives a ratio of transforms (`record_transforms`). These ratios are averaged with
    weights, and their scatter is included in the standard error. Only frequencies at which the
    input moves the cart are returned.

    Raises
    ------
    DataError : no record has an input that changes, or no record gives a usable frequency.
    """
    runs = [r for r in records if r.u is not None and np.any(r.u != 0) and r.t.size > 16]
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
        response = _combined(omega, rows, cart=cart)
        if response.omega.size:
            measured = tuple(run.id for run in runs if cart in run.carts)
            responses.append(replace(response, experiments=measured))
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


def _combined(
    omega: Array, rows: Sequence[tuple[ComplexArray, Array]], *, cart: int
) -> FrequencyResponse:
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
    columns = np.array(points).reshape(-1, 5).T
    return FrequencyResponse(
        cart=cart,
        omega=columns[0],
        magnitude=columns[1],
        magnitude_std=columns[2],
        phase=columns[3],
        phase_std=columns[4],
        source="records",
    )


# ------------------------------------------------------------- peaks and nulls


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
    names = set(parameter_names(n))
    found: dict[str, Estimate] = {}
    modes = _shared_peaks(seen, n=n)
    if len(modes) == n - 1 and n in by_cart:
        modes = _with_damped_mode(by_cart[n], modes)
    nulls = {cart: _between(_extrema(r, sign=-1), modes) for cart, r in by_cart.items()}
    symbols = mode_suffixes(n)
    if len(modes) == n:
        found |= _estimates(omega_names(symbols), modes)
    lowest = modes[0].omega if len(modes) == n else None
    for cart, response in sorted(by_cart.items()):
        gain = _low_frequency_gain(response, resonance=lowest)
        found |= {gain_name(cart, n=n): gain} if gain else {}
    if n > 1 and n - 1 in by_cart:
        found |= _estimates([own_omega(n, n=n)], _strongest(nulls[n - 1], 1))
    if n == 3 and 1 in by_cart:
        found |= _estimates(omega_names(NULLS), _strongest(nulls[1], 2))
    assumed = [mode_zeta(suffix) for suffix in (*symbols, *NULLS)]
    # The carts share the peaks, which also correct the gains.
    runs = tuple(dict.fromkeys(run for response in seen for run in response.experiments))
    measured = {name: replace(one, experiments=runs) for name, one in found.items()}
    return measured | {
        name: Estimate(value=ASSUMED_ZETA, std=None, source="assumed")
        for name in assumed
        if by_cart and name in names
    }


def _estimates(names: Sequence[str], extrema: Sequence[_Extremum]) -> Mapping[str, Estimate]:
    """Name extrema in ascending order; {} if there are more or fewer extrema than names."""
    if len(names) != len(extrema):
        return {}
    return {
        name: Estimate(value=e.omega, std=e.std, source="frequency_response")
        for name, e in zip(names, sorted(extrema), strict=True)
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
    usable = found[fall > np.log(_CLEAR_FALL)]
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
