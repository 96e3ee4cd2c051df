"""The lab set-up as one value: carts, springs, units and sign of the input."""

from dataclasses import dataclass
from typing import Literal

from pipeline.json_files import result, written


@result()
class Units:
    """The submission's own units of position and input."""

    position: str = written()
    input: str = written()

    # Derived units; times are in s. The input gain is 1, so forces have the input unit.

    @property
    def gain(self) -> str:
        """The unit of a static gain."""
        return f"{self.position}/{self.input}"

    @property
    def mass(self) -> str:
        """The unit of a mass."""
        return f"{self.input} s^2/{self.position}"

    @property
    def damping(self) -> str:
        """The unit of a damping coefficient."""
        return f"{self.input} s/{self.position}"

    @property
    def stiffness(self) -> str:
        """The unit of a spring's stiffness, and of a prefilter."""
        return f"{self.input}/{self.position}"


PAPER_UNITS = Units(position="cm", input="V")


@dataclass(frozen=True, kw_only=True)
class Setup:
    """The carts in a row between two walls, and the units of their measurements.

    Attributes
    ----------
    springs : (n + 1,) whether each spring exists: wall to cart 1, cart 1 to 2, …, cart n to wall.
    sign : the stated sign of the input. With -1 a positive input pushes cart 1 towards negative x.
        None if the sign must be found from the data.
    """

    springs: tuple[bool, ...]
    units: Units = PAPER_UNITS
    sign: Literal[1, -1] | None = None

    @property
    def n(self) -> int:
        """The number of carts."""
        return len(self.springs) - 1

    @property
    def rigid(self) -> bool:
        """Whether the bench is one cart without a spring, which has a mass but no static gain."""
        return self.n == 1 and not any(self.springs)

    @property
    def tied(self) -> bool:
        """Whether a spring ties the carts to a wall.

        If not, a constant input never lets them rest.
        """
        return self.springs[0] or self.springs[-1]

    @property
    def stiff(self) -> tuple[bool, ...]:
        """(n + 1,) whether each stiffness can be identified.

        For a single cart, only the sum of the two springs can be identified; it counts as the
        first.
        """
        return (any(self.springs), False) if self.n == 1 else self.springs
