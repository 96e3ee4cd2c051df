"""Final estimates copied from the initial ones: too many coincidences for a fit."""

from pipeline.grading.reference import References
from pipeline.grading.rubric import is_damping
from pipeline.grading.tolerance import half_digit
from pipeline.submission import Reported

# How far an initial and a final estimate of one number usually lie apart, relative.
_APART = 0.01
_APART_DAMPING = 0.15
_CHANCE = 1e-3  # of a table that a fit gave agreeing so by coincidence
_FITTED_BY_EYE = "abcdefghxy"  # symbols of resonances and nulls: only a fit gives those
_SHARE = 0.75  # of the numbers in both tables


def copied_final(reported: Reported, *, references: References) -> list[str]:
    """Return the final estimates that stand in the initial table too, if that is no coincidence.

    The numbers of a cart alone may honestly be taken over, so those that only a fit can give
    must be among the copied. An initial damping that is the usual guess tells most.
    """
    both = [name for name in reported.final if name in reported.initial]
    same = [n for n in both if _same(reported, n)]
    if not both or len(same) < _SHARE * len(both):
        return []
    fitted = [name for name in both if name[-1] in _FITTED_BY_EYE]
    if len([name for name in fitted if name in same]) < _SHARE * len(fitted):
        return []
    chance = 1.0
    for name in same:
        apart = _APART_DAMPING if is_damping(name) else _APART
        reference = references.final.get(name)
        typed = reported.final[name]
        if name in fitted and reference and reference.low > 0 and not is_damping(name):
            apart = max(apart, abs(float(typed) / reference.value - 1))
        step = 2 * float(half_digit(typed)) / abs(float(typed)) if typed else 1.0
        chance *= min(1.0, step / (apart * 3.5))  # the density of a normal difference at zero
    return same if chance < _CHANCE else []


def _same(reported: Reported, name: str) -> bool:
    return reported.final[name] == reported.initial[name]
