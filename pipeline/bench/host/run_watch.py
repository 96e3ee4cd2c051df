"""What is looked at while lines come: the limits and the wave of a run, the end of a rest."""

import time
from collections.abc import Sequence

from pipeline.bench.host.stream import Stream
from pipeline.bench.live.observer import Observer
from pipeline.bench.planning.orders import Order
from pipeline.bench.protocol.messages import Reading
from pipeline.bench.thresholds import ASTRAY

STOPPED = "stopped: "  # begins why a run was ended that was not safe to go on with
_FORWARD = 0.05  # s between batches handed to the observers


class RunWatch:
    """Checks each line against the limits and the wave, and hands them on in batches.

    Parameters
    ----------
    period : ms from line to line; None of a stock bench, whose waves nobody knows to the ms.
    """

    def __init__(
        self, order: Order, *, carts: int, period: float | None, stream: Stream, observer: Observer
    ) -> None:
        self._order = order
        self._carts = carts
        self._period = period
        self._astray = self._off = 0  # lines in a row
        self._before: Reading | None = None
        self._stream = stream
        self._observer = observer
        self._batch: list[Reading] = []
        self._forwarded = time.monotonic()

    def check(self, batch: Sequence[Reading]) -> str:
        """Return why the run must stop, or ""."""
        self._batch += batch
        for reading in batch:
            if passed := self._order.passed(reading, carts=self._carts):
                return f"{STOPPED}{passed}"  # before anybody is told: the stop goes out first
            if self._period is not None:
                strays = self._order.strays(reading, period=self._period)
                self._astray = self._astray + 1 if strays else 0
                if self._astray == ASTRAY:
                    return (
                        f"the bench follows another wave than it was sent, {reading.target} counts "
                        f"at {1e-3 * reading.ms:.3f} s: the line changed a digit"
                    )
            off = self._order.drives_off(reading, before=self._before or reading)
            self._off, self._before = self._off + 1 if off else 0, reading
            if self._off == ASTRAY:
                return (
                    f"{STOPPED}the bench drives its motor with {reading.duty} duty counts where it "
                    f"was told {reading.target}, at {1e-3 * reading.ms:.3f} s"
                )
        now = time.monotonic()
        if now - self._forwarded > _FORWARD:
            self._forwarded = now
            self.forward(())
        return ""

    def forward(self, batch: Sequence[Reading]) -> None:
        """Hand on what waits, and this."""
        waiting, self._batch = [*self._batch, *batch], []
        if waiting:
            self._observer.readings(waiting, self._stream.anomalies())


class RestTail:
    """The last lines of a rest."""

    def __init__(self, *, since: float) -> None:
        self._since = since
        self._readings: list[Reading] = []

    def keep(self, batch: Sequence[Reading]) -> str:
        """Keep what is late enough; nothing is wrong with it."""
        self._readings += [reading for reading in batch if reading.ms >= self._since]
        return ""

    @property
    def swings(self) -> list[int]:
        """How far each encoder went, counts."""
        columns = zip(*(reading.counts for reading in self._readings), strict=True)
        return [max(column) - min(column) for column in columns]
