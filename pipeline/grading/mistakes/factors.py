"""A table of mistakes that multiply a number by one factor; a new mistake is a row here.

Its code is in `pipeline/grading/grade.py`, its sentences are in `templates/words/grading.toml`.
"""

import math
from dataclasses import dataclass
from typing import Literal

from pipeline.grading import limits
from pipeline.grading.grade import Code

TURN = 2 * math.pi
LOG10 = math.log10(math.e)
MISREAD_RATIO = 0.06  # tolerance for a ratio of a reduced table with one mistake
Of = Literal[
    "frequencies",  # … known well from the recordings
    "all frequencies",  # … including vaguely known ones
    "gains",
    "sharp gains",  # … without the uncertainty of friction
    "dampings",  # of decays
    "sharp dampings",  # … each separately
    "frequencies of rows",  # of a reduced table, with dwells to compare
    "ratios of rows",
    "fitted gains",  # … fitted, with steps and decays to compare
    "fitted frequencies",
]


@dataclass(frozen=True, kw_only=True)
class Factor:
    """A row: the reported number is the right one times a factor.

    Attributes
    ----------
    code : of the flag; `said` is the key of its advice in the words of grading.
    of : the numbers that can have it.
    tolerance : relative, around the recordings' own number times the factor.
    whole, least, tries, from_time_records : see `Mistake`.
    """

    code: Code
    said: str
    of: Of
    factor: float
    tolerance: float
    whole: bool = False
    least: int = 1
    tries: int = 1
    from_time_records: bool = False


def _frequency(said: str, factor: float, *, of: Of = "frequencies", least: int = 1) -> Factor:
    tolerance = limits.UNMISTAKABLE
    return Factor(
        code="hz_for_rad_s", said=said, of=of, factor=factor, tolerance=tolerance, least=least
    )


def _peaks(said: str, factor: float, *, of: Of, whole: bool = False) -> Factor:
    return Factor(
        code="peak_to_peak", said=said, of=of, factor=factor, tolerance=limits.READ, whole=whole
    )


def _decrement(said: str, factor: float) -> Factor:
    return Factor(
        code="peak_count",
        said=said,
        of="sharp dampings",
        factor=factor,
        tolerance=limits.READ,
        tries=2,
        from_time_records=True,
    )


def _reduced(code: Code, said: str, factor: float, *, of: Of) -> Factor:
    return Factor(code=code, said=said, of=of, factor=factor, tolerance=MISREAD_RATIO)


FACTORS = (
    _frequency("hertz", 1 / TURN),
    _frequency("hertz", 1 / TURN, of="all frequencies", least=2),  # together with a sharper one
    _frequency("hertz_twice", TURN),
    # A team reads peak to peak for every cart; for a single cart only a sharp reference proves it.
    _peaks("peak_to_peak", 2.0, of="gains", whole=True),
    _peaks("input_peak_to_peak", 0.5, of="gains", whole=True),
    _peaks("peak_to_peak", 2.0, of="sharp gains"),
    _peaks("input_peak_to_peak", 0.5, of="sharp gains"),
    Factor(
        code="log10_for_ln",
        said="log10",
        of="dampings",
        factor=LOG10,
        tolerance=limits.LOG10_DAMPING,
        whole=True,
        from_time_records=True,
    ),
    # The decrement alone, without friction: over half a period, or over two.
    _decrement("half_decrement", 0.5),
    _decrement("twice_decrement", 2.0),
    # A column headed Hz that holds rad/s, or vice versa.
    _reduced("hz_for_rad_s", "reduced_radians", 1 / TURN, of="frequencies of rows"),
    _reduced("hz_for_rad_s", "reduced_hertz", TURN, of="frequencies of rows"),
    _reduced("peak_to_peak", "reduced_twice", 2.0, of="ratios of rows"),
    _reduced("peak_to_peak", "reduced_half", 0.5, of="ratios of rows"),
    _reduced("peak_to_peak", "gains_twice", 2.0, of="fitted gains"),
    _reduced("peak_to_peak", "gains_half", 0.5, of="fitted gains"),
    _reduced("hz_for_rad_s", "frequencies_in_radians", TURN, of="fitted frequencies"),
    _reduced("hz_for_rad_s", "frequencies_in_hertz", 1 / TURN, of="fitted frequencies"),
)
