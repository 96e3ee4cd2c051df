"""The law of motion of one cart, read off all records at once, and the force that it leaves.

The acceleration of the cart by positions, velocities and input, with dry friction and drag, over
short windows: linear in what is unknown, so that nothing is simulated and nothing searched. The
loss lets go of what does not follow the law.

Reference: S. Geman and D. E. McClure, Bull. Int. Statistical Institute 52 (1987) 5-21 (the loss).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump_integral, window_weights
from pipeline.estimation.noise import MEDIAN_TO_SIGMA, grain
from pipeline.results_of_runs import Record

HOP = 0.01  # s from window to window
_WINDOW = 0.1  # s; the middle 0.04 s weigh most
_FEWEST = 9  # samples in a window
_MOVES = 3.0  # smallest changes in a window: with less the cart rests
_LAGS = (0.0, 0.02, 0.05)  # s that the input may come late
_JUMP = 0.3  # of the input's range from one sample to the next
_STATIC = 3.0  # times dry friction in motion: what may hold a cart at rest
_ROUNDS, _SETTLED = 30, 1e-3  # of weighing anew; relative change of the bulk that ends it
_SINGULAR = 1e-12  # of the normal equations: what is less is nothing
_PER_UNKNOWN = 3  # windows, at least
_BULK = 2.0  # standard deviations of the bulk: beyond, the loss lets go


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceLeft:
    """The force on one cart in one record that the law does not explain, over windows at `t` (n,).

    Attributes
    ----------
    left : (n,) acceleration that the law does not explain; in a cart at rest, that friction
        does not hold either.
    acting : (n,) size of the acceleration, or of what springs and input ask for, if larger.
    state : (5, n) position about the rest, stretches of both springs, velocity, input.
    moves : the cart moves; `jumps`: so does the input, suddenly, in the window or just before.
    idle : (n,) the cart rests without an input.
    """

    record: Record
    t: Array
    left: Array
    acting: Array
    state: Array
    moves: NDArray[np.bool_]
    jumps: NDArray[np.bool_]
    idle: NDArray[np.bool_]

    @property
    def follows(self) -> NDArray[np.bool_]:
        """(n,) where the law should hold."""
        return self.moves & ~self.jumps


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """Means over windows (n,) of one record: `x`, `v` (3, n) of the cart between its neighbours."""

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

    def columns(self, *, driven: bool) -> tuple[Array, Array, Array]:
        """Return what the law multiplies: springs and input, dampers, friction by its sign."""
        v = self.v[1]
        # Within a window in which the cart turns, it goes this way for longer.
        turning = np.maximum(np.abs(self.acceleration) * _WINDOW / 4.0, 1e-12 * np.abs(v).max())
        side = np.clip(v / np.maximum(turning, 1e-300), -1.0, 1.0)
        dampers = [*self.v, np.abs(v) * v, v * self.on]
        return (
            np.array([*self.x, *(driven * self.u)]).T,
            np.array(dampers).T,
            np.array([side, side * np.abs(self.u[0])]).T,
        )


def forces_left(cart: int, records: Sequence[Record]) -> tuple[list[ForceLeft], float]:
    """Return the force in each record that one law of a cart does not explain, and its usual size.

    Records in which a free neighbour was not measured are left out. The list is empty if the cart
    moves too little to fit the law.
    """
    cut = [_cut(record, cart) for record in records if cart in record.free]
    windows = [one for one in cut if one is not None]
    usable = [one.moves & ~one.jumps for one in windows]
    if not windows or not np.any(np.concatenate(usable)):
        return [], 0.0
    count = len(windows)
    parts = []
    for k, one in enumerate(windows):
        springs, dampers, friction = one.columns(driven=cart == 1)
        # Each record has a rest of its own, and a gain: what a drive makes of one level is not
        # what it makes of another.
        own = np.zeros((one.t.size, 2 * count))
        own[:, k], own[:, count + k] = 1.0, springs[:, 3]
        parts.append((np.hstack([springs, own]), dampers, friction))
    design = np.vstack([np.hstack(part)[use] for part, use in zip(parts, usable, strict=True)])
    target = np.concatenate([w.acceleration[use] for w, use in zip(windows, usable, strict=True)])
    if target.size < _PER_UNKNOWN * design.shape[1]:
        return [], 0.0
    law, size = _fit(design, target, least=_BULK * float(np.median([w.noise for w in windows])))
    found = []
    for k, (one, part) in enumerate(zip(windows, parts, strict=True)):
        springs, dampers, friction = part
        n_springs, n_dampers = springs.shape[1], dampers.shape[1]
        asked = springs @ law[:n_springs]
        free = one.acceleration - asked - dampers @ law[n_springs : n_springs + n_dampers]
        dry = law[n_springs + n_dampers :]
        holds = _STATIC * (abs(dry[0]) + abs(dry[1]) * np.abs(one.u[0]))
        at_rest = np.sign(free) * np.maximum(np.abs(free) - holds, 0.0)
        rest = 0.0
        if -law[1] * np.ptp(one.x[1]) > size:
            rest = -law[springs.shape[1] - 2 * count + k] / law[1]
        found.append(
            ForceLeft(
                record=one.record,
                t=one.t,
                left=np.where(one.moves, free - friction @ dry, at_rest),
                acting=np.maximum(np.abs(one.acceleration), np.abs(asked)),
                state=np.array([one.x[1] - rest, *np.diff(one.x, axis=0), one.v[1], one.u[0]]),
                moves=one.moves,
                jumps=one.jumps,
                idle=~one.moves & ~np.any(one.u, axis=0),
            )
        )
    return found, size


def _cut(record: Record, cart: int) -> _Windows | None:
    """Return a record in windows, or None where it does not serve."""
    neighbours = (cart - 1, cart, cart + 1)
    if any(c in record.free and c not in record.carts for c in neighbours):
        return None
    t, interval = record.t, record.sample_time
    width = max(round(_WINDOW / interval) + 1, _FEWEST)
    if width >= t.size:
        return None
    first = np.arange(0, t.size - width + 1, max(1, round(HOP / interval)))
    at = first[:, None] + np.arange(width)
    local = t[at]
    w, w1, w2 = window_weights(local)
    s = (local - local[:, :1]) / (local[:, -1:] - local[:, :1])
    held = np.diff(bump_integral(s), axis=1) / bump_integral(np.ones(1))
    still = np.zeros(t.size)
    around = [record.position(c) if c in record.carts else still for c in neighbours]
    y, u = around[1], still if record.u is None else record.u
    step = grain(t, y, step=record.encoder_step(cart))
    reach = round(_LAGS[-1] / interval) + 1
    jump = np.abs(np.diff(u, prepend=u[0])) > _JUMP * np.ptp(u)
    lately = maximum_filter1d(jump.astype(int), width + reach, origin=(width + reach - 1) // 2)
    return _Windows(
        record=record,
        t=(w * local).sum(1),
        x=np.array([(w * x[at]).sum(1) for x in around]),
        v=np.array([-(w1 * x[at]).sum(1) for x in around]),
        acceleration=(w2 * y[at]).sum(1),
        u=np.array([(held * np.interp(t - lag, t, u)[at[:, :-1]]).sum(1) for lag in _LAGS]),
        on=(held * (u != 0.0)[at[:, :-1]]).sum(1),
        noise=float(np.median(np.linalg.norm(w2, axis=1))) * step / np.sqrt(12.0),
        moves=np.ptp(y[at], axis=1) > _MOVES * step,
        jumps=np.array(lately[at[:, -1]] > 0, dtype=np.bool_),
    )


def _fit(design: Array, target: Array, *, least: float) -> tuple[Array, float]:
    """Return the law that the bulk of the windows follows, and the size of what it leaves there."""
    size = np.linalg.norm(design, axis=0)
    used = size > 0.0
    scaled = design[:, used] / size[used]
    weight, bulk, law = np.ones(target.size), np.inf, np.zeros(scaled.shape[1])
    for _ in range(_ROUNDS):
        weighed = scaled.T * weight**2
        law = np.linalg.lstsq(weighed @ scaled, weighed @ target, rcond=_SINGULAR)[0]
        left = target - scaled @ law
        before = bulk
        bulk = max(_BULK * MEDIAN_TO_SIGMA * float(np.median(np.abs(left))), least)
        if abs(bulk - before) < _SETTLED * bulk:
            break
        weight = 1.0 / (1.0 + (left / bulk) ** 2)
    out = np.zeros(size.size)
    out[used] = law / size[used]
    return out, bulk
