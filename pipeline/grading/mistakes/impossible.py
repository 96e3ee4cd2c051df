"""Find numbers that no real carts can have, by their signs and order."""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal

from pipeline.grading.grade import Flag
from pipeline.grading.tolerance import as_typed, rounding
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.plant.identities import parameter_orders
from pipeline.plant.limits import HEAVY_DAMPING


@dataclass(frozen=True, kw_only=True)
class BrokenOrder:
    """Two numbers of a table that break the law `lesser ≤ greater`."""

    lesser: str
    greater: str
    reason: str

    @property
    def names(self) -> tuple[str, str]:
        """Both parameter names."""
        return self.lesser, self.greater

    @property
    def is_of_gains(self) -> bool:
        """Return whether the two numbers are static gains."""
        return read_name(self.lesser).is_gain

    @property
    def is_plain(self) -> bool:
        """Return whether the law is obvious to students, as it is for gains and resonances.

        Laws about nulls and about frequencies of single carts are not obvious. Then the number from
        the recordings helps the student more.
        """
        return self.is_of_gains or all(read_name(name).is_mode for name in self.names)

    def flag(self, table: Mapping[str, Decimal], label: str) -> Flag:
        """Return the flag for the two numbers."""
        low, high = table[self.lesser], table[self.greater]
        return Flag(
            code="physically_impossible",
            parameters=self.names,
            message=WORDS.text(
                "broken_order",
                lesser=self.lesser,
                low=as_typed(low),
                greater=self.greater,
                high=as_typed(high),
                table=label,
                reason=self.reason,
            ),
            evidence={
                "table": label,
                "reported": {self.lesser: float(low), self.greater: float(high)},
                "ratio": float(low / high),
            },
        )


def not_positive(table: Mapping[str, Decimal]) -> list[str]:
    """Return the parameters that are zero or negative."""
    return [name for name, typed in table.items() if typed <= 0]


def broken_orders(table: Mapping[str, Decimal], *, initial: bool) -> list[BrokenOrder]:
    """Return the laws of order that a table breaks by more than rounding and usual errors.

    Parameters
    ----------
    initial : whether this is the initial table, whose numbers are read off plots.
    """
    # Numbers from a fit are right within a few percent; first estimates are less precise.
    slack = 1.2 if initial else 1.1
    heavy = any(v > HEAVY_DAMPING for n, v in table.items() if read_name(n).is_ratio)
    broken = []
    for lesser, greater, reason in parameter_orders(list(table)):
        if heavy and read_name(lesser).is_frequency:
            continue
        low, high = table[lesser], table[greater]
        if low <= 0 or high <= 0:
            continue
        least = low - Decimal(float(rounding(low)))
        most = high + Decimal(float(rounding(high)))
        if float(least) > slack * float(most):
            broken.append(BrokenOrder(lesser=lesser, greater=greater, reason=reason))
    return broken
