"""A table of mistakes that multiply a number by a factor. Add a row for a new mistake.

The codes of the mistakes are in `pipeline/grading/grade.py`, their sentences in
`templates/words/grading.toml`.
"""

import math
from dataclasses import dataclass
from typing import Literal

from pipeline.grading import limits
from pipeline.grading.grade import Code

TURN = 2 * math.pi
LOG10 = math.log10(math.e)
# Relative tolerance for numbers of a table that the students reduced themselves.
MISREAD_RATIO = 0.06
Of = Literal[
    "frequencies",  # those that the recordings give with close bounds
    "all frequencies",  # including those with wide bounds
    "gains",
    "sharp gains",  # those not made uncertain by friction
    "dampings",  # of all decays at once
    "every damping",  # of all decays and resonances at once
    "sharp dampings",  # of one decay at a time, without friction
    "frequencies of rows",  # of a table that the students reduced themselves, compared with dwells
    "ratios of rows",
    "fitted gains",  # from a fit to such a table, compared with steps and decays
    "fitted frequencies",
]


@dataclass(frozen=True, kw_only=True)
class Factor:
    """A row of the table: a mistake that multiplies the right number by a factor.

    Attributes
    ----------
    advice_key : key of the advice in `templates/words/grading.toml`.
    of : the group of numbers that the mistake can affect.
    whole, least, tries, from_time_records : see `Mistake`.
    """

    code: Code
    advice_key: str
    of: Of
    factor: float
    tolerance: float
    whole: bool = False
    least: int = 1
    tries: int = 1
    from_time_records: bool = False


def _frequency(advice_key: str, factor: float, *, of: Of = "frequencies", least: int = 1) -> Factor:
    tolerance = limits.UNMISTAKABLE
    return Factor(
        code="hz_for_rad_s",
        advice_key=advice_key,
        of=of,
        factor=factor,
        tolerance=tolerance,
        least=least,
    )


def _peaks(advice_key: str, factor: float, *, of: Of, whole: bool = False) -> Factor:
    return Factor(
        code="peak_to_peak",
        advice_key=advice_key,
        of=of,
        factor=factor,
        tolerance=limits.READ,
        whole=whole,
    )


def _log10(of: Of) -> Factor:
    return Factor(
        code="log10_for_ln",
        advice_key="log10",
        of=of,
        factor=LOG10,
        tolerance=limits.LOG10_DAMPING,
        whole=True,
        from_time_records=True,
    )


def _decrement(advice_key: str, factor: float) -> Factor:
    return Factor(
        code="peak_count",
        advice_key=advice_key,
        of="sharp dampings",
        factor=factor,
        tolerance=limits.READ,
        tries=2,
        from_time_records=True,
    )


def _reduced(code: Code, advice_key: str, factor: float, *, of: Of) -> Factor:
    return Factor(code=code, advice_key=advice_key, of=of, factor=factor, tolerance=MISREAD_RATIO)


FACTORS = (
    _frequency("hertz", 1 / TURN),
    # With wide bounds, one frequency proves nothing, so a second number must match.
    _frequency("hertz", 1 / TURN, of="all frequencies", least=2),
    _frequency("hertz_twice", TURN),
    # A team that reads peak to peak does so for every cart. For one cart alone, only a precise
    # reference proves it.
    _peaks("peak_to_peak", 2.0, of="gains", whole=True),
    _peaks("input_peak_to_peak", 0.5, of="gains", whole=True),
    _peaks("peak_to_peak", 2.0, of="sharp gains"),
    _peaks("input_peak_to_peak", 0.5, of="sharp gains"),
    _log10("dampings"),
    _log10("every damping"),
    # The decrement was taken over half a period, or over two. The frequency of the decay must be
    # right, and there must be no friction.
    _decrement("half_decrement", 0.5),
    _decrement("twice_decrement", 2.0),
    # A column with the heading Hz contains rad/s, or vice versa.
    _reduced("hz_for_rad_s", "reduced_radians", 1 / TURN, of="frequencies of rows"),
    _reduced("hz_for_rad_s", "reduced_hertz", TURN, of="frequencies of rows"),
    _reduced("peak_to_peak", "reduced_twice", 2.0, of="ratios of rows"),
    _reduced("peak_to_peak", "reduced_half", 0.5, of="ratios of rows"),
    _reduced("peak_to_peak", "gains_twice", 2.0, of="fitted gains"),
    _reduced("peak_to_peak", "gains_half", 0.5, of="fitted gains"),
    _reduced("hz_for_rad_s", "frequencies_in_radians", TURN, of="fitted frequencies"),
    _reduced("hz_for_rad_s", "frequencies_in_hertz", 1 / TURN, of="fitted frequencies"),
)
