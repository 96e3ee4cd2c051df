"""Recordings of another experiment: an input of another kind, a file that is cut or a copy."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.identify import limits
from pipeline.ingest.inspect import is_stepped, line_frequency
from pipeline.results import LeftOut, Record


def find_other_kinds(records: Sequence[Record], *, files: Mapping[str, str]) -> dict[str, LeftOut]:
    """Return the records that are no whole recording of the kind stated, by id.

    `files` has the digest of each data file.
    """
    largest = max((float(np.abs(r.u).max()) for r in records if r.u is not None), default=0.0)
    first: dict[str, str] = {}
    found: dict[str, LeftOut] = {}
    for record in records:
        original = first.setdefault(files.get(record.source, record.source), record.source)
        for reason in (
            *([f"{record.source} is a copy of {original}"] if original != record.source else ()),
            *_another_input(record, largest=largest),
            *_cut(record, records),
        ):
            one = LeftOut(experiment=record.id, reason=reason, is_wrong=True)
            found.setdefault(record.id, one)
    return found


def _another_input(record: Record, *, largest: float) -> Iterator[str]:
    u = record.u
    if u is None:
        return
    if record.kind == "step" and not (np.any(u) and is_stepped(u)):
        yield "the input is no step: it looks like the file of another experiment"
    if record.kind == "sine" and not _is_sine(record.t, u):
        yield "the input is no sine: it looks like the file of another experiment"
    if record.kind == "decay" and float(np.ptp(u[u.size // 2 :])) > limits.DRIVEN_DECAY * largest:
        yield "the input is at work in what should be a free decay"


def _is_sine(t: Array, u: Array) -> bool:
    return bool(np.ptp(u) > 0) and line_frequency(t, u) is not None


def _cut(record: Record, records: Sequence[Record]) -> Iterator[str]:
    """Yield that a file looks cut: its repeats run for one and the same time, and longer.

    Whoever stops by hand stops anywhere. A repeat whose clock is in another unit lasts long with
    no more samples.
    """
    if record.kind not in ("decay", "step"):
        return
    others = [
        other
        for other in records
        if (other.kind, other.free) == (record.kind, record.free) and other is not record
    ]
    lengths = np.array([r.t[-1] - r.t[0] for r in others])
    usual = float(np.median(lengths)) if others else 0.0
    alike = np.abs(lengths - usual) <= limits.SAME * usual
    samples = float(np.median([r.t.size for r in others] or [0]))
    length = float(record.t[-1] - record.t[0])
    if alike.sum() < max(limits.WITNESSES, len(others) / 2):
        return
    if length < limits.CUT_LENGTH * usual and record.t.size < limits.CUT_LENGTH * samples:
        yield f"it lasts {length:.3g} s, its repeats {usual:.3g} s: the file looks cut"
