"""Drop needless laws one by one, as long as the Bayesian criterion improves."""

import numpy as np

from pipeline.gap import limits
from pipeline.gap.pem.fit import PemFit, Records
from pipeline.plant.simulator.terms import EffectKind

_RIDGE = 1e-10  # share of the diagonal that is added to it
_CONTACTS = {EffectKind.BACKLASH}


def is_rough(fit: PemFit) -> bool:
    """Return whether the model has contacts and does not fit down to the noise."""
    meets = _CONTACTS & {kind for kind, _ in fit.laws.keys}
    return bool(meets) and fit.chi > limits.AT_FLOOR


def criterion(fit: PemFit, n_independent: float) -> float:
    """Return the Bayesian criterion for `n_independent` readings, with a penalty for every effect.

    Two models are compared with the fuller model's `n_independent`, because only its residual is
    due to chance.
    """
    low, high, _ = fit.laws.bounds()
    size = int(np.sum(low < high))
    return (
        n_independent * float(np.log(max(fit.total, 1e-300) / fit.points))
        + size * float(np.log(n_independent))
        + len(fit.laws.groups()) * limits.SAME_LAW
    )


def is_better(fuller: PemFit, other: PemFit) -> bool:
    """Return whether the criterion prefers the fuller of two models."""
    return criterion(fuller, fuller.n_independent) < criterion(other, fuller.n_independent)


def drop_needless(fit: PemFit, records: Records) -> PemFit:
    """Drop every law that the criterion does not need, the least needed first; refit the others."""
    while order := _needless(fit, records):
        here, rough = criterion(fit, fit.n_independent), is_rough(fit)
        while order:
            laws, p = fit.laws.without(fit.p, order)
            trial = records.refit(fit, laws, p)
            if rough or criterion(trial, fit.n_independent) < here:
                fit = trial
                break
            if len(order) == 1:
                return fit
            order = order[: len(order) // 2]
    return fit


def _needless(fit: PemFit, records: Records) -> list[int]:
    """Return the groups that may be dropped, least needed first, by the quadratic cost model."""
    slope = records.slope(fit, factors=False)
    if not slope.is_finite:
        return []
    groups = dict(fit.laws.groups())
    off = fit.p - fit.laws.neutral()
    low, high, _ = fit.laws.bounds()
    power = np.maximum(np.diag(slope.H), 0.0)
    # A parameter with less than this share of the largest power is undetermined.
    usable = (power > 1e-20 * power.max()) & (low < high)
    order = [g for g, at in groups.items() if not np.any(np.abs(off[at]) > 0.0)]
    for g in order:
        usable[fit.laws.whole_group(g)] = False
        del groups[g]
    for g in [g for g, at in groups.items() if not usable[at].all()]:
        if not usable[groups[g]].any():
            order.append(g)
            del groups[g]
    count, cost, rough = fit.n_independent, fit.total, is_rough(fit)
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
            price = limits.SAME_LAW + len(fit.laws.whole_group(g)) * np.log(count)
            if rough and (g < 0 or fit.laws.keys[g][0] not in _CONTACTS):
                # A law counts only if the excess over the noise would at least double without it.
                beyond = max(cost - fit.points, 0.0) * (1.0 / limits.CONTACT_GAIN - 1.0)
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
        gone = set(fit.laws.whole_group(g).tolist())
        active = np.array([i for i in active.tolist() if i not in gone])
        del groups[g]
    return order
