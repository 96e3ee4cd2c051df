"""Undo mistakes in the reported numbers, so that each mistake is charged only once."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import cached_property

from pipeline.grading.grade import Code
from pipeline.grading.reference import Reference
from pipeline.grading.tolerance import as_typed, percent_off, rounding
from pipeline.names import read_name


@dataclass(frozen=True, kw_only=True)
class Slip:
    """One mistake of a student, wherever it shows.

    Attributes
    ----------
    number : the only number that the mistake concerns, such as "final.K_1", if no known mistake
        explains this number; otherwise "".
    """

    code: Code
    number: str = ""


@dataclass(frozen=True, kw_only=True)
class Number:
    """A reported number, as typed or with mistakes undone.

    Attributes
    ----------
    factor : the number is the typed one times this factor.
    """

    typed: Decimal
    factor: Fraction = Fraction(1)

    @cached_property
    def value(self) -> Fraction:
        """The number itself."""
        return Fraction(self.typed) * self.factor

    @property
    def text(self) -> str:
        """The number as typed, or with four digits if a mistake was undone."""
        return as_typed(self.typed) if self.factor == 1 else f"{float(self.value):.4g}"

    @property
    def rounding(self) -> Fraction:
        """How far rounding may have moved the number."""
        return rounding(self.typed) * abs(self.factor)

    def percent_off(self, reference: Reference, *, sigmas: float) -> Fraction:
        """Return the error against a reference, in percent; see `tolerance.percent_off`."""
        typed = self.typed if self.factor > 0 else -self.typed
        scaled = reference if self.factor == 1 else reference.times(1 / abs(float(self.factor)))
        return percent_off(typed, scaled, sigmas=sigmas)


@dataclass(frozen=True, kw_only=True)
class Slipped:
    """What mistakes did to one number of a table.

    Attributes
    ----------
    name : the parameter under which the number is reported.
    source : the parameter that it belongs to; another one if carts are swapped.
    factors : for each mistake, the factor by which it changed the number.
    right : the number from the recordings, if the mistake cannot be undone.
    """

    name: str
    source: str
    factors: Mapping[Slip, float]
    right: Reference | None = None

    def undone(self, typed: Decimal | None, *, left: Collection[Slip]) -> Number:
        """Return the number with all mistakes undone, except those that are left."""
        if self.right is not None or typed is None:
            assert self.right is not None
            return Number(typed=Decimal(repr(self.right.value)))
        factor = Fraction(1)
        for slip, by in self.factors.items():
            if slip not in left:
                factor /= Fraction(by)
        return Number(typed=typed, factor=factor)


def undo(
    table: Mapping[str, Decimal], slipped: Sequence[Slipped], *, left: Collection[Slip]
) -> dict[str, Number]:
    """Return the numbers of a table with all mistakes undone, except those that are left."""
    numbers = {name: Number(typed=typed) for name, typed in table.items()}
    for one in slipped:
        if all(slip in left for slip in one.factors):
            continue
        moved = any(slip.code == "carts_swapped" and slip not in left for slip in one.factors)
        numbers[one.source if moved else one.name] = one.undone(table.get(one.name), left=left)
    return numbers


def all_slips(slipped: Sequence[Slipped]) -> Iterator[Slip]:
    """Yield every mistake once."""
    yield from dict.fromkeys(slip for one in slipped for slip in one.factors)


def swapped_order(slipped: Sequence[Slipped], *, n: int) -> Iterator[tuple[int, ...]]:
    """Yield the order of the states of n carts that swapped labels of carts imply, if any are."""
    carts = list(range(n))
    for one in slipped:
        here, there = read_name(one.name).cart, read_name(one.source).cart
        if here and there and one.name != one.source:
            carts[here - 1] = there - 1
    if sorted(carts) == list(range(n)) != carts:
        yield tuple(2 * cart + part for cart in carts for part in (0, 1))
