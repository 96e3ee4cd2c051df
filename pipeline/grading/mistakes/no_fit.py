"""Find final estimates that were copied from the initial ones."""

from decimal import Decimal
from fractions import Fraction
from math import exp

from pipeline.grading import limits
from pipeline.grading.references.reference import Reference, References
from pipeline.grading.references.tolerance import half_digit, is_vague, percent_off, rounding
from pipeline.names import read_name
from pipeline.submission import Reported


def copied_final(reported: Reported, *, references: References) -> list[str]:
    """Return the final estimates equal to the initial ones, if this is not a coincidence.

    Numbers of a single cart may honestly be kept, so the copied ones must include numbers that only
    a fit can give. A copy of the usual guess of a damping is the strongest evidence. Tables with
    single digits agree anyway.
    """
    both = [name for name in reported.final if name in reported.initial]
    same = [n for n in both if _same(reported, n)]
    most = 0.75  # of the numbers in both tables
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
    return same if chance < 3e-3 else []  # a fit rarely agrees by chance


def _coincidence(typed: Decimal, reference: Reference | None, name: str) -> float:
    """Return the probability that a fit reproduces a number digit for digit.

    It is high if the first estimate was right to its last digit, and if few digits were typed.
    """
    if not typed:
        return 1.0
    damping = read_name(name).is_damping
    half = half_digit(typed) / abs(Fraction(typed))
    # Usual difference between the two estimates of a number, smaller for certain ones.
    apart, surprise = 0.15 if damping else 0.01, 0.0
    if reference is not None and reference.low > 0:
        # Rounding to a single digit is more than grading excuses.
        hidden = half - rounding(typed) / abs(Fraction(typed))
        off = max(float(percent_off(typed, reference, sigmas=limits.SIGMAS) / 100 - hidden), 0.0)
        if reference.within(1.05 if damping else 1.01):
            apart = 0.03 if damping else 0.003
            if off == 0:
                return 1.0
        measured = not damping and not read_name(name).is_by_eye
        # A larger error is a mistake, perhaps in both tables; some students fit badly.
        if not measured or off <= 0.2:
            surprise = min(0.5 * (off / apart) ** 2, 3.0)
    # A normal difference has the density 1/√(4π) at zero.
    again = 1.0 if is_vague(typed) else min(1.0, 2 * float(half) / (apart * 3.5))
    return again * exp(-surprise)


def _same(reported: Reported, name: str) -> bool:
    return reported.final[name] == reported.initial[name]
