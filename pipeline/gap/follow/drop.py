"""Drop needless laws one by one, as long as the Bayesian criterion improves."""

import numpy as np

from pipeline.gap import limits
from pipeline.gap.follow.fit import Follow, Records
from pipeline.plant.simulator.terms import Kind

_RIDGE = 1e-10  # share of the diagonal that is added to it
_CONTACTS = {Kind.BACKLASH}


def is_rough(follow: Follow) -> bool:
    """Return whether the model has contacts and does not fit down to the noise."""
    meets = _CONTACTS & {kind for kind, _ in follow.laws.keys}
    return bool(meets) and follow.chi > limits.AT_FLOOR


def criterion(follow: Follow, n_independent: float) -> float:
    """Return the Bayesian criterion for `n_independent` readings, with a penalty for every effect.

    Two models are compared with the fuller model's `n_independent`, because only its residual is
    due to chance.
    """
    low, high, _ = follow.laws.bounds()
    size = int(np.sum(low < high))
    return (
        n_independent * float(np.log(max(follow.total, 1e-300) / follow.points))
        + size * float(np.log(n_independent))
        + len(follow.laws.groups()) * limits.SAME_LAW
    )


def is_better(fuller: Follow, other: Follow) -> bool:
    """Return whether the criterion prefers the fuller of two models."""
    return criterion(fuller, fuller.n_independent) < criterion(other, fuller.n_independent)


def drop_needless(follow: Follow, records: Records) -> Follow:
    """Drop every law that the criterion does not need, the least needed first; refit the others."""
    while order := _needless(follow, records):
        here, rough = criterion(follow, follow.n_independent), is_rough(follow)
        while order:
            laws, p = follow.laws.without(follow.p, order)
            trial = records.refit(follow, laws, p)
            if rough or criterion(trial, follow.n_independent) < here:
                follow = trial
                break
            if len(order) == 1:
                return follow
            order = order[: len(order) // 2]
    return follow


def _needless(follow: Follow, records: Records) -> list[int]:
    """Return the groups that may be dropped, least needed first, by the quadratic cost model."""
    slope = records.slope(follow, factors=False)
    if not slope.sound:
        return []
    groups = dict(follow.laws.groups())
    off = follow.p - follow.laws.neutral()
    low, high, _ = follow.laws.bounds()
    power = np.maximum(np.diag(slope.H), 0.0)
    # A parameter with less than this share of the largest power is undetermined.
    usable = (power > 1e-20 * power.max()) & (low < high)
    order = [g for g, at in groups.items() if not np.any(np.abs(off[at]) > 0.0)]
    for g in order:
        usable[follow.laws.whole_group(g)] = False
        del groups[g]
    for g in [g for g, at in groups.items() if not usable[at].all()]:
        if not usable[groups[g]].any():
            order.append(g)
            del groups[g]
    count, cost, rough = follow.n_independent, follow.total, is_rough(follow)
    active = np.flatnonzero(usable)
    while groups:
        size = np.sqrt(power[active])
        A = slope.H[np.ix_(active, active)] / np.outer(size, size)
        inverse = np.linalg.inv(A + _RIDGE * np.eye(active.size)) / np.outer(size, size)
        where = {index: at for at, index in enumerate(active.tolist())}
        found: list[tuple[float, int, list[int], float]] = []
        for g, at in groups.items():
            mine = [where[i] for i in at.tolist() if i in where]
            d = off[active[mine]]
            rise = float(d @ np.linalg.solve(inverse[np.ix_(mine, mine)], d))
            price = limits.SAME_LAW + len(follow.laws.whole_group(g)) * np.log(count)
            if rough and (g < 0 or follow.laws.keys[g][0] not in _CONTACTS):
                # A law counts only if the excess over the noise would at least double without it.
                beyond = max(cost - follow.points, 0.0) * (1.0 / limits.CONTACT_GAIN - 1.0)
                price = max(price, count * float(np.log1p(beyond / cost)))
            excess = count * float(np.log1p(max(rise, 0.0) / cost)) - price
            found.append((excess, g, mine, max(rise, 0.0)))
        excess, g, mine, rise = min(found)
        if excess > 0.0:
            break
        d = off[active[mine]]
        off[active] -= inverse[:, mine] @ np.linalg.solve(inverse[np.ix_(mine, mine)], d)
        cost += rise
        order.append(g)
        gone = set(follow.laws.whole_group(g).tolist())
        active = np.array([i for i in active.tolist() if i not in gone])
        del groups[g]
    return order
