"""A model that follows records: its laws as one physical vector, and each run's errors."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.parameters import FACTOR_STEP, FACTORS, FRICTION_SPREAD
from pipeline.gap.pem import kernel
from pipeline.gap.runs import GapRun, make_run
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.plant.effect import ForceLaw, FrictionLaw
from pipeline.plant.simulator.tables import TABLES, Drive
from pipeline.plant.simulator.terms import COEFFICIENTS, EffectKind
from pipeline.results import Record

# --------------------------------------------------------------------- laws and their parameters

_CHAIN = (0.005, 20.0)  # limits of masses and springs, times the largest first estimate
_REACH = 0.3  # largest relative step of a mass or spring
_SMALL = 0.1  # share of the largest first estimate; smaller ones are not trusted
_DELAY = (-0.05, 0.1)  # limits of a delay, s
_SHORT = 0.01  # largest step of a delay or lag, s
# For each kind, in the order of the catalogue: the coordinates in which a law grows from zero.
GROWTHS = tuple(effect.grown for effect in CATALOGUE)
SIZES = tuple(len(growth.coordinates) for growth in GROWTHS)
POSITIVE = {kind for kind, growth in enumerate(GROWTHS) if not growth.signed}
DRY = tuple(kind for kind, effect in enumerate(CATALOGUE) if effect.dry)
SIDED = (
    EffectKind.END_STOP,
    EffectKind.SLACK_SPRING,
)  # laws with a position whose sign selects the side
# The columns that each law fills in the simulator's tables.
COLUMNS = tuple(
    tuple(effect.columns(dict.fromkeys((p.name for p in effect.own), 1.0))) for effect in CATALOGUE
)
# The laws that need no shape, so that they can start from zero.
PLAIN = tuple(
    kind
    for kind, effect in enumerate(CATALOGUE)
    if isinstance(effect.law, ForceLaw | FrictionLaw) and len(COEFFICIENTS[kind]) == SIZES[kind]
)
Column = tuple[type[IntEnum], int]  # table and number, because tables share numbers
DRIVE_COLUMNS = (
    Drive.DEAD_ZONE_WIDTH,
    Drive.SATURATION_LIMIT,
    Drive.INPUT_DELAY_DELAY,
    Drive.ACTUATOR_LAG_TIME_CONSTANT,
)
DEAD_ZONE, LIMIT, DELAY, LAG = range(kernel.DRIVE)


def column_set(columns: Iterable[IntEnum]) -> frozenset[Column]:
    """Return columns as a set, each with its table."""
    return frozenset((type(column), int(column)) for column in columns)


@dataclass(frozen=True, kw_only=True)
class TrialLaw:
    """A law at a cart or spring (from 0), with the values of its parameters.

    `drop` is the decrease of the cost that these values would give, if it is known.
    """

    kind: int
    place: int
    values: tuple[float, ...]
    drop: float = 0.0

    @property
    def key(self) -> tuple[int, int]:
        """Kind and place."""
        return self.kind, self.place

    @property
    def sided(self) -> tuple[int, int, float]:
        """Kind, place, and the side (1 or -1; 0 for a law without sides)."""
        return self.kind, self.place, float(np.sign(self.values[1]) if self.kind in SIDED else 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class PemSetup:
    """The properties of a bench that decide which laws are possible.

    Attributes
    ----------
    chain : the first estimate of the chain.
    springs : whether each spring exists (n + 1,).
    largest : the largest input; zero without an input.
    free : for each run, whether each cart moves.
    pinned : the cart whose mass is fixed at its first estimate, if no input sets a scale.
    """

    chain: Chain
    springs: tuple[bool, ...]
    largest: float
    free: tuple[tuple[bool, ...], ...]
    pinned: int | None = None

    @cached_property
    def shown(self) -> tuple[bool, ...]:
        """Whether each cart moves in some run (n,)."""
        return tuple(any(moves) for moves in zip(*self.free, strict=True))

    @cached_property
    def rows(self) -> tuple[int, ...]:
        """The springs that are stretched in some run; of springs with equal stretch, only one."""
        shown: dict[tuple, int] = {}
        for j in (j for j, there in enumerate(self.springs) if there):
            ends = [i for i in (j - 1, j) if 0 <= i < self.n]
            moving = tuple(tuple(i for i in ends if run[i]) for run in self.free)
            if any(moving):
                shown.setdefault(moving, j)
        return tuple(shown.values())

    @property
    def n(self) -> int:
        """The number of carts."""
        return self.chain.n


@dataclass(frozen=True, kw_only=True, eq=False)
class LawSet:
    """The laws that act; they determine the shape of the vector `p`.

    The vector holds masses, dampings, springs (n + 1), the four values of the drive, then each
    law's parameters.
    """

    bench: PemSetup
    keys: tuple[tuple[int, int], ...]
    drive: tuple[bool, ...]  # which of the drive's laws are free

    @cached_property
    def kinds(self) -> np.ndarray:
        """The kinds of the laws (laws,)."""
        return np.array([kind for kind, _ in self.keys], dtype=np.int64)

    @cached_property
    def places(self) -> np.ndarray:
        """The carts or springs of the laws (laws,), from 0."""
        return np.array([place for _, place in self.keys], dtype=np.int64)

    @cached_property
    def base(self) -> int:
        """The number of parameters of chain and drive."""
        return 3 * self.bench.n + 1 + kernel.DRIVE

    @cached_property
    def first(self) -> np.ndarray:
        """The index of each law's first parameter (laws,)."""
        sizes = [SIZES[kind] for kind, _ in self.keys]
        return self.base + np.cumsum([0, *sizes])[:-1].astype(np.int64)

    @cached_property
    def size(self) -> int:
        """The length of the vector."""
        return self.base + sum(SIZES[kind] for kind, _ in self.keys)

    @cached_property
    def dry(self) -> np.ndarray:
        """Whether dry friction acts on each cart (n,)."""
        there = {place for kind, place in self.keys if kind in DRY}
        return np.array([i in there for i in range(self.bench.n)])

    @property
    def drive_at(self) -> int:
        """Index of the drive's first value."""
        return 3 * self.bench.n + 1

    def neutral_drive(self) -> Array:
        """The values of a drive without any law."""
        return np.array([0.0, self.bench.largest, 0.0, 0.0])

    def start(self, chain: Chain) -> Array:
        """Return the vector of a chain without laws; masses and springs near zero are raised."""
        p = np.zeros(self.size)
        n = self.bench.n
        p[:n] = np.maximum(chain.m, _SMALL * chain.m.max())
        p[n : 2 * n] = chain.c
        p[2 * n : 3 * n + 1] = np.maximum(chain.k, _SMALL * chain.k.max())
        p[2 * n + np.flatnonzero(~np.array(self.bench.springs))] = 0.0
        p[self.drive_at : self.base] = self.neutral_drive()
        return p

    def chain(self, p: Array) -> Chain:
        """Return the chain that a vector describes."""
        n = self.bench.n
        k = p[2 * n : 3 * n + 1].copy()
        return Chain(m=p[:n].copy(), c=np.maximum(p[n : 2 * n], 0.0), k=k)

    def bounds(self) -> tuple[Array, Array, Array]:
        """Return lower bounds, upper bounds, and largest steps."""
        n, chain = self.bench.n, self.bench.chain
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        reach = np.full(self.size, np.inf)
        for at, value in ((slice(0, n), chain.m), (slice(2 * n, 3 * n + 1), chain.k)):
            most = value.max()
            low[at], high[at] = _CHAIN[0] * most, _CHAIN[1] * most
            reach[at] = _REACH * np.maximum(value, _SMALL * most)
        missing = 2 * n + np.flatnonzero(~np.array(self.bench.springs))
        low[missing] = high[missing] = 0.0
        if self.bench.pinned is not None:
            low[self.bench.pinned] = high[self.bench.pinned] = chain.m[self.bench.pinned]
        if n == 1 and all(self.bench.springs):  # both wall springs act as one
            low[3] = high[3] = chain.k[1]
        low[n : 2 * n] = 0.0
        d, largest = self.drive_at, max(self.bench.largest, 1e-12)
        low[d : d + 4] = (0.0, 0.2 * largest, _DELAY[0], 0.0)
        high[d : d + 4] = (0.9 * largest, largest, _DELAY[1], 0.3)
        reach[d : d + 4] = (0.1 * largest, 0.1 * largest, _SHORT, _SHORT)
        neutral = self.neutral_drive()
        for q, free in enumerate(self.drive):
            if not free:
                low[d + q] = high[d + q] = neutral[q]
        for (kind, place), o in zip(self.keys, self.first, strict=True):
            if kind in POSITIVE:
                low[[o + q for q in COEFFICIENTS[kind]]] = 0.0
            if kind == EffectKind.SLACK_SPRING:
                # A slack spring keeps at least a twentieth of its stiffness.
                low[o] = -0.95 * max(chain.k[place], _SMALL * chain.k.max())
            elif kind == EffectKind.SENSOR_GAIN:
                low[o], high[o] = -0.5, 0.5
        return low, high, reach

    def steps_of_shape(self, p: Array) -> tuple[Array, Array, Array]:
        """Return bounds and steps that keep the shapes of the laws near their values."""
        low, high, reach = self.bounds()
        for (kind, _), o in zip(self.keys, self.first, strict=True):
            for q in range(SIZES[kind]):
                if q in COEFFICIENTS[kind]:
                    continue
                value = abs(p[o + q])
                reach[o + q] = 0.15 * value
                side = 1.0 if p[o + q] >= 0 else -1.0
                low[o + q], high[o + q] = sorted((side * 0.02 * value, side * 50.0 * value))
        return low, high, reach

    def with_laws(self, p: Array, extra: Sequence[TrialLaw]) -> tuple["LawSet", Array]:
        """Return laws and vector with additional laws."""
        laws = LawSet(
            bench=self.bench, keys=(*self.keys, *(law.key for law in extra)), drive=self.drive
        )
        return laws, np.concatenate([p, *(law.values for law in extra)])

    def without(self, p: Array, groups: Sequence[int]) -> tuple["LawSet", Array]:
        """Return laws and vector without some groups.

        The group of a law is its index; the laws of the drive are the groups -1 to -4.
        """
        kept = [i for i in range(len(self.keys)) if i not in groups]
        drive = tuple(free and -1 - q not in groups for q, free in enumerate(self.drive))
        laws = LawSet(bench=self.bench, keys=tuple(self.keys[i] for i in kept), drive=drive)
        base = p[: self.base].copy()
        for q, value in enumerate(self.neutral_drive()):
            if not drive[q]:
                base[self.drive_at + q] = value
        parts = [p[self.first[i] : self.first[i] + SIZES[self.keys[i][0]]] for i in kept]
        return laws, np.concatenate([base, *parts])

    def groups(self) -> dict[int, np.ndarray]:
        """Return the groups that may be dropped, each with the indices of its coefficients."""
        out = {-1 - q: np.array([self.drive_at + q]) for q, free in enumerate(self.drive) if free}
        for i, ((kind, _), o) in enumerate(zip(self.keys, self.first, strict=True)):
            out[i] = np.array([o + q for q in COEFFICIENTS[kind]])
        return out

    def whole_group(self, group: int) -> np.ndarray:
        """Return the indices of all parameters of a group."""
        if group < 0:
            return np.array([self.drive_at - 1 - group])
        o = self.first[group]
        return np.arange(o, o + SIZES[self.keys[group][0]])

    def filled(self, group: int) -> set[tuple[int, Column]]:
        """Return the places, as in the catalogue, and the columns that a group fills there."""
        if group < 0:
            return {(0, column) for column in column_set([DRIVE_COLUMNS[-1 - group]])}
        kind, at = self.keys[group]
        place = 0 if CATALOGUE[kind].place == "input" else at + 1
        return {(place, column) for column in column_set(COLUMNS[kind])}

    def neutral(self) -> Array:
        """Return the neutral values of the vector, 0 except for the input limit."""
        out = np.zeros(self.size)
        out[self.drive_at + LIMIT] = self.bench.largest
        return out

    def _shared(self, kind: int, place: int, p: Array) -> dict[str, float]:
        """Return, by symbol, the parameters of the friction that a law extends, at the same place.

        They are 0 if that friction does not act, and missing if the law extends none.
        """
        law = CATALOGUE[kind].law
        if not (isinstance(law, FrictionLaw) and law.beyond):
            return {}
        within = next(i for i, effect in enumerate(CATALOGUE) if effect.key == law.beyond)
        there = dict(zip(self.keys, self.first, strict=True)).get((within, place))
        symbols = GROWTHS[within].coordinates
        return {s: 0.0 if there is None else float(p[there + q]) for q, s in enumerate(symbols)}

    def columns(self, p: Array) -> dict[tuple[type[IntEnum], int], dict[IntEnum, float]]:
        """Return the values of the laws in the simulator's tables.

        The keys are table and row (0 for a drive).
        """
        n = self.bench.n
        out: dict[tuple[type[IntEnum], int], dict[IntEnum, float]] = {}
        for q, column in enumerate(DRIVE_COLUMNS):
            if self.drive[q]:
                out.setdefault((Drive, 0), {})[column] = float(p[self.drive_at + q])
        for (kind, place), o in zip(self.keys, self.first, strict=True):
            effect, own = CATALOGUE[kind], self._shared(kind, place, p)
            if effect.place == "spring":
                own["k"] = float(p[2 * n + place])
            own |= zip(GROWTHS[kind].coordinates, p[o : o + SIZES[kind]].tolist(), strict=True)
            table = TABLES[effect.place]
            row = out.setdefault((table, 0 if table is Drive else place), {})
            row.update(effect.columns(effect.grown_values(own)))
            if kind == EffectKind.BACKLASH:
                firm, damping = self._contact(p, motor=own["m_m"], bounce=own["e"])
                row[Drive.BACKLASH_CONTACT_STIFFNESS] = firm
                row[Drive.BACKLASH_CONTACT_DAMPING] = damping
        return out

    def _contact(self, p: Array, *, motor: float, bounce: float) -> tuple[float, float]:
        """Return stiffness and damping of a contact with a given coefficient of restitution.

        The contact in this package is rigid, but the simulator's contact is slightly soft. See W.
        Goldsmith, Impact (1960), chapter 4.
        """
        firm = 40.0 * float(p[2 * self.bench.n] + p[2 * self.bench.n + 1])
        fall = -float(np.log(np.clip(bounce, 0.02, 0.9)))
        both = motor * max(1.0 - motor / float(p[0]), 0.0)
        return firm, 2.0 * fall / float(np.hypot(np.pi, fall)) * float(np.sqrt(firm * both))


def smooth_laws(bench: PemSetup, *, columns: frozenset[Column]) -> LawSet:
    """Return every law that needs no shape, at every place, as the start of a fit.

    `columns` are those that the effects of the catalogue may fill.
    """
    n, driven = bench.n, bench.largest > 0.0

    def here(place: str) -> list[int]:
        """Return the kinds of law that the runs can show at a place."""
        return [
            kind
            for kind in PLAIN
            if (effect := CATALOGUE[kind]).place == place
            and (driven or not effect.needs_drive)
            and not (effect.only_rest and any(bench.springs))
        ]

    keys = [(kind, i) for i in range(n) if bench.shown[i] for kind in here("cart")]
    for j in bench.rows:
        ends = 0 < j < n
        keys += [(kind, j) for kind in here("spring") if ends or not CATALOGUE[kind].between_carts]
    keys += [(kind, 0) for kind in here("input")]
    kept = tuple(key for key in keys if column_set(COLUMNS[key[0]]) <= columns)
    drive = tuple(driven and (Drive, int(column)) in columns for column in DRIVE_COLUMNS)
    return LawSet(bench=bench, keys=kept, drive=drive)


# --------------------------------------- the parameters of one run, and its errors with a model

_FREELY = 0.4  # factor on the longest step for a small gain, where step errors add up
_KNOCK = 0.25  # factor on the longest step if bodies may meet
_SURE = 1e6  # weight of known quantities


@dataclass(frozen=True, kw_only=True, eq=False)
class RunParameters:
    """The parameters of one run, (n,) each.

    They are encoder zeros, shifts of the start, start velocities, and factors on dry friction.
    """

    zero: Array
    shift: Array
    v0: Array
    factor: Array

    @classmethod
    def of(cls, run: GapRun) -> "RunParameters":
        """Return the parameters of a run at their expected values."""
        n = run.zero.size
        return cls(zero=run.zero, shift=np.zeros(n), v0=run.slope, factor=np.ones(n))

    def prior(self, run: GapRun, dry: np.ndarray) -> tuple[Array, Array]:
        """Return weights (4 n,) of the priors on the parameters, and their residuals."""
        n, swing, known = self.zero.size, float(run.swing.max()), run.start_std
        # At a release the first readings may be off by a third of the swing.
        start = np.full(n, _SURE if run.at_rest else 1.0 / max(0.3 * swing, 1e-12))
        start = np.where(np.isfinite(known[0]), 1.0 / known[0], start)
        moves = np.array(run.free) & (not run.at_rest)
        speed = np.where(moves, 1.0 / known[1], _SURE)
        # An unknown velocity needs a weak prior, because following the record closely does not
        # determine it.
        speed = np.maximum(speed, 1e-3 / max(swing, 1e-12))
        factor = np.where(dry, 1.0 / FRICTION_SPREAD, _SURE)
        weight = np.concatenate([1.0 / run.zero_std, start, speed, factor])
        off = [run.zero - self.zero, -self.shift, run.slope - self.v0, 1.0 - self.factor]
        return weight, weight * np.concatenate(off)

    def moved(self, by: Array) -> "RunParameters":
        """Return the parameters after a step (4 n,)."""
        zero, shift, v0, factor = by.reshape(4, -1)
        step = np.clip(factor, -FACTOR_STEP, FACTOR_STEP)
        return RunParameters(
            zero=self.zero + zero,
            shift=self.shift + shift,
            v0=self.v0 + v0,
            factor=np.clip(self.factor + step, *FACTORS),
        )


def errors_of(
    laws: LawSet, p: Array, run: GapRun, own: RunParameters, *, gain: float, derive: bool
) -> tuple[Array, Array] | None:
    """Return errors (samples, n) and derivatives of the simulated readings (lanes, samples, n).

    The result is None if the simulation diverges. The lanes are the entries of the vector, then
    zeros, shifts, velocities and factors.
    """
    n, count = laws.bench.n, len(laws.keys)
    lanes = p.size + 4 * n if derive else 0
    followed = run.followed
    E, J = np.zeros((followed.t.size, n)), np.zeros((lanes, followed.t.size, n))
    x = np.where(followed.free, run.start - own.zero + own.shift, 0.0)
    DX, DV = np.zeros((n, lanes)), np.zeros((n, lanes))
    for i in np.flatnonzero(followed.free) if derive else ():
        DX[i, p.size + i], DX[i, p.size + n + i], DV[i, p.size + 2 * n + i] = -1.0, 1.0, 1.0
    aux, DA = np.zeros((count, kernel.ROOM)), np.zeros((2 * count, lanes))
    for law, (kind, place) in enumerate(laws.keys):
        if kind in (EffectKind.EXTRA_MODE, EffectKind.BACKLASH):
            aux[law, : kernel.OWN] = x[place], own.v0[place]
            DA[2 * law], DA[2 * law + 1] = DX[place], DV[place]
    play = max(np.flatnonzero(laws.kinds == EffectKind.BACKLASH), default=-1)
    # With a large gain, step errors do not add up.
    longest = followed.longest * (1.0 if gain > 0.05 else _FREELY)
    if play >= 0:
        longest = min(longest, _KNOCK * followed.longest)
    followed = followed._replace(
        held=_shaped(run, p[laws.drive_at + DEAD_ZONE], p[laws.drive_at + LIMIT]),
        zero=own.zero,
        factor=own.factor,
        gain=float(gain),
        longest=longest,
    )
    state = kernel.PemState(x, own.v0.copy(), aux, DX, DV, DA)
    room = (np.zeros(shape) for shape in (n, n, n, (n, n), (n, n), 4, 4, (n, lanes), (n, lanes)))
    acting = kernel.ActingLaws(p, laws.kinds, laws.places, laws.first, int(play))
    fine = kernel.predict_run(acting, followed, state, kernel.WorkArrays(*room), E, J)
    return (E, J) if fine and np.all(np.isfinite(E)) else None


@lru_cache(maxsize=64)  # most models have no dead zone and no limit
def _shaped(run: GapRun, dead: float, limit: float) -> Array:
    """Return the input after dead zone and limit, and its derivatives by the two, (3, 2, knots).

    The second axis holds the values and their integrals over time.
    """
    u = run.command
    sign, past = np.sign(u), np.maximum(np.abs(u) - dead, 0.0)
    full = past >= limit * (1.0 - 1e-9)
    out = np.zeros((3, 2, u.size))
    out[0, 0] = sign * np.minimum(past, limit)
    out[1, 0] = np.where((np.abs(u) > dead) & ~full, -sign, 0.0)
    out[2, 0] = np.where(full, sign, 0.0)
    out[:, 1, 1:] = np.cumsum(out[:, 0, :-1] * np.diff(run.knots), axis=1)
    return out


def compile_predictor() -> None:
    """Compile the simulation by running it on a short record.

    This takes seconds, unless compiled code is stored.
    """
    t, one = np.linspace(0.0, 0.1, 11), np.ones(1)
    record = Record(
        id="", kind="step", t=t, u=0.0 * t, y=t[None], carts=(1,), free=(1,), resolution=one
    )
    run, chain = make_run(record, n=1), Chain(m=one, c=one, k=np.array([1.0, 0.0]))
    bench = PemSetup(chain=chain, springs=(True, False), largest=1.0, free=((True,),))
    laws = LawSet(bench=bench, keys=(), drive=(True,) * kernel.DRIVE)
    errors_of(laws, laws.start(chain), run, RunParameters.of(run), gain=0.0, derive=True)
