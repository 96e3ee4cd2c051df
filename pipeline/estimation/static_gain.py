"""Step: static gain from the levels at which a cart settles before and after each edge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation import noise
from pipeline.estimation.least_squares import find_poles, fit_ringing
from pipeline.results import Record, StepEdge, StepGain

# Motion is counted in grains. A grain is the encoder step, or the step whose rounding error equals
# the noise if that is larger.
_MOVED = 6.0  # grains; a smaller motion does not count
# Largest residual and standard error of an extrapolated level, as shares of the motion.
_EXTRAPOLATES = 0.02
_STICKS_SIGMAS = 4.0  # standard errors; by chance, one edge in 16,000 is as far off
_ARITHMETIC = 1e-3  # scatter, in grains, of a level without noise or rounding
_SAME_INPUT = 0.02  # share of the input's range


@dataclass(frozen=True, kw_only=True)
class _Level:
    """The level at which a cart rests under one input, with its standard error and samples."""

    first: int
    stop: int
    value: float
    std: float
    extrapolated: bool


@dataclass(frozen=True, kw_only=True)
class _Plateau:
    """Samples [first, stop) with one input, and the level at which the cart settled.

    The level is None if the cart did not settle.
    """

    first: int
    stop: int
    u: float
    level: _Level | None


def fit_static_gain(record: Record, *, cart: int) -> StepGain:
    """Estimate the static gain of one cart from every edge of a stepped input.

    A level is the mean of the samples after the last motion. If the record or the input ends a
    level while the cart still rings, damped sinusoids are fitted to the ringing, one for each free
    cart, and give the level. The method is valid for any number of carts on at least one spring,
    and steps of any size and sign.

    Raises
    ------
    DataError : there is no input column or no step in it; or the cart is held, does not move or
        never settles.
    """
    t, y, step = record.t, record.position(cart), record.encoder_step(cart)
    parts, drift = _constant_parts(record), 0.0
    if cart not in record.free:
        raise DataError(f"{record.id}: step gain needs a cart that is free, cart {cart} is held")
    if np.ptp(y) == 0:
        raise DataError(f"{record.id}: step gain needs motion, cart {cart} does not move")
    size = noise.resolution(t, y, step=step)
    found = [_settle(record, y, part, size=size, step=step) for part in parts]
    for _ in range(4):  # without the drift, more samples count as settled
        more = _drift(t, y, [p.level for p in found if p.level], size=size)
        if not more:
            break
        drift += more
        y = y - more * (t - t[0])
        found = [_settle(record, y, part, size=size, step=step) for part in parts]
    found, notes = _with_unseen_start(t, y, found, size=size, step=step)
    if drift:
        notes.append(f"a drift of {drift:.3g} per second was removed")
    edges = _edges(t, found)
    if not edges:
        raise DataError(
            f"{record.id}: step gain needs an edge before and after which cart {cart} settles, "
            "found no such edge"
        )
    moving = [edge for edge in edges if abs(edge.level_after - edge.level_before) > _MOVED * size]
    if not moving:
        raise DataError(
            f"{record.id}: step gain needs cart {cart} to move by more than {_MOVED:.0f} "
            "encoder steps, found less"
        )
    gain, gain_std = _combine(moving)
    shift, shift_std = _rest_shift(found)
    spread = [abs(edge.gain - gain) / edge.gain_std for edge in moving]
    sticks = len(moving) < len(edges) or max(spread) > _STICKS_SIGMAS
    sticks = sticks or (shift is not None and abs(shift) > _STICKS_SIGMAS * shift_std)
    notes += _notes(found, moving, edges, shift=shift if sticks else None)
    return StepGain(
        experiment=record.id,
        cart=cart,
        edges=tuple(edges),
        gain=gain,
        gain_std=gain_std,
        rest_shift=shift,
        interval=_interval(moving, shift=shift or 0.0) if sticks else None,
        note="; ".join(notes),
    )


# ------------------------------------------------------------- input and levels


def _constant_parts(record: Record) -> list[tuple[int, int, float]]:
    """Return (first, stop, input) of the stretches of constant input, with edges in between."""
    u = record.u
    if u is None:
        raise DataError(
            f"{record.id}: step gain needs the input as well as the positions, found no input "
            "column: export it too, or name it under `columns`"
        )
    # The means of the halves of a constant stretch differ by less than 0.5 % of the input's range.
    creep = 0.005 * float(np.ptp(u))
    long = [
        (a, b)
        for a, b in noise.plateaus(u)
        if a == 0 or (b - a >= noise.MIN_SAMPLES and abs(_halves_differ(u[a:b])) <= creep)
    ]
    share = sum(b - a for a, b in long) / u.size
    parts = [(a, b, float(np.mean(u[a:b]))) for a, b in long]
    # In a step run, the input is constant for at least 60 % of the record.
    if share < 0.6 or not any(value for _, _, value in parts):
        raise DataError(
            f"{record.id}: step gain needs an input that steps and then stays, found it constant "
            f"and nonzero for only {100 * share if any(p[2] for p in parts) else 0:.0f} % of the "
            "record"
        )
    return parts


def _halves_differ(values: Array) -> float:
    middle = values.size // 2
    return float(values[middle:].mean() - values[:middle].mean())


def _settle(
    record: Record, y: Array, part: tuple[int, int, float], *, size: float, step: float
) -> _Plateau:
    first, stop, u = part
    level = _level(
        record.t[first:stop], y[first:stop], n_modes=len(record.free), size=size, step=step
    )
    if level:
        level = replace(level, first=first + level.first, stop=first + level.stop)
    return _Plateau(first=first, stop=stop, u=u, level=level)


def _level(t: Array, y: Array, *, n_modes: int, size: float, step: float) -> _Level | None:
    """Return the level at which y (n,) settles; None if it does not settle."""
    motion, pace = float(np.ptp(y)), _pace(t, y, size=size)
    # A window with a range of less than three grains is level.
    flat = _flat_from(y, span=3.0 * size)
    if flat == 0 or t[-1] - t[flat] >= pace:
        return _mean_level(y, flat, step=step, arithmetic=_ARITHMETIC * size)
    ringing = _extrapolated(t, y, n_modes=n_modes, floor=size / np.sqrt(12))
    if ringing:
        return ringing
    # If no window is level down to the noise, 2 % of the motion must do.
    flat = _flat_from(y, span=0.02 * motion)
    if t[-1] - t[flat] >= pace:
        return _mean_level(y, flat, step=step, arithmetic=_ARITHMETIC * size)
    return None


def _pace(t: Array, y: Array, *, size: float) -> float:
    """Return how long (s) a window must be to prove rest: two periods, or two rise times."""
    turning = noise.extrema(y, prominence=noise.PROMINENCE * size)
    if len(turning) > 3:  # the ends are not turning points
        return 2 * float(np.max(np.diff(t[turning[1:-1]])))
    risen = np.abs(y - y[0]) >= (1 - np.exp(-1)) * abs(y[-1] - y[0])
    return 2 * float(t[int(np.argmax(risen))] - t[0])


def _flat_from(y: Array, *, span: float) -> int:
    """Return the first sample from which on the range of y is at most `span`."""
    backwards = y[::-1]
    spans = np.maximum.accumulate(backwards) - np.minimum.accumulate(backwards)
    return y.size - int(np.searchsorted(spans, span, side="right"))


def _mean_level(y: Array, first: int, *, step: float, arithmetic: float) -> _Level:
    """Return the mean from `first` on as a level.

    If the cart stands still, rounding causes an error of up to half an encoder step.
    """
    window = y[first:]
    residual = window - window.mean()
    rms = float(np.sqrt(np.mean(residual**2)))
    scatter = max(rms, arithmetic) * np.sqrt(noise.relative_psd(residual, angle=0.0) / window.size)
    rounding = step / np.sqrt(12) * noise.rounding_left(rms, step=step)
    return _Level(
        first=first,
        stop=y.size,
        value=float(window.mean()),
        std=float(np.hypot(scatter, rounding)),
        extrapolated=False,
    )


def _extrapolated(t: Array, y: Array, *, n_modes: int, floor: float) -> _Level | None:
    """Return the level about which y still rings, if damped sinusoids fit it well.

    There is one sinusoid for each free cart, or fewer if noise hides the smallest.
    """
    motion = float(np.ptp(y))
    for n in range(n_modes, 0, -1):
        if t.size < noise.MIN_SAMPLES * (n + 1):
            continue
        poles = find_poles(t, y, n_modes=n)
        if poles.size < n:
            continue
        fit = fit_ringing(t, y, poles=poles, drift=False)
        std = float(np.sqrt(fit.covariance[0, 0]))
        left = max(2 * floor, _EXTRAPOLATES * motion)
        if (
            fit.converged
            and bool(np.all(fit.poles.real < 0))
            and float(np.min(fit.poles.imag)) * (t[-1] - t[0]) >= np.pi  # half a period is seen
            and fit.rms <= left
            and std <= _EXTRAPOLATES * motion
        ):
            return _Level(first=0, stop=y.size, value=fit.level, std=std, extrapolated=True)
    return None


def _with_unseen_start(
    t: Array, y: Array, found: list[_Plateau], *, size: float, step: float
) -> tuple[list[_Plateau], list[str]]:
    """Add a rest before the record if the input is on, and motion begins, at its first sample."""
    head = found[0]
    if head.u == 0 or not head.level or abs(head.level.value - y[0]) <= _MOVED * size:
        return found, []
    radian = _pace(t[: head.stop], y[: head.stop], size=size) / (2 * np.pi)
    n = max(5, int(np.searchsorted(t, t[0] + radian / 2)))
    velocity = np.polyfit(t[:n] - t[0], y[:n], 2)[1]
    # The initial velocity must be below 10 % of the motion per radian of the ringing.
    if abs(velocity) * radian > 0.1 * abs(head.level.value - y[0]):
        return found, []
    std = max(size, step) / np.sqrt(12)
    level = _Level(first=0, stop=1, value=float(y[0]), std=float(std), extrapolated=False)
    rest = _Plateau(first=0, stop=0, u=0.0, level=level)
    return [rest, *found], ["the input is on from the first sample: taken as switched on there"]


def _drift(t: Array, y: Array, levels: Sequence[_Level], *, size: float) -> float:
    """Return the slope, per second, that all settled windows share; 0 if they do not."""
    slopes, errors = [], []
    for level in levels:
        if level.extrapolated or level.stop - level.first < noise.MIN_SAMPLES:
            continue
        tau = t[level.first : level.stop] - t[level.first : level.stop].mean()
        window = y[level.first : level.stop]
        slope = float(tau @ window / (tau @ tau))
        residual = window - window.mean() - slope * tau
        rms = max(float(np.sqrt(np.mean(residual**2))), size / np.sqrt(12))
        slopes.append(slope)
        errors.append(rms * np.sqrt(noise.relative_psd(residual, angle=0.0) / (tau @ tau)))
    if len(slopes) < 2:
        return 0.0
    weight = 1 / np.square(errors)
    drift = float(np.average(slopes, weights=weight))
    # All settled windows must clearly show the same drift.
    seen = abs(drift) > 5.0 / np.sqrt(weight.sum())
    alike = np.abs(np.array(slopes) - drift) <= 0.3 * abs(drift) + 3 * np.array(errors)
    return drift if seen and bool(np.all(alike)) else 0.0


# ----------------------------------------------------------------- edges to gain


def _edges(t: Array, found: Sequence[_Plateau]) -> list[StepEdge]:
    """Return the edges of the input before and after which the cart settled."""
    same = _SAME_INPUT * float(np.ptp([p.u for p in found]))
    edges = []
    for before, after in pairwise(found):
        low, high, change = before.level, after.level, after.u - before.u
        if low and high and abs(change) > same:
            edge = StepEdge(
                t=float(t[after.first]),
                u_before=before.u,
                u_after=after.u,
                level_before=low.value,
                level_after=high.value,
                window_before=(float(t[low.first]), float(t[low.stop - 1])),
                window_after=(float(t[high.first]), float(t[high.stop - 1])),
                gain=(high.value - low.value) / change,
                gain_std=float(np.hypot(low.std, high.std)) / abs(change),
            )
            edges.append(edge)
    return edges


def _combine(edges: Sequence[StepEdge]) -> tuple[float, float]:
    """Return the weighted mean gain and its standard error.

    Edges share levels, and a cart at rest is rounded the same way each time. So the standard error
    does not shrink with the number of edges. If the spread of the gains gives a larger standard
    error, that one is used.
    """
    gains = np.array([edge.gain for edge in edges])
    std = np.array([edge.gain_std for edge in edges])
    mean = float(np.average(gains, weights=std**-2))
    spread = float(np.average((gains - mean) ** 2, weights=std**-2)) / max(len(edges) - 1, 1)
    return mean, float(max(np.average(std, weights=std**-2), np.sqrt(spread)))


def _rest_shift(found: Sequence[_Plateau]) -> tuple[float | None, float]:
    """Return how far the last rest at the first input is from the first rest, and its error.

    The distance is None if the first input does not occur again.
    """
    span = max(p.u for p in found) - min(p.u for p in found)
    settled = [p for p in found if p.level]
    for last in reversed(settled[1:]):
        if abs(last.u - settled[0].u) <= _SAME_INPUT * span and last.level and settled[0].level:
            shift = last.level.value - settled[0].level.value
            return shift, float(np.hypot(last.level.std, settled[0].level.std))
    return None, 0.0


def _interval(edges: Sequence[StepEdge], *, shift: float) -> tuple[float, float]:
    """Return the range of gains that friction allows.

    Each rest point may be off by half the shift.
    """
    gains = [edge.gain for edge in edges]
    slack = abs(shift) / (2 * min(abs(edge.u_after - edge.u_before) for edge in edges))
    slack = max(slack, max(edge.gain_std for edge in edges))
    return min(gains) - slack, max(gains) + slack


def _notes(
    found: Sequence[_Plateau],
    moving: Sequence[StepEdge],
    edges: Sequence[StepEdge],
    *,
    shift: float | None,
) -> list[str]:
    notes = []
    if shift is not None:
        notes.append(
            f"the cart came back to rest {abs(shift):.3g} away from where it began: it sticks"
        )
    notes += [
        f"at the edge to {edge.u_after:.3g} the cart did not move: it sticks"
        for edge in edges
        if edge not in moving
    ]
    if any(p.level and p.level.extrapolated for p in found):
        notes.append(
            "the cart still oscillates at the end of a level, so the level comes from a fitted "
            "oscillation"
        )
    if any(p.level is None for p in found):
        notes.append("edges before or after which the cart never settles are left out")
    return notes
