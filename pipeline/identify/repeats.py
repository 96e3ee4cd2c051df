"""Compare repeats of one experiment, and find the one that differs from the others."""

from collections.abc import Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.identify.fault import RecordingFault
from pipeline.results import Record

_MATERIAL = 0.05  # share of the response; a smaller difference does not matter
# A repeat is odd if it differs from the others by this many times their spread; the keys are
# numbers of repeats. If repeats differ by normally distributed multiples of one shape, 5 % of the
# sets are flagged by chance; if they differ in several ways, far fewer are. With three repeats, the
# spread comes from a single difference, so the factor is large.
_SPREADS, _SPREADS_OF_MANY = {3: 30.0, 4: 8.0}, 5.0
_AMPLIFICATION = 2.0  # factor by which a lightly damped chain amplifies a difference of the inputs
_START_SAMPLES = 3  # samples whose median is the start, so that a spike is ignored


def find_outlier_repeats(records: Sequence[Record], *, unit: str) -> dict[str, RecordingFault]:
    """Find the repeats that do not belong with the others, by id.

    Repeats have the same kind, free and measured carts, and nearly the same input (in closed loop,
    the same set point). Decays are not compared, because a hand never releases a cart twice from
    the same place. Fewer than half of a group can be flagged, so none of two. `unit` is the
    unit of positions.
    """
    outliers: dict[str, RecordingFault] = {}
    for group in _groups(records):
        differences, expected = _differences(group)
        left = list(range(len(group)))
        while len(left) > 2 and 2 * (len(group) - len(left) + 1) < len(group):
            found = _farthest(differences, left, expected=expected)
            if found is None:
                break
            index, distance, spread = found
            left.remove(index)
            name, others = group[index].id, ", ".join(group[i].id for i in left)
            details = {"others": others, "unit": unit}
            details |= {"distance": f"{distance:.3g}", "spread": f"{spread:.3g}"}
            outliers[name] = RecordingFault(
                code="odd_repeat", run=name, details=details, is_wrong=False
            )
    return outliers


def _groups(records: Sequence[Record]) -> list[list[Record]]:
    """Return the groups of repeats among the records, in the order of the records."""
    groups: list[list[Record]] = []
    for record in records:
        if record.kind == "decay" or not np.any(_excitation(record)):
            continue
        home = next((group for group in groups if _is_repeat(group[0], record)), None)
        if home is None:
            groups.append([record])
        else:
            home.append(record)
    return groups


def _excitation(record: Record) -> Array:
    """Return what drove the record (n,): its set point in closed loop, else its input."""
    if record.kind == "closed_loop" and record.reference is not None:
        return record.reference
    return record.t * 0 if record.u is None else record.u


def _is_repeat(first: Record, other: Record) -> bool:
    """Return whether two records are repeats of one experiment."""
    spans = np.ptp(first.t), np.ptp(other.t)
    if (first.kind, first.free, first.carts) != (other.kind, other.free, other.carts):
        return False
    if min(spans) < 0.8 * max(spans):
        return False
    t = _common_times(first, other)
    u = np.concatenate([_at(t, record, _excitation(record)) for record in (first, other)])
    # An edge that is one sample early differs by 8 %, the next usual amplitude by 33 %.
    return bool(_rms(u[0] - u[1]) <= 0.2 * _rms(u))


def _common_times(*records: Record) -> Array:
    """Return the times of the shortest record, from its start."""
    shortest = min(records, key=lambda record: np.ptp(record.t))
    return shortest.t - shortest.t[0]


def _at(t: Array, record: Record, signal: Array) -> Array:
    """Return a signal of the record (…, n) at times t from the record's start."""
    return np.stack([np.interp(t, record.t - record.t[0], row) for row in np.atleast_2d(signal)])


def _rms(signal: Array) -> float:
    return float(np.sqrt(np.mean(signal**2)))


def _differences(group: Sequence[Record]) -> tuple[Array, Array]:
    """Return the differences (n, n) of the responses of each pair, and the allowed differences.

    The differences are root-mean-squares over carts and time. Positions count from the start of the
    record, because encoders need not start at zero. The final rest is part of the response.
    """
    t = _common_times(*group)
    u = np.concatenate([_at(t, record, _excitation(record)) for record in group])  # (n, n_t)
    y = np.stack([_at(t, record, record.y) for record in group])  # (n, p, n_t)
    y = y - np.median(y[:, :, :_START_SAMPLES], axis=2, keepdims=True)
    # The differences of all pairs at once would need gigabytes for a hundred repeats.
    by_input = np.sqrt([np.mean((one - u) ** 2, axis=1) for one in u]) / _rms(u)
    differences = np.sqrt([np.mean((one - y) ** 2, axis=(1, 2)) for one in y])
    return differences, (_MATERIAL + _AMPLIFICATION * by_input) * _rms(y)


def _farthest(
    differences: Array, left: Sequence[int], *, expected: Array
) -> tuple[int, float, float] | None:
    """Return the odd repeat, if any: its index, its distance, and the spread of the others."""
    threshold = _SPREADS.get(len(left), _SPREADS_OF_MANY)
    candidates = []
    for index in left:
        others = [i for i in left if i != index]
        distance = float(np.median(differences[index, others]))
        pairs = differences[np.ix_(others, others)][np.triu_indices(len(others), 1)]
        spread = float(np.median(pairs))
        if distance > max(threshold * spread, float(np.median(expected[index, others]))):
            candidates.append((index, distance, spread))
    return max(candidates, key=lambda found: found[1], default=None)
