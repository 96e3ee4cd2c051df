"""The known mistakes: predict the numbers that each gives on the student's own recordings."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.grading import limits
from pipeline.grading.grade import Code
from pipeline.grading.mistakes.factors import FACTORS, LOG10, OF_MISTAKE, TURN, Of
from pipeline.grading.reference import Reference, StepTurns, is_explained, step_turns
from pipeline.grading.tolerance import as_typed
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.results import Analysis, FrequencyResponse, Record
from pipeline.submission import Reported

# (periods counted, true periods): one too many, or one too few.
_COUNTS = [pair for k in range(1, 11) for pair in ((k + 1, k), (k, k + 1))]

# (numerator, denominator) of a power of ten.
_POWERS = [pair for p in (10, 100, 1000) for pair in ((p, 1), (1, p))]

Numbers = Mapping[str, Reference]
ExplanationKey = tuple[tuple[str, ...], tuple[int, int]]  # the keys of the advice, and the ratio


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One mistake, or two combined, and the numbers that they would give in a table.

    Attributes
    ----------
    advice_keys : keys of the advice in `templates/words/grading.toml`.
    predicted : for each parameter, the bounds of the number that the mistake gives.
    tolerance : relative distance from these bounds within which a number still matches.
    ratio : the number of periods counted, and the true number; or a power of ten.
    whole : whether the mistake is credible only if all reported numbers are near its predictions.
    least : the mistake is credible only if at least this many numbers match.
    table_wide : whether the mistake also explains every other wrong number of the table.
    tries : number of variants tried; with more variants, a match by chance is more likely.
    beside : other parameters; the mistake is credible only if their numbers are right.
    from_time_records : whether the mistake is made when reading a decay or a step. A final table
        contains such a mistake only if the initial table contains it too.
    sources : if carts are swapped, the parameter to which each number belongs.
    base : the first of two combined mistakes.
    """

    codes: tuple[Code, ...]
    advice_keys: tuple[str, ...]
    predicted: dict[str, Reference]
    tolerance: float
    ratio: tuple[int, int] = (0, 0)
    whole: bool = False
    least: int = 1
    table_wide: bool = False
    tries: int = 1
    beside: frozenset[str] = frozenset()
    from_time_records: bool = False
    sources: Mapping[str, str] = field(default_factory=dict)
    base: "Mistake | None" = None

    @property
    def kind(self) -> ExplanationKey:
        """What is the same for all variants of a mistake; they concern different numbers."""
        return self.advice_keys, self.ratio

    @property
    def is_plain(self) -> bool:
        """Whether the mistake is credible even if gains are in an impossible order."""
        return self.whole or self.codes == ("factor_of_ten",)

    def changes(self, name: str, known: Numbers) -> tuple[str, dict[Code, float]]:
        """Return the parameter to which a number belongs, and the factor of each mistake.

        Parameters
        ----------
        known : the numbers from the recordings.
        """
        source = self.sources.get(name, name)
        right = known[source].value
        total = self.predicted[name].value / right
        if self.base is None:
            return source, {self.codes[0]: total}
        before = self.base.predicted.get(source)
        first = before.value / right if before else 1.0
        return source, {self.codes[0]: first, self.codes[-1]: total / first}

    def help(self, typed: Decimal, reference: Reference) -> str:
        """Return the advice about one number."""
        counted, there = self.ratio
        recomputed = f"{reference.value:.4g}"
        values = {"reported": as_typed(typed), "recomputed": recomputed}
        return "".join(
            WORDS.text(key, counted=counted, there=there, **values) for key in self.advice_keys
        )

    def together_with(
        self, code: Code, advice_key: str, predicted: dict[str, Reference]
    ) -> "Mistake":
        """Return this mistake combined with a second one."""
        codes, advice_keys = (*self.codes, code), (*self.advice_keys, advice_key)
        return replace(self, codes=codes, advice_keys=advice_keys, predicted=predicted, base=self)


def _may_be_log10(name: str, reference: Reference, reported: Reported) -> bool:
    """Return whether a damping can show that log10 was taken instead of ln.

    Without friction, it always can. With friction, the bounds of the reference are so wide that any
    ratio fits. Then log10 is ruled out if the final damping is at most 1.5 times the initial one.
    """
    if reference.high <= limits.BLURRED_DAMPING * reference.low:
        return True
    initial, final = reported.initial.get(name), reported.final.get(name)
    return initial is None or final is None or final > Decimal("1.5") * initial


def known_mistakes(references: Numbers, analysis: Analysis, reported: Reported) -> list[Mistake]:
    """Return all mistakes that can be tried on a table, single ones before combined ones."""
    of = _groups(references, reported)
    gains, omegas, zetas = of["gains"], of["own frequencies"], of["own dampings"]
    hertz = _by_factor(of, "frequencies", "all frequencies")
    scales = [*_by_factor(of, "gains", "sharp gains"), *_gain_mistakes(gains, analysis)]
    log10 = _by_factor(of, "dampings", "every damping")
    miscounts = [*_miscounts(omegas, zetas, of["all dampings"]), *_by_factor(of, "sharp dampings")]
    found = [*hertz, *scales, *log10, *miscounts]
    found += _powers_of_ten(of, {name: _count(name, analysis) for name in gains})
    found += [*_swaps(gains), *_swaps(omegas), *_swaps(zetas)]
    if {_damping(name) for name in omegas} == zetas.keys():
        found += _swaps(omegas, {n: _with_slack(r) for n, r in zetas.items()})
    found += [*_swapped(hertz, omegas), *_swapped(scales, gains), *_swapped(log10, zetas)]
    found += _in_counts(scales)
    for miscount in miscounts:
        found += _miscount_and(miscount, omegas, of["all dampings"])
    found = [mistake for mistake in found if mistake.predicted]
    if is_explained(analysis):
        return found
    return [
        replace(m, tolerance=max(m.tolerance, limits.BLURRED))
        if gains.keys() >= m.predicted.keys()
        else m
        for m in found
    ]


def _groups(references: Numbers, reported: Reported) -> dict[str, dict[str, Reference]]:
    """Return the numbers of a table in groups; a typical mistake affects all numbers of a group."""
    read = {name: read_name(name) for name in references}
    sure = {n for n, r in references.items() if 0 < r.high <= limits.VAGUE * r.low}
    frequencies = {n: r for n, r in references.items() if read[n].is_frequency and r.low > 0}
    dampings = {
        n: r
        for n, r in references.items()
        if read[n].is_ratio and not read[n].is_by_eye and r.low > 0
    }
    every = {n: r for n, r in references.items() if read[n].is_ratio and r.low > 0}
    gains = {n: r for n, r in references.items() if n in sure and read[n].is_gain}
    certain = {n: r for n, r in frequencies.items() if n in sure}
    own = {n: r for n, r in dampings.items() if n in sure}
    shows_log10 = any(_may_be_log10(n, r, reported) for n, r in dampings.items())
    return {
        "frequencies": certain,
        "all frequencies": frequencies if frequencies.keys() > certain.keys() else {},
        "own frequencies": {n: r for n, r in certain.items() if not read[n].is_by_eye},
        "gains": gains,
        "sharp gains": {n: r for n, r in gains.items() if r.within(limits.SHARP)},
        "all dampings": dampings,
        "own dampings": own,
        "dampings": dampings if shows_log10 else {},  # including those with wide bounds
        "every damping": every if shows_log10 and every.keys() > dampings.keys() else {},
        "sharp dampings": {n: r for n, r in own.items() if r.within(limits.SHARP)},
    }


def _by_factor(of: Mapping[str, Numbers], *groups: Of) -> list[Mistake]:
    """Return the mistakes of the table `FACTORS` that apply to some groups of numbers."""
    found = []
    for row in [row for row in FACTORS if row.of in groups]:
        numbers = of[row.of]
        # A decrement comes from one decay. It can be wrong while the frequency of that decay is
        # right.
        alone = row.of == "sharp dampings"
        for some in [{n: r} for n, r in numbers.items()] if alone else [numbers]:
            beside = [n for n in of["own frequencies"] if alone and _damping(n) in some]
            found.append(
                Mistake(
                    codes=(row.code,),
                    advice_keys=(row.advice_key,),
                    predicted=_times(some, row.factor),
                    beside=frozenset(beside),
                    **{name: getattr(row, name) for name in OF_MISTAKE},
                )
            )
    return found


def _times(references: Numbers, factor: float) -> dict[str, Reference]:
    return {name: reference.times(factor) for name, reference in references.items()}


def _powers_of_ten(of: Mapping[str, Numbers], counts: Mapping[str, float]) -> Iterator[Mistake]:
    """Yield the mistakes of a wrong decimal point or prefix of a unit, one for each number.

    Parameters
    ----------
    counts : one encoder count in position units, for each gain. If counts differ from positions by
        a power of ten, the mistake is one of counts.
    """
    for more, less in _POWERS:
        factor = more / less
        for name, right in {**of["gains"], **of["frequencies"], **of["all dampings"]}.items():
            count = counts.get(name, 0.0)
            if count and abs(math.log(factor * count)) < math.log1p(limits.UNMISTAKABLE):
                continue
            damping = read_name(name).is_damping
            yield Mistake(
                codes=("factor_of_ten",),
                advice_keys=("power_more" if more > 1 else "power_less",),
                predicted={name: right.times(factor)},
                tolerance=limits.LOG10_DAMPING if damping else limits.UNMISTAKABLE,
                ratio=(more, less),
                tries=len(_POWERS),
            )


# -------------------------------------------------------------------- frequencies


def _miscounts(omegas: Numbers, zetas: Numbers, every_zeta: Numbers) -> Iterator[Mistake]:
    """Yield mistakes in counting periods: one too many or too few.

    The frequency is then wrong by the ratio of counted to true periods, and the decrement by its
    inverse.
    """
    for counted, there in _COUNTS:
        fast = _times(omegas, counted / there)
        damped = {n: _miscounted_damping(r, there / counted) for n, r in every_zeta.items()}
        damped = {n: r for n, r in damped.items() if n in map(_damping, omegas)}
        both = Mistake(
            codes=("peak_count",),
            advice_keys=("miscount",),
            ratio=(counted, there),
            predicted={**fast, **damped},
            tolerance=limits.COUNTED,
            whole=True,
            least=len(fast) + 1,
            tries=len(_COUNTS),
            from_time_records=True,
        )
        if damped:
            yield both
        odd = limits.ODD if damped else 1
        yield replace(both, predicted=fast, least=min(2, len(omegas)), tries=len(_COUNTS) * odd)
        for name in omegas if len(omegas) > 1 else ():
            zeta = _damping(name)
            if zeta in zetas and zetas[zeta].within(limits.BLURRED_DAMPING):
                one = {name: fast[name], zeta: damped[zeta]}
                tries = len(_COUNTS) * limits.ONE_OF_SEVERAL
                yield replace(both, predicted=one, least=2, tries=tries)


def _with_slack(zeta: Reference) -> Reference:
    """Return a damping with bounds widened by the tolerance of dampings.

    The other numbers of a mistake can then have a closer tolerance.
    """
    return zeta.widened(1 + limits.DAMPING)


def _miscounted_damping(zeta: Reference, factor: float) -> Reference:
    """Return the bounds of a damping from miscounted periods.

    The bounds end halfway to the right damping, so that the right damping does not match.
    """
    mistaken, middle = _with_slack(zeta.times(factor)), zeta.times(math.sqrt(factor))
    if factor < 1:
        return replace(mistaken, high=middle.high)
    return replace(mistaken, low=middle.low)


def _miscount_and(miscount: Mistake, omegas: Numbers, zetas: Numbers) -> Iterator[Mistake]:
    """Yield a miscount combined with a second mistake: frequency in Hz or decrement with log10."""
    omega = {n: r for n, r in miscount.predicted.items() if n in omegas}
    zeta = {n: r for n, r in miscount.predicted.items() if n in zetas}
    if omega:
        slow = {**_times(omega, 1 / TURN), **zeta}
        yield miscount.together_with("hz_for_rad_s", "and_hertz", slow)
    if omega and zeta:
        damped = {**omega, **_times(zeta, LOG10)}
        both = miscount.together_with("log10_for_ln", "and_log10", damped)
        yield replace(both, least=2)


# -------------------------------------------------------------------------- gains


def _gain_mistakes(gains: Numbers, analysis: Analysis) -> Iterator[Mistake]:
    turns = {name: step_turns(name, analysis) for name in gains}
    yield from _peaks(turns)
    yield from _swinging(turns, gains)
    counts = {name: _count(name, analysis) for name in gains}
    if all(counts.values()):
        far = all(abs(math.log(count)) > math.log(limits.FAR) for count in counts.values())
        yield Mistake(
            codes=("counts_for_length",),
            advice_keys=("counts",),
            predicted={n: r.times(1 / counts[n]) for n, r in gains.items()},
            tolerance=limits.UNMISTAKABLE if far else limits.READ,
        )


def _peaks(turns: Mapping[str, StepTurns]) -> Iterator[Mistake]:
    """Yield the mistake of reading the peak of a step as its settled level.

    The peak is that of one edge, or the mean of all edges. A step moves all carts, so the mistake
    is predicted for every cart.
    """
    edges = set.intersection(*({*t.by_edge} for t in turns.values())) if turns else set()
    peaks = [{n: t.peak(edge) for n, t in turns.items()} for edge in sorted(edges)]
    peaks.append({n: peak for n, t in turns.items() if (peak := t.mean_peak()) is not None})
    for predicted in peaks:
        yield Mistake(
            codes=("peak_for_steady_state",),
            advice_keys=("step_peak",),
            predicted=predicted,
            tolerance=limits.TURN_READ,
            whole=True,
            tries=len(peaks),
            from_time_records=True,
        )


def _swinging(turns: Mapping[str, StepTurns], gains: Numbers) -> Iterator[Mistake]:
    """Yield the mistake of reading a later turning point of a step as its settled level."""
    edges = {edge for one in turns.values() for edge in one.by_edge}
    for edge, turn in itertools.product(sorted(edges), (1, 2)):
        later = {n: e for n, t in turns.items() if (e := t.turn(edge, turn)) is not None}
        yield Mistake(
            codes=("transient_used",),
            advice_keys=("swinging",),
            predicted={n: e for n, e in later.items() if _is_off(e, gains[n])},
            tolerance=limits.TURN_READ,
            whole=True,
            least=min(2, len(gains)),
            tries=2 * len(edges),
            from_time_records=True,
        )


def _count(name: str, analysis: Analysis) -> float:
    """Return one encoder count in position units, for the cart of a gain; 0 if unknown."""
    cart = read_name(name).cart or 1
    steps = [r.encoder_step(cart) for r in analysis.records if cart in r.carts and cart in r.free]
    step = float(np.median(steps)) if steps else 0.0
    return 0.0 if step == 1.0 else step  # a step of exactly 1 means that positions are in counts


def _in_counts(mistakes: Sequence[Mistake]) -> Iterator[Mistake]:
    """Yield the mistakes in reading gains, combined with positions in encoder counts."""
    counted = [m for m in mistakes if m.codes == ("counts_for_length",)]
    twice = next(m for m in mistakes if m.codes == ("peak_to_peak",))
    for mistake in mistakes if counted else ():
        if mistake.codes in (("peak_to_peak",), ("peak_for_steady_state",)):
            in_counts = counted[0].predicted
            per_length = {n: 2 * r.value / twice.predicted[n].value for n, r in in_counts.items()}
            scaled = {n: r.times(per_length[n]) for n, r in mistake.predicted.items()}
            both = mistake.together_with("counts_for_length", "and_counts", scaled)
            yield replace(both, tolerance=limits.READ, tries=1)


def _is_off(extreme: Reference, gain: Reference) -> bool:
    low, high = gain.low * (1 - limits.TURN_OFF), gain.high * (1 + limits.TURN_OFF)
    return extreme.high < low or extreme.low > high


# -------------------------------------------------------------------- carts swapped


def _permutations(names: Sequence[str]) -> Iterator[dict[str, str]]:
    for order in itertools.permutations(names):
        if list(order) != list(names):
            yield dict(zip(names, order, strict=True))


def _swaps(references: Numbers, dampings: Numbers | None = None) -> Iterator[Mistake]:
    """Yield every wrong order of the carts for a group of numbers.

    Parameters
    ----------
    dampings : if given, each damping is swapped together with its frequency.
    """
    for source in _permutations(list(references)):
        moved = {name: other for name, other in source.items() if name != other}
        predicted = {name: references[other] for name, other in moved.items()}
        if dampings is not None:
            too = {_damping(name): _damping(other) for name, other in moved.items()}
            moved |= too
            predicted |= {name: dampings[other] for name, other in too.items()}
        yield Mistake(
            codes=("carts_swapped",),
            advice_keys=("swapped",),
            predicted=predicted,
            tolerance=limits.DAMPING if read_name(next(iter(moved))).is_damping else limits.READ,
            whole=True,
            least=2,
            sources=moved,
        )


def _damping(omega: str) -> str:
    return read_name(omega).damping


def _swapped(mistakes: Sequence[Mistake], references: Numbers) -> Iterator[Mistake]:
    """Yield each mistake combined with swapped carts."""
    for mistake in mistakes:
        if mistake.codes == ("transient_used",) or not set(references) <= set(mistake.predicted):
            continue
        for source in _permutations(list(references)):
            swapped = {name: mistake.predicted[other] for name, other in source.items()}
            both = mistake.together_with("carts_swapped", "and_swapped", swapped)
            yield replace(both, whole=True, least=2, tries=1, sources=source)


Reading = Callable[[Record, Array], float]


def transient_fits(
    analysis: Analysis, table: Mapping[str, Decimal], known: Mapping[str, Reference]
) -> list[Mistake]:
    """Return the mistakes of reading amplitudes too early, one for each way to do so."""
    runs = {r.id: r for r in analysis.records if r.kind == "sine" and r.u is not None}
    if analysis.fit is None or not runs or len(runs) < len(analysis.sine_points) / analysis.bench.n:
        return []
    found = []
    for reading in early_readings():
        predicted = _refit(analysis, runs, reading)
        moved = {
            name: r
            for name, r in predicted.items()
            if name in known and known[name].low > 0 and _is_new(name, r.value / known[name].value)
        }
        asked = [name for name in moved if name in table]
        if asked:
            found.append(
                Mistake(
                    codes=("transient_used",),
                    predicted=moved,
                    tolerance=0.06,  # relative; a student's fit may weigh the points differently
                    advice_keys=("early",),
                    # No parameters fit such amplitudes exactly, so not every number of the table
                    # matches.
                    least=max(2, round(0.65 * len(asked))),
                    table_wide=True,
                    from_time_records=True,
                )
            )
    return found


def _is_new(name: str, ratio: float) -> bool:
    # If the mistake changes a number less than this, the right number would match too.
    return abs(np.log(ratio)) > np.log1p(0.5 if read_name(name).is_damping else 0.12)


def early_readings() -> Iterator[Reading]:
    """Yield functions that read an amplitude too early from a dwell."""
    yield lambda record, y: float(np.max(np.abs(y - np.median(y))))
    for cycles in (1.0, 2.0, 3.0, 5.0):
        yield lambda record, y, cycles=cycles: _half_swing(record, y, cycles=cycles)


def _half_swing(record: Record, y: Array, *, cycles: float) -> float:
    """Return half the distance from the lowest to the highest point in the first cycles."""
    end = record.t[0] + cycles * 2 * np.pi / (record.omega or np.inf)
    first = y[record.t <= end]
    return float(np.ptp(first)) / 2


def _refit(
    analysis: Analysis, runs: Mapping[str, Record], reading: Reading
) -> dict[str, Reference]:
    """Return the parameters fitted to amplitudes that `reading` gives; empty if the fit fails."""
    responses = []
    for response in analysis.frequency_responses:
        points = [
            (p.omega, reading(runs[p.experiment], runs[p.experiment].position(p.cart)), p)
            for p in analysis.sine_points
            if p.cart == response.cart and p.experiment in runs and runs[p.experiment].omega
        ]
        if not points or response.source != "dwells":
            return {}
        points.sort(key=lambda point: point[0])
        magnitude = np.array([amplitude / p.input_amplitude for _, amplitude, p in points])
        if not np.all(magnitude > 0):
            return {}
        responses.append(
            FrequencyResponse(
                cart=response.cart,
                omega=np.array([omega for omega, _, _ in points]),
                magnitude=magnitude,
                magnitude_std=0.01 * magnitude,
                phase=None,
                phase_std=None,
                source="table",
            )
        )
    assert analysis.fit is not None
    chain = analysis.fit.chain
    try:
        fit = fit_bode(responses, bench=analysis.bench, near=chain)
    except DataError:
        return {}
    references = {}
    for name, estimate in fit.parameters.items():
        if estimate.value <= 0:
            continue
        slack = limits.DAMPING if read_name(name).is_damping else 0.0
        reference = Reference.at(estimate.value, source="transient")
        references[name] = reference.widened(1 + slack)
    return references
