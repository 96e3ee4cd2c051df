"""What a bench's controller does between its line and its motor: a state machine, once a period.

docs/protocol.md says in words and formulas what is written here.
"""

from collections.abc import Sequence
from typing import Protocol


class Core(Protocol):
    """A bench's controller without its hardware.

    Whatever carries it calls `receive` when bytes arrive, `tick` once a period while the bench
    has power, and `take` to send on what it has to say. The firmware and `ReferenceCore` are such.
    """

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; what they ask for happens at the next tick."""
        ...

    def tick(self, counts: Sequence[int], *, stamp: int, now: int) -> int:
        """Return the duty that acts from now on, within ± FULL_SCALE.

        Parameters
        ----------
        counts : of the encoders since they had power; a reset makes the next ones zero.
        stamp : whole ms of the bench's clock, which lines, waves and run times go by.
        now : whole ms of wall time, for the watchdog alone: an emulation may run faster.
        """
        ...

    def take(self) -> bytes:
        """Return what is to be sent since the last call: lines of readings, answers."""
        ...
