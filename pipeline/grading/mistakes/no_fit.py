"""Find final estimates that were copied from the initial ones instead of fitted."""

from decimal import Decimal
from fractions import Fraction
from math import exp

from pipeline.grading import limits
from pipeline.grading.reference import Reference, References
from pipeline.grading.tolerance import half_digit, is_vague, percent_off, rounding
from pipeline.names import read_name
from pipeline.submission import Reported


def copied_final(reported: Reported, *, references: References) -> list[str]:
    """Return the final estimates that equal the initial ones, if this is no coincidence.

    Students may honestly keep the numbers of single carts, so most numbers that only a fit can give
    must be equal too. The strongest evidence is a guessed damping that did not change. Tables typed
    with single digits are ignored, because rounding makes them agree.
    """
    both = [name for name in reported.final if name in reported.initial]
    same = [n for n in both if _same(reported, n)]
    most = 0.75  # least share of equal numbers
    if not both or len(same) < most * len(both):
        return []
    if 2 * sum(is_vague(reported.final[name]) for name in same) > len(same):
        return []
    fitted = [name for name in both if read_name(name).is_by_eye]
    if len([name for name in fitted if name in same]) < most * len(fitted):
        return []
    chance = 1.0
    for name in same:
        chance *= _coincidence(reported.final[name], references.final.get(name), name)
    return same if chance < 3e-3 else []  # a fit rarely reproduces so many numbers by chance


def _coincidence(typed: Decimal, reference: Reference | None, name: str) -> float:
    """Return the probability that a fit gives the same digits as the first estimate.

    It is high if the first estimate was right to its last digit, or if few digits were typed.
    """
    if not typed:
        return 1.0
    damping = read_name(name).is_damping
    half = half_digit(typed) / abs(Fraction(typed))
    # Usual relative difference between first and final estimate; smaller where the data are
    # precise.
    apart, surprise = 0.15 if damping else 0.01, 0.0
    if reference is not None and reference.low > 0:
        # A number with a single digit is rounded more than grading allows for.
        hidden = half - rounding(typed) / abs(Fraction(typed))
        off = max(float(percent_off(typed, reference, sigmas=limits.SIGMAS) / 100 - hidden), 0.0)
        if reference.within(1.05 if damping else 1.01):
            apart = 0.03 if damping else 0.003
            if off == 0:
                return 1.0
        measured = not damping and not read_name(name).is_by_eye
        # A larger error points to a mistake, perhaps the same one in both tables, not to a poor
        # fit.
        if not measured or off <= 0.2:
            surprise = min(0.5 * (off / apart) ** 2, 3.0)
    # A difference of two normal errors has the density 1/√(4π) at zero.
    again = 1.0 if is_vague(typed) else min(1.0, 2 * float(half) / (apart * 3.5))
    return again * exp(-surprise)


def _same(reported: Reported, name: str) -> bool:
    return reported.final[name] == reported.initial[name]
