"""Score laws that need a shape: how much each would lower the cost of the fitted model.

A law of size zero moves nothing, but the derivatives give its first-order effect. Its best size,
together with the other parameters, follows from a small linear problem.

Reference: T. Söderström, P. Stoica, System Identification, section 11.5 (score tests).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.pem.fit import PemFit, Records
from pipeline.gap.pem.laws import COEFFICIENTS, POSITIVE, TrialLaw
from pipeline.plant.simulator.terms import EffectKind


@dataclass(frozen=True, kw_only=True)
class Scored:
    """A law with its best values, and the decrease of the cost that these would give."""

    law: TrialLaw
    drop: float


def score(fit: PemFit, records: Records, trials: Sequence[TrialLaw]) -> list[Scored]:
    """Return the trial laws that would help in addition to the model's laws, the best first."""
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
        out.append(Scored(law=replace(law, values=tuple(values)), drop=drop))
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
    for track, own in zip(records.runs, fit.own, strict=True):
        x = np.where(track.free, track.y - own.zero, 0.0)
        position = np.maximum(position, [x.max(0), -x.min(0)])
        d = np.diff(np.pad(x, ((0, 0), (1, 1))), axis=1)
        stretch = np.maximum(stretch, [d.max(0), -d.min(0)])
        v = np.gradient(x, track.t, axis=0)
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
    for track, own in zip(records.runs, fit.own, strict=True):
        if track.free[0]:
            span = max(span, float(np.ptp(track.y[:, 0] - own.zero[0])))
    if span == 0.0 or (EffectKind.COGGING, 0) in fit.laws.keys:
        return []
    # Numbers of pitches in the travel, in steps of less than one half.
    counts = np.arange(1.5, 25.0, 0.4).tolist()
    return [TrialLaw(kind=EffectKind.COGGING, place=0, values=(0.0, 0.0, span / n)) for n in counts]


def backlash_laws(fit: PemFit, records: Records) -> list[TrialLaw]:
    """Return trial laws for backlash at the motor, which no fit from zero can find."""
    spans = [
        float(np.ptp(track.y[:, 0]))
        for track in records.runs
        if track.free[0] and track.seen[0] and np.any(track.command)
    ]
    if not spans or (EffectKind.BACKLASH, 0) in fit.laws.keys:
        return []
    # Size of the gap, motor mass, and speed after an impact relative to the speed before it.
    values = 0.03 * max(spans), 0.15 * float(fit.p[0]), 0.4
    law = TrialLaw(kind=EffectKind.BACKLASH, place=0, values=values)
    return [law] if records.allows(law) else []


def shaped_trials(fit: PemFit, records: Records) -> list[Scored]:
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
    best: dict[tuple, Scored] = {}
    for one in sorted(trials, key=lambda one: -one.drop):
        if one.drop > 0.0:
            best.setdefault(one.law.sided, one)
    return list(best.values())
