"""Fit all parameters at once to the errors of a model that follows the records.

The method is Levenberg-Marquardt.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.independent import independent
from pipeline.gap.fit.bounded import bounded_step
from pipeline.gap.fit.levenberg_marquardt import Mapper
from pipeline.gap.pem.laws import COLUMNS, Column, LawSet, TrialLaw, column_set
from pipeline.gap.pem.run import PemRun, RunParameters, errors_of

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
    def inflate(self) -> float:
        """Factor on the noise, at least 1, that makes it as large as the misfit."""
        return max(1.0, float(np.sqrt(self.chi))) if np.isfinite(self.chi) else 1.0

    @property
    def total(self) -> float:
        """The cost including the priors."""
        return self.cost + self.inflate**2 * self.prior


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

    runs: tuple[PemRun, ...]
    mapper: Mapper
    columns: frozenset[Column]

    def allows(self, law: TrialLaw) -> bool:
        """Return whether the catalogue has an effect for a law."""
        return column_set(COLUMNS[law.kind]) <= self.columns

    def begin(self, laws: LawSet, p: Array, *, gain: float) -> PemFit:
        """Return a model before any fit."""
        own = tuple(track.fresh() for track in self.runs)
        return self.evaluate(PemFit(laws=laws, p=p, own=own, gain=gain, cost=np.inf, points=1.0))

    def evaluate(self, fit: PemFit) -> PemFit:
        """Return the model with its cost, which is infinite if the simulation diverges."""
        laws, dry = fit.laws, fit.laws.dry

        def one(pair: tuple[PemRun, RunParameters]) -> tuple[tuple[float, float], Array]:
            track, own = pair
            run = errors_of(laws, fit.p, track, own, gain=fit.gain, derive=False)
            if run is None:
                return (np.inf, np.inf), np.zeros((1, 1))  # counts as one reading
            left = run[0] * track.weight
            prior = track.prior(own, dry)[1]
            cost = float((left**2).sum()), float((prior**2).sum())
            return cost, left[:, track.seen].T

        told = self.mapper(one, zip(self.runs, fit.own, strict=True))
        costs, errors = zip(*told, strict=True)
        points = sum(track.points for track in self.runs)
        cost, prior = np.sum(costs, axis=0).tolist()
        return replace(fit, cost=cost, points=points, prior=prior, errors=errors)

    def slope(self, fit: PemFit, *, factors: bool = True) -> Slope:
        """Return the normal equations; without `factors`, dry friction is the same in all runs."""
        laws, size, inflate = fit.laws, fit.p.size, fit.inflate
        dry = laws.dry & factors

        def one(pair: tuple[PemRun, RunParameters]) -> tuple[Array, Array, Array]:
            track, own = pair
            run = errors_of(laws, fit.p, track, own, gain=fit.gain, derive=True)
            # An almost infinite slope has no finite square.
            if run is None or not np.vdot(run[1], run[1]) < 1e200:
                nothing = np.full((size, size), np.nan)
                return nothing, nothing[0], nothing
            E, J = run
            weight = track.weight[:, track.seen]
            J = J if track.seen.all() else np.ascontiguousarray(J[:, :, track.seen])
            J *= weight
            J = J.reshape(len(J), -1)
            A, r = J @ J.T, J @ (E[:, track.seen] * weight).ravel()
            hold, off = track.prior(own, dry)
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
                    track.moved(one, taken[:, -1] - taken[:, :-1] @ delta)
                    for track, one, taken in zip(self.runs, best.own, slope.back, strict=True)
                )
                trial = self.evaluate(replace(best, p=best.p + delta, own=own))
                if trial.cost + best.inflate**2 * trial.prior < best.total:
                    break
                damp = max(damp * _CHANGE, _DAMP)
            else:
                break
            fall = 1.0 - (trial.cost + best.inflate**2 * trial.prior) / best.total
            best, damp = trial, max(damp / _CHANGE, _LEAST_DAMP)
            # The fit has converged.
            if fall < 1e-3:
                break
        return best


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
