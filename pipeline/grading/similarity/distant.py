"""Find submissions whose carts differ from those of the class.

This is a question to the TA, since a bench may have other springs. It is neither a flag nor does it
cost points.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.grading.grade import Grade
from pipeline.grading.rubric import Rubric
from pipeline.names import read_name
from pipeline.words.numbers import significant, unit_text

_FEWEST_TEAMS = 5  # from which a class has a median
_MOST_SPREADS = 10  # median absolute deviations from the median that are usual
_MOST_PART = 0.1  # relative distance from the median that is usual
_RARE = 0.25  # share of the class; if more teams are far off, the class has several benches
_NAMED = 3

Quantity = tuple[str, str]  # name and unit of a static gain or a frequency


@dataclass(frozen=True, kw_only=True)
class Distant:
    """A submission whose carts lie far from the class median.

    Attributes
    ----------
    numbers : name, unit, value and class median of each such number, the most different first.
    """

    submission: str
    numbers: tuple[tuple[str, str, float, float], ...]

    def __str__(self) -> str:
        """Return the most different numbers in words."""
        told = [
            f"{name} is {significant(value, digits=3)} {unit_text(unit)}"
            f" (class median {significant(median, digits=3)})"
            for name, unit, value, median in self.numbers[:_NAMED]
        ]
        more = len(self.numbers) - _NAMED
        return ", ".join(told) + (f", and {more} more" if more > 0 else "")


def recomputed_numbers(grade: Grade, *, rubric: Rubric) -> dict[Quantity, float]:
    """Return the static gains and frequencies that the recordings of a submission give."""
    tables = {asked.id: asked.check for asked in rubric.criteria}
    found: dict[Quantity, float] = {}
    if grade.units is None:
        return found
    for wanted in ("initial", "final"):  # the final numbers are more precise
        for criterion in grade.criteria:
            if tables.get(criterion.id) == wanted:
                for name, value in criterion.expected.items():
                    if not read_name(name).is_damping:
                        found[name, read_name(name).unit(grade.units)] = abs(value)
    return found


def find_distant(class_: Mapping[str, Mapping[Quantity, float]]) -> list[Distant]:
    """Return the submissions whose carts lie far from the class median, in order.

    A number is left out if fewer than five teams have it, or if more than a quarter of them lie far
    from the median.

    Parameters
    ----------
    class_ : static gains and frequencies of each submission.
    """
    having: dict[Quantity, dict[str, float]] = defaultdict(dict)
    for submission, numbers in class_.items():
        for quantity, value in numbers.items():
            having[quantity][submission] = value
    found: dict[str, list[tuple[str, str, float, float]]] = defaultdict(list)
    for (name, unit), values in having.items():
        if len(values) < _FEWEST_TEAMS:
            continue
        every = np.array(list(values.values()))
        median = float(np.median(every))
        spread = float(np.median(np.abs(every - median)))
        usual = max(_MOST_SPREADS * spread, _MOST_PART * abs(median))
        far = {team: value for team, value in values.items() if abs(value - median) > usual}
        if len(far) <= _RARE * len(values):
            for team, value in far.items():
                found[team].append((name, unit, value, median))
    return [
        Distant(submission=team, numbers=tuple(sorted(numbers, key=_difference)))
        for team, numbers in sorted(found.items())
    ]


def _difference(number: tuple[str, str, float, float]) -> tuple[float, str]:
    name, _, value, median = number
    ratio = min(value, median) / max(value, median, 1e-300)
    return ratio, name
