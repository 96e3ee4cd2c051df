"""Turn chunks of bytes into lines, and count every fault on the way.

A line is judged when the next line has arrived. The bench's clock never runs backwards, and no cart
jumps out and back within two lines. So a readable line that differs from both neighbours was
garbled. This delays each line by one but loses no valid line.
"""

from array import array
from collections.abc import Iterable, Sequence

import numpy as np

from pipeline.bench.events import Anomalies
from pipeline.bench.stamps import StampFit, even_period, fit_stamps
from pipeline.protocol import FULL_SCALE, Reading, parse_reading

# _WINDOW is in ms, _DRIVEN in duty counts. An encoder is stuck if it moved in one window and stands
# still in the next, although the motor still drives. Below _DRIVEN, carts may stand still. If the
# motor drives, an encoder that never moved is stuck if it is on cart 1 or if another cart moves.
_WINDOW, _DRIVEN = 1000, 8


class Stream:
    """The valid lines of one run, and the number of faults.

    Parameters
    ----------
    encoders : number of encoder counts in a line.
    period : expected ms between lines.
    stated : whether the bench itself stated the period.
    free : carts that can move; their encoders are watched.
    closed : whether the loop is closed. Then the duty may jump for a single line when an encoder
        flickers.

    Attributes
    ----------
    broken : the fault of the bench's clock that ended the run; otherwise "".
    """

    def __init__(
        self,
        *,
        encoders: int,
        period: float = 1.0,
        stated: bool = False,
        free: Sequence[int] = (),
        closed: bool = False,
    ) -> None:
        self._encoders = encoders
        self._stated = stated
        self._closed = closed
        self._expected = period
        self._tail = b""
        self._before: Reading | None = None  # the last line that was returned
        self._held: Reading | None = None  # waits for the next line, to be judged
        self._stamps = array("q")
        self._missing = _MissingSoFar(period)
        self._garbled = 0
        # Lines lost to garbling; two merged lines are one garbled line but two lost ones.
        self._garbled_lines = 0
        self._late = 0
        self._resets = 0
        self.broken = ""
        # The smallest difference between arrival and time stamp, in s: in the last second, and in
        # the current one.
        self._lead, self._new_lead, self._lead_from = float("inf"), float("inf"), float("-inf")
        self._watch = _EncoderWatch(cart for cart in free if cart <= encoders)

    @property
    def lines(self) -> int:
        """The number of valid lines so far."""
        return len(self._stamps)

    @property
    def latest(self) -> int:
        """The time stamp of the newest line in ms, even if not yet judged; -1 before any line."""
        newest = self._held or self._before
        return -1 if newest is None else newest.ms

    @property
    def widest(self) -> int:
        """The range in counts of the free cart that moved most."""
        return self._watch.widest

    def fit(self) -> StampFit:
        """Return the clock that explains the time stamps.

        This takes too long to be done during a run.
        """
        return fit_stamps(np.array(self._stamps), period=self._expected, stated=self._stated)

    def anomalies(self, fit: StampFit | None = None) -> Anomalies:
        """Return all faults so far.

        Parameters
        ----------
        fit : the clock of the complete run; without it, the number of lost lines is an estimate.
        """
        missing = self._missing.lines if fit is None else fit.missing
        return Anomalies(
            lost=max(0, missing - self._garbled_lines),
            garbled=self._garbled,
            late=self._late,
            resets=self._resets,
            stuck=self._watch.stuck,
        )

    def feed(self, data: bytes, *, since: float, now: float) -> list[Reading]:
        """Return the lines that are now known to be valid.

        Parameters
        ----------
        data : new bytes from the port.
        since : time in s when the port was last found empty. Data that waited while this computer
            was busy do not count as late.
        now : current time in s, from the same clock as `since`.
        """
        *lines, self._tail = (self._tail + data).split(b"\n")
        if len(self._tail) > 512:  # bytes without a line end are noise
            lines.append(self._tail)
            self._tail = b""
        valid: list[Reading] = []
        for line in lines:
            reading = self._read(line)
            if reading is not None:
                valid += self._judge(reading)
                self._time(reading, since=since, now=now)
        self._watch.see(valid)
        return valid

    def finish(self) -> list[Reading]:
        """Return the last line of the run, which no later line can confirm."""
        last, self._held = self._held, None
        if last is None or (self._before is not None and last.ms < self._before.ms):
            return []
        self._keep(last)
        self._watch.see([last])
        return [last]

    def _read(self, line: bytes) -> Reading | None:
        if not line.strip():
            return None
        reading = parse_reading(line)
        if (
            reading is None
            or len(reading.counts) != self._encoders
            or abs(reading.duty) > FULL_SCALE
        ):
            whole = round(line.count(b":") / (self._encoders + 2))
            self._reject(lines=max(1, whole))
            return None
        return reading

    def _reject(self, *, lines: int = 1) -> None:
        self._garbled += 1
        self._garbled_lines += lines

    def _judge(self, after: Reading) -> list[Reading]:
        """Return the waiting line if its neighbours confirm it; the new line then waits."""
        if self.broken:
            return []
        before, held, self._held = self._before, self._held, after
        if held is None:
            return []
        last = 0 if before is None else before.ms
        if before is None and after.ms < held.ms:  # left over from an earlier run, or garbled
            self._reject()
            return []
        if held.ms < last and after.ms < last and after.ms >= held.ms:
            self._resets += 1
            return self._break(
                "the bench restarted during the recording: check its supply and its reset line"
            )
        if before is not None and _stands_out(before, held, after, closed=self._closed):
            self._reject()
            return []
        if held.ms - last > 1000:
            return self._break(
                f"the bench's time stamps jump from {1e-3 * last:.3f} to {1e-3 * held.ms:.3f} s: "
                "its clock jumped, or no line came for a second"
            )
        self._keep(held)
        if self.lines > 500:
            went_on = held.ms - self._stamps[-501]
            # If 500 lines take half of the expected time, the true period may be shorter. If they
            # take less than a quarter, the clock is at fault.
            if went_on < 0.25 * 500 * self._expected:
                self._break(f"the bench's clock hardly moves: {went_on} ms in 500 lines")
        return [held]

    def _break(self, why: str) -> list[Reading]:
        """End the run because of a fault of the clock."""
        self.broken, self._held = why, None
        return []

    def _keep(self, reading: Reading) -> None:
        self._before = reading
        self._stamps.append(reading.ms)
        self._missing.tick(reading.ms)

    def _time(self, reading: Reading, *, since: float, now: float) -> None:
        due = 1e-3 * reading.ms
        if now - self._lead_from > 1.0:  # s; compare the clocks of bench and computer again
            self._lead, self._new_lead, self._lead_from = self._new_lead, now - due, now
        self._new_lead = min(self._new_lead, now - due)
        # A line is late if it comes more than 0.02 s later than the earliest lines of the last
        # second.
        self._late += since - due > min(self._lead, self._new_lead) + 0.02


def _stands_out(before: Reading, held: Reading, after: Reading, *, closed: bool) -> bool:
    """Return whether a line contradicts both neighbours although the neighbours agree."""
    if before.ms <= after.ms and not before.ms <= held.ms <= after.ms:
        return True
    if held.ms < before.ms:
        return True
    # A cart that hits an end stop moves by at most 32 counts in 1 ms.
    room = 32 * max(1, after.ms - before.ms)
    signals = [*zip(before.counts, held.counts, after.counts, strict=True)]
    signals.append((before.target, held.target, after.target))
    if not closed:
        signals.append((before.duty, held.duty, after.duty))
    return any(abs(2 * b - a - c) > 2 * (room + 2 * abs(c - a)) for a, b, c in signals)


class _MissingSoFar:
    """An estimate of the missing lines, second by second.

    Even if no line is lost, the time stamps skip a value now and then. If a regular clock explains
    all stamps of one second, no line is missing in that second. The period of this clock is then
    used for later seconds. Until then, the smallest mean spacing serves as the period, because lost
    lines only increase the spacing.
    """

    def __init__(self, period: float) -> None:
        self._expected = self._period = period
        self._seen_even = False
        self._stamps: list[int] = []
        self.lines = 0

    def tick(self, ms: int) -> None:
        """Record the time stamp of a line, in ms."""
        self._stamps.append(ms)
        span, count = ms - self._stamps[0], len(self._stamps) - 1
        if span < _WINDOW or not count:
            return
        if (even := even_period(np.array(self._stamps))) is not None:
            self._period, self._seen_even = even, True
        else:
            measured = span / count
            # Relative deviation that is plausible for a clock.
            near = abs(measured / self._expected - 1) < 0.005
            first = self._period == self._expected
            if near and not self._seen_even and (first or measured < self._period):
                self._period = measured
            self.lines += max(0, round(span / self._period) - count)
        self._stamps = [ms]


class _EncoderWatch:
    """Notice encoders that stand still although the motor drives."""

    def __init__(self, carts: Iterable[int]) -> None:
        self._encoders = [cart - 1 for cart in carts]
        self._ranges: dict[int, _Range] = {encoder: _Range() for encoder in self._encoders}
        self._duty = _Range()
        self._start = 0
        self._earlier: tuple[dict[int, int], int] | None = None
        self._overall: dict[int, _Range] = {encoder: _Range() for encoder in self._encoders}
        self._driven = _Range()
        self._frozen: set[int] = set()

    @property
    def stuck(self) -> int:
        """The number of encoders that stopped while driven, or never moved but should have."""
        moved = {encoder: seen.width for encoder, seen in self._overall.items()}
        pushed = self._driven.width >= _DRIVEN
        never = {
            encoder
            for encoder, width in moved.items()
            if width == 0
            and pushed
            and (encoder == 0 or max(moved.values()) >= 200)
            and self._earlier is not None  # a run shorter than a window proves nothing
        }
        return len(self._frozen | never)

    @property
    def widest(self) -> int:
        """The largest range of any watched encoder, in counts."""
        return max((seen.width for seen in self._overall.values()), default=0)

    def see(self, readings: Sequence[Reading]) -> None:
        """Record valid lines, in order."""
        if not readings:
            return
        for encoder in self._encoders:
            counts = [reading.counts[encoder] for reading in readings]
            self._ranges[encoder].widen(counts)
            self._overall[encoder].widen(counts)
        duties = [reading.duty for reading in readings]
        self._duty.widen(duties)
        self._driven.widen(duties)
        if readings[-1].ms - self._start >= _WINDOW:
            self._close(readings[-1].ms)

    def _close(self, ms: int) -> None:
        widths = {encoder: seen.width for encoder, seen in self._ranges.items()}
        duty = self._duty.width
        if self._earlier is not None:
            earlier, earlier_duty = self._earlier
            if duty >= max(_DRIVEN, earlier_duty / 2):
                self._frozen |= {
                    encoder
                    for encoder, width in widths.items()
                    if width == 0 and earlier[encoder] >= 20
                }
        self._earlier, self._start = (widths, duty), ms
        self._ranges = {encoder: _Range() for encoder in self._encoders}
        self._duty = _Range()


class _Range:
    """The range of some integers."""

    def __init__(self) -> None:
        self._low: int | None = None
        self._high = 0

    @property
    def width(self) -> int:
        """The largest integer minus the smallest; 0 before the first integer."""
        return 0 if self._low is None else self._high - self._low

    def widen(self, values: Sequence[int]) -> None:
        """Include more integers."""
        low, high = min(values), max(values)
        self._high = high if self._low is None else max(self._high, high)
        self._low = low if self._low is None else min(self._low, low)
