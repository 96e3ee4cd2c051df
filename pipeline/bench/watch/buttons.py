"""What a person wants done with the run at hand: pressed in one thread, done in another.

A button does nothing by itself. The acquisition says what it would heed now, looks at every turn of
its loop what was pressed, and decides.
"""

import threading
from typing import Literal, get_args

Wish = Literal["stop", "skip", "keep", "repeat"]
WISHES: tuple[Wish, ...] = get_args(Wish)


class Buttons:
    """The buttons beside a session.

    Attributes
    ----------
    turn : which try of which recording the offer is about; a press for another is void.
    offered : what would be heeded now besides "stop", which always is.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.turn = 0
        self.offered: tuple[Wish, ...] = ()
        self._pressed: Wish | None = None

    @property
    def pressed(self) -> Wish | None:
        """What was pressed in this turn; "stop" stays pressed."""
        return self._pressed

    def begin(self) -> None:
        """Begin another turn, with nothing offered yet."""
        with self._lock:
            self.turn += 1
            self.offered = ()
            if self._pressed != "stop":
                self._pressed = None

    def offer(self, *wishes: Wish) -> None:
        """Say what would be heeded now; what was pressed before in this turn stays so."""
        with self._lock:
            self.offered = wishes

    def press(self, wish: Wish, *, turn: int) -> bool:
        """Press one; return whether it will be heeded. "stop" will, at any time."""
        with self._lock:
            if wish != "stop" and (self._pressed or turn != self.turn or wish not in self.offered):
                return False
            self._pressed = wish
            return True
