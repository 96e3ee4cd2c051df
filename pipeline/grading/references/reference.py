"""Recompute each parameter from the student's recordings, with bounds for honest readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.estimation.chain.time_search import FOLLOWED
from pipeline.grading import limits
from pipeline.names import read_name
from pipeline.plant.linear.chain import Chain
from pipeline.results import Analysis, Estimate, ParameterRow, StepEdge, StepGain
from pipeline.stages.compare import GAIN_AND_FREQUENCY_LIMIT

OFF_SCALE = "the recordings are not in the units stated, see the data"


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A recomputed parameter.

    Attributes
    ----------
    value : the estimate that is shown; `source` is its method.
    low, high : an honest reading of these recordings lies between them.
    std : standard error of the bounds.
    """

    value: float
    low: float
    high: float
    std: float
    source: str

    @classmethod
    def at(cls, value: float, *, std: float = 0.0, source: str = "") -> "Reference":
        """Return the reference of a single number."""
        return cls(value=value, low=value, high=value, std=std, source=source)

    @property
    def said(self) -> str:
        """The reference in words: a number or a range."""
        if self.low > 0 and self.within(limits.ONE_NUMBER):
            return f"{self.value:.4g}"
        return f"{self.low:.3g} to {self.high:.3g}"

    def within(self, factor: float) -> bool:
        """Return whether the ratio of its bounds is at most a factor."""
        return self.high <= self.low * factor

    def including(self, value: float) -> "Reference":
        """Return the reference with bounds extended to include a value."""
        return replace(self, low=min(self.low, value), high=max(self.high, value))

    def widened(self, factor: float) -> "Reference":
        """Return the reference with bounds moved outwards."""
        return replace(self, low=self.low / factor, high=self.high * factor)

    def times(self, factor: float) -> "Reference":
        """Return the reference multiplied by a positive factor."""
        return Reference(
            value=factor * self.value,
            low=factor * self.low,
            high=factor * self.high,
            std=factor * self.std,
            source=self.source,
        )


@dataclass(frozen=True, kw_only=True)
class References:
    """Both tables by parameter name, without guesses and numbers that cannot be recomputed."""

    initial: dict[str, Reference]
    final: dict[str, Reference]


def off_scale(analysis: Analysis) -> set[str]:
    """Return which scales differ from the stated ones: positions, input or both."""
    return {c.kind for c in analysis.checks if c.kind in ("position_scale", "input_scale")}


def in_scale(
    references: References, chain: Chain | None, *, analysis: Analysis, per_count: float | None
) -> tuple[References, Chain | None]:
    """Return references and carts in the required units, if the recordings use others.

    Counts are multiplied by their length, if stated. Numbers in an unknown scale are left out.
    """
    wrong = off_scale(analysis)
    if not wrong:
        return references, chain
    factor = per_count if wrong == {"position_scale"} else None

    def scaled(table: Mapping[str, Reference]) -> dict[str, Reference]:
        kept = {n: r for n, r in table.items() if factor or not read_name(n).is_gain}
        return {n: r.times(factor or 1.0) if read_name(n).is_gain else r for n, r in kept.items()}

    return (
        References(initial=scaled(references.initial), final=scaled(references.final)),
        replace(chain, m=chain.m / factor, c=chain.c / factor, k=chain.k / factor)
        if chain and factor
        else None,
    )


def recompute(analysis: Analysis) -> References:
    """Return the references of both tables.

    A number measured in several ways is right anywhere between them, in either table. Dry friction
    adds to every damping ratio; a student who removed it is right too.
    """
    chain = trusted_chain(analysis)
    trusted, tables = chain is not None, _by_decays(chain, analysis) if chain else []
    final, initial = {}, {}
    for row in analysis.rows:
        fitted = _final(row, analysis, tables) if trusted else None
        measured = _initial(row, fitted, analysis)
        if measured is not None:
            initial[row.name] = measured
        if fitted is not None:
            final[row.name] = fitted
        elif measured is not None:
            final[row.name] = measured
            # If our fit of a gain fails, the students' fit may fail too; they notice a large error.
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
    # Without a fit, the peaks in the dwells may be other ones than assumed.
    for table in (initial, final) if not trusted else ():
        for name in [n for n, r in table.items() if r.source == "frequency_response"]:
            del table[name]
    return References(initial=initial, final=final)


def trusted_chain(analysis: Analysis) -> Chain | None:
    """Return the fitted chain; None if dry friction or worse has spoilt the fit.

    A fit that does not explain the data must at least reproduce the frequencies and gains measured
    without it, and must determine them.
    """
    if analysis.fit is None or is_explained(analysis):
        return analysis.chain
    for row in analysis.rows:
        if read_name(row.name).is_damping:
            continue
        if row.name in analysis.fit.parameters and row.final is None:
            return None  # the fit does not determine it
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
    """Return whether linear carts and noise explain the data; without a fit, assume so."""
    return analysis.fit is None or analysis.fit.explains_data


def is_followed(analysis: Analysis) -> bool:
    """Return whether nearly all driven recordings follow the fitted carts.

    Near a sharp resonance, a coarse encoder hides the rest of a dwell's transient. Its point is
    then off by several standard errors, although the recording follows the carts.
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
    """Return the references that may count against a student.

    If no linear carts move like the recordings, first estimates still belong to their own runs, but
    a fit means nothing, ours or the students'.
    """
    if is_linear(analysis):
        return references

    def factor(name: str, *, of_gains: float) -> float:
        if read_name(name).is_damping:
            return limits.BEYOND_BELIEF_DAMPING
        return of_gains if read_name(name).is_gain else limits.BEYOND_BELIEF

    def widened(table: Mapping[str, Reference], *, of_gains: float) -> dict[str, Reference]:
        return {
            name: one.widened(factor(name, of_gains=of_gains))
            for name, one in table.items()
            # Resonances of nonlinear carts are not parameters, nor are numbers derived from them.
            if one.source != "frequency_response"
        }

    return References(
        initial=widened(references.initial, of_gains=limits.BEYOND_BELIEF),
        final=widened(references.final, of_gains=limits.FITTED_TO_NOTHING),
    )


def _final(
    row: ParameterRow, analysis: Analysis, tables: Sequence[Mapping[str, float]]
) -> Reference | None:
    """Return the bounds of a final number: the fit, and all measurements without it.

    A fit that stops at a damping of zero, its bound, does not measure the damping. A fit that
    neither explains the points nor the recordings does not count where it is the only measurement.
    """
    fitted, read_off = row.final, _readings(row.name, analysis)
    if read_name(row.name).is_damping:
        measured = [table[row.name] for table in tables]
    else:
        measured = list(read_off)
        if row.initial and (measured or not is_explained(analysis)):
            spread = limits.READ_BY_EYE if row.initial.source == "frequency_response" else 1.0
            measured += [row.initial.value / spread, row.initial.value * spread]
    told = fitted is not None and not (read_name(row.name).is_damping and _undamped(analysis))
    # A damping depends on no unit, sign or clock. But dry friction adds to it, more in dwells than
    # in decays, and with few dwells the fit explains them anyway.
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
        std=(fitted.std or 0.0) if fitted and told else 0.0,
        source=fitted.source if fitted and told else read,
    )


def _agrees(value: float, fitted: Estimate) -> bool:
    """Return whether a reading agrees with a fit that explains the data.

    Otherwise its recording contains something else, and it is not used as a bound.
    """
    slack, factor = limits.SIGMAS * (fitted.std or 0.0), 1 + GAIN_AND_FREQUENCY_LIMIT / 100
    least, most = fitted.value / factor, fitted.value * factor
    return least - slack <= value <= most + slack


def _undamped(analysis: Analysis) -> bool:
    """Return whether the fit stopped at zero damping, which is a bound and not a measurement."""
    return analysis.chain is not None and not np.all(analysis.chain.c > 0)


def _by_decays(chain: Chain, analysis: Analysis) -> list[dict[str, float]]:
    """Return the numbers of the fitted carts with the least and the most damping of their decays.

    The fit supplies dampings without decays; there is no result if the fit stopped at zero.
    """
    readings = [_readings(f"zeta_{cart}", analysis) for cart in range(1, chain.n + 1)]
    if not any(readings) or not chain.is_tied:
        return []
    critical = 2 * chain.m * chain.omega_carts
    found = []
    for choose in (min, max):
        zeta = [choose(r) if r else z for r, z in zip(readings, chain.zeta_carts, strict=True)]
        found.append(replace(chain, c=np.array(zeta) * critical))
    return [one.parameters() for one in found] if np.all(found[0].c > 0) else []


def _initial(row: ParameterRow, final: Reference | None, analysis: Analysis) -> Reference | None:
    measured = row.initial
    if measured is not None and measured.source == "assumed":
        return None
    if measured is None:
        return final
    readings = _readings(row.name, analysis)
    bounds = [measured.value, *readings]
    if final is not None:
        bounds += [final.low, final.high]
    spread = limits.READ_BY_EYE if measured.source == "frequency_response" else 1.0
    return Reference(
        value=measured.value,
        low=min(bounds) / spread,
        high=max(bounds) * spread,
        std=0.0 if len(readings) > 1 else measured.std or 0.0,  # else the bounds show it
        source=measured.source,
    )


def _readings(name: str, analysis: Analysis) -> list[float]:
    """Return the single readings of a gain or of a cart alone; a student may quote any.

    The damping of a decay is read with and without the best-fitting dry friction, even if friction
    is not certain: with little damping a trace of it counts.
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
            without = decay.friction.zeta if decay.friction else decay.zeta
            readings += [zeta for zeta in (decay.zeta, without) if zeta > 0]
    return readings


def _by_size(steps: Sequence[StepGain]) -> list[float]:
    """Return the gain from small steps to large ones, where the two have different ones.

    A dead zone, or an amplifier that starts late, takes as much off each.
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
    """Return the largest step of the input that friction kept a free cart from following."""
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
    """Return the gain where so much of the input's worth of friction held the cart far out."""
    return abs((edge.level_after - edge.level_before) / (abs(edge.u_after - edge.u_before) + held))
