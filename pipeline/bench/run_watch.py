"""Check arriving lines against the limits and the wave, while the carts settle and in a run."""

import time
from collections.abc import Callable, Sequence

from pipeline.bench.events import Observer
from pipeline.bench.orders import Order
from pipeline.bench.stream import Stream
from pipeline.protocol import Reading


class LineWatch:
    """Check each line against the limits and the wave of an order.

    Parameters
    ----------
    carts : number of carts whose travel is watched; 0 if the zero of the counts is not reliable.
    period : ms between lines; None for a stock bench, because its wave is not known to the ms.

    Attributes
    ----------
    is_astray : whether the motor's duty differed from the order.
    is_too_far : whether a cart was farther from its zero than the limit allows.
    is_unsafe : whether the run was stopped because it was not safe to continue.
    """

    def __init__(self, order: Order, *, carts: int, period: float | None) -> None:
        self._order = order
        self._carts = carts
        self._period = period
        self._strays, self._drives_off = _InARow(), _InARow()
        self._before: Reading | None = None
        self.is_astray = self.is_too_far = self.is_unsafe = False

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the run must stop, or ""."""
        for reading in batch:
            if trouble := self._trouble(reading):
                return trouble
        return ""

    def stop(self, why: str) -> str:
        """Mark the run as unsafe; return the message for its end."""
        self.is_unsafe = True
        return f"stopped: {why}"

    def _trouble(self, reading: Reading) -> str:
        order = self._order
        off = order.drives_off(reading, before=self._before or reading)
        self._before = reading
        if passed := order.passed(reading, carts=self._carts):
            self.is_too_far = bool(order.too_far(reading, carts=self._carts))
            self.is_astray = off
            return self.stop(passed)
        if self._period is not None:
            strays = order.strays(reading, period=self._period)
            if self._strays.lasts(strays, ms=reading.ms):
                return (
                    f"the bench does not follow the wave that was ordered: {reading.target} counts "
                    f"at {1e-3 * reading.ms:.3f} s; a digit changed on the line"
                )
        if self._drives_off.lasts(off, ms=reading.ms):
            self.is_astray = True
            return self.stop(
                f"the bench drives its motor with {reading.duty} duty counts instead "
                f"of {reading.target}, at {1e-3 * reading.ms:.3f} s"
            )
        return ""


class _InARow:
    """Distinguish a condition that lasts two or more lines from a single garbled line."""

    def __init__(self) -> None:
        self._since: int | None = None  # ms of the first line with the condition

    def lasts(self, shows: bool, *, ms: int) -> bool:
        """Return whether the condition has lasted for two or more lines.

        Parameters
        ----------
        shows : whether this line meets the condition.
        """
        if not shows:
            self._since = None
        elif self._since is None:
            self._since = ms
        else:
            return ms - self._since >= 4  # at least two lines, or five at 1 kHz
        return False


class RunWatch(LineWatch):
    """Check the lines of a run, and pass them to the observer in batches."""

    def __init__(
        self,
        order: Order,
        *,
        carts: int,
        period: float | None,
        stream: Stream,
        observer: Observer,
        let_in: Callable[[], None],
    ) -> None:
        super().__init__(order, carts=carts, period=period)
        self._stream = stream
        self._observer = observer
        self._let_in = let_in
        self._batch: list[Reading] = []
        self._forwarded = time.monotonic()

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the run must stop, or ""."""
        self._let_in()
        self._batch += batch
        if trouble := super().check(batch):
            return trouble  # the stop must be sent before any observer is informed
        now = time.monotonic()
        if now - self._forwarded > 0.05:
            self._forwarded = now
            self.forward(())
        return ""

    def forward(self, batch: Sequence[Reading]) -> None:
        """Pass the waiting lines and a new batch to the observer."""
        waiting, self._batch = [*self._batch, *batch], []
        if waiting:
            self._observer.readings(waiting, self._stream.anomalies())


class RestWatch(LineWatch):
    """Check the lines while the carts come to rest, and keep the last ones.

    Parameters
    ----------
    since : time in ms from which lines are kept.
    """

    def __init__(self, order: Order, *, carts: int, period: float | None, since: float) -> None:
        super().__init__(order, carts=carts, period=period)
        self._since = since
        self._readings: list[Reading] = []

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the wait must stop, or ""."""
        self._readings += [reading for reading in batch if reading.ms >= self._since]
        return super().check(batch)

    @property
    def last(self) -> Reading | None:
        """The last line kept; None before the first."""
        return self._readings[-1] if self._readings else None

    @property
    def swings(self) -> list[int]:
        """The range of each encoder in the kept lines, in counts."""
        columns = zip(*(reading.counts for reading in self._readings), strict=True)
        return [max(column) - min(column) for column in columns]
