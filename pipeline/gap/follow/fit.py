"""Fit all parameters at once to the errors of a model that follows, by Levenberg-Marquardt."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.independent import independent
from pipeline.gap.fit.levenberg_marquardt import Mapper
from pipeline.gap.follow.laws import Laws
from pipeline.gap.follow.track import Own, Track, errors_of

_DAMP, _CHANGE, _LEAST_DAMP = 1e-4, 8.0, 1e-9
_ATTEMPTS, _RELEASES = 6, 12
_HUGE = 1e100
_RIDGE = 1e-12  # of the diagonal of what a run alone has
_INDEPENDENT = 4.0  # readings of a track that tell as much as one independent, or more
_DEAD = 1e-24  # of the strongest, squared


@dataclass(frozen=True, kw_only=True, eq=False)
class Follow:
    """A model that follows: its laws and vector, every run's own parameters, what it leaves.

    `cost` is the sum of squared errors over their noise; `points` how many they are, `news` how
    many of them are independent.
    """

    laws: Laws
    p: Array
    own: tuple[Own, ...]
    gain: float
    cost: float
    points: float
    news: float = 1.0
    prior: float = 0.0

    @property
    def chi(self) -> float:
        """Squared error per reading, in noises."""
        return self.cost / self.points

    @property
    def inflate(self) -> float:
        """By how much the misfit of a model that is still wrong widens the noise."""
        return max(1.0, float(np.sqrt(self.chi))) if np.isfinite(self.chi) else 1.0

    @property
    def total(self) -> float:
        """With the priors."""
        return self.cost + self.inflate**2 * self.prior


def start_follow(
    laws: Laws, p: Array, tracks: Sequence[Track], *, gain: float, mapper: Mapper = map
) -> Follow:
    """Return a model before any fit."""
    own = tuple(track.fresh() for track in tracks)
    bare = Follow(laws=laws, p=p, own=own, gain=gain, cost=np.inf, points=1.0)
    return weigh(bare, tracks, mapper=mapper)


def weigh(follow: Follow, tracks: Sequence[Track], *, mapper: Mapper = map) -> Follow:
    """Return it with its cost: infinite where the model runs away."""
    laws, dry = follow.laws, follow.laws.dry
    on_springs = any(laws.bench.springs)

    def one(pair: tuple[Track, Own]) -> tuple[float, float, float]:
        track, own = pair
        run = errors_of(laws, follow.p, track, own, gain=follow.gain, derive=False)
        if run is None:
            return np.inf, np.inf, 1.0
        left = run[0] * track.weight
        prior = track.prior(own, dry)[1]
        rows = left[:, track.seen].T
        news = sum(independent(row) for row in rows) if on_springs else rows.size
        return float((left**2).sum()), float((prior**2).sum()), news

    costs = np.array(list(mapper(one, zip(tracks, follow.own, strict=True))))
    points = sum(track.points for track in tracks)
    cost, prior, news = costs.sum(axis=0).tolist()
    return replace(
        follow, cost=cost, points=points, prior=prior, news=min(news, points / _INDEPENDENT)
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Slope:
    """The normal equations of a step: H and b of the vector, each run's own eliminated.

    `back` leads from a step of the vector to those of the runs' own.
    """

    H: Array
    b: Array
    back: tuple[Array, ...]

    @property
    def sound(self) -> bool:
        """Whether the model runs away nowhere."""
        return bool(np.all(np.isfinite(self.H)))


def slope_of(
    follow: Follow, tracks: Sequence[Track], *, factors: bool = True, mapper: Mapper = map
) -> Slope:
    """Return the normal equations; without `factors` dry friction is of one size in all runs."""
    laws, size, inflate = follow.laws, follow.p.size, follow.inflate
    dry = laws.dry & factors

    def one(pair: tuple[Track, Own]) -> tuple[Array, Array, Array]:
        track, own = pair
        run = errors_of(laws, follow.p, track, own, gain=follow.gain, derive=True)
        # A slope that is next to infinite has no square.
        if run is None or not np.all(np.abs(run[1]) < _HUGE):
            nothing = np.full((size, size), np.nan)
            return nothing, nothing[0], nothing
        E, J = run
        weight = track.weight[:, track.seen]
        J = (J[:, :, track.seen] * weight).reshape(len(J), -1)
        A, r = J @ J.T, J @ (E[:, track.seen] * weight).ravel()
        hold, off = track.prior(own, dry)
        mine = A[size:, size:] + np.diag((inflate * hold) ** 2)
        mine += _RIDGE * np.diag(np.diag(mine))
        right = np.column_stack([A[size:, :size], r[size:] + inflate**2 * hold * off])
        taken = np.linalg.solve(mine, right)
        H = A[:size, :size] - A[:size, size:] @ taken[:, :size]
        return H, r[:size] - A[:size, size:] @ taken[:, size], np.asarray(taken, dtype=np.float64)

    H, b, back = zip(*mapper(one, zip(tracks, follow.own, strict=True)), strict=True)
    return Slope(H=np.sum(H, axis=0), b=np.sum(b, axis=0), back=back)


def fit_follow(
    start: Follow,
    tracks: Sequence[Track],
    *,
    gain: float | None = None,
    iterations: int = 12,
    tolerance: float = 1e-3,
    mapper: Mapper = map,
) -> Follow:
    """Fit from a start, at a gain of its own or another."""
    best = start if gain is None else replace(start, gain=gain)
    best = weigh(best, tracks, mapper=mapper)
    low, high, reach = best.laws.steps_of_shape(best.p)
    damp = _DAMP
    for _ in range(iterations):
        if not np.isfinite(best.cost):
            break
        slope = slope_of(best, tracks, mapper=mapper)
        if not slope.sound:
            break
        for _attempt in range(_ATTEMPTS):
            delta = _step(slope, best.p, low, high, reach, damp)
            own = tuple(
                track.moved(one, taken[:, -1] - taken[:, :-1] @ delta)
                for track, one, taken in zip(tracks, best.own, slope.back, strict=True)
            )
            trial = weigh(replace(best, p=best.p + delta, own=own), tracks, mapper=mapper)
            if trial.cost + best.inflate**2 * trial.prior < best.total:
                break
            damp = max(damp * _CHANGE, _DAMP)
        else:
            break
        fall = 1.0 - (trial.cost + best.inflate**2 * trial.prior) / best.total
        best, damp = trial, max(damp / _CHANGE, _LEAST_DAMP)
        if fall < tolerance:
            break
    return best


def _step(slope: Slope, p: Array, low: Array, high: Array, reach: Array, damp: float) -> Array:
    """Return the damped step inside bounds and reach."""
    power = np.maximum(np.diag(slope.H), 0.0)
    active = np.flatnonzero((power > _DEAD * power.max()) & (low < high))
    delta = np.zeros(p.size)
    for _ in range(_RELEASES):
        if not active.size:
            break
        size = np.sqrt(power[active])
        A = slope.H[np.ix_(active, active)] / np.outer(size, size)
        step = np.linalg.solve(A + damp * np.eye(active.size), slope.b[active] / size) / size
        at = p[active]
        out = (at + step <= low[active]) & (at <= low[active])
        out |= (at + step >= high[active]) & (at >= high[active])
        if not out.any():
            delta[active] = step
            break
        active = active[~out]
    return np.clip(p + np.clip(delta, -reach, reach), low, high) - p
