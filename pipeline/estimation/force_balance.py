"""The law of motion of one cart, from all records at once, and the force that it does not explain.

The acceleration of the cart is regressed on positions, velocities and input, with dry friction and
drag, over short windows. The problem is linear, so nothing is simulated or searched. The loss
function ignores data that do not follow the law.

Reference: S. Geman and D. E. McClure, Bull. Int. Statistical Institute 52 (1987) 5-21 (the loss).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump_integral, is_even, window_weights
from pipeline.estimation.noise import MEDIAN_TO_SIGMA, resolution
from pipeline.results import Record

_WINDOW = 0.1  # s; the middle 0.04 s have most of the weight
_LAGS = (0.0, 0.02, 0.05)  # trial delays of the input, s
# Columns of the law, in this order: rest and gain of each record; positions and inputs; dampers,
# drag and braking; dry friction, constant and proportional to the input.
_OWN, _POSITION = 2, 3
_SPRINGS, _DAMPERS, _DRY = slice(0, 8), slice(8, 13), slice(13, 15)
_ROUNDS, _SETTLED = 30, 1e-3  # most rounds of reweighting; change of the bulk at which they end
_BULK = 2.0  # standard deviations of the residual; data beyond have little weight


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordResidualForce:
    """The unexplained force on one cart in one record, over windows at `t` (n,).

    Attributes
    ----------
    residual : unexplained acceleration (n,). For a cart at rest, only the part that static friction
        cannot hold.
    acting : size (n,) of the acceleration, either in total or due to springs and input, whichever
        is larger.
    state : variables (5, n) of the law: position about the rest, stretches of both springs,
        velocity, input.
    moves : whether the cart moves (n,).
    jumps : whether the input jumps (n,), in the window or just before.
    idle : whether the cart rests without an input (n,).
    """

    record: Record
    t: Array
    residual: Array
    acting: Array
    state: Array
    moves: NDArray[np.bool_]
    jumps: NDArray[np.bool_]
    idle: NDArray[np.bool_]

    @property
    def follows(self) -> NDArray[np.bool_]:
        """Whether the law should hold (n,)."""
        return self.moves & ~self.jumps

    @property
    def hop(self) -> float:
        """The time between windows, s."""
        return _hop(self.record) * self.record.sample_time


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowMeans:
    """Means over windows (n,) of one record, for all carts' laws.

    Attributes
    ----------
    x, v, acceleration : motion (carts, n) of the measured carts.
    span : range (carts, n) of the readings in each window.
    u, on : the input (3, n) at each of `_LAGS`, and the share of the time in which it is not zero
        (n,).
    gain : standard deviation of the acceleration that white noise of size 1 causes.
    """

    record: Record
    t: Array
    x: Array
    v: Array
    acceleration: Array
    span: Array
    u: Array
    on: Array
    gain: float
    jumps: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """Means over windows (n,) of one record; `x` and `v` (3, n) of a cart and its neighbours."""

    record: Record
    t: Array
    x: Array
    v: Array
    acceleration: Array
    u: Array
    on: Array
    noise: float
    moves: NDArray[np.bool_]
    jumps: NDArray[np.bool_]

    def columns(self, *, driven: bool) -> Array:
        """Return the columns (n, unknowns) of the law: those of `_SPRINGS`, `_DAMPERS` and `_DRY`.

        Each record gets a separate rest and input gain, because a drive's gain may depend on the
        level of the input.
        """
        v, u = self.v[1], driven * self.u
        # In a window in which the cart reverses, this is its main direction.
        turning = np.maximum(np.abs(self.acceleration) * _WINDOW / 4.0, 1e-12 * np.abs(v).max())
        side = np.clip(v / np.maximum(turning, 1e-300), -1.0, 1.0)
        rest = np.ones(v.size)
        dampers = [*self.v, np.abs(v) * v, v * self.on]
        dry = [side, side * np.abs(self.u[0])]
        return np.array([rest, u[0], *self.x, *u, *dampers, *dry]).T


def record_residual_forces(
    cart: int, means: Sequence[WindowMeans]
) -> tuple[list[RecordResidualForce], float]:
    """Return, by record, the unexplained force on a cart, and its usual size.

    One law is fitted to all records. Records in which a free neighbour was not measured are left
    out. The list is empty if the cart moves too little to fit the law.
    """
    cut = [_between_neighbours(one, cart) for one in means if cart in one.record.free]
    windows = [one for one in cut if one is not None]
    if not windows:
        return [], 0.0
    columns = [one.columns(driven=cart == 1) for one in windows]
    usable = [one.moves & ~one.jumps for one in windows]
    parts = [(c[use], w.acceleration[use])
             for c, w, use in zip(columns, windows, usable, strict=True)]  # fmt: skip
    unknowns = columns[0].shape[1] + _OWN * (len(windows) - 1)
    # A fit needs three times as many windows as unknowns.
    if sum(target.size for _, target in parts) < 3 * unknowns:
        return [], 0.0
    laws, size = _fit(parts, least=_BULK * float(np.median([w.noise for w in windows])))
    found = []
    for one, column, law in zip(windows, columns, laws, strict=True):
        asked = column[:, _SPRINGS] @ law[_SPRINGS]
        free = one.acceleration - asked - column[:, _DAMPERS] @ law[_DAMPERS]
        rubs, by_load = np.abs(law[_DRY])
        # The largest static friction is assumed to be three times the friction in motion.
        holds = 3.0 * (rubs + by_load * np.abs(one.u[0]))
        at_rest = np.sign(free) * np.maximum(np.abs(free) - holds, 0.0)
        offset, stiffness = law[0], -law[_POSITION]
        rest = offset / stiffness if stiffness * np.ptp(one.x[1]) > size else 0.0
        found.append(
            RecordResidualForce(
                record=one.record,
                t=one.t,
                residual=np.where(one.moves, free - column[:, _DRY] @ law[_DRY], at_rest),
                acting=np.maximum(np.abs(one.acceleration), np.abs(asked)),
                state=np.array([one.x[1] - rest, *np.diff(one.x, axis=0), one.v[1], one.u[0]]),
                moves=one.moves,
                jumps=one.jumps,
                idle=~one.moves & ~np.any(one.u, axis=0),
            )
        )
    return found, size


def window_means(record: Record) -> WindowMeans | None:
    """Return the means over a record's windows, or None if the record is shorter than a window."""
    t, interval = record.t, record.sample_time
    # number of samples in a window
    width = max(round(_WINDOW / interval) + 1, 9)
    if width >= t.size:
        return None
    first = np.arange(0, t.size - width + 1, _hop(record))
    u = np.zeros(t.size) if record.u is None else record.u
    inputs = np.array([*(np.interp(t - lag, t, u) for lag in _LAGS), u != 0.0])
    # At most 1000 windows are computed at once, to limit the memory for long recordings.
    parts = np.array_split(first, -(-first.size // 1000))
    means = np.hstack([_means(t, record.y, inputs, part[:, None] + np.arange(width))
                       for part in parts])  # fmt: skip
    reach = round(_LAGS[-1] / interval) + 1
    # A jump is a change by 30 % of the input's range from one sample to the next.
    jump = np.abs(np.diff(u, prepend=u[0])) > 0.3 * np.ptp(u)
    jumped = np.append(0, np.cumsum(jump))  # number of jumps before each sample
    x, v, acceleration, span = means[6:].reshape(4, len(record.carts), -1)
    return WindowMeans(
        record=record,
        t=means[0],
        u=means[1:4],
        on=means[4],
        gain=float(np.median(means[5])),
        x=x,
        v=v,
        acceleration=acceleration,
        span=span,
        jumps=jumped[first + width] > jumped[np.maximum(first - reach, 0)],
    )


def _between_neighbours(means: WindowMeans, cart: int) -> _Windows | None:
    """Return the data to which one cart's law is fitted; None if a free neighbour is unmeasured."""
    record, neighbours = means.record, (cart - 1, cart, cart + 1)
    if any(c in record.free and c not in record.carts for c in neighbours):
        return None
    rows = [record.carts.index(c) if c in record.carts else None for c in neighbours]
    still = np.zeros(means.t.size)
    row = record.carts.index(cart)
    step = resolution(record.t, record.position(cart), step=record.encoder_step(cart))
    # A cart rests if its readings change by at most three steps in a window.
    return _Windows(
        record=record,
        t=means.t,
        x=np.array([still if i is None else means.x[i] for i in rows]),
        v=np.array([still if i is None else means.v[i] for i in rows]),
        acceleration=means.acceleration[row],
        u=means.u,
        on=means.on,
        noise=means.gain * step / np.sqrt(12.0),
        moves=means.span[row] > 3.0 * step,
        jumps=means.jumps,
    )


def _hop(record: Record) -> int:
    """Return the number of samples between windows."""
    # Windows are 0.01 s apart.
    return max(1, round(0.01 / record.sample_time))


def _means(t: Array, y: Array, inputs: Array, at: NDArray[np.int64]) -> Array:
    """Return means (6 + 4 carts, n) over the windows whose samples are `at` (n, samples).

    The first rows are time, inputs, and the acceleration's gain for white noise. Four rows per cart
    follow: position, velocity, acceleration, and range of the readings.
    """
    local = t[at]
    # With an even clock, all windows have the weights of the first one.
    clock = local[:1] if is_even(t) else local
    w, w1, w2 = window_weights(clock)
    s = (clock - clock[:, :1]) / (clock[:, -1:] - clock[:, :1])
    held = np.diff(bump_integral(s), axis=1) / bump_integral(np.ones(1))
    readings = [x[at] for x in y]
    return np.array(
        [
            _weighed(w, local),
            *(_weighed(held, u[at[:, :-1]]) for u in inputs),
            np.broadcast_to(np.linalg.norm(w2, axis=1), len(at)),
            *(_weighed(w, x) for x in readings),
            *(-_weighed(w1, x) for x in readings),
            *(_weighed(w2, x) for x in readings),
            *(np.ptp(x, axis=1) for x in readings),
        ]
    )


def _weighed(weights: Array, x: Array) -> Array:
    """Return the weighted sums (n,) over windows (n, samples), which may share their weights."""
    return x @ weights[0] if len(weights) == 1 else (weights * x).sum(1)


def _fit(parts: Sequence[tuple[Array, Array]], *, least: float) -> tuple[list[Array], float]:
    """Return, by record, the law that most windows follow, and the usual residual.

    Parameters
    ----------
    parts : columns (windows, unknowns) and accelerations (windows,) of each record. The first
        columns are for the unknowns that differ from record to record.
    least : a lower limit for the usual residual.
    """
    shared = parts[0][0].shape[1] - _OWN
    behind = np.arange(_OWN * len(parts), _OWN * len(parts) + shared)
    places = [np.append(np.arange(_OWN * k, _OWN * (k + 1)), behind) for k in range(len(parts))]
    count = _OWN * len(parts) + shared
    power = np.zeros(count)
    for (columns, _), place in zip(parts, places, strict=True):
        power[place] += (columns**2).sum(axis=0)
    scale = 1.0 / np.sqrt(np.where(power > 0.0, power, np.inf))
    weights, bulk, law = [np.ones(target.size) for _, target in parts], np.inf, np.zeros(count)
    for _ in range(_ROUNDS):
        H, b = np.zeros((count, count)), np.zeros(count)
        for (columns, target), place, weight in zip(parts, places, weights, strict=True):
            weighed = columns.T * weight**2
            H[np.ix_(place, place)] += weighed @ columns
            b[place] += weighed @ target
        # Eigenvalues of the normal equations below this share count as zero.
        law = scale * np.linalg.lstsq(H * np.outer(scale, scale), scale * b, rcond=1e-12)[0]
        left = [target - columns @ law[place]
                for (columns, target), place in zip(parts, places, strict=True)]  # fmt: skip
        before = bulk
        bulk = max(_BULK * MEDIAN_TO_SIGMA * float(np.median(np.abs(np.concatenate(left)))), least)
        if abs(bulk - before) < _SETTLED * bulk:
            break
        weights = [1.0 / (1.0 + (one / bulk) ** 2) for one in left]
    return [law[place] for place in places], bulk
