"""Find recordings that are not what they should be: a wrong input, a truncated file or a copy."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.identify.fault import SAME, WITNESSES, RecordingFault
from pipeline.ingest.inspect import is_stepped, line_frequency
from pipeline.results import Record


def find_other_kinds(
    records: Sequence[Record], *, files: Mapping[str, str]
) -> dict[str, RecordingFault]:
    """Return the records that are not a complete recording of their kind, by id.

    `files` has the digest of each data file.
    """
    largest = max((float(np.abs(r.u).max()) for r in records if r.u is not None), default=0.0)
    first: dict[str, str] = {}
    found: dict[str, RecordingFault] = {}
    for record in records:
        original = first.setdefault(files.get(record.source, record.source), record.source)
        if original != record.source:
            details = {"source": record.source, "original": original}
            found[record.id] = RecordingFault(code="copied_file", run=record.id, details=details)
        for fault in (*_another_input(record, largest=largest), *_cut(record, records)):
            found.setdefault(record.id, fault)
    return found


def _another_input(record: Record, *, largest: float) -> Iterator[RecordingFault]:
    u = record.u
    if u is None:
        return
    if record.kind == "step" and not (np.any(u) and is_stepped(u)):
        yield RecordingFault(code="no_step", run=record.id)
    if record.kind == "sine" and not _is_sine(record.t, u):
        yield RecordingFault(code="no_sine", run=record.id)
    if record.kind == "decay" and float(np.ptp(u[u.size // 2 :])) > 1e-3 * largest:
        yield RecordingFault(code="driven_decay", run=record.id)


def _is_sine(t: Array, u: Array) -> bool:
    return bool(np.ptp(u) > 0) and line_frequency(t, u) is not None


def _cut(record: Record, records: Sequence[Record]) -> Iterator[RecordingFault]:
    """Yield a fault if most similar records have one length, and this one less than half of it.

    Recordings that a person stops by hand differ in duration, so they are not compared. A
    truncated file must also have fewer samples; otherwise its clock may just be in another unit.
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
    alike = np.abs(lengths - usual) <= SAME * usual
    samples = float(np.median([r.t.size for r in others] or [0]))
    length = float(record.t[-1] - record.t[0])
    if alike.sum() < max(WITNESSES, len(others) / 2):
        return
    if length < 0.5 * usual and record.t.size < 0.5 * samples:
        details = {"length": f"{length:.3g}", "usual": f"{usual:.3g}"}
        yield RecordingFault(code="cut", run=record.id, details=details)
