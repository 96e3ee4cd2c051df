"""A careful student with a textbook, a ruler and a curve fit, but not the pipeline's methods.

Levels are means over the last part of a step. Periods and decrements are read off the peaks, and
amplitudes are half the swing of the last cycles. Bode magnitudes are fitted in dB, last cart first,
as in Throne (2005); the other numbers follow from the coefficients.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import find_peaks

from pipeline.arrays import Array
from pipeline.results import Record

MODES = "abcdefgh"
LEAST_SWING = 20  # encoder steps; a cart that moves less may be stuck


def settled(y: Array) -> float:
    return float(y[-max(3, y.size // 7) :].mean())


def gain(record: Record, cart: int) -> float | None:
    """Return the gain at the first edge: change of level divided by change of input."""
    assert record.u is not None
    edges = np.flatnonzero(np.diff(record.u)) + 1
    if not edges.size:
        return None
    start, end = edges[0], edges[1] if edges.size > 1 else record.t.size
    y = record.position(cart)
    return (settled(y[start:end]) - float(y[:start].mean())) / float(record.u[start])


def decay(record: Record, cart: int) -> tuple[float, float] | None:
    """Return (omega_n, zeta) from the first peaks after the release or the edge of a step."""
    y = record.position(cart) - settled(record.position(cart))
    if record.u is not None and np.any(record.u):
        y = y[np.flatnonzero(np.diff(record.u))[-1] + 1 :]
    y = y if np.abs(y.max()) > np.abs(y.min()) else -y
    peaks, _ = find_peaks(y, prominence=0.08 * np.ptp(y), distance=5)
    peaks = peaks[peaks > np.argmin(y)] if np.argmin(y) < y.size // 2 else peaks
    peaks = peaks[y[peaks] > 0.06 * np.ptp(y)][:6]
    if peaks.size < 2:
        return None
    t, periods = record.t - record.t[0], peaks.size - 1
    period = float(t[peaks[-1]] - t[peaks[0]]) / periods
    delta = float(np.log(y[peaks[0]] / y[peaks[-1]])) / periods
    zeta = delta / float(np.hypot(2 * np.pi, delta))
    return 2 * np.pi / period / float(np.sqrt(1 - zeta**2)), zeta


def bode(records: Sequence[Record], cart: int) -> tuple[Array, Array]:
    """Return (omega, amplitude ratio) of each dwell, from half the swing of its last cycles."""
    points = []
    for record in records:
        if record.kind == "sine" and record.omega and record.u is not None:
            last = record.t >= record.t[-1] - 3 * 2 * np.pi / record.omega
            swing = np.ptp(record.position(cart)[last])
            if min(np.ptp(y[last]) for y in record.y) > LEAST_SWING * max(record.resolution):
                points.append((record.omega, float(swing / np.ptp(record.u[last]))))
    omega, ratio = np.array(sorted(points)).T
    return omega, ratio


def initial_table(records: Sequence[Record], n: int) -> dict[str, float]:
    """Return the initial estimates; numbers that cannot be read are left out."""
    table: dict[str, float] = {}
    for cart in range(1, n + 1):
        suffix = "" if n == 1 else f"_{cart}"
        gains = [
            g
            for r in records
            if r.kind == "step" and cart in r.carts and cart in r.free
            if len(r.free) == n and (g := gain(r, cart)) is not None
        ]
        alone = [
            d
            for r in records
            if r.kind in ("decay", "step") and r.free == (cart,)
            if (d := decay(r, cart)) is not None
        ]
        if gains:
            table[f"K{suffix}"] = float(np.mean(gains))
        if alone:
            table["omega_n" if n == 1 else f"omega{suffix}"] = float(np.mean([o for o, _ in alone]))
            table[f"zeta{suffix}"] = float(np.mean([z for _, z in alone]))
    return table


def by_eye(records: Sequence[Record], n: int) -> dict[str, float]:
    """Return resonances of the last cart and nulls of the first, read at the nearest dwells."""
    omega, last = bode(records, n)
    _, first = bode(records, 1)
    slope = np.log(np.concatenate([last[:1] * 0.9, last, last[-1:] * 0.5]))
    peaks, found = find_peaks(slope, prominence=0.02)
    names = MODES[:n]
    table = {}
    strongest = np.sort(peaks[np.argsort(-found["prominences"])][:n]) - 1
    if strongest.size == n:
        table |= {f"omega_{x}": float(omega[i]) for x, i in zip(names, strongest, strict=True)}
    if n == 3:
        nulls, depth = find_peaks(-np.log(first), prominence=0.05)
        deepest = np.sort(nulls[np.argsort(-depth["prominences"])][:2])
        if deepest.size == 2:
            table |= {"omega_x": float(omega[deepest[0]]), "omega_y": float(omega[deepest[1]])}
    table |= {name.replace("omega", "zeta"): 0.1 for name in table}
    return table


def _factor(s: np.ndarray, omega: float, zeta: float) -> np.ndarray:
    return (s / omega) ** 2 + 2 * zeta * s / omega + 1


def _fit(omega: Array, ratio: Array, start: list[float], shape) -> list[float]:
    """Fit K and (omega, zeta) pairs in dB; `shape` gives the frequency response without K."""

    def off(log: Array) -> Array:
        values = np.exp(log)
        return 20 * np.log10(values[0] * np.abs(shape(1j * omega, values[1:])) / ratio)

    found = least_squares(
        off, np.log(start), max_nfev=300, bounds=(np.log(start) - 2, np.log(start) + 2)
    )
    return np.exp(found.x).tolist()


def final_table(records: Sequence[Record], n: int, initial: dict[str, float]) -> dict[str, float]:
    """Return the fitted parameters; the last cart is fitted first and gives the denominator."""
    omega, last = bode(records, n)
    if n == 1:
        start = [initial.get("K", float(last[0])), initial["omega_n"], initial["zeta"]]
        values = _fit(omega, last, start, lambda s, p: 1 / _factor(s, *p))
        return dict(zip(("K", "omega_n", "zeta"), values, strict=True))
    modes = [f"_{x}" for x in MODES[:n]]
    start = [initial.get(f"K_{n}", float(last[0]))]
    for m in modes:
        start += [initial[f"omega{m}"], 0.1]
    values = _fit(
        omega,
        last,
        start,
        lambda s, p: 1 / np.prod([_factor(s, *p[i : i + 2]) for i in range(0, 2 * n, 2)], axis=0),
    )
    table = {f"K_{n}": values[0]}
    denominator = np.ones_like(omega, dtype=complex)
    for i, m in enumerate(modes):
        table |= {f"omega{m}": values[1 + 2 * i], f"zeta{m}": values[2 + 2 * i]}
        denominator = denominator * _factor(1j * omega, *values[1 + 2 * i : 3 + 2 * i])
    zeros = {2: {1: ["_2"]}, 3: {2: ["_3"], 1: ["_x", "_y"]}}[n]
    for cart, own in zeros.items():
        _, ratio = bode(records, cart)
        start = [initial.get(f"K_{cart}", float(ratio[0]))]
        for m in own:
            start += [initial[f"omega{m}"], initial.get(f"zeta{m}", 0.1)]
        values = _fit(
            omega,
            ratio * np.abs(denominator),
            start,
            lambda s, p: np.prod([_factor(s, *p[i : i + 2]) for i in range(0, p.size, 2)], axis=0),
        )
        table[f"K_{cart}"] = values[0]
        for i, m in enumerate(own):
            table |= {f"omega{m}": values[1 + 2 * i], f"zeta{m}": values[2 + 2 * i]}
    return table | _recomputed(table, n)


def _recomputed(p: dict[str, float], n: int) -> dict[str, float]:
    """Return the carts' numbers computed from the coefficients, without impossible ones."""

    def quadratic(x: str) -> Array:
        return np.array([1.0, 2 * p[f"zeta_{x}"] * p[f"omega_{x}"], p[f"omega_{x}"] ** 2])

    d = np.array([1.0])
    for x in MODES[:n]:
        d = np.polymul(d, quadratic(x))
    found = {}
    if n == 2:
        _, g2, w2 = quadratic("2")
        g1 = d[1] - g2
        found["1"] = (d[2] - w2 - g1 * g2, g1)
    else:
        z = np.polymul(quadratic("x"), quadratic("y"))
        _, g3, w3 = quadratic("3")
        g2, g1 = z[1] - g3, d[1] - z[1]
        found["2"] = (z[2] - w3 - g2 * g3, g2)
        found["1"] = (d[2] - z[2] - g1 * z[1], g1)
    table = {}
    for cart, (square, twice) in found.items():
        if square > 0 and twice > 0:
            table[f"omega_{cart}"] = float(np.sqrt(square))
            table[f"zeta_{cart}"] = float(twice / (2 * np.sqrt(square)))
    return table
