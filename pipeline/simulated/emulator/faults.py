"""Deliberate faults on a serial line, inserted into the lines that a bench sends.

A fault is written `KIND=RATE`, `KIND@SECONDS` or, for an encoder, `stuck=ENCODER@SECONDS`. The
first form affects a random share of the lines. The other forms occur once, after the bench
has sent lines for so many seconds, counted over all runs.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.errors import ConfigError
from pipeline.submission.complaints import nearest

HOLD = 0.05  # s of the bench's clock for which a late chunk is held back

KINDS = {
    "drop": "the line never comes",
    "garble": "one character of the line becomes one that no line contains",
    "merge": "the line's end is lost, so the next line follows without a break",
    "delay": f"this line and those after it arrive together, {1e3 * HOLD:g} ms late",
    "reset": "the bench's clock restarts during the run",
    "disconnect": "the cable is pulled: the connection ends",
    "stuck": "from then on the encoder no longer changes",
}
_SYNTAX = re.compile(r"(?P<kind>[a-z]+)(?:=(?P<value>[0-9.e-]+))?(?:@(?P<at>[0-9.]+))?")
_NOISE = b"#?xZ~ \x80\xff"  # no line has these, so a garbled line is always recognised


@dataclass(frozen=True, kw_only=True)
class LineFault:
    """One kind of fault.

    Attributes
    ----------
    rate : share of the lines affected.
    at : time of streaming in s after which the fault occurs once; None for random faults.
    encoder : the encoder that is stuck; 0 for other faults.
    """

    kind: str
    rate: float = 0.0
    at: float | None = None
    encoder: int = 0


def read_fault(text: str) -> LineFault:
    """Read one fault as the user writes it.

    Raises
    ------
    ConfigError : the text is not a fault.
    """
    where = f"--fault {text}"
    match = _SYNTAX.fullmatch(text.strip())
    if match is None:
        raise ConfigError(f"{where}: write KIND=RATE, KIND@SECONDS or stuck=ENCODER@SECONDS")
    kind = match["kind"]
    if kind not in KINDS:
        raise ConfigError(f"{where}: no fault {kind!r}{nearest(kind, list(KINDS))}")
    try:
        value = None if match["value"] is None else float(match["value"])
        at = None if match["at"] is None else float(match["at"])
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from None
    if kind == "stuck":
        if value not in (1, 2, 3):
            raise ConfigError(f"{where}: say which encoder and when, as in stuck=1@5")
        return LineFault(kind=kind, at=at or 0.0, encoder=int(value))
    if (value is None) == (at is None):
        raise ConfigError(f"{where}: give a rate, {kind}=0.01, or a time, {kind}@5")
    if value is not None and not 0 <= value <= 1:
        raise ConfigError(f"{where}: a rate is between 0 and 1")
    return LineFault(kind=kind, rate=value or 0.0, at=at)


class Faults:
    """Applies faults to passing lines, at most one fault per line.

    Parameters
    ----------
    period : s between lines.

    Attributes
    ----------
    injected : number of faults of each kind. `late` counts the lines held back by a delay.
    """

    def __init__(self, faults: Sequence[LineFault] = (), *, seed: int, period: float) -> None:
        self._random = [fault for fault in faults if fault.rate > 0]
        timed = [(fault.at, fault) for fault in faults if fault.at is not None]
        self._timed = sorted(timed, key=lambda entry: entry[0])
        self._rng = np.random.default_rng(seed)
        self.injected: Counter[str] = Counter()
        self._period, self._streamed = period, 0.0  # s
        self._stuck: dict[int, bytes | None] = {}  # frozen readings; None: freeze the next one
        self._ms = -1  # stamp of the last line
        self._clock_began = 0  # ms of the run, at the last reset
        self._open = False  # whether the last line has lost its end
        self._held = bytearray()
        self._until = 0.0  # s of the bench's clock, the end of the hold

    def strike(self, line: bytes, *, clock: float) -> tuple[bytes, str]:
        """Return the bytes to send instead of a line, and the kind of fault ("" if none).

        Parameters
        ----------
        clock : time of the bench's clock, s.
        """
        kind = self._choose()
        self._open = kind == "merge"
        line = self._rewritten(line, reset=kind == "reset")
        if kind == "garble":
            at = int(self._rng.integers(len(line) - 1))
            line = line[:at] + bytes([int(self._rng.choice(list(_NOISE)))]) + line[at + 1 :]
        elif kind == "merge":
            line = line[:-1]
        elif kind == "delay":
            self._until = clock + HOLD
        elif kind in ("drop", "disconnect"):
            line = b""
        if clock < self._until:
            self.injected["late"] += bool(line)
        return self._hold(line, clock=clock), kind

    def idle(self, *, clock: float) -> bytes:
        """Return bytes still due while the bench sends no line: a late chunk, a lost line end."""
        end, self._open = b"\n" * self._open, False
        return self._hold(end, clock=clock)

    def behind(self, data: bytes, *, clock: float) -> bytes:
        """Return the bytes to send now, given an answer; it must not overtake a delayed line."""
        return self._hold(data, clock=clock)

    def _hold(self, data: bytes, *, clock: float) -> bytes:
        """Return the bytes to send now: the held data and the new data, or nothing yet."""
        self._held += data
        if not self._held or clock < self._until:
            return b""
        out = bytes(self._held)
        self._held.clear()
        return out

    def _choose(self) -> str:
        """Return the kind of fault for the next line; "" if none."""
        self._streamed += self._period
        while self._timed and self._timed[0][0] <= self._streamed:
            _, fault = self._timed.pop(0)
            self.injected[fault.kind] += 1
            if not fault.encoder:
                return fault.kind
            self._stuck[fault.encoder] = None
        if self._open or not self._random:  # the line after a lost line end is lost already
            return ""
        draw = self._rng.random()
        for fault in self._random:
            if draw < fault.rate:
                if fault.kind == "delay" and self._held:  # the line is late already
                    return ""
                self.injected[fault.kind] += 1
                return fault.kind
            draw -= fault.rate
        return ""

    def _rewritten(self, line: bytes, *, reset: bool) -> bytes:
        """Return the line as changed by stuck encoders and a restarted clock."""
        *counts, target, duty, stamp = line.rstrip().split(b":")
        ms = int(stamp)
        if reset or ms < self._ms:  # or another run has begun
            self._clock_began = ms if reset else 0
        self._ms = ms
        for encoder, shown in self._stuck.items():
            if encoder <= len(counts):
                self._stuck[encoder] = shown = counts[encoder - 1] if shown is None else shown
                counts[encoder - 1] = shown
        return b":".join([*counts, target, duty, b"%d" % (ms - self._clock_began)]) + b"\n"
