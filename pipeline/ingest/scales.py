"""Numbers too large for the unit they are said to be in: counts for a length, millivolts for volts.

The carts that such records give explain them as well as the right ones: only every gain is off.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from pipeline.ingest.columns import conversion
from pipeline.results import Check, Record
from pipeline.submission import System

SCALES = POSITION_SCALE, INPUT_SCALE = "position_scale", "input_scale"  # then the record's id
_LONGEST = 3.0  # m from end to end: no bench has so long a track
_LONGEST_WHOLE = 0.5  # … for one that is read to whole numbers alone, as counts are
_LARGEST = 100.0  # V: no amplifier at a bench gives as much


def check_scales(records: Sequence[Record], *, system: System) -> list[Check]:
    """Return a failed check for the positions and for the input, where no bench reaches so far."""
    return [*_positions(records, system=system), *_inputs(records, system=system)]


def _positions(records: Sequence[Record], *, system: System) -> list[Check]:
    unit = system.position.unit
    metres = conversion(unit, "m")
    travel, run = _reached((r, float(np.ptp(r.y, axis=1).max())) for r in records)
    if metres is None:
        return []
    whole = all(np.array_equal(record.y, np.round(record.y)) for record in records)
    limit = (_LONGEST_WHOLE if whole else _LONGEST) / metres
    if travel <= limit:
        return []
    why = "in whole numbers only" if whole else "further than a bench is long"
    return [
        Check(
            id=f"{POSITION_SCALE}.{run}",
            outcome="fail",
            value=travel,
            limit=limit,
            message=f"{run}: the positions run through {travel:.4g} {unit}, {why}: these "
            "look like encoder counts, and every static gain is in them. Multiply them by the "
            "length of a count; or head the columns `Encoder 1 Pos` … and state position = "
            f"{{ unit = {unit!r}, per_count = … }}; or state position = {{ unit = 'count' }}.",
        )
    ]


def _inputs(records: Sequence[Record], *, system: System) -> list[Check]:
    unit = system.input.unit
    volts = conversion(unit, "V")
    # Under feedback a bench may log another signal as its input.
    driven = [(r, r.u) for r in records if r.u is not None and r.kind != "closed_loop"]
    largest, run = _reached((r, float(np.abs(u).max())) for r, u in driven)
    if volts is None or largest * volts <= _LARGEST:
        return []
    return [
        Check(
            id=f"{INPUT_SCALE}.{run}",
            outcome="fail",
            value=largest,
            limit=_LARGEST / volts,
            message=f"{run}: the input reaches {largest:.4g} {unit}, more than a bench's amplifier "
            "gives, and every static gain is off as much: is it in mV, or in counts? Head the "
            f"column `input [mV]`, or state input = {{ unit = {unit!r}, per_count = … }}.",
        )
    ]


def _reached(reaches: Iterable[tuple[Record, float]]) -> tuple[float, str]:
    """Return how far two kinds of experiment reach, and where: one alone may be a slip."""
    by_kind: dict[str, tuple[float, str]] = {}
    for record, reach in reaches:
        by_kind[record.kind] = max(by_kind.get(record.kind, (0.0, "")), (reach, record.id))
    return sorted(by_kind.values())[-2:][0] if by_kind else (0.0, "")
