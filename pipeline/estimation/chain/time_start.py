"""A start for the time-domain fit, found by linear regression alone.

Each cart's equation of motion is multiplied by a bump φ and integrated by parts (`modulating`). The
result is

    m_i ∫ x_i φ'' - c_i ∫ x_i φ' + k_i ∫ (x_i - x_{i-1}) φ + k_{i+1} ∫ (x_i - x_{i+1}) φ = ∫ u φ.

Cart 1's equation gives its mass, damping and springs in input units. The equation of each further
cart gives them relative to the spring before it. An encoder zero acts as a constant force in its
record.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.chain.parametrisation import even_chain, physical_start
from pipeline.estimation.chain.time_window import FitWindow
from pipeline.estimation.modulating import bump, bump_integral
from pipeline.plant.chain import Chain
from pipeline.set_up import Bench

WIDTHS = (0.15, 0.3, 0.6, 1.2)  # s; a bump should last about one period of the carts
_HOP = 0.25  # distance of bumps over their width; they overlap, so closer bumps add little
_MOST_BUMPS = 400  # bumps in a record; more would only take time
_FEWEST_SAMPLES = 8  # samples in a bump; fewer do not integrate φ'' well
_FEWEST_PERIODS = 2  # periods of the slowest resonance to try, in the longest record
_FEWEST_PER_PERIOD = 8  # samples in a period of the fastest resonance to try
_FREQUENCY_STEP = 1.5  # frequency ratio of successive chains; the fit converges from a third away
_SWING_OVER_GAIN = 1.6  # range of a lightly damped cart after a step, over its static change
_SMALLEST_ZETA = 0.005  # least damping ratio, because noise may make a regressed damping negative


def regress_chain(windows: Sequence[FitWindow], *, bench: Bench, width: float) -> Chain | None:
    """Regress a chain from the windows, with bumps of `width` (s).

    The result is None if some cart's equation cannot be set up, because the cart or a free
    neighbour was not measured. It is also None if the equation gives an impossible value (a
    negative mass or coupling).
    """
    n = bench.n
    m, c, k = np.zeros(n), np.zeros(n), np.zeros(n + 1)
    moments = [_moments(window, n=n, width=width) for window in windows]
    for cart in range(1, n + 1):
        seen = [
            moment
            for window, moment in zip(windows, moments, strict=True)
            if moment is not None and _has_equation(window, cart, n)
        ]
        if not seen:
            return None
        rows, targets = zip(*(_equation(cart, bench, *moment) for moment in seen), strict=True)
        zeros = np.zeros((sum(map(len, rows)), len(rows)))  # a constant force in each record
        ends = np.cumsum([0, *map(len, rows)])
        for column, (first, last) in enumerate(pairwise(ends)):
            zeros[first:last, column] = 1.0
        columns = np.hstack([np.concatenate(rows), zeros])
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0] = 1.0
        found = np.linalg.lstsq(columns / scale, np.concatenate(targets), rcond=None)[0] / scale
        unit = 1.0 if cart == 1 else k[cart - 1]
        m[cart - 1], c[cart - 1], k[cart] = unit * found[:3]
        if cart == 1:
            k[0] = found[3]
        if not m[cart - 1] > 0 or (cart < n and not k[cart] > 0):
            return None
    start = physical_start(Chain(m=m, c=c, k=k), bench=bench)
    omega = np.maximum(start.omega_carts, 1 / width)
    return Chain(m=start.m, c=np.maximum(c, 2 * _SMALLEST_ZETA * omega * start.m), k=start.k)


def _has_equation(window: FitWindow, cart: int, n: int) -> bool:
    """Return whether a cart's equation can be set up: it moves, and all forces on it are known."""
    near = {j for j in (cart - 1, cart, cart + 1) if 1 <= j <= n and j in window.free}
    driven = cart > 1 or window.drive_u is not None
    return driven and cart in window.free and near <= set(window.carts)


def _equation(cart: int, bench: Bench, x: Array, force: Array) -> tuple[Array, Array]:
    """Return the columns of m, c and the springs of a cart's equation, and its right side.

    The spring before the cart is a column only for cart 1; otherwise it is the right side. `x` (3,
    n + 2, n_b) holds the moments of walls and carts with φ, φ', φ''; `force` (n_b,) holds the
    moments of the input.
    """
    stretch = x[0, cart] - x[0, cart - 1], x[0, cart] - x[0, cart + 1]
    columns = [x[2, cart], -x[1, cart], stretch[1] * bench.stiff[cart]]
    if cart > 1:
        return np.stack(columns, axis=1), -stretch[0]
    columns.append(stretch[0] * bench.stiff[0])
    return np.stack(columns, axis=1), force


def _moments(window: FitWindow, *, n: int, width: float) -> tuple[Array, Array] | None:
    """Return the moments (3, n + 2, n_b) of the positions with φ, φ', φ'', and (n_b,) of the input.

    φ = (τ (1 - τ))⁴, with τ from 0 to 1 over the bump. Walls, held and unmeasured carts are at
    zero. The result is None if the record is shorter than two bumps, or if a bump holds too few
    samples.
    """
    t, duration = window.t, window.t[-1]
    if duration < 2 * width or t.size * width / duration < _FEWEST_SAMPLES:
        return None
    count = min(int((duration - width) / (_HOP * width)) + 1, _MOST_BUMPS)
    starts = np.linspace(0.0, duration - width, count)
    around = _around(t, starts, width)
    tau = np.clip((t[around] - starts[:, None]) / width, 0.0, 1.0)
    bumps = np.stack(bump(tau, span=width))
    bumps *= np.gradient(t)[around]  # trapezoidal rule, accurate because bumps end smoothly
    x = np.zeros((3, n + 2, count))
    for cart, y in zip(window.carts, window.y, strict=True):
        x[:, cart] = np.einsum("dbi,bi->db", bumps, y[around])
    force = np.zeros(count)
    if window.drive_u is not None:
        around = _around(window.drive_t, starts, width)
        tau = np.clip((window.drive_t[around] - starts[:, None]) / width, 0.0, 1.0)
        # ∫ φ between samples. The input is held between samples, so its moment is exact.
        area = width * bump_integral(tau)
        force = np.sum(window.drive_u[around][:, :-1] * np.diff(area, axis=1), axis=1)
    return x, force


def _around(t: Array, starts: Array, width: float) -> np.ndarray:
    """Return indices (n_b, n_k) of the samples in each bump, and of one sample on either side."""
    first = np.searchsorted(t, starts, side="right") - 1
    last = np.searchsorted(t, starts + width, side="left")
    return np.minimum(first[:, None] + np.arange(np.max(last - first) + 1), t.size - 1)


def even_chains(windows: Sequence[FitWindow], *, bench: Bench) -> list[Chain]:
    """Return chains of equal carts, from slow to fast, with about the static gain of the records.

    They serve for records that a regression cannot use, such as one with an unmeasured cart. Their
    frequencies cover all that the records can show.
    """
    driven = [window for window in windows if window.drive_u is not None]
    # The input may be on from the first sample, so its range includes zero.
    ranges = [np.ptp(np.append(0.0, w.drive_u)) for w in driven if w.drive_u is not None]
    swing = np.median([np.ptp(w.y[0]) / u for w, u in zip(driven, ranges, strict=True)])
    slowest = 2 * np.pi * _FEWEST_PERIODS / max(w.t[-1] for w in driven)
    fastest = 2 * np.pi / (_FEWEST_PER_PERIOD * min(float(np.median(np.diff(w.t))) for w in driven))
    if not swing > 0 or fastest <= slowest or not bench.tied:
        return []  # without a spring to a wall there is no static gain
    ratio = fastest / slowest
    count = int(np.log(ratio) / np.log(_FREQUENCY_STEP)) + 1
    chains = []
    for omega in slowest * ratio ** (np.arange(count + 1) / count):
        values = {"K_1": swing / _SWING_OVER_GAIN, "omega_a": omega}
        chains.append(even_chain(values, bench=bench))
    return chains
