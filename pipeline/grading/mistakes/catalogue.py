"""The known mistakes, tried on the student's own data: what each would make of every number."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.grading.mistakes.step_turns import StepTurns, step_turns
from pipeline.grading.references.reference import Reference, is_explained
from pipeline.grading.rubric import is_damping
from pipeline.names import read_name
from pipeline.results import Analysis
from pipeline.schemas.grade import Code

_TURN = 2 * math.pi
_LOG10 = math.log10(math.e)
_PERIODS = range(1, 11)  # counted one more, or one less
_RATIOS = 2 * len(_PERIODS)

_GAIN_OR_FREQUENCY = 0.03  # an honest reading after one slip: relative
_TURN_READ = 0.015  # … of where a cart turns, which is sharper than where it settles
_UNMISTAKABLE, _FAR = 0.1, 4.0  # … by a factor that is nothing else's, from so much on
_BLURRED = 0.05  # … of a gain where the carts stick
_COUNTED = 0.02
_DAMPING = 0.2
_LOG10_DAMPING = 0.3  # … beside which no other mistake of a damping lies as near
_ONE_OF_SEVERAL = 5  # who miscounts one decay miscounts the others; once in so many not
_ODD = 20  # a period miscounted for ω alone, where δ is of the same peaks: one in so many
_BLURRED_DAMPING = 1.3  # high over low: such a damping tells no story
_VAGUE = 3.0  # high over low: what any mistake would meet tells of none
_SHARP = 1.05  # high over low of a reference that friction does not blur
_CLEARLY_OFF = 0.06  # of a gain: another extremum of the step as near as this says nothing


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """One or two mistakes, and what they make of the numbers of a table.

    Attributes
    ----------
    predicted : by parameter name; the bounds within which the mistaken number lies.
    tolerance : relative, around those bounds.
    whole : all of the predicted that were reported must be met for it to be believed.
    least : so many numbers must be explained for it to be believed.
    table_wide : believed, it explains every other wrong number of the table too.
    tries : so many of its kind are tried, of which one meets the numbers the easier.
    beside : numbers that are right where it is this mistake.
    help : a sentence with {name}, {reported} and {recomputed} to fill in.
    """

    codes: tuple[Code, ...]
    predicted: dict[str, Reference]
    tolerance: float
    help: str
    whole: bool = False
    least: int = 1
    table_wide: bool = False
    tries: int = 1
    beside: frozenset[str] = frozenset()


def known_mistakes(references: Mapping[str, Reference], analysis: Analysis) -> list[Mistake]:
    """Return every mistake that can be tried on a table, single ones before combined ones."""
    every_zeta = {
        n: r
        for n, r in references.items()
        if r.low > 0 and read_name(n).is_ratio and not read_name(n).is_by_eye
    }
    every_omega = {n: r for n, r in references.items() if read_name(n).is_frequency and r.low > 0}
    references = {n: r for n, r in references.items() if 0 < r.high <= _VAGUE * r.low}
    gains = {n: r for n, r in references.items() if read_name(n).is_gain}
    omegas = {n: r for n, r in references.items() if read_name(n).is_frequency}
    own_omegas = {n: r for n, r in omegas.items() if not read_name(n).is_by_eye}
    own_zetas = {n: r for n, r in every_zeta.items() if n in references}
    hertz, scales = _hertz(omegas, every_omega), _gain_mistakes(gains, analysis)
    log10 = [
        Mistake(
            codes=("log10_for_ln",),
            predicted=_times(every_zeta, _LOG10),  # vague ones as well
            tolerance=_LOG10_DAMPING,
            help="{reported} is {recomputed}/2.303: the logarithmic decrement takes the natural "
            "logarithm, and this looks like log10",
            whole=True,
        )
    ]
    single = [*hertz, *scales, *log10, *_miscounts(own_omegas, own_zetas, every_zeta)]
    swaps = [*_swaps(gains), *_swaps(own_omegas), *_swaps(own_zetas)]
    if {_damping(name) for name in own_omegas} == own_zetas.keys():
        swaps += _swaps(own_omegas, {n: _with_slack(r) for n, r in own_zetas.items()})
    pairs = [*_swapped(hertz, own_omegas), *_swapped(scales, gains), *_swapped(log10, own_zetas)]
    pairs += list(_in_counts(scales))
    for miscount in single:
        if miscount.codes == ("peak_count",):
            pairs += _miscount_and(miscount, own_omegas, every_zeta)
    found = [m for m in (*single, *swaps, *pairs) if m.predicted]
    if is_explained(analysis):
        return found
    return [
        replace(m, tolerance=max(m.tolerance, _BLURRED))
        if gains.keys() >= m.predicted.keys()
        else m
        for m in found
    ]


def _times(references: Mapping[str, Reference], factor: float) -> dict[str, Reference]:
    return {name: reference.times(factor) for name, reference in references.items()}


# -------------------------------------------------------------------- frequencies


def _hertz(omegas: Mapping[str, Reference], every: Mapping[str, Reference]) -> list[Mistake]:
    """Hz for rad/s, or converted twice; of a vague number only beside a sharper one."""
    in_hertz = [(omegas, 1)]
    if every.keys() > omegas.keys():
        in_hertz.append((every, 2))
    return [
        *(
            Mistake(
                codes=("hz_for_rad_s",),
                predicted=_times(some, 1 / _TURN),
                tolerance=_UNMISTAKABLE,
                help="{reported} is {recomputed}/2π: this looks like Hz where rad/s is asked, "
                "so multiply by 2π",
                least=least,
            )
            for some, least in in_hertz
        ),
        Mistake(
            codes=("hz_for_rad_s",),
            predicted=_times(omegas, _TURN),
            tolerance=_UNMISTAKABLE,
            help="{reported} is 2π·{recomputed}: this was in rad/s already and looks converted "
            "from Hz once more",
        ),
    ]


def _miscounts(
    omegas: Mapping[str, Reference],
    zetas: Mapping[str, Reference],
    every_zeta: Mapping[str, Reference],
) -> Iterator[Mistake]:
    """One period too many or too few: ω is off by their ratio, and a decrement by its inverse."""
    for counted, there in _counts():
        help_ = _miscount_help(counted, there)
        fast = _times(omegas, counted / there)
        damped = {n: _miscounted_damping(r, there / counted) for n, r in every_zeta.items()}
        damped = {n: r for n, r in damped.items() if n in map(_damping, omegas)}
        least = min(2, len(omegas))
        if damped:
            yield _miscount({**fast, **damped}, help_, least=len(fast) + 1)
        yield _miscount(fast, help_, least=least, tries=_ODD if damped else 1)
        for name in omegas if len(omegas) > 1 else ():
            zeta = _damping(name)
            if zeta in zetas and zetas[zeta].high <= zetas[zeta].low * _BLURRED_DAMPING:
                both = {name: fast[name], zeta: damped[zeta]}
                yield _miscount(both, help_, least=2, tries=_ONE_OF_SEVERAL)
    for zeta, reference in zetas.items():
        if reference.high > reference.low * _SHARP:
            continue
        for factor, words in ((0.5, "half"), (2.0, "twice")):
            # The decrement alone, not blurred by friction: over half a period, or over two.
            yield Mistake(
                codes=("peak_count",),
                predicted={zeta: reference.times(factor)},
                tolerance=_GAIN_OR_FREQUENCY,
                help=f"{{reported}} is {words} of {{recomputed}}: δ is the logarithm of the "
                "ratio of two peaks a whole period apart, divided by the number of periods",
                tries=2,
                beside=frozenset(n for n in omegas if _damping(n) == zeta),
            )


def _counts() -> Iterator[tuple[int, int]]:
    """Yield (periods counted, periods there)."""
    for k in _PERIODS:
        yield k + 1, k
        yield k, k + 1


def _miscount_help(counted: int, there: int) -> str:
    return (
        f"{{reported}} is {{recomputed}}·{counted}/{there}: {counted} periods counted "
        f"where there are {there}? From one peak to the n-th there are n − 1 periods"
    )


def _with_slack(zeta: Reference) -> Reference:
    """Return a damping with what it may be off in its bounds, to stand beside sharper numbers."""
    return replace(zeta, low=zeta.low / (1 + _DAMPING), high=zeta.high * (1 + _DAMPING))


def _miscounted_damping(zeta: Reference, factor: float) -> Reference:
    """Return the bounds of a damping so miscounted, up to where it is as near to the right one."""
    mistaken, middle = zeta.times(factor), zeta.times(math.sqrt(factor))
    if factor < 1:
        return replace(mistaken, low=mistaken.low / (1 + _DAMPING), high=middle.high)
    return replace(mistaken, low=middle.low, high=mistaken.high * (1 + _DAMPING))


def _miscount(
    predicted: dict[str, Reference], help_: str, *, least: int, tries: int = 1
) -> Mistake:
    return Mistake(
        codes=("peak_count",),
        predicted=predicted,
        tolerance=_COUNTED,
        help=help_,
        whole=True,
        least=least,
        tries=_RATIOS * tries,
    )


def _miscount_and(
    miscount: Mistake, omegas: Mapping[str, Reference], zetas: Mapping[str, Reference]
) -> Iterator[Mistake]:
    """A miscount in Hz, or one whose decrement was taken with log10."""
    omega = {n: r for n, r in miscount.predicted.items() if n in omegas}
    zeta = {n: r for n, r in miscount.predicted.items() if n in zetas}
    if omega:
        yield Mistake(
            codes=("hz_for_rad_s", "peak_count"),
            predicted={**_times(omega, 1 / _TURN), **zeta},
            tolerance=_COUNTED,
            help=f"{miscount.help}; and it is in Hz where rad/s is asked",
            whole=True,
            least=miscount.least,
            tries=miscount.tries,
        )
    if omega and zeta:
        yield Mistake(
            codes=("peak_count", "log10_for_ln"),
            predicted={**omega, **_times(zeta, _LOG10)},
            tolerance=_COUNTED,
            help=f"{miscount.help}; and the decrement looks taken with log10",
            whole=True,
            least=2,
            tries=miscount.tries,
        )


# -------------------------------------------------------------------------- gains


def _gain_mistakes(gains: Mapping[str, Reference], analysis: Analysis) -> list[Mistake]:
    twice = (
        "{reported} is twice {recomputed}: an amplitude is half of the distance from peak to peak"
    )
    half = (
        "{reported} is half of {recomputed}: was the input taken from peak to peak, and the "
        "position not?"
    )
    # Who reads from peak to peak does so for every cart; of one alone a sharp reference tells.
    sharp = _sharp(gains)
    found = [
        Mistake(
            codes=("peak_to_peak",),
            predicted=_times(some, factor),
            tolerance=_GAIN_OR_FREQUENCY,
            help=text,
            whole=some is gains,
        )
        for some in (gains, sharp)
        for factor, text in ((2.0, twice), (0.5, half))
    ]
    turns = {name: step_turns(name, analysis) for name in gains}
    found += _peaks(turns)
    found += _swinging(turns, gains)
    counts = {name: _count(name, analysis) for name in gains}
    if all(counts.values()):
        far = all(abs(math.log(count)) > math.log(_FAR) for count in counts.values())
        found.append(
            Mistake(
                codes=("counts_for_length",),
                predicted={n: r.times(1 / counts[n]) for n, r in gains.items()},
                tolerance=_UNMISTAKABLE if far else _GAIN_OR_FREQUENCY,
                help="{reported} is {recomputed} in encoder counts: multiply by the length of a "
                "count",
            )
        )
    return found


def _peaks(turns: Mapping[str, StepTurns]) -> Iterator[Mistake]:
    """Yield the peaks of one edge, or of all: of every cart, as one step moves them all."""
    peaks = {n: e for n, t in turns.items() if (e := t.mean_peak()) is not None}
    edges = set.intersection(*({*t.by_edge} for t in turns.values())) if turns else set()
    one_edge = [{n: t.peak(edge) for n, t in turns.items()} for edge in sorted(edges)]
    for predicted in one_edge:
        yield _peak(predicted, tries=len(one_edge) + 1)
    yield _peak(peaks, tries=len(one_edge) + 1)


def _peak(predicted: dict[str, Reference], *, tries: int) -> Mistake:
    return Mistake(
        codes=("peak_for_steady_state",),
        predicted=predicted,
        tolerance=_TURN_READ,
        help="{reported} is what the step peaks at: the static gain is the level it settles "
        "at, {recomputed}, per unit of input",
        whole=True,
        tries=tries,
    )


def _swinging(turns: Mapping[str, StepTurns], gains: Mapping[str, Reference]) -> Iterator[Mistake]:
    """Yield where the carts turn after the peak of one edge: next, and after that."""
    edges = {edge for one in turns.values() for edge in one.by_edge}
    tries = 2 * len(edges)
    for edge, turn in itertools.product(sorted(edges), (1, 2)):
        later = {n: e for n, t in turns.items() if (e := t.turn(edge, turn)) is not None}
        later = {n: e for n, e in later.items() if _is_off(e, gains[n])}
        yield Mistake(
            codes=("transient_used",),
            predicted=later,
            tolerance=_TURN_READ,
            help="{reported} is where the cart turns while it still swings: wait until it has "
            "settled, at {recomputed} per unit of input",
            whole=True,
            least=min(2, len(gains)),
            tries=tries,
        )


def _sharp(references: Mapping[str, Reference]) -> dict[str, Reference]:
    return {n: r for n, r in references.items() if r.high <= r.low * _SHARP}


def _count(name: str, analysis: Analysis) -> float:
    """Return the encoder step of the gain's cart in position units; 0 where it says nothing."""
    cart = read_name(name).cart or 1
    steps = [r.encoder_step(cart) for r in analysis.records if cart in r.carts and cart in r.free]
    step = float(np.median(steps)) if steps else 0.0
    return 0.0 if step == 1.0 else step  # positions in counts


def _in_counts(mistakes: Sequence[Mistake]) -> Iterator[Mistake]:
    """Yield the other gain mistakes, read in counts."""
    counted = [m for m in mistakes if m.codes == ("counts_for_length",)]
    twice = next(m for m in mistakes if m.codes == ("peak_to_peak",))
    for mistake in mistakes if counted else ():
        if mistake.codes in (("peak_to_peak",), ("peak_for_steady_state",)):
            in_counts = counted[0].predicted
            per_length = {n: 2 * r.value / twice.predicted[n].value for n, r in in_counts.items()}
            yield Mistake(
                codes=(*mistake.codes, "counts_for_length"),
                predicted={n: r.times(per_length[n]) for n, r in mistake.predicted.items()},
                tolerance=_GAIN_OR_FREQUENCY,
                help=f"{mistake.help}; and it is in encoder counts",
                whole=mistake.whole,
            )


def _is_off(extreme: Reference, gain: Reference) -> bool:
    return extreme.high < gain.low * (1 - _CLEARLY_OFF) or extreme.low > gain.high * (
        1 + _CLEARLY_OFF
    )


# -------------------------------------------------------------------- carts swapped


def _permutations(names: Sequence[str]) -> Iterator[dict[str, str]]:
    for order in itertools.permutations(names):
        if list(order) != list(names):
            yield dict(zip(names, order, strict=True))


def _swaps(
    references: Mapping[str, Reference], dampings: Mapping[str, Reference] | None = None
) -> Iterator[Mistake]:
    """Yield every order of the carts but the right one; frequencies may take dampings along."""
    for source in _permutations(list(references)):
        moved = {name: other for name, other in source.items() if name != other}
        predicted = {name: references[other] for name, other in moved.items()}
        if dampings is not None:
            predicted |= {
                _damping(name): dampings[_damping(other)] for name, other in moved.items()
            }
        yield Mistake(
            codes=("carts_swapped",),
            predicted=predicted,
            tolerance=_DAMPING if is_damping(next(iter(moved))) else _GAIN_OR_FREQUENCY,
            help="{reported} is what your recordings give for another cart, not {recomputed}: "
            "cart 1 is the one at the motor",
            whole=True,
            least=2,
        )


def _damping(omega: str) -> str:
    return omega.replace("omega", "zeta").removesuffix("_n")


def _swapped(mistakes: Sequence[Mistake], references: Mapping[str, Reference]) -> Iterator[Mistake]:
    """Yield each mistake on swapped carts."""
    for mistake in mistakes:
        if mistake.codes == ("transient_used",) or not set(references) <= set(mistake.predicted):
            continue
        for source in _permutations(list(references)):
            yield Mistake(
                codes=(*mistake.codes, "carts_swapped"),
                predicted={name: mistake.predicted[other] for name, other in source.items()},
                tolerance=mistake.tolerance,
                help=f"{mistake.help}; and the carts look swapped",
                whole=True,
                least=2,
            )
