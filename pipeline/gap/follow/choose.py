"""Choose the laws: all at once from nothing, then those of a shape, then drop what is nothing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.follow import kernel
from pipeline.gap.fit.levenberg_marquardt import Mapper
from pipeline.gap.follow.fit import Follow, Slope, fit_follow, slope_of, start_follow
from pipeline.gap.follow.laws import (
    COEFFICIENTS,
    COLUMNS,
    SIDED,
    Bench,
    Column,
    Law,
    Laws,
    column_set,
    smooth_laws,
)
from pipeline.gap.follow.track import Track
from pipeline.plant.linear.chain import Chain

CONTACTS = {kernel.STOP, kernel.BACKLASH}
CLOSE, LOOSE, FREE = 0.5, 0.1, 0.0  # gains
_NEAR_FREE = 0.02
_INDEPENDENT = 4.0  # readings of a track that tell as much as one independent
_RIDGE = 1e-10  # of the diagonal
_FIRST = 25  # iterations of the first fit, from a chain that may be far off
_SHORT_LIST = 4  # of laws with a shape, refitted
_HOLDS = 1.5  # times what a closer model leaves: a looser one that leaves more lacks something
_PLAY, _MOTOR = 0.03, 0.15  # of the travel and of cart 1's mass: where a play starts
_ROUNDS = 3  # of adding one of them


@dataclass(frozen=True, kw_only=True, eq=False)
class Records:
    """What is followed, how work on it is shared out, and which columns laws may fill."""

    tracks: tuple[Track, ...]
    mapper: Mapper
    columns: frozenset[Column]

    def fit(self, start: Follow, **options) -> Follow:
        """Fit a model from a start, see `fit_follow`."""
        return fit_follow(start, self.tracks, mapper=self.mapper, **options)

    def refit(self, follow: Follow, laws: Laws, p: Array, **options) -> Follow:
        """Fit a model with other laws, the runs' own parameters as they are."""
        return self.fit(replace(follow, laws=laws, p=p), **options)

    def slope(self, follow: Follow, *, factors: bool = True) -> Slope:
        """Return the normal equations, see `slope_of`."""
        return slope_of(follow, self.tracks, factors=factors, mapper=self.mapper)

    def allows(self, law: Law) -> bool:
        """Whether the catalogue has an effect that fills the columns of a law."""
        return column_set(COLUMNS[law.kind]) <= self.columns


def independent(follow: Follow) -> float:
    """Return how many independent readings there are."""
    return follow.points / _INDEPENDENT


def criterion(follow: Follow) -> float:
    """Return the Bayesian criterion, what each effect costs included."""
    count = independent(follow)
    bounds = follow.laws.bounds()
    size = int(np.sum(bounds[0] < bounds[1]))
    effects = len(follow.laws.groups())
    return (
        count * float(np.log(max(follow.total, 1e-300) / follow.points))
        + size * float(np.log(count))
        + effects * limits.BIC_DROP
    )


# ------------------------------------------------------------------ dropping what is nothing


def drop_needless(follow: Follow, records: Records) -> Follow:
    """Drop every law whose loss the criterion does not feel, the least first; refit the rest."""
    while follow.laws.groups():
        order = _needless(follow, records)
        if not order:
            break
        here, rough = criterion(follow), _rough_contact(follow)
        while order:
            laws, p = follow.laws.without(follow.p, order)
            trial = records.refit(follow, laws, p)
            if rough or criterion(trial) < here:
                follow = trial
                break
            if len(order) == 1:
                return follow
            order = order[: len(order) // 2]
        else:
            break
    return follow


def _needless(follow: Follow, records: Records) -> list[int]:
    """Return the groups that may go, in order, judged by the quadratic form about the fit."""
    slope = records.slope(follow, factors=False)
    groups = dict(follow.laws.groups())
    off = follow.p - follow.laws.neutral()
    low, high, _ = follow.laws.bounds()
    power = np.maximum(np.diag(slope.H), 0.0)
    usable = (power > 1e-20 * power.max()) & (low < high)
    order = [g for g, at in groups.items() if not np.any(np.abs(off[at]) > 0.0)]
    for g in order:
        usable[follow.laws.whole_group(g)] = False
        del groups[g]
    for g in [g for g, at in groups.items() if not usable[at].all()]:
        if not usable[groups[g]].any():
            order.append(g)
            del groups[g]
    count, cost, rough = independent(follow), follow.total, _rough_contact(follow)
    active = np.flatnonzero(usable)
    while groups:
        size = np.sqrt(power[active])
        A = slope.H[np.ix_(active, active)] / np.outer(size, size)
        inverse = np.linalg.inv(A + _RIDGE * np.eye(active.size)) / np.outer(size, size)
        where = {index: at for at, index in enumerate(active.tolist())}
        best: tuple[float, int, list[int]] | None = None
        for g, at in groups.items():
            mine = [where[i] for i in at.tolist() if i in where]
            d = off[active[mine]]
            rise = float(d @ np.linalg.solve(inverse[np.ix_(mine, mine)], d))
            price = limits.BIC_DROP + len(follow.laws.whole_group(g)) * np.log(count)
            if rough and (g < 0 or follow.laws.keys[g][0] not in CONTACTS):
                price = max(price, -count * float(np.log(limits.CONTACT_GAIN)))
            excess = count * float(np.log1p(max(rise, 0.0) / cost)) - price
            if best is None or excess < best[0]:
                best = excess, g, mine
                least = rise
        assert best is not None
        excess, g, mine = best
        if excess > 0.0:
            break
        d = off[active[mine]]
        off[active] -= inverse[:, mine] @ np.linalg.solve(inverse[np.ix_(mine, mine)], d)
        cost += max(least, 0.0)
        order.append(g)
        gone = set(follow.laws.whole_group(g).tolist())
        active = np.array([i for i in active.tolist() if i not in gone])
        del groups[g]
    return order


# ------------------------------------------------------------------ laws with a shape


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
    base = base[(power[base] > 1e-20 * power.max()) & (low < high) & ~at_bound]
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
        own = np.sqrt(np.diag(slope.H)[mine])
        S = S + 1e-9 * np.diag(own**2)
        found = np.linalg.solve(S, b)
        mask = np.ones(mine.size, dtype=bool)
        if law.kind in (kernel.STOP, kernel.DAHL, kernel.STRIBECK, kernel.HIDDEN):
            if found[0] <= 0.0:
                continue
            if np.any(found < 0.0):
                mask = found > 0.0
                found = np.where(mask, 0.0, 0.0)
                found[0] = b[0] / S[0, 0]
                mask = np.arange(mine.size) == 0
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
        speed = np.maximum(speed, np.quantile(np.abs(v), 0.98, axis=0))
    taken = set(follow.laws.keys)
    out = []
    for i in range(n):
        reach = position[:, i].max()
        if reach <= 0.0:
            continue
        for side, most in ((1.0, position[0, i]), (-1.0, position[1, i])):
            for part in (0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.93, 0.97):
                if most > 0.1 * reach:
                    out.append(Law(kind=kernel.STOP, place=i, values=(0.0, side * part * most, 0.0)))
        if (kernel.DAHL, i) not in taken:
            for part in (0.004, 0.012, 0.035):
                out.append(Law(kind=kernel.DAHL, place=i, values=(0.0, part * reach)))
        if (kernel.STRIBECK, i) not in taken:
            for part in (0.02, 0.06, 0.15):
                out.append(Law(kind=kernel.STRIBECK, place=i, values=(0.0, part * speed[i])))
        if (kernel.HIDDEN, i) not in taken:
            omega = np.sqrt(max(diagonal[i], 1e-12) / chain.m[i])
            for part in (0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.7, 2.3):
                rate = part * omega
                out.append(Law(kind=kernel.HIDDEN, place=i, values=(0.0, rate**2, 0.06 * rate)))
        if n > 1 and (kernel.GAIN, i) not in taken:
            out.append(Law(kind=kernel.GAIN, place=i, values=(0.0,)))
    rows = [j for j, there in enumerate(bench.springs) if there]
    for j in rows[:1] if n == 1 else rows:
        for side, most in ((1.0, stretch[0, j]), (-1.0, stretch[1, j])):
            for part in (0.08, 0.2, 0.35, 0.5, 0.65, 0.8):
                if most > 0.1 * stretch[:, j].max():
                    out.append(Law(kind=kernel.SLACK, place=j, values=(0.0, side * part * most)))
    return [law for law in out if records.allows(law)]


def cogging_laws(follow: Follow, records: Records) -> list[Law]:
    """Return cogging at trial pitches, close enough for its phase over the whole travel."""
    span = 0.0
    for track, own in zip(records.tracks, follow.own, strict=True):
        if track.free[0]:
            span = max(span, float(np.ptp(track.y[:, 0] - own.zero[0])))
    if span == 0.0 or (kernel.COGGING, 0) in follow.laws.keys:
        return []
    return [
        Law(kind=kernel.COGGING, place=0, values=(0.0, 0.0, span / count))
        for count in np.arange(1.5, 25.0, 0.4)
    ]


def backlash_laws(follow: Follow, records: Records) -> list[Law]:
    """Return a play between motor and cart 1, which no trial from nothing can show."""
    spans = [
        float(np.ptp(track.y[:, 0]))
        for track in records.tracks
        if track.free[0] and track.seen[0] and np.any(track.command)
    ]
    if not spans or (kernel.BACKLASH, 0) in follow.laws.keys:
        return []
    values = _PLAY * max(spans), _MOTOR * float(follow.p[0])
    law = Law(kind=kernel.BACKLASH, place=0, values=values)
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


def add_shaped(follow: Follow, records: Records) -> Follow | None:
    """Return the model with one more law that has a shape, or None where none helps."""
    best: Follow | None = None
    trials = [one.law for one in shaped_trials(follow, records)[:_SHORT_LIST]]
    for law in (*trials, *backlash_laws(follow, records)):
        laws, p = follow.laws.with_laws(follow.p, [law])
        trial = records.refit(follow, laws, p, iterations=8)
        if best is None or trial.total < best.total:
            best = trial
    if best is None or criterion(best) > criterion(follow):
        return None
    # Behind a contact, whose own law is known to a factor, another would mop up the rest of it.
    if _rough_contact(follow) and best.total > limits.CONTACT_GAIN * follow.total:
        return None
    return best


def _rough_contact(follow: Follow) -> bool:
    """Whether bodies meet in a way that is not fully described."""
    meets = CONTACTS & {kind for kind, _ in follow.laws.keys}
    return bool(meets) and follow.chi > limits.AT_FLOOR


# ------------------------------------------------------------------ the whole way


def start_all(
    records: Records, *, springs: Sequence[bool], chains: Sequence[Chain]
) -> Follow:
    """Return the model with all laws that need no shape, fitted from nothing.

    It starts from each of the `chains`.
    """
    tracks = records.tracks
    driven = any(np.any(track.command) for track in tracks)
    largest = max(float(np.abs(track.command).max()) for track in tracks)
    shown = np.any([track.free for track in tracks], axis=0)
    pinned = None if driven else int(np.argmax(shown))
    starts = []
    for chain in chains:
        bench = Bench(chain=chain, springs=tuple(springs), largest=largest, pinned=pinned)
        laws = smooth_laws(bench, driven=driven, shown=shown.tolist(), columns=records.columns)
        starts.append(
            start_follow(laws, laws.start(chain), tracks, gain=CLOSE, mapper=records.mapper)
        )
    fits = [records.fit(start, iterations=_FIRST) for start in starts]
    return records.fit(min(fits, key=lambda follow: follow.total), gain=LOOSE)


def choose_laws(
    records: Records,
    *,
    springs: Sequence[bool],
    chains: Sequence[Chain],
    tell: Callable[[str], None] = lambda text: None,
) -> Follow:
    """Return the model that following finds: the laws that are left, fitted to free runs."""
    full = start_all(records, springs=springs, chains=chains)
    lean = let_go(full, records)
    tell(f"all at once: {full.chi:.3f}, let go: {lean.chi:.3f}")
    for _ in range(_ROUNDS):
        if lean.gain == FREE and lean.chi < limits.AT_FLOOR:
            break
        more = add_shaped(full, records)
        if more is None:
            break
        leaner = let_go(more, records)
        tell(f"with {more.laws.keys[-1]}: {more.chi:.3f}, let go: {leaner.chi:.3f}")
        full = more
        if leaner.gain < lean.gain or criterion(leaner) < criterion(lean):
            lean = leaner
    return lean


def let_go(full: Follow, records: Records) -> Follow:
    """Drop what is nothing, then loosen the gain to none, dropping again.

    Where a looser model leaves more, something is missing: what it leaves then swings with the
    carts, and would ask for laws that are not there.
    """
    lean = _one_friction(drop_needless(full, records), records)
    for gain in (_NEAR_FREE, FREE):
        loose = records.fit(lean, gain=gain)
        if not loose.chi < _HOLDS * max(lean.chi, limits.AT_FLOOR):
            break
        lean = drop_needless(loose, records)
    return lean


def _one_friction(follow: Follow, records: Records) -> Follow:
    """Leave each cart one law of dry friction where it has two that exclude each other."""
    for place in range(follow.laws.bench.n):
        here = [i for i, key in enumerate(follow.laws.keys) if key[1] == place]
        sides = [
            [i for i in here if follow.laws.keys[i][0] in kinds]
            for kinds in ((kernel.COULOMB, kernel.STRIBECK), (kernel.DAHL,))
        ]
        if all(sides):
            trials = [
                records.refit(follow, *follow.laws.without(follow.p, groups)) for groups in sides
            ]
            follow = min(trials, key=lambda one: one.total)
    return follow


def rivals_of(lean: Follow, records: Records) -> list[Follow]:
    """Return models with one law exchanged for another, fitted as fully, the best first."""
    out: list[Follow] = []
    for group in lean.laws.groups():
        laws, p = lean.laws.without(lean.p, [group])
        bare = records.refit(lean, laws, p, gain=LOOSE, iterations=6)
        keys = {key for key in laws.keys if key[0] not in SIDED}
        everything = smooth_laws(
            laws.bench,
            driven=any(np.any(track.command) for track in records.tracks),
            shown=np.any([track.free for track in records.tracks], axis=0).tolist(),
            columns=records.columns,
        )
        gone = lean.laws.keys[group] if group >= 0 else None
        plain = [
            Law(kind=kind, place=place, values=(0.0,))
            for kind, place in everything.keys
            if (kind, place) not in keys and (kind, place) != gone
        ]
        trials = score(bare, records, plain)
        trials += [one for one in shaped_trials(bare, records) if one.law.key != gone]
        for q in range(kernel.DRIVE):
            if everything.drive[q] and not laws.drive[q] and group != -1 - q:
                opened = replace(laws, drive=tuple(f or i == q for i, f in enumerate(laws.drive)))
                trials.append(Scored(law=Law(kind=-1 - q, place=0, values=()), drop=0.0))
                out.append(records.refit(bare, opened, bare.p, iterations=6))
        trials.sort(key=lambda one: -one.drop)
        for one in trials[:_SHORT_LIST]:
            if one.law.kind >= 0:
                out.append(records.refit(bare, *laws.with_laws(bare.p, [one.law]), iterations=6))
    near = [one for one in out if np.isfinite(one.cost)]
    near.sort(key=lambda one: one.total)
    return [records.fit(one, gain=lean.gain) for one in near[:_SHORT_LIST]]
