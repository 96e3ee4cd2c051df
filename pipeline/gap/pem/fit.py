"""Fit models that follow the records, and choose the laws that the records need.

First fit all laws that can grow from zero, then add laws that need a shape (such as the position of
an end stop), then drop needless ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.fit import Mapper, bounded_step
from pipeline.gap.pem.model import (
    COEFFICIENTS,
    COLUMNS,
    POSITIVE,
    Column,
    LawSet,
    PemSetup,
    RunParameters,
    TrialLaw,
    column_set,
    errors_of,
    smooth_laws,
)
from pipeline.gap.runs import GapRun, independent
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.terms import EffectKind
from pipeline.words.progress import Progress, silent

# ------------------------------------------------------------- the fit of all parameters at once
#
# The method is Levenberg-Marquardt.

_DAMP, _CHANGE, _LEAST_DAMP = 1e-4, 8.0, 1e-9
_RIDGE = 1e-12  # share of the diagonal of each run that is added to it


@dataclass(frozen=True, kw_only=True, eq=False)
class PemFit:
    """A model that follows the records.

    `p` is the vector of shared parameters; `own` holds the parameters of each run. `cost` is the
    sum of squared errors in units of the noise. `points` is the number of errors. `errors` (rows,
    samples) of each run are in units of the noise. `gain` is the share of each error that corrects
    the state.
    """

    laws: LawSet
    p: Array
    own: tuple[RunParameters, ...]
    gain: float
    cost: float
    points: float
    errors: tuple[Array, ...] = ()
    prior: float = 0.0

    @property
    def chi(self) -> float:
        """Mean squared error per reading, in units of the noise."""
        return self.cost / self.points

    @cached_property
    def n_independent(self) -> float:
        """The number of independent errors, at most a quarter of the readings."""
        if any(self.laws.bench.springs):
            alone = sum(sum(map(independent, run)) for run in self.errors)
        else:
            alone = sum(run.size for run in self.errors)
        return min(alone, self.points / 4.0)

    @property
    def inflation(self) -> float:
        """Factor on the noise, at least 1, that makes it as large as the misfit."""
        return max(1.0, float(np.sqrt(self.chi))) if np.isfinite(self.chi) else 1.0

    @property
    def total(self) -> float:
        """The cost including the priors."""
        return self.cost + self.inflation**2 * self.prior


@dataclass(frozen=True, kw_only=True, eq=False)
class Slope:
    """The normal equations H and b of a step of the vector.

    The parameters of single runs are eliminated. Their steps follow from a step of the vector
    through `back`.
    """

    H: Array
    b: Array
    back: tuple[Array, ...]

    @property
    def is_finite(self) -> bool:
        """Whether no simulation diverged."""
        return bool(np.all(np.isfinite(self.H)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Records:
    """The data to follow: the runs, their mapper, and the columns that laws may fill."""

    runs: tuple[GapRun, ...]
    mapper: Mapper
    columns: frozenset[Column]

    def allows(self, law: TrialLaw) -> bool:
        """Return whether the catalogue has an effect for a law."""
        return column_set(COLUMNS[law.kind]) <= self.columns

    def begin(self, laws: LawSet, p: Array, *, gain: float) -> PemFit:
        """Return a model before any fit."""
        own = tuple(map(RunParameters.of, self.runs))
        return self.evaluate(PemFit(laws=laws, p=p, own=own, gain=gain, cost=np.inf, points=1.0))

    def evaluate(self, fit: PemFit) -> PemFit:
        """Return the model with its cost, which is infinite if the simulation diverges."""
        laws, dry = fit.laws, fit.laws.dry

        def one(pair: tuple[GapRun, RunParameters]) -> tuple[tuple[float, float], Array]:
            run, own = pair
            told = errors_of(laws, fit.p, run, own, gain=fit.gain, derive=False)
            if told is None:
                return (np.inf, np.inf), np.zeros((1, 1))  # counts as one reading
            left = told[0] * run.followed.weight
            prior = own.prior(run, dry)[1]
            cost = float((left**2).sum()), float((prior**2).sum())
            return cost, left[:, run.followed.seen].T

        told = self.mapper(one, zip(self.runs, fit.own, strict=True))
        costs, errors = zip(*told, strict=True)
        points = sum(map(_points, self.runs))
        cost, prior = np.sum(costs, axis=0).tolist()
        return replace(fit, cost=cost, points=points, prior=prior, errors=errors)

    def slope(self, fit: PemFit, *, factors: bool = True) -> Slope:
        """Return the normal equations; without `factors`, dry friction is the same in all runs."""
        laws, size, inflate = fit.laws, fit.p.size, fit.inflation
        dry = laws.dry & factors

        def one(pair: tuple[GapRun, RunParameters]) -> tuple[Array, Array, Array]:
            run, own = pair
            told = errors_of(laws, fit.p, run, own, gain=fit.gain, derive=True)
            # An almost infinite slope has no finite square.
            if told is None or not np.vdot(told[1], told[1]) < 1e200:
                nothing = np.full((size, size), np.nan)
                return nothing, nothing[0], nothing
            (E, J), seen = told, run.followed.seen
            weight = run.followed.weight[:, seen]
            J = J if seen.all() else np.ascontiguousarray(J[:, :, seen])
            J *= weight
            J = J.reshape(len(J), -1)
            A, r = J @ J.T, J @ (E[:, seen] * weight).ravel()
            hold, off = own.prior(run, dry)
            mine = A[size:, size:] + np.diag((inflate * hold) ** 2)
            mine += _RIDGE * np.diag(np.diag(mine))
            right = np.column_stack([A[size:, :size], r[size:] + inflate**2 * hold * off])
            taken = np.linalg.solve(mine, right)
            H = A[:size, :size] - A[:size, size:] @ taken[:, :size]
            b = r[:size] - A[:size, size:] @ taken[:, size]
            return H, b, np.asarray(taken, dtype=np.float64)

        H, b, back = zip(*self.mapper(one, zip(self.runs, fit.own, strict=True)), strict=True)
        return Slope(H=np.sum(H, axis=0), b=np.sum(b, axis=0), back=back)

    def refit(self, fit: PemFit, laws: LawSet, p: Array, **options: Any) -> PemFit:
        """Refit a model with other laws, keeping the runs' own parameters."""
        return self.fit(replace(fit, laws=laws, p=p), **options)

    def fit(self, start: PemFit, *, gain: float | None = None, iterations: int = 12) -> PemFit:
        """Fit a model from its present values, with its present gain or the given `gain`."""
        best = self.evaluate(start if gain is None else replace(start, gain=gain))
        bounds = best.laws.steps_of_shape(best.p)
        damp = _DAMP
        for _ in range(iterations):
            if not np.isfinite(best.cost):
                break
            slope = self.slope(best)
            if not slope.is_finite:
                break
            for _attempt in range(6):
                delta = _step(slope, best.p, bounds, damp=damp)
                own = tuple(
                    one.moved(taken[:, -1] - taken[:, :-1] @ delta)
                    for one, taken in zip(best.own, slope.back, strict=True)
                )
                trial = self.evaluate(replace(best, p=best.p + delta, own=own))
                if trial.cost + best.inflation**2 * trial.prior < best.total:
                    break
                damp = max(damp * _CHANGE, _DAMP)
            else:
                break
            fall = 1.0 - (trial.cost + best.inflation**2 * trial.prior) / best.total
            best, damp = trial, max(damp / _CHANGE, _LEAST_DAMP)
            # The fit has converged.
            if fall < 1e-3:
                break
        return best


def _points(run: GapRun) -> float:
    """Return the number of readings of a run, each counted by its weight."""
    weight = run.followed.weight
    largest = np.maximum(weight.max(axis=0), 1e-300)
    return float(((weight / largest) ** 2).sum())


def _step(slope: Slope, p: Array, bounds: tuple[Array, Array, Array], *, damp: float) -> Array:
    """Return the damped step, within bounds and step limits."""
    low, high, _ = bounds
    power = np.maximum(np.diag(slope.H), 0.0)

    def solve(active: np.ndarray) -> Array:
        size = np.sqrt(power[active])
        A = slope.H[np.ix_(active, active)] / np.outer(size, size)
        return np.linalg.solve(A + damp * np.eye(active.size), slope.b[active] / size) / size

    active = np.flatnonzero((power > 1e-24 * power.max()) & (low < high))
    return bounded_step(p, bounds, active, solve=solve, rounds=12)


# ---------------------------------------------- how much a law with a shape would lower the cost
#
# A law of size zero moves nothing, but the derivatives give its first-order effect. Its best size,
# together with the other parameters, follows from a small linear problem.
#
# Reference: T. Söderström, P. Stoica, System Identification, section 11.5 (score tests).


def score(fit: PemFit, records: Records, trials: Sequence[TrialLaw]) -> list[TrialLaw]:
    """Return the trial laws that would help in addition to the model's laws, the best first.

    They have their best values, and the decrease of the cost that these would give.
    """
    laws, p = fit.laws.with_laws(fit.p, trials)
    wide = replace(fit, laws=laws, p=p)
    slope = records.slope(wide)
    if not np.all(np.isfinite(slope.H)):
        return []
    low, high, _ = fit.laws.bounds()
    power = np.maximum(np.diag(slope.H), 0.0)
    base = np.arange(fit.p.size)
    at_bound = (fit.p <= low) | (fit.p >= high)
    # A parameter with less than this share of the largest power is undetermined.
    base = base[(power[base] > 1e-20 * power.max()) & (low < high) & ~at_bound]
    size = np.sqrt(power[base])
    A = slope.H[np.ix_(base, base)] / np.outer(size, size) + 1e-10 * np.eye(base.size)
    out = []
    first = len(fit.laws.keys)
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
        # A law needs this share of its power after the other parameters are adjusted.
        S = S + 1e-9 * np.diag(np.diag(slope.H)[mine])
        found = np.linalg.solve(S, b)
        if law.kind in POSITIVE and np.any(found < 0.0):
            # The second value, the damping of a contact, may be zero.
            found = np.array([b[0] / S[0, 0], *np.zeros(mine.size - 1)])
            if found[0] <= 0.0:
                continue
        drop = float(2 * found @ b - found @ S @ found)
        values = list(law.values)
        for i, value in zip(mine, found, strict=True):
            values[i - o] = float(value)
        out.append(replace(law, values=tuple(values), drop=drop))
    return sorted(out, key=lambda one: -one.drop)


def shaped_laws(fit: PemFit, records: Records) -> list[TrialLaw]:
    """Return laws that need a shape, with size zero and with shapes that a fit can start from."""
    bench = fit.laws.bench
    n = bench.n
    chain = fit.laws.chain(fit.p)
    diagonal = np.diag(chain.stiffness)
    position = np.zeros((2, n))
    stretch = np.zeros((2, n + 1))
    speed = np.zeros(n)
    for run, own in zip(records.runs, fit.own, strict=True):
        followed = run.followed
        x = np.where(followed.free, followed.y - own.zero, 0.0)
        position = np.maximum(position, [x.max(0), -x.min(0)])
        d = np.diff(np.pad(x, ((0, 0), (1, 1))), axis=1)
        stretch = np.maximum(stretch, [d.max(0), -d.min(0)])
        v = np.gradient(x, followed.t, axis=0)
        speed = np.maximum(speed, np.quantile(np.abs(v), 0.98, axis=0))
    shapes: dict[tuple[int, int], list[tuple[float, ...]]] = {}
    for i in range(n):
        reach = position[:, i].max()
        if reach <= 0.0:
            continue
        omega = np.sqrt(max(diagonal[i], 1e-12) / chain.m[i])
        # Trial frequencies of a hidden mass; its damping is 3 % of critical.
        rates = [part * omega for part in (0.45, 0.6, 0.75, 0.9, 1.05, 1.2, 1.4, 1.7, 2.3)]
        stops = _to_both_sides(position[:, i], (0.2, 0.4, 0.55, 0.7, 0.8, 0.87, 0.93, 0.97))
        shapes |= {
            (EffectKind.END_STOP, i): [(0.0, at, 0.0) for at in stops],
            (EffectKind.PRESLIDING_FRICTION, i): [
                (0.0, part * reach) for part in (0.004, 0.012, 0.035)
            ],
            (EffectKind.STICTION, i): [(0.0, part * speed[i]) for part in (0.02, 0.06, 0.15)],
            (EffectKind.EXTRA_MODE, i): [(0.0, rate**2, 0.06 * rate) for rate in rates],
            (EffectKind.SENSOR_GAIN, i): [(0.0,)] if n > 1 else [],
        }
    for j in bench.rows:
        slack = _to_both_sides(stretch[:, j], (0.08, 0.2, 0.35, 0.5, 0.65, 0.8))
        shapes[EffectKind.SLACK_SPRING, j] = [(0.0, at) for at in slack]
    out = [
        TrialLaw(kind=kind, place=place, values=values)
        for (kind, place), trials in shapes.items()
        for values in trials
        if (kind, place) not in fit.laws.keys
    ]
    return [law for law in out if records.allows(law)]


def _to_both_sides(most: Array, parts: Sequence[float]) -> list[float]:
    """Return fractions (`parts`) of the largest excursion on each side that is really reached."""
    sides = [(side, most[k]) for k, side in enumerate((1.0, -1.0)) if most[k] > 0.1 * most.max()]
    return [side * part * size for side, size in sides for part in parts]


def cogging_laws(fit: PemFit, records: Records) -> list[TrialLaw]:
    """Return cogging at trial pitches, close enough that its phase fits over the whole travel."""
    span = 0.0
    for run, own in zip(records.runs, fit.own, strict=True):
        if run.free[0]:
            span = max(span, float(np.ptp(run.followed.y[:, 0] - own.zero[0])))
    if span == 0.0 or (EffectKind.COGGING, 0) in fit.laws.keys:
        return []
    # Numbers of pitches in the travel, in steps of less than one half.
    counts = np.arange(1.5, 25.0, 0.4).tolist()
    return [TrialLaw(kind=EffectKind.COGGING, place=0, values=(0.0, 0.0, span / n)) for n in counts]


def backlash_laws(fit: PemFit, records: Records) -> list[TrialLaw]:
    """Return trial laws for backlash at the motor, which no fit from zero can find."""
    spans = [
        float(np.ptp(run.followed.y[:, 0]))
        for run in records.runs
        if run.followed.seen[0] and np.any(run.command)
    ]
    if not spans or (EffectKind.BACKLASH, 0) in fit.laws.keys:
        return []
    # Size of the gap, motor mass, and speed after an impact relative to the speed before it.
    values = 0.03 * max(spans), 0.15 * float(fit.p[0]), 0.4
    law = TrialLaw(kind=EffectKind.BACKLASH, place=0, values=values)
    return [law] if records.allows(law) else []


def shaped_trials(fit: PemFit, records: Records) -> list[TrialLaw]:
    """Return the laws with a shape that would help the model, the best first.

    Only the best shape of each law at each place and side is returned.
    """
    trials = score(fit, records, shaped_laws(fit, records))
    moving = [i for i, t in enumerate(records.runs) if t.free[0] and np.any(t.command)]
    cogging = cogging_laws(fit, records) if moving else []
    if cogging and records.allows(cogging[0]):
        part = replace(records, runs=tuple(records.runs[i] for i in moving))
        own = tuple(fit.own[i] for i in moving)
        trials += score(replace(fit, own=own), part, cogging)
    best: dict[tuple, TrialLaw] = {}
    for one in sorted(trials, key=lambda one: -one.drop):
        if one.drop > 0.0:
            best.setdefault(one.sided, one)
    return list(best.values())


# ---------------------------------------------------------------------- dropping needless laws

_DROP_RIDGE = 1e-10  # share of the diagonal that is added to it
_CONTACTS = {EffectKind.BACKLASH}


def is_rough(fit: PemFit) -> bool:
    """Return whether the model has contacts and does not fit down to the noise."""
    meets = _CONTACTS & {kind for kind, _ in fit.laws.keys}
    return bool(meets) and fit.chi > limits.AT_FLOOR


def bic(fit: PemFit, n_independent: float) -> float:
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
    return bic(fuller, fuller.n_independent) < bic(other, fuller.n_independent)


def drop_needless(fit: PemFit, records: Records) -> PemFit:
    """Drop every law that the criterion does not need, the least needed first; refit the others."""
    while order := _needless(fit, records):
        here, rough = bic(fit, fit.n_independent), is_rough(fit)
        while order:
            laws, p = fit.laws.without(fit.p, order)
            trial = records.refit(fit, laws, p)
            if rough or bic(trial, fit.n_independent) < here:
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
        inverse = np.linalg.inv(A + _DROP_RIDGE * np.eye(active.size)) / np.outer(size, size)
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


# ---------------------------------------------------------------------- choosing the laws

CLOSE, LOOSE, FREE = 0.5, 0.1, 0.0  # gains: share of the error that corrects the model
_FIRST = 25  # iterations of the first fit, which may start far from the solution
_FEW = 6  # iterations of a fit that only shows whether a rival comes near
_SHORT_LIST = 4  # number of laws with a shape for which the model is refitted


def start_all(records: Records, *, springs: Sequence[bool], chains: Sequence[Chain]) -> PemFit:
    """Return the model with all laws that need no shape, fitted from zero.

    The fit is done from each of the `chains`; the best result is returned.
    """
    largest = max(float(np.abs(run.command).max()) for run in records.runs)
    free = tuple(run.free for run in records.runs)
    pinned = int(np.argmax(np.any(free, axis=0))) if largest == 0.0 else None

    def fitted(chain: Chain) -> PemFit:
        bench = PemSetup(
            chain=chain, springs=tuple(springs), largest=largest, free=free, pinned=pinned
        )
        laws = smooth_laws(bench, columns=records.columns)
        start = records.begin(laws, laws.start(chain), gain=CLOSE)
        return records.fit(start, iterations=_FIRST)

    fits = list(records.mapper(fitted, chains))
    return records.fit(min(fits, key=lambda follow: follow.total), gain=LOOSE)


def choose_laws(
    records: Records,
    *,
    springs: Sequence[bool],
    chains: Sequence[Chain],
    progress: Progress = silent,
) -> PemFit:
    """Return the model with only the needed laws, fitted to free simulations if possible."""
    full = start_all(records, springs=springs, chains=chains)
    lean = reduce_gain(full, records)
    progress(f"all laws fitted together: {len(lean.laws.groups())} remain")
    # Add at most six laws with a shape; a real bench has several.
    for _ in range(6):
        if lean.gain == FREE and lean.chi < limits.AT_FLOOR:
            break
        more = add_shaped(full, records)
        if more is None:
            break
        leaner = reduce_gain(more, records)
        added = CATALOGUE[more.laws.keys[-1][0]].title.lower()
        progress(f"with {added}: {len(leaner.laws.groups())} laws remain")
        full = more
        if leaner.gain < lean.gain or is_better(leaner, lean):
            lean = leaner
    return lean


def add_shaped(fit: PemFit, records: Records) -> PemFit | None:
    """Return the model with one more law that has a shape, or None if no such law helps."""
    best: PemFit | None = None
    trials = shaped_trials(fit, records)[:_SHORT_LIST]
    for law in (*trials, *backlash_laws(fit, records)):
        laws, p = fit.laws.with_laws(fit.p, [law])
        trial = records.refit(fit, laws, p, iterations=8)
        if best is None or bic(trial, fit.n_independent) < bic(best, fit.n_independent):
            best = trial
    if best is None or not is_better(best, fit):
        return None
    # The law of a contact is only approximate, and a further law could absorb its error. So the
    # further law must remove at least half of the excess.
    if is_rough(fit) and best.total > _half_way(fit):
        return None
    return best


def _half_way(fit: PemFit) -> float:
    """Return the cost at which half of the excess over the noise remains."""
    return fit.points + limits.CONTACT_GAIN * max(fit.total - fit.points, 0.0)


def reduce_gain(full: PemFit, records: Records) -> PemFit:
    """Drop needless laws, then lower the gain to zero, dropping again at each step.

    If the error grows with a lower gain, an effect is missing. The error of a missing effect swings
    with the carts, and would be mistaken for laws that do not exist.
    """
    lean = _one_friction(drop_needless(full, records), records)
    for gain in (0.02, FREE):
        loose = records.fit(lean, gain=gain)
        # An effect is missing if the error grows by half.
        if not loose.chi < 1.5 * max(lean.chi, limits.AT_FLOOR):
            break
        lean = drop_needless(loose, records)
    return _look_again(lean, records) if lean.gain == FREE else lean


def _look_again(lean: PemFit, records: Records) -> PemFit:
    """Fit all laws once more to free simulations, which show small errors; drop needless laws."""
    everything = smooth_laws(lean.laws.bench, columns=records.columns)
    missing = [key for key in everything.keys if key not in lean.laws.keys]
    extra = [TrialLaw(kind=kind, place=place, values=(0.0,)) for kind, place in missing]
    laws, p = replace(lean.laws, drive=everything.drive).with_laws(lean.p, extra)
    again = records.refit(lean, laws, p, iterations=_FEW)
    again = _one_friction(drop_needless(again, records), records)
    return again if is_better(again, lean) else lean


def _one_friction(fit: PemFit, records: Records) -> PemFit:
    """Keep only one kind of dry friction on each cart, because two kinds exclude each other."""
    for place in range(fit.laws.bench.n):
        here = [i for i, key in enumerate(fit.laws.keys) if key[1] == place]
        sides = [
            [i for i in here if fit.laws.keys[i][0] in kinds]
            for kinds in (
                (EffectKind.COULOMB_FRICTION, EffectKind.STICTION),
                (EffectKind.PRESLIDING_FRICTION,),
            )
        ]
        if all(sides):
            trials = [records.refit(fit, *fit.laws.without(fit.p, groups)) for groups in sides]
            fit = min(trials, key=lambda one: one.total)
    return fit


def rivals_of(lean: PemFit, records: Records) -> list[PemFit]:
    """Return refitted models in which one law is replaced by another, the best first."""
    everything = smooth_laws(lean.laws.bench, columns=records.columns)
    out: list[PemFit] = []
    for group in lean.laws.groups():
        laws, p = lean.laws.without(lean.p, [group])
        bare = records.refit(lean, laws, p, gain=LOOSE, iterations=_FEW)
        gone = lean.laws.keys[group] if group >= 0 else None
        taken = {gone, *laws.keys}
        plain = [TrialLaw(kind=kind, place=place, values=(0.0,)) for kind, place in everything.keys]
        trials = [*score(bare, records, plain), *shaped_trials(bare, records)]
        trials = sorted((one for one in trials if one.key not in taken), key=lambda one: -one.drop)
        exchanged = [laws.with_laws(bare.p, [one]) for one in trials[:_SHORT_LIST]]
        for q, free in enumerate(everything.drive):
            if free and not laws.drive[q] and group != -1 - q:
                drive = tuple(f or i == q for i, f in enumerate(laws.drive))
                exchanged.append((replace(laws, drive=drive), bare.p))

        def fitted(model: tuple[LawSet, Array], bare: PemFit = bare) -> PemFit:
            return _one_friction(records.refit(bare, *model, iterations=_FEW), records)

        out += records.mapper(fitted, exchanged)
    near = sorted((one for one in out if np.isfinite(one.cost)), key=lambda one: one.total)
    return list(records.mapper(partial(records.fit, gain=lean.gain), near[:_SHORT_LIST]))
