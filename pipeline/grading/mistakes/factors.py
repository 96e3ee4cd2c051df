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


@dataclass(frozen=True)
class Factor:
    """A row of the table: a mistake that multiplies the right number by a factor.

    Attributes
    ----------
    advice_key : key of the advice in `templates/words/grading.toml`.
    of : the group of numbers that the mistake can affect.
    tolerance, whole, least, tries, from_time_records : see `Mistake`.
    """

    code: Code
    advice_key: str
    of: Of
    factor: float
    tolerance: float = MISREAD_RATIO
    whole: bool = False
    least: int = 1
    tries: int = 1
    from_time_records: bool = False


OF_MISTAKE = ("tolerance", "whole", "least", "tries", "from_time_records")  # as in `Mistake`
_CLEAR, _READ = limits.UNMISTAKABLE, limits.READ
_LOG10 = {"tolerance": limits.LOG10_DAMPING, "whole": True, "from_time_records": True}
_DECREMENT = {"tolerance": _READ, "tries": 2, "from_time_records": True}

FACTORS = (
    Factor("hz_for_rad_s", "hertz", "frequencies", 1 / TURN, _CLEAR),
    # With wide bounds, one frequency proves nothing, so a second number must match.
    Factor("hz_for_rad_s", "hertz", "all frequencies", 1 / TURN, _CLEAR, least=2),
    Factor("hz_for_rad_s", "hertz_twice", "frequencies", TURN, _CLEAR),
    # A team that reads peak to peak does so for every cart. For one cart alone, only a precise
    # reference proves it.
    Factor("peak_to_peak", "peak_to_peak", "gains", 2.0, _READ, whole=True),
    Factor("peak_to_peak", "input_peak_to_peak", "gains", 0.5, _READ, whole=True),
    Factor("peak_to_peak", "peak_to_peak", "sharp gains", 2.0, _READ),
    Factor("peak_to_peak", "input_peak_to_peak", "sharp gains", 0.5, _READ),
    Factor("log10_for_ln", "log10", "dampings", LOG10, **_LOG10),
    Factor("log10_for_ln", "log10", "every damping", LOG10, **_LOG10),
    # The decrement was taken over half a period, or over two. The frequency of the decay must be
    # right, and there must be no friction.
    Factor("peak_count", "half_decrement", "sharp dampings", 0.5, **_DECREMENT),
    Factor("peak_count", "twice_decrement", "sharp dampings", 2.0, **_DECREMENT),
    # A column with the heading Hz contains rad/s, or vice versa.
    Factor("hz_for_rad_s", "reduced_radians", "frequencies of rows", 1 / TURN),
    Factor("hz_for_rad_s", "reduced_hertz", "frequencies of rows", TURN),
    Factor("peak_to_peak", "reduced_twice", "ratios of rows", 2.0),
    Factor("peak_to_peak", "reduced_half", "ratios of rows", 0.5),
    Factor("peak_to_peak", "gains_twice", "fitted gains", 2.0),
    Factor("peak_to_peak", "gains_half", "fitted gains", 0.5),
    Factor("hz_for_rad_s", "frequencies_in_radians", "fitted frequencies", TURN),
    Factor("hz_for_rad_s", "frequencies_in_hertz", "fitted frequencies", 1 / TURN),
)
