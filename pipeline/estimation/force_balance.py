"""The law of motion of a cart over windows: its force balance, hands that disturb it, delays.

The equation is multiplied by a bump, which is zero at both ends of a window, as are its first three
derivatives. Then it is integrated by parts: the derivatives move from the data to the known bump.
The result is linear in masses, dampings and springs.

References: M. Shinbrot, Trans. ASME 79 (1957), 579-588; H. A. Preisig & D. W. T. Rippin, Computers
& Chemical Engineering 17 (1993).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.arrays import Array, true_runs
from pipeline.estimation.noise import MEDIAN_TO_SIGMA, resolution
from pipeline.plant.chain import Chain
from pipeline.results import Intervention, Record

# ---------------------------------------------------------------------- modulating functions


def bump(s: Array, *, span: Array | float) -> tuple[Array, Array, Array]:
    """Return (s (1 - s))⁴ for s from 0 to 1 over `span` seconds, and two time derivatives."""
    b, slope = s * (1 - s), 1 - 2 * s
    return b**4, 4 * b**3 * slope / span, (12 * b**2 * slope**2 - 8 * b**3) / span**2


def _bump_integral(s: Array) -> Array:
    """Return the integral of the bump from 0 to s; these are the weights for a held input."""
    return s**5 * np.polyval([1 / 9, -1 / 2, 6 / 7, -2 / 3, 1 / 5], s)


def is_even(t: Array) -> bool:
    """Return whether the intervals between times (n,) differ only by rounding."""
    dt = np.diff(t)
    return bool(np.ptp(dt) <= 1e-9 * dt[0])


def motion_period(x: Array) -> float:
    """Return the period, in samples, of a sine with the same size and speed as this motion."""
    return float(2 * np.pi * np.std(x) / np.sqrt(np.mean(np.diff(x) ** 2)))


class Windows:
    """Means over windows of a record, weighted by a bump.

    With few samples the bump's derivatives are integrated badly. So the weights are corrected:
    curvatures are exact for parabolas, rates of change for straight lines.

    Parameters
    ----------
    t : times (n,) of all samples, s.
    first : the first sample of each window, as indices (windows,) or as a slice. With a slice, no
        samples are copied.
    width : number of samples in a window.
    """

    def __init__(self, t: Array, *, first: NDArray[np.intp] | slice, width: int) -> None:
        self.first, self.width = first, width
        # With an even clock, all windows have the weights of the first one.
        local = self.cut(t)[: 1 if is_even(t) else None]
        self._t, self._span = local, local[:, -1:] - local[:, :1]
        self._s = (local - local[:, :1]) / self._span

    @cached_property
    def weights(self) -> Array:
        """Weights for the mean, the rate of change and the curvature, (3, windows, samples).

        All windows may share their weights, (3, 1, samples).
        """
        w, w1, w2 = bump(self._s, span=self._span)
        dt = np.gradient(self._t, axis=1)
        size = (w * dt).sum(1, keepdims=True)
        w, w1, w2 = (weight * dt / size for weight in (w, w1, w2))
        tau = self._t - (w * self._t).sum(1, keepdims=True)
        spread = (w * tau**2).sum(1, keepdims=True)
        w2 = w2 - w * w2.sum(1, keepdims=True) - w * tau * (w2 * tau).sum(1, keepdims=True) / spread
        w2 = 2 * w2 / (w2 * tau**2).sum(1, keepdims=True)
        w1 = w1 - w * w1.sum(1, keepdims=True)
        w1 = w1 / (w1 * tau).sum(1, keepdims=True)
        return np.array([w, w1, w2])

    @cached_property
    def _held(self) -> Array:
        """Weights (…, samples - 1) for an input that is held after each sample."""
        return np.diff(_bump_integral(self._s), axis=1) / _bump_integral(np.ones(1))

    def cut(self, x: Array) -> Array:
        """Return the samples (…, windows, samples) of signals (…, n)."""
        return sliding_window_view(x, self.width, axis=-1)[..., self.first, :]

    def mean(self, x: Array) -> Array:
        """Return the means (…, windows) of signals (…, n)."""
        return _weighed(self.weights[0], self.cut(x))

    def means(self, x: Array) -> Array:
        """Return mean, rate of change and curvature (3, …, windows) of signals (…, n)."""
        local = self.cut(x)
        return np.array([_weighed(weight, local) for weight in self.weights])

    def held_mean(self, u: Array) -> Array:
        """Return the means (…, windows) of inputs (…, n) that are held after each sample."""
        return _weighed(self._held, self.cut(u)[..., :-1])

    def gain(self, chain: Chain, cart: int) -> float:
        """Return the standard deviation of a cart's force that white noise of size 1 causes."""
        held = chain.k[cart - 1] + chain.k[cart]
        w, w1, w2 = self.weights
        own = chain.m[cart - 1] * w2 + chain.c[cart - 1] * w1 + held * w
        return float(np.median(np.linalg.norm(own, axis=1)))


def _weighed(weights: Array, x: Array) -> Array:
    """Return weighted sums over windows (…, windows, samples), which may share their weights."""
    return x @ weights[0] if len(weights) == 1 else np.einsum("wi,...wi->...w", weights, x)


def required_force(chain: Chain, means: Array) -> Array:
    """Return the force (n, windows) that a motion requires, from its `means` (3, n, windows)."""
    x, v, acceleration = means
    return chain.m[:, None] * acceleration + chain.c[:, None] * v + chain.stiffness @ x


# --------------------------------------------------------- the law of one cart, from all records
#
# The acceleration of the cart is regressed on positions, velocities and input, with dry friction
# and drag, over short windows. The problem is linear, so nothing is simulated or searched. The loss
# function ignores data that do not follow the law.
#
# Reference: S. Geman and D. E. McClure, Bull. Int. Statistical Institute 52 (1987) 5-21 (the loss).

_WINDOW = 0.1  # s; the middle 0.04 s have most of the weight
_LAGS = (0.0, 0.02, 0.05)  # trial delays of the input, s
# Columns of the law, in this order: rest and gain of each record; positions and inputs; dampers,
# drag and braking; dry friction, constant and proportional to the input.
_OWN, _POSITION = 2, 3
_SPRINGS, _DAMPERS, _DRY = slice(0, 8), slice(8, 13), slice(13, 15)
_BULK = 2.0  # standard deviations of the residual; data beyond have little weight


class RecordResidualForce:
    """The force on one cart in one record that a law leaves unexplained, over windows at `t` (n,).

    The `columns` (n, unknowns) times the `law` (unknowns,) are the acceleration that it explains.
    `size` is the usual residual.

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

    def __init__(self, windows: "_CartWindows", columns: Array, law: Array, *, size: float) -> None:
        self.record, self.t, self.jumps = windows.means.record, windows.means.t, windows.means.jumps
        self.moves, u, x = windows.moves, windows.means.u, windows.x
        asked = columns[:, _SPRINGS] @ law[_SPRINGS]
        free = windows.acceleration - asked - columns[:, _DAMPERS] @ law[_DAMPERS]
        rubs, by_load = np.abs(law[_DRY])
        # The largest static friction is assumed to be three times the friction in motion.
        holds = 3.0 * (rubs + by_load * np.abs(u[0]))
        at_rest = np.sign(free) * np.maximum(np.abs(free) - holds, 0.0)
        offset, stiffness = law[0], -law[_POSITION]
        rest = offset / stiffness if stiffness * np.ptp(x[1]) > size else 0.0
        self.residual = np.where(self.moves, free - columns[:, _DRY] @ law[_DRY], at_rest)
        self.acting = np.maximum(np.abs(windows.acceleration), np.abs(asked))
        self.state = np.array([x[1] - rest, *np.diff(x, axis=0), windows.v[1], u[0]])
        self.idle = ~self.moves & ~np.any(u, axis=0)

    @property
    def follows(self) -> NDArray[np.bool_]:
        """Whether the law should hold (n,)."""
        return self.moves & ~self.jumps

    @property
    def hop(self) -> float:
        """The time between windows, s."""
        return _hop(self.record) * self.record.sample_time


class WindowMeans:
    """Means over windows (n,) at times `t` of one record, for all carts' laws.

    Attributes
    ----------
    x, v, acceleration : motion (carts, n) of the measured carts.
    span : range (carts, n) of the readings in each window.
    u, on : the input (3, n) at each of `_LAGS`, and the share of the time in which it is not zero
        (n,).
    gain : standard deviation of the acceleration that white noise of size 1 causes.
    jumps : whether the input jumps (n,), in the window or just before.
    """

    def __init__(self, record: Record) -> None:
        self.record = record
        t, width = record.t, _width(record)
        first = np.arange(0, t.size - width + 1, _hop(record))
        u = record.input
        inputs = np.array([*(np.interp(t - lag, t, u) for lag in _LAGS), u != 0.0])
        # At most 1000 windows are computed at once, to limit the memory for long recordings.
        parts = np.array_split(first, -(-first.size // 1000))
        means = np.hstack([_means(t, record.y, inputs, part, width) for part in parts])
        self.t, self.u, self.on = means[0], means[1:4], means[4]
        self.gain = float(np.median(means[5]))
        moved = means[6:].reshape(4, len(record.carts), -1)
        self.x, self.v, self.acceleration, self.span = moved
        reach = round(_LAGS[-1] / record.sample_time) + 1
        # A jump is a change by 30 % of the input's range from one sample to the next.
        jump = np.abs(np.diff(u, prepend=u[0])) > 0.3 * np.ptp(u)
        jumped = np.append(0, np.cumsum(jump))  # number of jumps before each sample
        self.jumps = jumped[first + width] > jumped[np.maximum(first - reach, 0)]


class _CartWindows:
    """Means over windows (n,) for one cart's law; `x` and `v` (3, n) include its neighbours."""

    def __init__(self, means: WindowMeans, cart: int) -> None:
        record, self.means = means.record, means
        near = [record.carts.index(c) if c in record.carts else None
                for c in (cart - 1, cart, cart + 1)]  # fmt: skip
        still = np.zeros(means.t.size)
        row = record.carts.index(cart)
        step = resolution(record.t, record.position(cart), step=record.encoder_step(cart))
        self.x = np.array([still if i is None else means.x[i] for i in near])
        self.v = np.array([still if i is None else means.v[i] for i in near])
        self.acceleration = means.acceleration[row]
        self.noise = means.gain * step / np.sqrt(12.0)
        # A cart rests if its readings change by at most three steps in a window.
        self.moves = means.span[row] > 3.0 * step

    def columns(self, *, driven: bool) -> Array:
        """Return the columns (n, unknowns) of the law: those of `_SPRINGS`, `_DAMPERS` and `_DRY`.

        Each record gets a separate rest and input gain, because a drive's gain may depend on the
        level of the input.
        """
        v, u = self.v[1], driven * self.means.u
        # In a window in which the cart reverses, this is its main direction.
        turning = np.maximum(np.abs(self.acceleration) * _WINDOW / 4.0, 1e-12 * np.abs(v).max())
        side = np.clip(v / np.maximum(turning, 1e-300), -1.0, 1.0)
        rest = np.ones(v.size)
        dampers = [*self.v, np.abs(v) * v, v * self.means.on]
        dry = [side, side * np.abs(self.means.u[0])]
        return np.array([rest, u[0], *self.x, *u, *dampers, *dry]).T


def record_residual_forces(
    cart: int, means: Sequence[WindowMeans]
) -> tuple[list[RecordResidualForce], float]:
    """Return, by record, the unexplained force on a cart, and its usual size.

    One law is fitted to all records. Records in which a free neighbour was not measured are left
    out. The list is empty if the cart moves too little to fit the law.
    """
    windows = [_CartWindows(one, cart) for one in means if _forces_are_measured(one.record, cart)]
    if not windows:
        return [], 0.0
    columns = [one.columns(driven=cart == 1) for one in windows]
    usable = [one.moves & ~one.means.jumps for one in windows]
    parts = [(c[use], w.acceleration[use])
             for c, w, use in zip(columns, windows, usable, strict=True)]  # fmt: skip
    unknowns = columns[0].shape[1] + _OWN * (len(windows) - 1)
    # A fit needs three times as many windows as unknowns.
    if sum(target.size for _, target in parts) < 3 * unknowns:
        return [], 0.0
    laws, size = _fit(parts, least=_BULK * float(np.median([w.noise for w in windows])))
    found = [
        RecordResidualForce(one, column, law, size=size)
        for one, column, law in zip(windows, columns, laws, strict=True)
    ]
    return found, size


def _width(record: Record) -> int:
    """Return the number of samples in a window."""
    return max(round(_WINDOW / record.sample_time) + 1, 9)


def _forces_are_measured(record: Record, cart: int) -> bool:
    """Return whether a cart is free, and it and its free neighbours were measured."""
    near = (c for c in (cart - 1, cart, cart + 1) if c in record.free)
    return cart in record.free and all(c in record.carts for c in near)


def _hop(record: Record) -> int:
    """Return the number of samples between windows."""
    # Windows are 0.01 s apart.
    return max(1, round(0.01 / record.sample_time))


def _means(t: Array, y: Array, inputs: Array, first: NDArray[np.intp], width: int) -> Array:
    """Return means (6 + 4 carts, n) over windows of `width` samples.

    The first rows are time, inputs, and the acceleration's gain for white noise. Four rows per cart
    follow: position, velocity, acceleration, and range of the readings.
    """
    windows = Windows(t, first=first, width=width)
    return np.vstack(
        [
            windows.mean(t),
            windows.held_mean(inputs),
            np.broadcast_to(np.linalg.norm(windows.weights[2], axis=1), first.size),
            *windows.means(y),
            np.ptp(windows.cut(y), axis=-1),
        ]
    )


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
    # At most thirty rounds of reweighting; they end when the bulk changes by 0.1 %.
    for _ in range(30):
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
        if abs(bulk - before) < 1e-3 * bulk:
            break
        weights = [1.0 / (1.0 + (one / bulk) ** 2) for one in left]
    return [law[place] for place in places], bulk


# ----------------------------------------------------------------- interventions, such as a hand
#
# A hand causes a burst in the force that the law of motion does not explain. An effect that the law
# lacks causes bursts too, but again and again: whenever position, stretch, speed and input are the
# same. An impact of two bodies is over in an instant. So a burst counts as a hand if it lasts,
# moves the cart, and occurs in a state in which the law holds at other times.

T = TypeVar("T", bound=np.generic)


def running_max(values: NDArray[T], width: int) -> NDArray[T]:
    """Return, for each value, the largest of the `width` values centred on it; `width` is odd."""
    padded = np.pad(values, width // 2, mode="edge")
    return sliding_window_view(padded, width).max(axis=-1)


# A burst must exceed the first multiple of `_BULK`. It begins and ends at the second multiple.
_FAR, _BEGINS = 4.0, 1.5
# Least share of a burst in the force on the cart, and least ratio of this share to its usual value.
_SHARE, _TYPICAL = 0.3, 3.0
# s on either side of a window's middle; this part has most of the weight.
_REACH = 0.02
_GAP = 0.1  # s; closer bursts are merged
# Number of bins for a variable of the state. At least this share and at least this number of
# the windows in a bin must be quiet.
_BINS, _MOST, _VISITS = 20, 0.5, 5


def find_interventions(records: Sequence[Record]) -> tuple[Intervention, ...]:
    """Return the interventions of hands on free carts, by record, cart and time.

    Runs under feedback are skipped, because part of what drives their motor is often not logged.
    """
    return _found_in(tuple(records))


@lru_cache(maxsize=1)  # a report and its gap analysis ask for the same records
def _found_in(records: tuple[Record, ...]) -> tuple[Intervention, ...]:
    open_loop = [record for record in records if record.kind not in ("closed_loop", "bode")]
    first = {record.id: _first_copy(record, open_loop) for record in open_loop}
    alone = [record for record in open_loop if first[record.id] == record.id]
    carts = sorted({cart for record in alone for cart in record.measured_free})
    seen = [WindowMeans(record) for record in alone if record.t.size > _width(record)]
    bursts = [one for cart in carts for one in _bursts(cart, seen)]
    found = [
        replace(one, experiment=name)
        for name, twin in first.items()
        for one in bursts
        if one.experiment == twin
    ]
    order = [record.id for record in open_loop]
    return tuple(sorted(found, key=lambda one: (order.index(one.experiment), one.cart, one.start)))


def _first_copy(record: Record, records: Sequence[Record]) -> str:
    """Return the id of the first record with the same readings; a file may be listed twice."""
    return next(other.id for other in records if np.array_equal(other.y, record.y))


def without_releases(
    interventions: Sequence[Intervention], records: Sequence[Record]
) -> list[Intervention]:
    """Return the interventions without the holds that precede the release of a decay."""
    released = {(record.id, float(record.t[0])) for record in records if record.kind == "decay"}
    return [one for one in interventions if (one.experiment, one.start) not in released]


def between(record: Record, interventions: Sequence[Intervention]) -> list[Record]:
    """Return the parts of a record before, between and after the interventions."""
    touched = np.zeros(record.t.size, dtype=np.bool_)
    for one in interventions:
        if one.experiment == record.id:
            touched |= (record.t >= one.start) & (record.t <= one.end)
    if not touched.any():
        return [record]
    return [
        record.part(slice(start, stop))
        for start, stop in true_runs(~touched)
        if record.t[stop - 1] - record.t[start] >= _GAP
    ]


def _bursts(cart: int, seen: Sequence[WindowMeans]) -> list[Intervention]:
    forces, size = record_residual_forces(cart, seen)
    if not forces:
        return []
    shares = [_share(force, size) for force in forces]
    usual = np.concatenate([s[f.follows] for s, f in zip(shares, forces, strict=True)])
    least = max(_SHARE, _TYPICAL * float(np.quantile(usual, 0.75)))
    found = []
    for force, share, known in zip(forces, shares, _known(forces, size), strict=True):
        left = np.abs(force.residual)
        bulk = size
        if force.follows.any():  # a record that departs from the law throughout cannot show a hand
            own = _BULK * MEDIAN_TO_SIGMA * float(np.median(left[force.follows]))
            bulk = max(size, own)
        strong = (left > _FAR * bulk) & (share > least) & ~force.jumps
        above = left > _BEGINS * bulk
        times = np.concatenate([force.record.t[:1], force.t[1:-1], force.record.t[-1:]])
        for first, stop in _stretches(above, force.t):
            inside = slice(first, stop)
            beyond = np.where(above[inside], force.residual[inside], 0.0)
            if _is_hand(beyond, strong=strong[inside], known=known[inside], hop=force.hop):
                found.append(
                    Intervention(
                        experiment=force.record.id,
                        cart=cart,
                        start=max(float(times[first]) - _REACH, float(times[0])),
                        end=min(float(times[stop - 1]) + _REACH, float(times[-1])),
                    )
                )
    driven = {
        record.id: float(record.t[0])
        for record in (one.record for one in seen)
        if np.any(record.input)
    }
    return [one for one in found if not _recurs(one, found, driven)]


def _recurs(one: Intervention, found: Sequence[Intervention], driven: Mapping[str, float]) -> bool:
    """Return whether a burst occurs at the same instant in another driven run.

    Such a burst is not due to a hand. `driven` gives the time of each driven run's first sample.
    """
    if one.start == driven.get(one.experiment, one.start):
        return False
    # Nobody pushes twice within 0.03 s of the same instant.
    return any(
        abs(one.start - other.start) < 0.03
        for other in found
        if other.experiment != one.experiment and other.experiment in driven
    )


def _share(force: RecordResidualForce, size: float) -> Array:
    """Return which share of the force on the cart is unexplained, near each sample."""
    # A burst is compared with the largest force within 0.15 s.
    acting = running_max(force.acting, 2 * round(0.15 / force.hop) + 1)
    return np.abs(force.residual) / (acting + size)


def _known(forces: Sequence[RecordResidualForce], size: float) -> list[NDArray[np.bool_]]:
    """Return for each window whether the law holds at other times in the same state.

    Position, stretches, velocity and input are checked one by one: most windows at about the same
    value must be quiet. A cart that rests without an input is always in a known state, because
    friction alone can hold it.
    """
    state = np.concatenate([force.state for force in forces], axis=1)
    follows = np.concatenate([force.follows for force in forces])
    quiet = np.concatenate([(np.abs(f.residual) < _BEGINS * size) & f.moves for f in forces])
    known = np.ones(follows.size, dtype=np.bool_)
    for values in state:
        low, high = values[follows].min(), values[follows].max()
        if high <= low:
            continue
        at = np.floor((values - low) / (high - low) * _BINS).astype(int)
        inside = (at >= 0) & (at <= _BINS)
        at = np.clip(at, 0, _BINS)
        visits = np.bincount(at[follows], minlength=_BINS + 1)
        calm = np.bincount(at[follows & quiet], minlength=_BINS + 1)
        known &= inside & ((calm >= _MOST * visits) & (calm >= _VISITS))[at]
    bounds = np.cumsum([0, *(force.t.size for force in forces)])
    # A window also shows a little of its neighbours.
    parts = [~running_max(~known[first:stop], 3) for first, stop in pairwise(bounds)]
    return [part | force.idle for part, force in zip(parts, forces, strict=True)]


def _stretches(above: NDArray[np.bool_], t: Array) -> list[tuple[int, int]]:
    """Return [start, stop) of each stretch of windows; stretches with a short gap are merged."""
    found: list[tuple[int, int]] = []
    for start, stop in true_runs(above):
        if found and t[start] - t[found[-1][1] - 1] < _GAP:
            found[-1] = (found[-1][0], stop)
        else:
            found.append((start, stop))
    return found


def _is_hand(
    left: Array, *, strong: NDArray[np.bool_], known: NDArray[np.bool_], hop: float
) -> bool:
    """Return whether a burst is due to a hand.

    Where the unexplained force is below the level at which a burst begins, `left` is zero. The
    windows are `hop` s apart.
    """
    swings = np.count_nonzero(np.diff(np.sign(left[left != 0.0])))
    lasts = understood = 0
    for start, stop in true_runs(strong):
        burst = np.abs(left[start:stop])
        lasts += np.count_nonzero(burst > 0.5 * burst.max())
        understood += np.count_nonzero(known[start:stop])
    # An impact is above half of its peak for 0.04 s, the width of a window; a hand for longer.
    # For 0.03 s, the cart must be in a state in which the law holds at other times.
    # The force of a hand changes its sign at most three times, that of an effect more often.
    return bool(swings <= 3 and lasts * hop >= 0.06 and understood * hop >= 0.03)


# --------------------------------------------------------------- the delay of one cart's channel
#
# A cart without a motor is moved by its neighbours alone, whatever the input is and however late it
# arrives. Its law of motion is
#
#     k_i x_{i-1} = m_i x_i'' + c_i x_i' + (k_i + k_{i+1}) x_i - k_{i+1} x_{i+1}.
#
# The best delay of a cart's channel, against the channel of the cart before it, is the one for
# which this law fits best. No data are differentiated: both sides are averaged with a bump that
# slides along the records. The coefficients may have any sign and size. So a cart in
# another unit, or with a reversed sign, gives the same delay.

_MOST_LATE = 15  # grid steps tried in each direction
_PARTS = 8  # fewest records, or parts of records, for a standard error


@dataclass(frozen=True, kw_only=True)
class ChannelDelay:
    """The delay of one cart's channel against the channel of the cart before it.

    Attributes
    ----------
    delay, std : delay in s, and its standard error by jackknife over records. The delay is positive
        if the cart's channel is read later.
    better : factor by which this delay lowers the residual of the cart's law. Friction, backlash
        and end stops look like a small delay, but no delay removes their residual.
    """

    cart: int
    delay: float
    std: float
    better: float
    experiments: tuple[str, ...]


def find_channel_delays(records: Sequence[Record], *, n: int) -> dict[int, ChannelDelay]:
    """Return, by cart, the delay of its channel against the channel before it, if significant.

    The search begins at the last cart, because the law of each cart uses the corrected times of the
    cart after it.
    """
    found: dict[int, ChannelDelay] = {}
    for cart in range(n, 1, -1):
        after = found[cart + 1].delay if cart + 1 in found else 0.0
        one = _channel_delay(records, cart, after=after)
        if one is not None:
            found[cart] = one
    return found


def _unexplained(products: Array) -> Array:
    """Return the power (n_d,) of the left side that the best law does not explain.

    `products` (n_d, 5, 5) are those of left side and right columns, for every trial delay.
    """
    power, cross, square = products[:, 0, 0], products[:, 0, 1:], products[0, 1:, 1:]
    used = np.diag(square) > 0
    size = np.sqrt(np.diag(square)[used])
    cross = cross[:, used] / size
    square = square[np.ix_(used, used)] / size / size[:, None]
    weights = np.linalg.lstsq(square, cross.T, rcond=None)[0]
    return power - np.sum(cross * weights.T, axis=1)


def _channel_delay(records: Sequence[Record], cart: int, *, after: float) -> ChannelDelay | None:
    usable = [record for record in records if _shows_delay(record, cart)]
    periods = [motion_period(one.position(cart)) * one.sample_time for one in usable]
    if not usable:
        return None
    # The grid has 240 steps in a period of the motion, unless the samples are closer.
    finest = float(np.median(periods)) / 240
    step = max(float(np.median([record.sample_time for record in usable])), finest)
    parts = -(-_PARTS // len(usable))
    products: list[Array] = []
    experiments: list[str] = []
    for record, period in zip(usable, periods, strict=True):
        if found := _products(record, cart, after=after, step=step, period=period, parts=parts):
            products += found
            experiments.append(record.id)
    if len(products) < _PARTS:
        return None
    total = np.sum(products, axis=0)
    left = _unexplained(total)
    best, least = _lowest(left)
    if abs(best) >= _MOST_LATE:  # a still longer delay would fit better, so this is not a delay
        return None
    others = np.array([_lowest(_unexplained(total - one))[0] for one in products])
    spread = float(np.sum((others - others.mean()) ** 2))
    return ChannelDelay(
        cart=cart,
        delay=best * step,
        std=step * float(np.sqrt(spread * (others.size - 1) / others.size)),
        better=float(left[_MOST_LATE]) / max(least, np.finfo(float).tiny),
        experiments=tuple(experiments),
    )


def _shows_delay(record: Record, cart: int) -> bool:
    """Return whether the record can show the delay.

    All forces on the cart must have been measured, and both this cart and the cart before it must
    move far.
    """
    if cart - 1 not in record.free or not _forces_are_measured(record, cart):
        return False
    # The motion must span at least this many encoder steps.
    return all(np.ptp(record.position(c)) > 20.0 * record.encoder_step(c) for c in (cart - 1, cart))


def _products(
    record: Record, cart: int, *, after: float, step: float, period: float, parts: int
) -> list[Array]:
    """Return products (n_d, 5, 5) of the law's left side and right columns, by trial delay.

    There is one array for each part of the record, and none if the record is too short.
    """
    t = np.arange(record.t[0], record.t[-1], step)
    # A bump lasts a quarter of the motion's period, because wider bumps would suppress fast motion,
    # which is the most informative. With fewer than 16 samples under a bump, only the encoder's
    # steps would count.
    width = max(round(0.25 * period / step), 16)
    first, last = _MOST_LATE, t.size - width - _MOST_LATE
    places = np.arange(first, last, max(width // 6, (last - first) // 400, 1))
    if places.size < max(30, parts):
        return []
    windows = Windows(t, first=places, width=width)

    def at(cart: int, *, late: float = 0.0) -> Array:
        return np.interp(t + late, record.t, record.position(cart))

    own, slope, bend = windows.means(at(cart))
    right = [bend, slope, own, np.zeros(places.size)]
    if cart + 1 in record.free:
        right[3] = windows.mean(at(cart + 1, late=after))
    before = np.correlate(at(cart - 1), windows.weights[0, 0])
    shifts = np.arange(-_MOST_LATE, _MOST_LATE + 1)
    left = before[places - shifts[:, None]]
    # Encoder zeros cancel, and each record has the same weight.
    left = left - left.mean(axis=1, keepdims=True)
    size = float(np.linalg.norm(left[_MOST_LATE]))
    if size == 0:
        return []
    a = left / size
    b = (np.array(right) - np.mean(right, axis=1)[:, None]) / size
    found = []
    for part in np.array_split(np.arange(places.size), parts):
        products = np.zeros((shifts.size, 5, 5))
        products[:, 0, 0] = np.sum(a[:, part] ** 2, axis=1)
        products[:, 0, 1:] = a[:, part] @ b[:, part].T
        products[:, 1:, 1:] = b[:, part] @ b[:, part].T
        found.append(products)
    return found


def _lowest(left: Array) -> tuple[float, float]:
    """Return the delay (in grid steps, interpolated) with the least residual, and this residual."""
    i = int(np.argmin(left))
    between = 0.0
    if 0 < i < left.size - 1 and (bend := left[i - 1] - 2 * left[i] + left[i + 1]) > 0:
        between = 0.5 * float((left[i - 1] - left[i + 1]) / bend)
    return i + between - _MOST_LATE, float(left[i])
