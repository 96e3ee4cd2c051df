"""One run for a model that follows it: thinned readings, the run's own parameters, errors."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.gap.pem import forces, kernel
from pipeline.gap.pem.laws import DEAD_ZONE, LIMIT, LawSet, PemSetup
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.terms import EffectKind

_LONGEST = 2.5e-3  # s; longest step for a bench of carts
_FREELY = 0.4  # factor on the longest step for a small gain, where step errors add up
_KNOCK = 0.25  # factor on the longest step if bodies may meet
_SURE = 1e6  # weight of known quantities
_FACTORS, _FACTOR_STEP = (0.3, 3.0), 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class RunParameters:
    """The parameters of one run, (n,) each.

    They are encoder zeros, shifts of the start, start velocities, and factors on dry friction.
    """

    zero: Array
    shift: Array
    v0: Array
    factor: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PemRun:
    """One thinned run, with arrays (samples, n).

    `weight` is divided by the noise; `guided` is the motion of held carts.
    """

    t: Array
    y: Array
    weight: Array
    free: np.ndarray
    seen: np.ndarray
    guided: Array
    knots: Array
    command: Array
    start: Array
    slope: Array
    zero: Array
    zero_std: Array
    at_rest: bool
    start_std: tuple[Array, Array]
    longest: float
    swing: float

    @cached_property
    def points(self) -> float:
        """The number of readings, each counted by its weight."""
        largest = np.maximum(self.weight.max(axis=0), 1e-300)
        return float(((self.weight / largest) ** 2).sum())

    def fresh(self) -> RunParameters:
        """Return the run's own parameters at their expected values."""
        n = self.free.size
        return RunParameters(
            zero=self.zero.copy(), shift=np.zeros(n), v0=self.slope.copy(), factor=np.ones(n)
        )

    def prior(self, own: RunParameters, dry: np.ndarray) -> tuple[Array, Array]:
        """Return weights (4 n,) of the priors on the run's own parameters, and residuals."""
        n = self.free.size
        # At a release the first readings may be off by a third of the swing.
        start = np.full(n, _SURE if self.at_rest else 1.0 / max(0.3 * self.swing, 1e-12))
        speed = np.where(self.free & (not self.at_rest), 1.0 / self.start_std[1], _SURE)
        start = np.where(np.isfinite(self.start_std[0]), 1.0 / self.start_std[0], start)
        factor = np.where(dry, 1.0 / 0.05, _SURE)  # friction differs by 5 % between runs
        weight = np.concatenate([1.0 / self.zero_std, start, speed, factor])
        off = [self.zero - own.zero, -own.shift, self.slope - own.v0, 1.0 - own.factor]
        # An unknown velocity needs a weak prior, because following the record closely does not
        # determine it.
        weight[2 * n : 3 * n] = np.maximum(weight[2 * n : 3 * n], 1e-3 / max(self.swing, 1e-12))
        return weight, weight * np.concatenate(off)

    def moved(self, own: RunParameters, by: Array) -> RunParameters:
        """Return the run's own parameters after a step (4 n,)."""
        zero, shift, v0, factor = by.reshape(4, -1)
        step = np.clip(factor, -_FACTOR_STEP, _FACTOR_STEP)
        return RunParameters(
            zero=own.zero + zero,
            shift=own.shift + shift,
            v0=own.v0 + v0,
            factor=np.clip(own.factor + step, *_FACTORS),
        )


def make_track(run: GapRun) -> PemRun:
    """Thin a run to the sample rate that is needed to describe a swing."""
    n = run.zero.size
    sampled = 1.0 / float(np.median(np.diff(run.t)))
    # 100 Hz for a bench of carts, which is some twenty readings per swing.
    thin = replace(run, block=max(1, int(sampled * run.pace / 100.0))).thin
    y, weight = np.zeros((thin.t.size, n)), np.zeros((thin.t.size, n))
    seen, free = np.zeros(n, dtype=np.bool_), np.array(run.free)
    for j, row in enumerate(thin.rows):
        y[:, row], weight[:, row] = thin.y[j], thin.weight[j] / thin.sigma[j]
        seen[row] = True
    return PemRun(
        t=np.array(thin.t),  # a copy, as numba would compile again for a read-only array
        y=y,
        weight=weight,
        free=free,
        seen=seen & free,
        guided=np.ascontiguousarray(thin.guided.T),
        knots=np.array(run.knots, dtype=np.float64),
        command=np.array(run.command, dtype=np.float64),
        start=np.where(free, run.start, 0.0),
        slope=np.where(free, 0.0 if run.at_rest else run.slope, 0.0),
        zero=np.where(free, run.zero, 0.0),
        zero_std=run.zero_std,
        at_rest=run.at_rest,
        start_std=run.start_std,
        longest=_LONGEST * run.pace,
        swing=float(run.swing.max()),
    )


def errors_of(
    laws: LawSet, p: Array, track: PemRun, own: RunParameters, *, gain: float, derive: bool
) -> tuple[Array, Array] | None:
    """Return errors (samples, n) and derivatives of the simulated readings (lanes, samples, n).

    The result is None if the simulation diverges. The lanes are the entries of the vector, then
    zeros, shifts, velocities and factors.
    """
    n, count = laws.bench.n, len(laws.keys)
    lanes = p.size + 4 * n if derive else 0
    E, J = np.zeros((track.t.size, n)), np.zeros((lanes, track.t.size, n))
    x = np.where(track.free, track.start - own.zero + own.shift, 0.0)
    DX, DV = np.zeros((n, lanes)), np.zeros((n, lanes))
    for i in np.flatnonzero(track.free) if derive else ():
        DX[i, p.size + i], DX[i, p.size + n + i], DV[i, p.size + 2 * n + i] = -1.0, 1.0, 1.0
    aux, DA = np.zeros((count, forces.ROOM)), np.zeros((2 * count, lanes))
    for law, (kind, place) in enumerate(laws.keys):
        if kind in (EffectKind.EXTRA_MODE, EffectKind.BACKLASH):
            aux[law, : forces.OWN] = x[place], own.v0[place]
            DA[2 * law], DA[2 * law + 1] = DX[place], DV[place]
    play = max(np.flatnonzero(laws.kinds == EffectKind.BACKLASH), default=-1)
    # With a large gain, step errors do not add up.
    longest = track.longest * (1.0 if gain > 0.05 else _FREELY)
    if play >= 0:
        longest = min(longest, _KNOCK * track.longest)
    run = forces.PemRunArrays(
        t=track.t,
        y=track.y,
        seen=track.seen,
        free=track.free,
        guided=track.guided,
        knots=track.knots,
        command=track.command,
        held=_shaped(track, p[laws.drive_at + DEAD_ZONE], p[laws.drive_at + LIMIT]),
        zero=own.zero,
        factor=own.factor,
        gain=float(gain),
        longest=longest,
    )
    state = forces.PemState(x, own.v0.copy(), aux, DX, DV, DA)
    room = (np.zeros(shape) for shape in (n, n, n, (n, n), (n, n), 4, 4, (n, lanes), (n, lanes)))
    acting = forces.ActingLaws(p, laws.kinds, laws.places, laws.first, int(play))
    fine = kernel.predict_run(acting, run, state, forces.WorkArrays(*room), E, J)
    return (E, J) if fine and np.all(np.isfinite(E)) else None


@lru_cache(maxsize=64)  # most models have no dead zone and no limit
def _shaped(track: PemRun, dead: float, limit: float) -> Array:
    """Return the input after dead zone and limit, and its derivatives by the two, (3, 2, knots).

    The second axis holds the values and their integrals over time.
    """
    u = track.command
    sign, past = np.sign(u), np.maximum(np.abs(u) - dead, 0.0)
    full = past >= limit * (1.0 - 1e-9)
    out = np.zeros((3, 2, u.size))
    out[0, 0] = sign * np.minimum(past, limit)
    out[1, 0] = np.where((np.abs(u) > dead) & ~full, -sign, 0.0)
    out[2, 0] = np.where(full, sign, 0.0)
    out[:, 1, 1:] = np.cumsum(out[:, 0, :-1] * np.diff(track.knots), axis=1)
    return out


def compile_follower() -> None:
    """Compile the simulation by running it on a record of two readings.

    This takes seconds, unless compiled code is stored.
    """
    one, two = np.ones(1), np.array([0.0, 0.01])
    track = PemRun(
        t=two, y=np.zeros((2, 1)), weight=np.ones((2, 1)), free=one > 0.0, seen=one > 0.0,
        guided=np.zeros((2, 1)), knots=two, command=np.zeros(2), start=np.zeros(1),
        slope=np.zeros(1), zero=np.zeros(1), zero_std=one, at_rest=True, start_std=(one, one),
        longest=_LONGEST, swing=1.0,
    )  # fmt: skip
    chain = Chain(m=one, c=one, k=np.array([1.0, 0.0]))
    bench = PemSetup(chain=chain, springs=(True, False), largest=1.0, free=((True,),))
    laws = LawSet(bench=bench, keys=(), drive=(True,) * forces.DRIVE)
    errors_of(laws, laws.start(chain), track, track.fresh(), gain=0.0, derive=True)
