"""Find tables of reported numbers that two submissions share.

Honest teams on one bench report nearly equal numbers, so right answers prove nothing. Equal errors
do: a table is a copy if nearly all of its numbers are equal, and enough of them are wrong by a few
units of their last digit. The spread of the errors in the class tells how probable this is by
chance. If the recordings agree within these digits, one faulty program explains the table too.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np

from pipeline.estimation.noise import MEDIAN_TO_SIGMA
from pipeline.grading.grade import Grade
from pipeline.grading.gradings import Grading
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.copies import same_team
from pipeline.names import read_name

_FEWEST_TEAMS = 5  # from which the spread of honest numbers is known
_EQUAL_PART = 0.9  # share of the numbers of a table that must be equal
_FEWEST_DIGITS = 3  # of a number that counts
_MOST_DECADES = 2.0  # that one number counts, so that a few numbers do not decide
# A class of 300 has 10^4.7 pairs; with three decades more, one class in a thousand has a pair that
# agrees by chance. The largest density of an error is used, which allows for dependent numbers.
_LEAST_DECADES = 8.0
_GROSS = 4.0  # standard deviations; two teams that are both further off may have the same slip
_EQUAL_DATA = 1e-6  # relative difference of numbers that were computed from equal recordings
_GIVEN_PART = 1 / 2  # share of a class; a number that more teams report was given to them

Key = tuple[str, str]  # table (initial or final) and name of a number


@dataclass(frozen=True, kw_only=True)
class TypedNumber:
    """A reported number without its sign, and the same number recomputed from the recordings.

    Zeros at the end of the reported number do not count as digits.
    """

    value: float
    recomputed: float

    @property
    def digits(self) -> int:
        """Number of significant digits."""
        return len(_shortest(self.value).as_tuple().digits)

    @property
    def step(self) -> float:
        """Unit of the last significant digit."""
        return 10.0 ** int(_shortest(self.value).as_tuple().exponent)

    @property
    def error(self) -> float:
        """Relative difference from the recomputed number."""
        return self.value / self.recomputed - 1

    @property
    def is_right(self) -> bool:
        """Whether anybody would report this number who computes correctly."""
        return abs(self.value - self.recomputed) <= self.step


@dataclass(frozen=True, kw_only=True)
class SharedTable:
    """A table whose numbers another submission also reports.

    Attributes
    ----------
    table : initial or final.
    equal, of : how many numbers are equal, of those that both submissions report.
    one_program : whether two honest teams would report the same if they used one faulty program,
        because their recordings agree within the digits that they report.
    """

    table: str
    submission: str
    equal: int
    of: int
    one_program: bool


def _shortest(value: float) -> Decimal:
    return Decimal(repr(value)).normalize()


def typed_numbers(grade: Grade, *, rubric: Rubric) -> dict[Key, TypedNumber]:
    """Return the reported numbers of a graded submission that could be recomputed."""
    tables = {asked.id: asked.check for asked in rubric.criteria}
    found = {}
    for criterion in grade.criteria:
        if (table := tables.get(criterion.id)) not in ("initial", "final"):
            continue
        for name, value in criterion.found.items():
            right = criterion.expected.get(name)
            if right and value:
                found[table, name] = TypedNumber(value=abs(value), recomputed=abs(right))
    return found


def find_shared_tables(
    batch: Sequence[Grading],
    reported: Mapping[str, Mapping[Key, TypedNumber]],
    *,
    given: Collection[tuple[str, float]] = (),
) -> dict[str, tuple[SharedTable, ...]]:
    """Return, for each submission of a class, the tables that it shares with others.

    Parameters
    ----------
    reported : numbers of each submission.
    given : name and value of each number that the lab gave out; everybody may have it.
    """
    teams = [one for one in batch if reported.get(one.submission)]
    if len(teams) < _FEWEST_TEAMS:
        return {}
    numbers = [reported[one.submission] for one in teams]
    keys = sorted({key for own in numbers for key in own})
    of_table = {
        table: np.array([key[0] == table for key in keys]) for table in dict.fromkeys(dict(keys))
    }
    values = np.array([[own[k].value if k in own else np.nan for k in keys] for own in numbers])
    spreads = _spreads(numbers)
    found: dict[str, list[SharedTable]] = defaultdict(list)
    for a, own in enumerate(numbers):
        equal = values == values[a]
        both = np.isfinite(values) & np.isfinite(values[a])
        # A number that half of the class reports counts as equal, but is no evidence.
        telling = equal & (equal.sum(axis=0) <= max(2.0, _GIVEN_PART * len(teams)))
        for b in (a + 1 + np.flatnonzero(_MOST_DECADES * telling[a + 1 :].sum(axis=1)
                                         >= _LEAST_DECADES)).tolist():  # fmt: skip
            counts = {
                table: (int(np.sum(equal[b] & mine)), int(np.sum(both[b] & mine)))
                for table, mine in of_table.items()
            }
            same = {t: (n, of) for t, (n, of) in counts.items() if n and n >= _EQUAL_PART * of}
            decades = {
                (key[1], own[key].value): _decades(own[key], numbers[b][key], spreads[_kind(key)])
                for at, key in enumerate(keys)
                if key[0] in same and telling[b, at] and (key[1], own[key].value) not in given
            }
            if sum(decades.values()) < _LEAST_DECADES or same_team(teams[a], teams[b]):
                continue
            apart = {
                (key[1], own[key].value)
                for key in own.keys() & numbers[b].keys()
                if abs(own[key].recomputed - numbers[b][key].recomputed) > own[key].step
            }
            beyond = sum(size for number, size in decades.items() if number in apart)
            for mine, other in ((a, b), (b, a)):
                found[teams[mine].submission] += [
                    SharedTable(
                        table=t,
                        submission=teams[other].submission,
                        equal=n,
                        of=of,
                        one_program=beyond < _LEAST_DECADES,
                    )
                    for t, (n, of) in sorted(same.items(), reverse=True)  # initial, then final
                ]
    return {name: tuple(tables) for name, tables in sorted(found.items())}


def _kind(key: Key) -> Key:
    """Return the table and the kind of a number: K, omega or zeta."""
    return key[0], read_name(key[1]).symbol


def _spreads(numbers: Sequence[Mapping[Key, TypedNumber]]) -> dict[Key, tuple[float, float]]:
    """Return median and spread of the relative errors in a class, by table and kind of number."""
    errors: dict[Key, list[float]] = defaultdict(list)
    for own in numbers:
        for key, number in own.items():
            errors[_kind(key)].append(number.error)
    found = {}
    for kind, those in errors.items():
        middle = float(np.median(those))
        found[kind] = middle, float(MEDIAN_TO_SIGMA * np.median(np.abs(np.array(those) - middle)))
    return found


def _decades(a: TypedNumber, b: TypedNumber, spread: tuple[float, float]) -> float:
    """Return how improbable an equal number is by honest work, as a power of ten; 0 if it is not.

    Parameters
    ----------
    spread : median and standard deviation of the relative errors of honest numbers.
    """
    middle, sigma = spread
    equal_data = abs(a.recomputed - b.recomputed) <= _EQUAL_DATA * a.recomputed
    both_gross = min(abs(one.error - middle) for one in (a, b)) > _GROSS * sigma
    if a.digits < _FEWEST_DIGITS or equal_data or both_gross or (a.is_right and b.is_right):
        return 0.0
    if not sigma:  # most teams report exact numbers, so nothing is known about errors
        return 0.0
    # The largest density of a normal distribution, times the width of a step.
    chance = a.step / (a.value * sigma * math.sqrt(2 * math.pi))
    return min(max(-math.log10(chance), 0.0), _MOST_DECADES)
