"""The set-up that every number is about, as one value: carts, springs, units, sign."""

from dataclasses import dataclass
from typing import Literal

from pipeline.json_files import result, written


@result()
class Units:
    """The submission's own units."""

    position: str = written()
    input: str = written()

    # Those that follow; times are in s. The input gain is one, so forces are in input units.

    @property
    def gain(self) -> str:
        """Of a static gain."""
        return f"{self.position}/{self.input}"

    @property
    def mass(self) -> str:
        """Of a mass."""
        return f"{self.input} s^2/{self.position}"

    @property
    def damping(self) -> str:
        """Of a damping coefficient."""
        return f"{self.input} s/{self.position}"

    @property
    def stiffness(self) -> str:
        """Of a spring, and of a prefilter."""
        return f"{self.input}/{self.position}"


PAPER_UNITS = Units(position="cm", input="V")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """The carts in a row between two walls, and what their numbers are measured in.

    Attributes
    ----------
    springs : (n + 1,) whether there is a spring from wall to cart 1, 1 to 2, …, n to wall.
    sign : of the input, as stated: -1 drives cart 1 towards negative x; None, found from the data.
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
        """Whether there is one cart without a spring: a mass and a damping, no gain."""
        return self.n == 1 and not any(self.springs)

    @property
    def tied(self) -> bool:
        """Whether a spring ties the carts to a wall: else no constant input has a rest position."""
        return self.springs[0] or self.springs[-1]

    @property
    def stiff(self) -> tuple[bool, ...]:
        """(n + 1,) the springs that have a stiffness of their own: of one cart's two, their sum."""
        return (any(self.springs), False) if self.n == 1 else self.springs
