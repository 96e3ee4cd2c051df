"""Interventions: stretches in which an unmeasured force, such as a hand, moves a cart.

A hand causes a burst in the force that the law of motion does not explain. An effect that the law
lacks causes bursts too, but again and again: whenever position, stretch, speed and input are the
same. An impact of two bodies is over in an instant. So a burst counts as a hand if it lasts, moves
the cart, and occurs in a state in which the law holds at other times.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.estimation.force_balance import (
    RecordResidualForce,
    WindowMeans,
    record_residual_forces,
    window_means,
)
from pipeline.estimation.noise import MEDIAN_TO_SIGMA
from pipeline.results import Intervention, Record

T = TypeVar("T", bound=np.generic)


def running_max(values: NDArray[T], width: int) -> NDArray[T]:
    """Return, for each value, the largest of the `width` values centred on it; `width` is odd."""
    padded = np.pad(values, width // 2, mode="edge")
    return sliding_window_view(padded, width).max(axis=-1)


_BULK = 2.0  # standard deviations of the law's residual, as in its fit
# A burst must exceed the first multiple of `_BULK`. It begins and ends at the second multiple.
_FAR, _BEGINS = 4.0, 1.5
# Least share of a burst in the force on the cart, and least ratio of this share to its usual value.
_SHARE, _TYPICAL = 0.3, 3.0
# s before and after a window. A burst is compared with the largest force in this time.
_AROUND = 0.15
# s on either side of a window's middle; this part has most of the weight.
_REACH = 0.02
_GAP = 0.1  # s; closer bursts are merged
_LASTS = 0.06  # s above half the peak of a burst; an impact has 0.04, the width of a window
# s of a burst during which the cart must be in a state in which the law holds at other times.
_KNOWN = 0.03
_SWINGS = 3  # sign changes of a hand's force; an effect's force has many more
_INSTANT = 0.03  # s; nobody pushes twice within this time of a recording
# Number of bins for a variable of the state. At least this share and at least this number of
# the windows in a bin must be quiet.
_BINS, _MOST, _VISITS = 20, 0.5, 5


def find_interventions(records: Sequence[Record]) -> tuple[Intervention, ...]:
    """Return the interventions of hands on free carts, by record, cart and time.

    Runs under feedback are skipped, because part of what drives their motor is often not logged.
    """
    return _found_in(tuple(records))


@lru_cache(maxsize=1)  # a report and its gap analysis ask for the same records
def _found_in(records: tuple[Record, ...]) -> tuple[Intervention, ...]:
    open_loop = [record for record in records if record.kind not in ("closed_loop", "bode")]
    first = {record.id: _first_copy(record, open_loop) for record in open_loop}
    alone = [record for record in open_loop if first[record.id] == record.id]
    carts = sorted({cart for r in alone for cart in r.free if cart in r.carts})
    seen = [one for one in map(window_means, alone) if one is not None]
    bursts = [one for cart in carts for one in _bursts(cart, seen)]
    found = [
        replace(one, experiment=name)
        for name, twin in first.items()
        for one in bursts
        if one.experiment == twin
    ]
    order = [record.id for record in open_loop]
    return tuple(sorted(found, key=lambda one: (order.index(one.experiment), one.cart, one.start)))


def _first_copy(record: Record, records: Sequence[Record]) -> str:
    """Return the id of the first record with the same readings; a file may be listed twice."""
    return next(other.id for other in records if np.array_equal(other.y, record.y))


def without_releases(
    interventions: Sequence[Intervention], records: Sequence[Record]
) -> list[Intervention]:
    """Return the interventions without the holds that precede the release of a decay."""
    released = {(record.id, float(record.t[0])) for record in records if record.kind == "decay"}
    return [one for one in interventions if (one.experiment, one.start) not in released]


def between(record: Record, interventions: Sequence[Intervention]) -> list[Record]:
    """Return the parts of a record before, between and after the interventions."""
    touched = np.zeros(record.t.size, dtype=np.bool_)
    for one in interventions:
        if one.experiment == record.id:
            touched |= (record.t >= one.start) & (record.t <= one.end)
    if not touched.any():
        return [record]
    pieces = []
    for first, last in _runs(~touched):
        if record.t[last] - record.t[first] < _GAP:
            continue
        part = slice(first, last + 1)
        pieces.append(
            replace(
                record,
                t=record.t[part],
                u=None if record.u is None else record.u[part],
                y=record.y[:, part],
                reference=None if record.reference is None else record.reference[part],
            )
        )
    return pieces


def _bursts(cart: int, seen: Sequence[WindowMeans]) -> list[Intervention]:
    forces, size = record_residual_forces(cart, seen)
    if not forces:
        return []
    shares = [_share(force, size) for force in forces]
    usual = np.concatenate([s[f.follows] for s, f in zip(shares, forces, strict=True)])
    least = max(_SHARE, _TYPICAL * float(np.quantile(usual, 0.75)))
    found = []
    for force, share, known in zip(forces, shares, _known(forces, size), strict=True):
        left = np.abs(force.residual)
        bulk = size
        if force.follows.any():  # a record that departs from the law throughout cannot show a hand
            own = _BULK * MEDIAN_TO_SIGMA * float(np.median(left[force.follows]))
            bulk = max(size, own)
        strong = (left > _FAR * bulk) & (share > least) & ~force.jumps
        above = left > _BEGINS * bulk
        times = np.concatenate([force.record.t[:1], force.t[1:-1], force.record.t[-1:]])
        for first, last in _stretches(above, force.t):
            inside = slice(first, last + 1)
            beyond = np.where(above[inside], force.residual[inside], 0.0)
            if _is_hand(beyond, strong=strong[inside], known=known[inside], hop=force.hop):
                found.append(
                    Intervention(
                        experiment=force.record.id,
                        cart=cart,
                        start=max(float(times[first]) - _REACH, float(times[0])),
                        end=min(float(times[last]) + _REACH, float(times[-1])),
                    )
                )
    driven = {
        record.id: float(record.t[0])
        for record in (one.record for one in seen)
        if record.u is not None and np.any(record.u)
    }
    return [one for one in found if not _recurs(one, found, driven)]


def _recurs(one: Intervention, found: Sequence[Intervention], driven: Mapping[str, float]) -> bool:
    """Return whether a burst occurs at the same instant in another driven run.

    Such a burst is not due to a hand. `driven` gives the time of each driven run's first sample.
    """
    if one.start == driven.get(one.experiment, one.start):
        return False
    return any(
        abs(one.start - other.start) < _INSTANT
        for other in found
        if other.experiment != one.experiment and other.experiment in driven
    )


def _share(force: RecordResidualForce, size: float) -> Array:
    """Return which share of the force on the cart is unexplained, near each sample."""
    acting = running_max(force.acting, 2 * round(_AROUND / force.hop) + 1)
    return np.abs(force.residual) / (acting + size)


def _known(forces: Sequence[RecordResidualForce], size: float) -> list[NDArray[np.bool_]]:
    """Return for each window whether the law holds at other times in the same state.

    Position, stretches, velocity and input are checked one by one: most windows at about the same
    value must be quiet. A cart that rests without an input is always in a known state, because
    friction alone can hold it.
    """
    state = np.concatenate([force.state for force in forces], axis=1)
    follows = np.concatenate([force.follows for force in forces])
    quiet = np.concatenate([(np.abs(f.residual) < _BEGINS * size) & f.moves for f in forces])
    known = np.ones(follows.size, dtype=np.bool_)
    for values in state:
        low, high = values[follows].min(), values[follows].max()
        if high <= low:
            continue
        at = np.floor((values - low) / (high - low) * _BINS).astype(int)
        inside = (at >= 0) & (at <= _BINS)
        at = np.clip(at, 0, _BINS)
        visits = np.bincount(at[follows], minlength=_BINS + 1)
        calm = np.bincount(at[follows & quiet], minlength=_BINS + 1)
        known &= inside & ((calm >= _MOST * visits) & (calm >= _VISITS))[at]
    bounds = np.cumsum([0, *(force.t.size for force in forces)])
    # A window also shows a little of its neighbours.
    parts = [~running_max(~known[first:stop], 3) for first, stop in pairwise(bounds)]
    return [part | force.idle for part, force in zip(parts, forces, strict=True)]


def _stretches(above: NDArray[np.bool_], t: Array) -> list[tuple[int, int]]:
    """Return first and last window of each stretch; stretches with a short gap are merged."""
    found: list[tuple[int, int]] = []
    for first, last in _runs(above):
        if found and t[first] - t[found[-1][1]] < _GAP:
            found[-1] = (found[-1][0], last)
        else:
            found.append((first, last))
    return found


def _runs(above: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and the last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.pad(above.astype(int), 1))).tolist()
    return [(first, behind - 1) for first, behind in zip(edges[::2], edges[1::2], strict=True)]


def _is_hand(
    left: Array, *, strong: NDArray[np.bool_], known: NDArray[np.bool_], hop: float
) -> bool:
    """Return whether a burst is due to a hand.

    Where the unexplained force is below the level at which a burst begins, `residual` is zero. The
    windows are `hop` s apart.
    """
    swings = np.count_nonzero(np.diff(np.sign(left[left != 0.0])))
    lasts = understood = 0
    for first, last in _runs(strong):
        burst = np.abs(left[first : last + 1])
        lasts += np.count_nonzero(burst > 0.5 * burst.max())
        understood += np.count_nonzero(known[first : last + 1])
    return bool(swings <= _SWINGS and lasts * hop >= _LASTS and understood * hop >= _KNOWN)
