"""Score laws that need a shape: how much each would lower the cost beside all that is fitted.

A law without effect moves nothing, yet what it would move to first order is known from the same
derivatives; beside the other parameters the best multiple of it is a small linear problem.

Reference: T. Söderström, P. Stoica, System Identification, section 11.5 (score tests).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.gap.follow import forces
from pipeline.gap.follow.fit import Follow
from pipeline.gap.follow.laws import COEFFICIENTS, POSITIVE, Law
from pipeline.gap.follow.records import Records

_RIDGE = 1e-10  # of the diagonal
_ALONE = 1e-9  # of a law's power, which the other parameters must leave of it
_SHOWN = 1e-20  # of the strongest parameter's power: a weaker one is not shown
# Trial shapes, close enough for a fit to find its way: of the largest position or stretch, of the
# usual speed, of the cart's own frequency; how fast a hidden mass rings off, and how many pitches
# of a motor are in the travel, by less than half a one.
_STOPS = (0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.93, 0.97)
_STRETCHES = (0.08, 0.2, 0.35, 0.5, 0.65, 0.8)
_DISTANCES, _SPEEDS = (0.004, 0.012, 0.035), (0.02, 0.06, 0.15)
_RATES, _RING = (0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.7, 2.3), 0.06
_PITCHES = tuple(np.arange(1.5, 25.0, 0.4).tolist())
_FAST = 0.98  # of the speeds, below which the usual ones are
_LITTLE = 0.1  # of the motion to the other side: on this side hardly any
_PLAY, _MOTOR, _BOUNCE = 0.03, 0.15, 0.4  # of travel, cart 1's mass, speed: where a play starts


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A law with the values the data ask for, and by how much it would lower the cost."""

    law: Law
    drop: float


def score(follow: Follow, records: Records, trials: Sequence[Law]) -> list[Scored]:
    """Return the trials that would help, each beside all laws of the model, the best first."""
    laws, p = follow.laws.with_laws(follow.p, trials)
    wide = replace(follow, laws=laws, p=p)
    slope = records.slope(wide)
    if not np.all(np.isfinite(slope.H)):
        return []
    low, high, _ = follow.laws.bounds()
    power = np.maximum(np.diag(slope.H), 0.0)
    base = np.arange(follow.p.size)
    at_bound = (follow.p <= low) | (follow.p >= high)
    base = base[(power[base] > _SHOWN * power.max()) & (low < high) & ~at_bound]
    size = np.sqrt(power[base])
    A = slope.H[np.ix_(base, base)] / np.outer(size, size) + _RIDGE * np.eye(base.size)
    out = []
    first = len(follow.laws.keys)
    for index, law in enumerate(trials, start=first):
        o = laws.first[index]
        mine = np.array([o + q for q in COEFFICIENTS[law.kind]])
        mine = mine[power[mine] > 0.0]
        if not mine.size:
            continue
        across = slope.H[np.ix_(base, mine)] / size[:, None]
        taken = np.linalg.solve(A, np.column_stack([across, slope.b[base] / size]))
        S = slope.H[np.ix_(mine, mine)] - across.T @ taken[:, :-1]
        b = slope.b[mine] - across.T @ taken[:, -1]
        S = S + _ALONE * np.diag(np.diag(slope.H)[mine])
        found = np.linalg.solve(S, b)
        if law.kind in POSITIVE and np.any(found < 0.0):
            # The second, the damping of a contact, may be nothing.
            found = np.array([b[0] / S[0, 0], *np.zeros(mine.size - 1)])
            if found[0] <= 0.0:
                continue
        drop = float(2 * found @ b - found @ S @ found)
        values = list(law.values)
        for i, value in zip(mine, found, strict=True):
            values[i - o] = float(value)
        out.append(Scored(law=replace(law, values=tuple(values)), drop=drop))
    return sorted(out, key=lambda one: -one.drop)


def shaped_laws(follow: Follow, records: Records) -> list[Law]:
    """Return laws that need a shape, at trial shapes, without effect."""
    bench = follow.laws.bench
    n = bench.n
    chain = follow.laws.chain(follow.p)
    diagonal = np.diag(chain.stiffness)
    position = np.zeros((2, n))
    stretch = np.zeros((2, n + 1))
    speed = np.zeros(n)
    for track, own in zip(records.tracks, follow.own, strict=True):
        x = np.where(track.free, track.y - own.zero, 0.0)
        position = np.maximum(position, [x.max(0), -x.min(0)])
        d = np.diff(np.pad(x, ((0, 0), (1, 1))), axis=1)
        stretch = np.maximum(stretch, [d.max(0), -d.min(0)])
        v = np.gradient(x, track.t, axis=0)
        speed = np.maximum(speed, np.quantile(np.abs(v), _FAST, axis=0))
    taken = set(follow.laws.keys)
    out = []
    for i in range(n):
        reach = position[:, i].max()
        if reach <= 0.0:
            continue
        stop = () if (forces.STOP, i) in taken else ((1.0, position[0, i]), (-1.0, position[1, i]))
        for side, most in stop:
            for part in _STOPS if most > _LITTLE * reach else ():
                at = side * part * most
                out.append(Law(kind=forces.STOP, place=i, values=(0.0, at, 0.0)))
        if (forces.DAHL, i) not in taken:
            for part in _DISTANCES:
                out.append(Law(kind=forces.DAHL, place=i, values=(0.0, part * reach)))
        if (forces.STRIBECK, i) not in taken:
            for part in _SPEEDS:
                out.append(Law(kind=forces.STRIBECK, place=i, values=(0.0, part * speed[i])))
        if (forces.HIDDEN, i) not in taken:
            omega = np.sqrt(max(diagonal[i], 1e-12) / chain.m[i])
            for part in _RATES:
                rate = part * omega
                out.append(Law(kind=forces.HIDDEN, place=i, values=(0.0, rate**2, _RING * rate)))
        if n > 1 and (forces.GAIN, i) not in taken:
            out.append(Law(kind=forces.GAIN, place=i, values=(0.0,)))
    for j in (j for j in bench.rows if (forces.SLACK, j) not in taken):
        for side, most in ((1.0, stretch[0, j]), (-1.0, stretch[1, j])):
            for part in _STRETCHES if most > _LITTLE * stretch[:, j].max() else ():
                out.append(Law(kind=forces.SLACK, place=j, values=(0.0, side * part * most)))
    return [law for law in out if records.allows(law)]


def cogging_laws(follow: Follow, records: Records) -> list[Law]:
    """Return cogging at trial pitches, close enough for its phase over the whole travel."""
    span = 0.0
    for track, own in zip(records.tracks, follow.own, strict=True):
        if track.free[0]:
            span = max(span, float(np.ptp(track.y[:, 0] - own.zero[0])))
    if span == 0.0 or (forces.COGGING, 0) in follow.laws.keys:
        return []
    return [
        Law(kind=forces.COGGING, place=0, values=(0.0, 0.0, span / count)) for count in _PITCHES
    ]


def backlash_laws(follow: Follow, records: Records) -> list[Law]:
    """Return a play between motor and cart 1, which no trial from nothing can show."""
    spans = [
        float(np.ptp(track.y[:, 0]))
        for track in records.tracks
        if track.free[0] and track.seen[0] and np.any(track.command)
    ]
    if not spans or (forces.BACKLASH, 0) in follow.laws.keys:
        return []
    values = _PLAY * max(spans), _MOTOR * float(follow.p[0]), _BOUNCE
    law = Law(kind=forces.BACKLASH, place=0, values=values)
    return [law] if records.allows(law) else []


def shaped_trials(follow: Follow, records: Records) -> list[Scored]:
    """Return the laws with a shape that would help beside those of the model, the best first.

    Of each law at each place and side the best shape.
    """
    trials = score(follow, records, shaped_laws(follow, records))
    moving = [i for i, t in enumerate(records.tracks) if t.free[0] and np.any(t.command)]
    cogging = cogging_laws(follow, records) if moving else []
    if cogging and records.allows(cogging[0]):
        part = replace(records, tracks=tuple(records.tracks[i] for i in moving))
        own = tuple(follow.own[i] for i in moving)
        trials += score(replace(follow, own=own), part, cogging)
    best: dict[tuple, Scored] = {}
    for one in sorted(trials, key=lambda one: -one.drop):
        if one.drop > 0.0:
            best.setdefault(one.law.sided, one)
    return list(best.values())
