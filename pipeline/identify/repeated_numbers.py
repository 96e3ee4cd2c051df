"""Compare numbers measured more than once: whether the runs agree, which are odd, and why.

If two runs give a frequency or a gain 10 % apart, beyond their standard errors, one of the runs is
wrong. The fit decides which one. Without a fit, the majority decides, or it stays undecided. Runs
that agree may share a mistake, which shows if they contradict dwells that one chain explains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.estimation.record_fit import TIME_FACTORS
from pipeline.identify.fault import SAME_SIZE, SIGMAS, RecordingFault
from pipeline.names import gain_name, own_omega, own_zeta, read_name
from pipeline.results import Check, Estimate, LogDecrement, StepGain

_LIKE_THE_FIT = 0.15  # relative; the usual difference of initial and final estimates (Throne 2005)
# Factors by which friction, play or a soft hold may change a gain or a frequency.
_BY_THE_BENCH = {"K": 1.6, "omega": 1.3}


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
    odd: dict[str, RecordingFault] = field(default_factory=dict)
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
    odd: dict[str, RecordingFault] = {}
    for name, value in usual.items():
        belong = {reading.run for reading in right[name]}
        for run in [r.run for r in readings[name] if r.run not in belong and r.run not in odd]:
            clock_error = _wrong_clock(of_run[run], usual)
            if clock_error or name not in by_size:
                wrong = clock_error or (not right[name] and _differ_in_size(readings[name]))
                odd[run] = RecordingFault(
                    code="odd_number" if right[name] else "odd_beside_dwells",
                    run=run,
                    details={
                        "parameter": name,
                        "found": f"{of_run[run][name]:.3g}",
                        "usual": f"{value:.3g}",
                        "look": f": {clock_error}" if clock_error else "",
                    },
                    is_wrong=bool(wrong) and not _is_reversed(of_run[run], usual),
                )
    undecided = tuple(name for name in readings if name not in usual and name not in by_size)
    return Repeats(
        checks=tuple(
            _check(name, all_, right=right[name], odd=odd, undecided=name in undecided)
            for name, all_ in readings.items()
            if len(all_) > 1 and (right[name] or name not in usual)
        ),
        odd=odd,
        undecided=undecided,
    )


def _readings(
    decays: Sequence[LogDecrement], steps: Sequence[StepGain], *, carts: int
) -> dict[str, list[_Reading]]:
    found: dict[str, list[_Reading]] = {}
    for decay in decays:
        name = own_omega(decay.cart, n=carts)
        slack = SIGMAS * decay.omega_n_std
        found.setdefault(name, []).append(
            _Reading(
                run=decay.experiment,
                value=decay.omega_n,
                low=decay.omega_n - slack,
                high=decay.omega_n + slack,
            )
        )
        slack = SIGMAS * decay.zeta_std
        # If the damping depends on the swing, the interval covers all amplitudes.
        seen = () if decay.law.is_exponential else decay.zeta_at_amplitude[1].tolist()
        ratios = [decay.zeta, *seen]
        found.setdefault(own_zeta(decay.cart, n=carts), []).append(
            _Reading(
                run=decay.experiment,
                value=decay.zeta,
                low=min(ratios) - slack,
                high=max(ratios) + slack,
                # Dirt in a bearing changes a damping by half.
                tolerance=50.0,
            )
        )
    for step in steps:
        name, slack = gain_name(step.cart, n=carts), SIGMAS * step.gain_std
        low, high = step.interval or (step.gain, step.gain)  # the cart may stick
        found.setdefault(name, []).append(
            _Reading(
                run=step.experiment,
                value=step.gain,
                low=min(low, step.gain - slack),
                high=max(high, step.gain + slack),
                size=max(abs(edge.u_after - edge.u_before) for edge in step.edges),
            )
        )
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
    ratios = [
        usual[name] / value
        for name, value in values.items()
        if read_name(name).is_frequency and usual.get(name)
    ]
    explanations = (
        words
        for factor, words in TIME_FACTORS.items()
        if ratios and all(_near(ratio, factor) for ratio in ratios)
    )
    return next(explanations, "")


def _is_reversed(values: Mapping[str, float], usual: Mapping[str, float]) -> bool:
    """Whether all gains have the opposite sign, perhaps because the logged input has."""
    known = [name for name in values if read_name(name).is_gain and usual.get(name)]
    return bool(known) and all(_near(values[name], -usual[name]) for name in known)


def _near(value: float, other: float) -> bool:
    # Two runs may differ by 5 % even when a known mistake is corrected.
    return abs(value - other) <= 0.05 * abs(other)


def _check(
    name: str,
    readings: Sequence[_Reading],
    *,
    right: Sequence[_Reading],
    odd: Mapping[str, RecordingFault],
    undecided: bool,
) -> Check:
    values = [reading.value for reading in readings]
    largest = max(map(abs, values))
    spread = 100 * (max(values) - min(values)) / largest if largest > 0 else 0.0
    # A run that is odd in another number may agree in this one.
    off = [reading for reading in readings if reading.run in odd and reading not in right]
    apart = f"from {min(values):.4g} to {max(values):.4g}"
    count = f"{len(readings)} runs"
    if undecided:
        outcome, text = (
            "fail",
            f"contradict each other ({apart}), and nothing shows which is right: no run is used",
        )
    elif off:
        runs = ", ".join(f"{reading.run} ({reading.value:.4g})" for reading in off)
        are = "is" if len(off) == 1 else "are"
        outcome, text = "fail", f"contradict each other ({apart}). {runs} {are} left out"
    elif np.any(_contradictions(readings)):
        outcome, text = "fail", f"give values {apart} that depend on the step, as if a cart stuck"
    elif spread > readings[0].tolerance:
        outcome, text = "skip", f"give values {apart}; their standard errors allow this difference"
    else:
        outcome, text = "pass", f"agree within {spread:.2g} %"
    return Check(
        kind="repeats",
        parameter=name,
        outcome=outcome,
        value=spread,
        limit=readings[0].tolerance,
        message=f"{name}: {count} {text}.",
    )
