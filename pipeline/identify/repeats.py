"""Compare repeats of one experiment, and find those that differ from the others.

Whole recordings with the same input are compared, and numbers that were measured more than once. If
two runs give a frequency or a gain 10 % apart, beyond their standard errors, one of the runs is
wrong. The fit decides which one. Without a fit, the majority decides, or it stays undecided. Runs
that agree may share a mistake, which shows if they contradict dwells that one chain explains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.estimation.record_fit import TIME_FACTORS
from pipeline.identify.findings import SAME_SIZE, SIGMAS, explain_ratio, say
from pipeline.names import gain_name, own_omega, own_zeta, read_name
from pipeline.results import Check, Estimate, Finding, LogDecrement, Record, StepGain

# A repeat is odd if it differs from the others by this many times their spread; the keys are
# numbers of repeats. If repeats differ by normally distributed multiples of one shape, 5 % of the
# sets are flagged by chance; if they differ in several ways, far fewer are. With three repeats, the
# spread comes from a single difference, so the factor is large.
_SPREADS, _SPREADS_OF_MANY = {3: 30.0, 4: 8.0}, 5.0
_SAME_RUN = 0.05  # relative; two runs may differ by this even if a known mistake is corrected
_LIKE_THE_FIT = 0.15  # relative; the usual difference of initial and final estimates (Throne 2005)
# Factors by which friction, play or a soft hold may change a gain or a frequency.
_BY_THE_BENCH = {"K": 1.6, "omega": 1.3}


def find_outlier_repeats(records: Sequence[Record], *, unit: str) -> dict[str, Finding]:
    """Find the repeats that do not belong with the others, by id.

    Repeats have the same kind, free and measured carts, and nearly the same input (in closed loop,
    the same set point). Decays are not compared, because a hand never releases a cart twice from
    the same place. Fewer than half of a group can be flagged, so none of two. `unit` is the
    unit of positions.
    """
    outliers: dict[str, Finding] = {}
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
            outliers[name] = Finding(code="odd_repeat", run=name, details=details, excludes="odd")
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
    return record.input


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
    # The start is the median of three samples, so that a spike is ignored.
    y = y - np.median(y[:, :, :3], axis=2, keepdims=True)
    # The differences of all pairs at once would need gigabytes for a hundred repeats.
    by_input = np.sqrt([np.mean((one - u) ** 2, axis=1) for one in u]) / _rms(u)
    differences = np.sqrt([np.mean((one - y) ** 2, axis=(1, 2)) for one in y])
    # A difference of 5 % does not matter, and a lightly damped chain doubles that of the inputs.
    return differences, (0.05 + 2.0 * by_input) * _rms(y)


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


@dataclass(frozen=True, kw_only=True)
class Repeats:
    """The comparison of repeated measurements.

    Attributes
    ----------
    checks : one check for each number that was measured more than once.
    odd : the runs that disagree with the others, by id, each with its fault.
    undecided : the numbers whose runs contradict each other, if nothing shows which runs are right.
    """

    checks: tuple[Check, ...] = ()
    odd: dict[str, Finding] = field(default_factory=dict)
    undecided: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Reading:
    """The value from one run, its interval, and the size of the step that gave it.

    `tolerance` is how far runs may differ, in percent, before they contradict each other. With dry
    friction, repeats differ by a few percent.
    """

    run: str
    value: float
    low: float
    high: float
    size: float = 0.0
    tolerance: float = 10.0


def compare_repeats(
    decays: Sequence[LogDecrement],
    steps: Sequence[StepGain],
    *,
    carts: int,
    fitted: Mapping[str, Estimate],
    dwells: Mapping[str, Estimate],
) -> Repeats:
    """Compare the runs that give the same frequency, damping or static gain.

    Parameters
    ----------
    fitted : the parameters of a fit that explains most records. Empty without such a fit.
    dwells : the parameters of a fit that uses only dwells and explains them. Empty without such a
        fit.
    """
    readings = _readings(decays, steps, carts=carts)
    # Dampings of a fit are not used, because they may come from the decays.
    estimates = {name: one for name, one in fitted.items() if not read_name(name).is_ratio}
    right = {name: _right_ones(all_, estimates.get(name)) for name, all_ in readings.items()}
    usual = {n: float(np.median([r.value for r in ones])) for n, ones in right.items() if ones}
    for name in [name for name in usual if name in dwells and not read_name(name).is_ratio]:
        if all(_is_far(reading, dwells[name], name=name) for reading in right[name]):
            usual[name], right[name] = dwells[name].value, []
    by_size = {name for name, ones in right.items() if ones and _only_by_size(readings[name])}
    of_run: dict[str, dict[str, float]] = {}
    for name, all_ in readings.items():
        for reading in all_:
            of_run.setdefault(reading.run, {})[name] = reading.value
    odd: dict[str, Finding] = {}
    for name, value in usual.items():
        belong = {reading.run for reading in right[name]}
        for run in [r.run for r in readings[name] if r.run not in belong and r.run not in odd]:
            clock_error = _wrong_clock(of_run[run], usual)
            if clock_error or name not in by_size:
                wrong = clock_error or (not right[name] and _differ_in_size(readings[name]))
                is_wrong = bool(wrong) and not _is_reversed(of_run[run], usual)
                details = {"parameter": name, "found": f"{of_run[run][name]:.3g}"}
                details |= {"usual": f"{value:.3g}", "look": clock_error and f": {clock_error}"}
                odd[run] = Finding(
                    code="odd_number" if right[name] else "odd_beside_dwells",
                    run=run,
                    details=details,
                    excludes="wrong" if is_wrong else "odd",
                )
    undecided = tuple(name for name in readings if name not in usual and name not in by_size)
    checks = tuple(
        _check(name, all_, right=right[name], odd=odd, undecided=name in undecided)
        for name, all_ in readings.items()
        if len(all_) > 1 and (right[name] or name not in usual)
    )
    return Repeats(checks=checks, odd=odd, undecided=undecided)


def _readings(
    decays: Sequence[LogDecrement], steps: Sequence[StepGain], *, carts: int
) -> dict[str, list[_Reading]]:
    found: dict[str, list[_Reading]] = {}
    for decay in decays:
        run, omega, slack = decay.experiment, decay.omega_n, SIGMAS * decay.omega_n_std
        frequency = _Reading(run=run, value=omega, low=omega - slack, high=omega + slack)
        # If the damping depends on the swing, the interval covers all amplitudes.
        seen = () if decay.law.is_exponential else decay.zeta_at_amplitude[1].tolist()
        ratios, slack = [decay.zeta, *seen], SIGMAS * decay.zeta_std
        low, high = min(ratios) - slack, max(ratios) + slack
        # Dirt in a bearing changes a damping by half.
        damping = _Reading(run=run, value=decay.zeta, low=low, high=high, tolerance=50.0)
        found.setdefault(own_omega(decay.cart, n=carts), []).append(frequency)
        found.setdefault(own_zeta(decay.cart, n=carts), []).append(damping)
    for step in steps:
        gain, slack = step.gain, SIGMAS * step.gain_std
        low, high = step.interval or (gain, gain)  # the cart may stick
        low, high = min(low, gain - slack), max(high, gain + slack)
        size = max(abs(edge.u_after - edge.u_before) for edge in step.edges)
        reading = _Reading(run=step.experiment, value=gain, low=low, high=high, size=size)
        found.setdefault(gain_name(step.cart, n=carts), []).append(reading)
    return found


def _contradictions(readings: Sequence[_Reading]) -> NDArray[np.bool_]:
    """Return which pairs of readings (n, n) contradict each other."""
    value, low, high = np.array([(r.value, r.low, r.high) for r in readings]).T
    size = np.maximum(np.abs(value[:, None]), np.abs(value))
    far = np.abs(value[:, None] - value) > readings[0].tolerance / 100 * size
    return far & (np.maximum(low[:, None], low) > np.minimum(high[:, None], high))


def _only_by_size(readings: Sequence[_Reading]) -> bool:
    """Whether only steps of different sizes contradict each other, as with dry friction."""
    size = np.array([reading.size for reading in readings])
    alike = np.abs(size[:, None] - size) <= SAME_SIZE * np.maximum(size[:, None], size)
    return not np.any(_contradictions(readings) & alike)


def _differ_in_size(readings: Sequence[_Reading]) -> bool:
    """Whether the steps have several sizes, so that friction or a limit may explain the gains."""
    size = np.array([reading.size for reading in readings])
    return bool(size.min() < (1 - SAME_SIZE) * size.max())


def _right_ones(readings: Sequence[_Reading], fitted: Estimate | None) -> list[_Reading]:
    """Return the readings that belong together; empty if undecided.

    These are all readings if they agree, else those that agree with the fit, else the majority.
    """
    apart = _contradictions(readings)
    if not np.any(apart):
        return list(readings)
    if fitted is not None and fitted.std is not None:
        near = _LIKE_THE_FIT * abs(fitted.value)
        like = [r for r in readings if abs(r.value - fitted.value) <= near]
        if like and SIGMAS * fitted.std <= near:
            near_it = np.array([reading in like for reading in readings])
            contrary = np.any(apart[:, near_it], axis=1) & ~near_it
            return [r for r, is_odd in zip(readings, contrary, strict=True) if not is_odd]
    most = ~apart[np.argmin(apart.sum(axis=1))]
    largest = [reading for reading, belongs in zip(readings, most, strict=True) if belongs]
    return largest if 2 * len(largest) > len(readings) else []


def _is_far(reading: _Reading, estimate: Estimate, *, name: str) -> bool:
    """Whether the whole interval of a reading is far from a number that is known well."""
    if (
        estimate.std is None
        or estimate.value <= 0
        or SIGMAS * estimate.std > _LIKE_THE_FIT * estimate.value
    ):
        return False
    factor = _BY_THE_BENCH[read_name(name).symbol]
    return reading.high < estimate.value / factor or reading.low > estimate.value * factor


def _wrong_clock(values: Mapping[str, float], usual: Mapping[str, float]) -> str:
    """Return the clock error that would explain a decay's frequencies, or ""."""
    known = [n for n in values if read_name(n).is_frequency and usual.get(n)]
    looks = {explain_ratio(usual[n] / values[n], TIME_FACTORS, within=_SAME_RUN) for n in known}
    return looks.pop() if len(looks) == 1 else ""


def _is_reversed(values: Mapping[str, float], usual: Mapping[str, float]) -> bool:
    """Whether all gains have the opposite sign, perhaps because the logged input has."""
    known = [name for name in values if read_name(name).is_gain and usual.get(name)]
    return bool(known) and all(abs(values[n] / usual[n] + 1) <= _SAME_RUN for n in known)


def _check(
    name: str,
    readings: Sequence[_Reading],
    *,
    right: Sequence[_Reading],
    odd: Mapping[str, Finding],
    undecided: bool,
) -> Check:
    values = [reading.value for reading in readings]
    largest = max(map(abs, values))
    spread = 100 * (max(values) - min(values)) / largest if largest > 0 else 0.0
    # A run that is odd in another number may agree in this one.
    off = [reading for reading in readings if reading.run in odd and reading not in right]
    details = {
        "name": name,
        "count": len(readings),
        "apart": f"from {min(values):.4g} to {max(values):.4g}",
        "runs": ", ".join(f"{reading.run} ({reading.value:.4g})" for reading in off),
        "are": "is" if len(off) == 1 else "are",
        "spread": f"{spread:.2g}",
    }
    limit, code = readings[0].tolerance, ""
    if undecided:
        code = "undecided_repeats"
    elif off:
        code = "odd_repeats"
    elif np.any(_contradictions(readings)):
        code = "sticking_repeats"
    finding = Finding(
        code=code, kind="repeats", parameter=name, details=details, value=spread, limit=limit
    )
    if code:
        return finding.check
    agree = spread <= limit
    return Check(
        kind="repeats",
        parameter=name,
        outcome="pass" if agree else "skip",
        value=spread,
        limit=limit,
        message=say("repeats_agree" if agree else "repeats_differ", **details),
    )
