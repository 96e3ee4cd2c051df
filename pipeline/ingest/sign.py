"""The sign of the input: stated, found from the data, or the same as in other records.

The comparison of the input with the force that cart 1's motion requires shows in which direction
the motor pushes. The equation of motion is

    s u = m x_1'' + c x_1' + k x_1 + k' (x_1 - x_2),   m, c, k, k' ≥ 0,   s = ±1.

It holds for every record of a bench with the same m, c, k and k', so all records together decide s.
No data are differentiated: both sides are averaged with a bump that slides along the record.
A late input (a delay or a lag) shifts the phase above the resonance so far that a
record, taken alone, can seem to have the other sign. With the inertia and stiffness from the other
records, this does not happen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from pipeline.arrays import Array
from pipeline.estimation.force_balance import Windows, motion_period
from pipeline.results import Record
from pipeline.submission import Submission
from pipeline.words.numbers import join_names

_NARROWEST = 8  # fewest samples under a bump
_BUMPS = 6  # bumps side by side in a record
FEW_NAMES = 6  # most names listed; further ones are only counted


@dataclass(frozen=True, kw_only=True)
class Signs:
    """The stated sign of each record, and the sign found in its data: 0 if unclear."""

    stated: Mapping[str, int]
    found: Mapping[str, int]


def with_signs(
    records: list[Record], submission: Submission
) -> tuple[list[Record], list[str], Signs]:
    """Return the records with signed inputs, notes on the signs found, and the signs.

    A record with an unclear sign takes the sign of most other records of its kind. There are two
    kinds: records under feedback, because a controller's log may have another sign, and all others.
    If there are no other records of its kind, it takes the sign of most records of the other kind.
    If the sign stated for a record differs from the system's sign, the record takes the sign found
    in its data, or the stated sign if the data are unclear.
    """
    stated: dict[str, int] = {}
    disputed: set[str] = set()
    for experiment in submission.experiments:
        own = experiment.input.sign if experiment.input is not None else None
        if (sign := own or submission.system.input.sign) is not None:
            stated[experiment.id] = sign
        if own and submission.system.input.sign == -own and experiment.kind != "closed_loop":
            disputed.add(experiment.id)
    driven = [r for r in records if r.u is not None and np.ptp(r.u) > 0]
    found = find_signs(driven, stated=stated)

    def usual(record: Record) -> int:
        alike = [r for r in driven if (r.kind == "closed_loop") == (record.kind == "closed_loop")]
        votes = [
            sum(stated.get(r.id) or found.get(r.id, 0) for r in group) for group in (alike, driven)
        ]
        return next((1 if vote > 0 else -1 for vote in votes if vote), 1)

    told = {**found, **{n: s for n, s in stated.items() if n not in disputed or not found.get(n)}}
    signs = {r.id: told.get(r.id) or usual(r) for r in records}
    others = [r.id for r in driven if r.kind != "closed_loop"] or [r.id for r in driven]
    bench = 1 if sum(signs[name] for name in others) >= 0 else -1
    signed = [
        replace(
            record,
            u=record.u if signs[record.id] == 1 else 0.0 - record.u,
            input_scale=signs[record.id] * record.input_scale,
            sign_reversed=record.id not in stated and found.get(record.id) == -bench,
        )
        if record.u is not None
        else record
        for record in records
    ]
    says = _say_signs([r.id for r in driven], stated=stated, found=found, signs=signs)
    return signed, says, Signs(stated=stated, found=found)


def _say_signs(
    driven: list[str], *, stated: dict[str, int], found: dict[str, int], signs: dict[str, int]
) -> list[str]:
    """Return a warning if the data show different signs; one sign for all is an assumption."""
    searched = [name for name in driven if name not in stated and found.get(name)]
    usual = 1 if sum(signs[name] for name in searched) >= 0 else -1
    others = [name for name in searched if signs[name] != usual]
    if not others:
        return []
    return [
        f"the data show the sign {-usual:+d} of the input in {join_names(others, most=FEW_NAMES)}, "
        f"but {usual:+d} in the other recordings; each is used here with its own sign"
    ]


# --------------------------------------------------------- signs from the data


@dataclass(frozen=True, kw_only=True, eq=False)
class _Weighed:
    """Both sides of the equation, averaged with the sliding bump, relative to the input's norm.

    Attributes
    ----------
    drive : (3, n) the input one sample early, as logged, and one sample late.
    motion : (n, 4) the terms that are multiplied by m, c, k and k'.
    complete : whether all terms are known. It is False if cart 2 is free and was not measured.
    decisive : whether the record may be called reversed. It is False for an incomplete dwell.
    closed : whether the record was made under feedback.
    """

    drive: Array
    motion: Array
    complete: bool
    decisive: bool
    closed: bool


@np.errstate(all="ignore")  # overflow gives no finite number and no sign
def find_signs(records: Sequence[Record], *, stated: Mapping[str, int]) -> dict[str, int]:
    """Return the sign of each record's logged input; 0 or no entry if the data are unclear.

    A bench has one sign. A record gets the opposite sign only if its input is opposite to the force
    that the equation of the other records gives. A signal logged under feedback may not be the
    input, so such a record is left out of the equation if there are other records.

    Parameters
    ----------
    stated : stated sign of each record; records that are not listed count as 1.
    """
    weighed = {record.id: found for record in records if (found := _weigh(record)) is not None}
    if not weighed:
        return {}
    stated_signs = {name: stated.get(name, 1) for name in weighed}
    rule = [name for name, w in weighed.items() if w.complete] or list(weighed)
    rule = [name for name in rule if not weighed[name].closed] or rule
    # If equally many records have each sign, the sign of each record by itself is the better start.
    alone = {n for n, w in weighed.items() if w.decisive and _bench([w], [stated_signs[n]])[0] < 0}
    for reversed_ in (set[str](), alone):
        found = _settle(weighed, stated_signs, reversed_, rule=rule)
        if found:
            return found
    return {}


def _settle(
    weighed: Mapping[str, _Weighed],
    stated: Mapping[str, int],
    reversed_: set[str],
    *,
    rule: Sequence[str],
) -> dict[str, int]:
    """Return the sign of each record, as in `find_signs`; empty if no solution is found.

    The equation is fitted to the records in `rule`. Records that contradict it are reversed, and
    the fit is repeated until the reversed records stay the same.
    """
    # At most five rounds of reversing records and fitting again.
    for _ in range(5):
        signs = {name: -stated[name] if name in reversed_ else stated[name] for name in weighed}
        sign, weights = _bench([weighed[name] for name in rule], [signs[name] for name in rule])
        if sign == 0:
            return {}
        cosines = {name: sign * stated[name] * _cosine(w, weights) for name, w in weighed.items()}
        contrary = {n for n, w in weighed.items() if w.decisive and cosines[n] < -0.7}
        if contrary == reversed_:
            # The cosine is between an input and the force that the bench's equation gives. It stays
            # positive with a lag (at most 90°) and any likely delay. For a log with the opposite
            # sign it is near -1.
            return {
                name: sign * signs[name] if name in reversed_ or cosines[name] > 0.3 else 0
                for name in weighed
            }
        reversed_ = contrary
    return {}


def _bench(weighed: Sequence[_Weighed], signs: Sequence[int]) -> tuple[int, Array]:
    """Return the sign (relative to `signs`) and m, c, k, k' of the equation of all records.

    The sign is 0 if the opposite sign explains the records nearly as well, or if a shift of the
    inputs by one sample would change it. Under feedback, the input is not shifted to earlier times.
    """
    motion = np.vstack([w.motion for w in weighed])
    size = np.linalg.norm(motion, axis=0)
    size[size == 0] = 1.0
    shifts = (1, 2) if all(w.closed for w in weighed) else (0, 1, 2)
    found, weights = set(), np.zeros(4)
    for shift in shifts:
        drive = np.concatenate([s * w.drive[shift] for s, w in zip(signs, weighed, strict=True)])
        (ahead, left), (back, right) = (_explain(motion / size, s * drive) for s in (1, -1))
        share = np.array([left, right]) ** 2 / len(weighed)  # each record's input has norm 1
        # A sign is excluded if it explains less of the input's power, by this margin. The
        # margin is far above the effect of an encoder's steps, and below that of a cart's damping.
        sure = abs(share[0] - share[1]) > 1e-3 + 0.1 * share.min()
        found.add((1 if share[0] < share[1] else -1) if sure else 0)
        if shift == 1:
            weights = (ahead if share[0] < share[1] else back) / size
    return (found.pop() if len(found) == 1 else 0), weights


def _explain(motion: Array, drive: Array) -> tuple[Array, float]:
    """Return the non-negative weights (4,), and the norm of the drive that they do not explain."""
    try:
        return nnls(motion, drive)
    # No solution, so nothing is explained. Equal columns end scipy before 1.15.
    except (RuntimeError, np.linalg.LinAlgError):
        return np.zeros(motion.shape[1]), float(np.linalg.norm(drive))


def _cosine(w: _Weighed, weights: Array) -> float:
    """Return the cosine between the logged input and the force that the equation gives."""
    force = w.motion @ weights
    size = float(np.linalg.norm(force) * np.linalg.norm(w.drive[1]))
    return float(w.drive[1] @ force) / size if size > 0 else 0.0


def _weigh(record: Record) -> _Weighed | None:
    """Return both sides of a record's equation; None if cart 1 is not driven or does not move."""
    if record.u is None or 1 not in record.carts or 1 not in record.free:
        return None
    t, u, x = record.t, record.u, record.position(1)
    if t.size < _BUMPS * _NARROWEST or np.ptp(u) == 0.0 or np.ptp(x) == 0.0:
        return None
    known = 2 in record.carts and 2 in record.free
    other = record.position(2) if known else np.full(t.size, x[0])
    grid = np.linspace(t[0], t[-1], t.size)
    u, x, other = (np.interp(grid, t, a - a.mean()) for a in (u, x, other))
    period = motion_period(x)
    if not np.isfinite(period):
        return None
    width = int(np.clip(period, _NARROWEST, t.size // _BUMPS))
    last = x.size - width  # start of the last bump
    places = np.arange(1, last, max(width // 6, last // 400, 1))
    windows = Windows(grid, first=places, width=width)
    position, velocity, acceleration = windows.means(x)
    centred = [windows.mean(np.roll(u, -shift)) for shift in (-1, 0, 1)]
    centred += [acceleration, velocity, position, windows.mean(x - other)]
    early, now, late, *terms = (a - a.mean() for a in centred)  # offsets of the encoders cancel
    drive = np.array([early, now, late]) / np.linalg.norm(now)
    motion = np.array(terms).T / np.linalg.norm(now)
    if not (np.all(np.isfinite(drive)) and np.all(np.isfinite(motion))):
        return None
    complete = known or 2 not in record.free
    return _Weighed(
        drive=drive,
        motion=motion,
        complete=complete,
        decisive=complete or record.kind != "sine",
        closed=record.kind == "closed_loop",
    )
