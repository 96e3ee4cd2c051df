"""Compute each parameter again from the student's recordings, with bounds for honest readings."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.estimates import GAIN_AND_FREQUENCY_LIMIT
from pipeline.estimation.record_fit import TIME_UNITS
from pipeline.estimation.time_fit import FOLLOWED
from pipeline.grading import limits
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import Analysis, Estimate, ParameterRow, Record, StepEdge, StepGain

OFF_SCALE = "the recordings are not in the stated units"
_SLOWEST = 0.3  # s between samples; benches sample 20 times as often, or more


# Sources of a reference other than the recordings: the true value of a team's bench, and the
# student's other numbers.
TRUE, OWN = "answer_key", "own"
_GIVES = {TRUE: "your bench has", OWN: "your other numbers give"}


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A parameter computed from the recordings.

    Attributes
    ----------
    value : the estimate that is shown.
    low, high : bounds between which an honest reading of these recordings lies.
    std : standard error of the bounds.
    source : the method of the estimate.
    """

    value: float
    low: float
    high: float
    std: float = 0.0
    source: str = ""

    @classmethod
    def at(cls, value: float, *, std: float = 0.0, source: str = "") -> "Reference":
        """Return a reference without a range: both bounds are the value."""
        return cls(value=value, low=value, high=value, std=std, source=source)

    @property
    def text(self) -> str:
        """The reference as text: a number if the bounds are close, otherwise a range."""
        if self.low > 0 and self.within(limits.ONE_NUMBER):
            return f"{self.value:.4g}"
        return f"{self.low:.3g} to {self.high:.3g}"

    @property
    def said_of(self) -> str:
        """What gives the reference, in words that precede it."""
        return _GIVES.get(self.source, "your recordings give")

    def within(self, factor: float) -> bool:
        """Return whether the ratio of the bounds is at most a factor."""
        return self.high <= self.low * factor

    def including(self, value: float) -> "Reference":
        """Return the reference with bounds extended to include another value."""
        return replace(self, low=min(self.low, value), high=max(self.high, value))

    def widened(self, factor: float) -> "Reference":
        """Return the reference with bounds moved outwards by a factor."""
        return replace(self, low=self.low / factor, high=self.high * factor)

    def times(self, factor: float) -> "Reference":
        """Return the reference multiplied by a positive factor."""
        scaled = {x: factor * getattr(self, x) for x in ("value", "low", "high", "std")}
        return Reference(**scaled, source=self.source)


@dataclass(frozen=True, kw_only=True)
class References:
    """The references of both tables, by parameter name.

    Parameters that were guessed, or that the recordings do not determine, are left out.
    """

    initial: dict[str, Reference]
    final: dict[str, Reference]


def off_scale(analysis: Analysis) -> set[str]:
    """Return which scales (position, input or both) contradict those that the submission states."""
    return {c.kind for c in analysis.checks if c.kind in ("position_scale", "input_scale")}


def clock_units(analysis: Analysis) -> float:
    """Return how many units of the time columns are a second: 1, or 1000 if they are milliseconds.

    They are not seconds if all dwells are slower than stated by such a factor, and if the samples
    would be longer apart than those of any bench.
    """
    ratios = [c.value for c in analysis.checks if c.kind == "dwells" and c.value]
    slow = min((record.sample_time for record in analysis.records), default=0.0) > _SLOWEST
    found = (u for u in TIME_UNITS for ratio in ratios if math.isclose(ratio, u, rel_tol=0.01))
    return next(found, 1.0) if slow else 1.0


def in_scale(
    references: References, chain: Chain | None, *, analysis: Analysis, per_count: float | None
) -> tuple[References, Chain | None]:
    """Return references and chain in the stated units, even if the recordings are in other units.

    Positions in counts are converted by the stated length per count, and times to seconds. Numbers
    whose scale is unknown are left out.
    """
    wrong, clock = off_scale(analysis), clock_units(analysis)
    if not wrong and clock == 1.0:
        return references, chain
    length = 1.0 if not wrong else per_count if wrong == {"position_scale"} else None

    def scaled(table: Mapping[str, Reference]) -> dict[str, Reference]:
        factors = {
            name: length
            if read_name(name).is_gain
            else clock
            if read_name(name).is_frequency
            else 1.0
            for name in table
        }
        return {name: table[name].times(factor) for name, factor in factors.items() if factor}

    if chain and length:
        m, c, k = chain.m / (length * clock**2), chain.c / (length * clock), chain.k / length
        chain = replace(chain, m=m, c=c, k=k)
    else:
        chain = None
    return References(initial=scaled(references.initial), final=scaled(references.final)), chain


def recompute(analysis: Analysis) -> References:
    """Return the references of both tables.

    If a number can be measured in several ways, its bounds include the results of all of them, in
    both tables. Dry friction adds to every damping ratio, but a damping ratio without this part is
    also right.
    """
    chain = trusted_chain(analysis)
    trusted, tables = chain is not None, _by_decays(chain, analysis) if chain else []
    scales = {symbol: _birge_ratio(symbol, analysis) for symbol in ("K", "omega")}
    final, initial = {}, {}
    for row in analysis.rows:
        scale = scales.get(read_name(row.name).symbol, 1.0)
        fitted = _final(row, analysis, tables, scale=scale) if trusted else None
        measured = _initial(row, fitted, analysis)
        if measured is not None:
            initial[row.name] = measured
        if fitted is not None:
            final[row.name] = fitted
        elif measured is not None:
            final[row.name] = measured
            # If the fit to these data finds a wrong gain, the student's fit may find it too. But
            # students notice a large error.
            astray = (
                row.final.value if row.final and read_name(row.name).is_gain else measured.value
            )
            if (
                measured.value / limits.BEYOND_BELIEF
                < astray
                < measured.value * limits.BEYOND_BELIEF
            ):
                final[row.name] = measured.including(astray)
        if not trusted and read_name(row.name).is_gain:
            for table in (initial, final):
                if row.name in table:
                    table[row.name] = table[row.name].widened(limits.STUCK)
    # Without a trusted fit, a peak in the dwells may be another resonance than assumed.
    for table in (initial, final) if not trusted else ():
        for name in [n for n, r in table.items() if r.source == "frequency_response"]:
            del table[name]
    return References(initial=initial, final=final)


def trusted_chain(analysis: Analysis) -> Chain | None:
    """Return the fitted chain; None if the fit cannot be trusted, for example because of friction.

    A fit that does not explain the data is trusted only if it determines the frequencies and gains,
    and agrees with values measured without a fit.
    """
    if analysis.fit is None or is_explained(analysis):
        return analysis.chain
    for row in analysis.rows:
        if read_name(row.name).is_damping:
            continue
        if row.name in analysis.fit.parameters and row.final is None:
            return None  # the fit does not determine this parameter
        if row.initial is None or row.final is None:
            continue
        before, after = row.initial.value, row.final.value
        limit = limits.ASTRAY if read_name(row.name).is_frequency else limits.ASTRAY_GAIN
        if min(before, after) <= 0 or max(before / after, after / before) > limit:
            return None
        if limits.SIGMAS * (row.final.std or 0.0) > (limit - 1) * after:
            return None
    return analysis.chain


def is_explained(analysis: Analysis) -> bool:
    """Return whether a linear chain and noise explain the data.

    Without a fit, this is assumed.
    """
    return analysis.fit is None or analysis.fit.explains_data


def is_followed(analysis: Analysis) -> bool:
    """Return whether nearly all driven recordings agree with a simulation of the fitted chain.

    This is possible even if the fit does not explain the measured response. Near a sharp resonance,
    a coarse encoder hides the end of a dwell's transient, so that the point of this dwell is wrong
    by several standard errors.
    """
    bad = {one.experiment for one in analysis.left_out}
    left = [share for name, share in analysis.unexplained.items() if name not in bad]
    return bool(left) and sum(share <= FOLLOWED for share in left) >= limits.FOLLOWED_SHARE * len(
        left
    )


def is_linear(analysis: Analysis) -> bool:
    """Return whether the recordings are close to those of linear carts.

    Otherwise every number depends on the amplitude and the method, and two honest students find
    different values.
    """
    return is_explained(analysis) or is_followed(analysis)


def in_doubt(references: References, *, analysis: Analysis) -> References:
    """Return the references with bounds beyond which a number counts against the student.

    On a nonlinear bench, the bounds are widened. They are widened more for a final gain than for an
    initial one, because a fit means little on such a bench. On a linear bench, only the bounds of
    extrapolated numbers are widened.
    """

    def factor(name: str, *, of_gains: float) -> float:
        if read_name(name).is_damping:
            return limits.BEYOND_BELIEF_DAMPING
        return of_gains if read_name(name).is_gain else limits.BEYOND_BELIEF

    if is_linear(analysis):
        beyond = {row.name for row in analysis.rows if row.extrapolated}
        final = {
            name: one.widened(factor(name, of_gains=1.0)) if name in beyond else one
            for name, one in references.final.items()
        }
        return replace(references, final=final)

    def widened(table: Mapping[str, Reference], *, of_gains: float) -> dict[str, Reference]:
        return {
            name: one.widened(factor(name, of_gains=of_gains))
            for name, one in table.items()
            # Resonances of nonlinear carts are not parameters, and neither are numbers derived from
            # them.
            if one.source != "frequency_response"
        }

    return References(
        initial=widened(references.initial, of_gains=limits.BEYOND_BELIEF),
        final=widened(references.final, of_gains=limits.FITTED_TO_NOTHING),
    )


def _birge_ratio(symbol: str, analysis: Analysis) -> float:
    """Return by which factor (at least 1) the fit underestimates errors of gains or frequencies.

    Gains from steps and frequencies from decays do not use the fit. The ratio is the root mean
    square of their differences from the fit, in standard errors (Birge, Physical Review 40, 1932).
    A reading that contradicts a fit which explains the data does not count: its recording is wrong.

    Parameters
    ----------
    symbol : kind of parameter: "K" for gains, "omega" for frequencies.
    """
    apart = []
    for row in analysis.rows:
        read, fitted = row.initial, row.final
        if read is None or fitted is None or read.source not in ("step", "log_decrement"):
            continue
        if is_explained(analysis) and not _agrees(read.value, fitted):
            continue
        std = np.hypot(read.std or 0.0, fitted.std or 0.0)
        if read_name(row.name).symbol == symbol and std > 0:
            apart.append((read.value - fitted.value) / std)
    return max(1.0, float(np.sqrt(np.mean(np.square(apart))))) if apart else 1.0


def _final(
    row: ParameterRow,
    analysis: Analysis,
    tables: Sequence[Mapping[str, float]],
    *,
    scale: float,
) -> Reference | None:
    """Return a final number, with bounds from the fit and from all measurements without a fit.

    The standard errors of the fit are multiplied by `scale`. A fit that stops at zero damping does
    not measure the damping. If there is no other measurement, a fit that explains neither the
    response nor the recordings does not count.
    """
    fitted, read_off = row.final, readings(row.name, analysis)
    if read_name(row.name).is_damping:
        measured = [table[row.name] for table in tables]
    else:
        measured = list(read_off)
        if row.initial and (measured or not is_explained(analysis)):
            spread = limits.READ_BY_EYE if row.initial.source == "frequency_response" else 1.0
            measured += [row.initial.value / spread, row.initial.value * spread]
    undamped = analysis.chain is not None and not np.all(analysis.chain.c > 0)
    told = fitted is not None and not (read_name(row.name).is_damping and undamped)
    # Readings may disagree with the fit because of a wrong unit, sign or clock, and are then left
    # out. Dampings stay, because they depend on none of these. Dry friction adds to dampings, more
    # in dwells than in decays, and a fit to few dwells looks good in spite of it.
    if fitted and told and not read_name(row.name).is_damping and is_explained(analysis):
        measured = [value for value in measured if _agrees(value, fitted)]
    read = row.initial.source if row.initial and not read_off else "log_decrement"
    if not measured and not (told and (is_explained(analysis) or is_followed(analysis))):
        return None
    bounds = [*measured, *([fitted.value] if fitted and told else [])]
    return Reference(
        value=fitted.value if fitted and told else sum(measured) / len(measured),
        low=min(bounds),
        high=max(bounds),
        std=scale * (fitted.std or 0.0) if fitted and told else 0.0,
        source=fitted.source if fitted and told else read,
    )


def _agrees(value: float, fitted: Estimate) -> bool:
    """Return whether a reading agrees with a fit that explains the data.

    A reading that does not agree is not used as a bound, because its recording must show something
    else.
    """
    slack, factor = limits.SIGMAS * (fitted.std or 0.0), 1 + GAIN_AND_FREQUENCY_LIMIT / 100
    least, most = fitted.value / factor, fitted.value * factor
    return least - slack <= value <= most + slack


def _by_decays(chain: Chain, analysis: Analysis) -> list[dict[str, float]]:
    """Return two tables of the fitted chain, with the smallest and largest dampings from decays.

    A cart without decays keeps the damping of the fit. No tables are returned without decays, for
    carts that no spring ties to a wall, or if the smallest damping is not positive.
    """
    decays = [readings(f"zeta_{cart}", analysis) for cart in range(1, chain.n + 1)]
    if not any(decays) or not chain.is_tied:
        return []
    critical = 2 * chain.m * chain.omega_carts
    found = []
    for choose in (min, max):
        zeta = [choose(r) if r else z for r, z in zip(decays, chain.zeta_carts, strict=True)]
        found.append(replace(chain, c=np.array(zeta) * critical))
    return [one.parameters() for one in found] if np.all(found[0].c > 0) else []


def _initial(row: ParameterRow, final: Reference | None, analysis: Analysis) -> Reference | None:
    measured = row.initial
    if measured is not None and measured.source == "assumed":
        return None
    if measured is None:
        return final
    read_off = readings(row.name, analysis)
    bounds = [measured.value, *read_off]
    if final is not None:
        bounds += [final.low, final.high]
    spread = limits.READ_BY_EYE if measured.source == "frequency_response" else 1.0
    return Reference(
        value=measured.value,
        low=min(bounds) / spread,
        high=max(bounds) * spread,
        # With several readings, the bounds already include the error.
        std=0.0 if len(read_off) > 1 else measured.std or 0.0,
        source=measured.source,
    )


def readings(name: str, analysis: Analysis) -> list[float]:
    """Return all values that students may read off for a cart's own gain, frequency or damping.

    The damping of a decay is read twice: with dry friction subtracted, and without subtracting it.
    """
    read = read_name(name)
    if read.is_by_eye:
        return []
    cart = read.cart or 1
    readings: list[float] = []
    if read.is_gain:
        held = _held(cart, analysis)
        for step in analysis.step_gains:
            if step.cart == cart:
                readings += [step.gain, *(step.interval or ())]
                readings += [_shortest(edge, held=held) for edge in step.edges if held]
        readings += _by_size([step for step in analysis.step_gains if step.cart == cart])
    for decay in analysis.log_decrements:
        if decay.cart == cart and read.is_frequency:
            readings.append(decay.omega_n)
        if decay.cart == cart and read.is_ratio:
            readings += [zeta for zeta in (decay.zeta, decay.law.zeta) if zeta > 0]
    return readings


def _by_size(steps: Sequence[StepGain]) -> list[float]:
    """Return the slope between small and large steps, if the gain depends on the size of the step.

    The slope is the difference in level divided by the difference in input. It is needed because a
    dead zone, or an amplifier with a threshold, subtracts the same amount from every step.
    """
    edges = sorted(
        (abs(e.u_after - e.u_before), abs(e.level_after - e.level_before))
        for step in steps
        for e in step.edges
    )
    if not edges:
        return []
    size, far = np.array(edges).T
    small, large = size < size.mean(), size >= size.mean()
    if not np.any(small) or size[small].max() > (1 - limits.SAME_STEP) * size[large].min():
        return []
    (u, x), (v, y) = ((size[at].mean(), far[at].mean()) for at in (small, large))
    slope = float((y - x) / (v - u))
    return [slope] if y / v > limits.BY_SIZE * x / u else []


def _held(cart: int, analysis: Analysis) -> float:
    """Return the largest input step that friction prevented from moving a free cart."""
    held = [
        float(np.abs(r.u).max())
        for r in analysis.records
        if r.kind == "step"
        and r.u is not None
        and cart in r.free
        and cart in r.carts
        and np.ptp(r.position(cart)) <= limits.STILL * r.encoder_step(cart)
    ]
    return max(held, default=0.0)


def _shortest(edge: StepEdge, *, held: float) -> float:
    """Return the gain from a step's edge, if friction stopped the cart beyond its equilibrium.

    Parameters
    ----------
    held : the largest input that friction can balance.
    """
    return abs((edge.level_after - edge.level_before) / (abs(edge.u_after - edge.u_before) + held))


_TURNS = 3  # the peak, the trough after it, and the second peak
_DIGITS = 2  # significant digits; edges whose sizes agree to so many digits count as equal

Edge = tuple[int, float]  # number of the edge in its recording, and its size


@dataclass(frozen=True, kw_only=True, eq=False)
class StepTurns:
    """The turning points of one cart, as displacement per unit of input.

    Attributes
    ----------
    by_edge : for each edge, and each recording that repeats it, the first three turning points.
    furthest : for each edge, the largest displacement in each recording. If two modes beat, it may
        come after the first turning point.
    """

    by_edge: dict[Edge, list[list[float]]]
    furthest: dict[Edge, list[float]]

    def mean_peak(self) -> Reference | None:
        """Return the mean first turning point over all edges; None without edges."""
        peaks = [one[0] for repeats in self.by_edge.values() for one in repeats]
        return _spread([float(np.mean(peaks))]) if peaks else None

    def turn(self, edge: Edge, number: int) -> Reference | None:
        """Return turning point `number` after an edge, as a range over the repeats.

        Returns None if this or an earlier turning point is missing or not positive.
        """
        repeats = [one for one in self.by_edge.get(edge, ()) if len(one) > number]
        if not repeats or min(min(one[: number + 1]) for one in repeats) <= 0:
            return None
        return _spread([one[number] for one in repeats])

    def peak(self, edge: Edge) -> Reference:
        """Return the peak after an edge: a range that covers the first and the largest peak."""
        return _spread([*(repeat[0] for repeat in self.by_edge[edge]), *self.furthest[edge]])


def step_turns(name: str, analysis: Analysis) -> StepTurns:
    """Return the turning points after steps, for the cart of a gain (`K` or `K_i`)."""
    cart = read_name(name).cart or 1
    records = {record.id: record for record in analysis.records}
    found: dict[Edge, list[list[float]]] = {}
    furthest: dict[Edge, list[float]] = {}
    for step in analysis.step_gains:
        if step.cart == cart:
            for edge, moved, turns in _turns(step, records[step.experiment]):
                if turns and turns[0] > 0:
                    found.setdefault(edge, []).append(turns)
                    furthest.setdefault(edge, []).append(float(moved.max()))
    return StepTurns(by_edge=found, furthest=furthest)


def _spread(values: Sequence[float]) -> Reference:
    middle = float(np.median(values))
    return Reference(value=middle, low=min(values), high=max(values), source="step")


def _turns(step: StepGain, record: Record) -> Iterator[tuple[Edge, Array, list[float]]]:
    """Yield each edge, the cart's displacement per unit of input, and its turning points."""
    y = record.position(step.cart)
    for number, edge in enumerate(step.edges):
        change = edge.u_after - edge.u_before
        inside = (record.t >= edge.t) & (record.t <= edge.window_after[1])
        moved = (y[inside] - edge.level_before) / change
        level = (edge.level_after - edge.level_before) / change
        turns, side, rest = [], 1.0, moved
        while rest.size and len(turns) < _TURNS:
            # A turning point is the farthest point before the cart crosses its settled level again.
            beyond = side * (rest - level) > 0
            first = int(np.argmax(beyond)) if beyond.any() else rest.size
            back = np.flatnonzero(~beyond[first:])
            last = first + int(back[0]) if back.size else rest.size
            if first == last:
                break
            stretch = rest[first:last]
            turns.append(float(stretch[np.argmax(side * stretch)]))
            rest, side = rest[last:], -side
        yield (number, float(f"{change:.{_DIGITS}g}")), moved, turns
