"""Find recordings that contradict their description: free carts, units, frequencies."""

from collections.abc import Iterable, Sequence

import numpy as np

from pipeline.estimation.record_fit import TIME_UNITS
from pipeline.identify.fault import SAME, RecordingFault, say
from pipeline.ingest.formats.headings import conversion
from pipeline.results import Record
from pipeline.setup import Setup

OTHER_DWELL = 0.1  # relative; a dwell this far from its stated frequency is another dwell
# Share of a held cart's swing. If a cart that should be free moves less, it is not free.
LEAST_SHARE = 0.2
# Share of the free carts' swing. A cart that is held firmly moves less.
_HELD_FIRMLY = 0.05
_LONGEST = 3.0  # metres; no bench has a longer track
_LONGEST_SLOW = 20.0  # metres; the limit if nothing moves faster than a person runs
_SLOW = 10.0  # metres per second
_LONGEST_WHOLE = 0.5  # metres; the limit if all readings are whole numbers, as counts are
_ECP_STEP = 2.27e-5  # metres per count of the encoders of an ECP 210
_LARGEST = 100.0  # volts; no amplifier at a bench gives as much
_ECP_LARGEST = 10.5  # volts; the converter of an ECP 210 gives 10, and files round
# Volts. A converter of 16 bits and ± 10 V has steps of 0.3 mV.
_LEAST = 1e-3


def swings(record: Record) -> tuple[float, dict[int, float]]:
    """Return the largest swing of the free carts, and the swing of each held cart.

    If no free cart was measured, the held ones are left out.
    """
    swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
    free = [swing.pop(cart) for cart in record.carts if cart in record.free]
    return (max(free), swing) if free else (0.0, {})


def find_wrong_setups(records: Sequence[Record]) -> list[RecordingFault]:
    """Find the records in which a cart that should be held moves, but the free carts do not."""
    found = []
    for record in records:
        free, held = swings(record)
        mover = max(held, key=lambda cart: held[cart], default=0)
        if mover and free < LEAST_SHARE * held[mover]:
            fault = RecordingFault(
                code="wrong_setup",
                run=record.id,
                cart=mover,
                details={"free": ", ".join(map(str, record.free))},
                value=held[mover] / free if free > 0 else None,
                limit=1 / LEAST_SHARE,
            )
            found.append(fault)
    return found


def find_loose_holds(records: Sequence[Record]) -> list[RecordingFault]:
    """Find carts that should be held but move much compared with the free ones."""
    found = []
    for record in records:
        free, held = swings(record)
        for cart, swing in held.items():
            if _HELD_FIRMLY * free < swing <= free:
                share = swing / free
                fault = RecordingFault(
                    code="moves_though_held",
                    run=record.id,
                    cart=cart,
                    details={"percent": f"{100 * share:.0f}"},
                    value=share,
                    limit=_HELD_FIRMLY,
                )
                found.append(fault)
    return found


def find_other_scales(records: Sequence[Record], *, bench: Setup) -> list[RecordingFault]:
    """Find positions or inputs of a size that no bench has, and so must be in another unit.

    Examples are counts in place of a length, and millivolts in place of volts. A fit to such
    records looks as good as a fit to right ones; only the gains are wrong.
    """
    found = []
    unit, metres = bench.units.position, conversion(bench.units.position, "m")
    travel, run = _reached((r, float(np.ptp(r.y, axis=1).max())) for r in records)
    whole = all(np.array_equal(record.y, np.round(record.y)) for record in records)
    speeds = [np.abs(np.diff(r.y) / np.diff(r.t)).max(initial=0.0) for r in records]
    longest = _LONGEST_SLOW if max(speeds, default=0.0) * (metres or 0.0) < _SLOW else _LONGEST
    if metres and travel > (limit := (_LONGEST_WHOLE if whole else longest) / metres):
        why = say("position_scale_whole" if whole else "position_scale_long")
        details = {"reach": f"{travel:.4g}", "unit": unit, "quoted": repr(unit), "why": why}
        found.append(
            RecordingFault(
                code="position_scale", run=run, details=details, value=travel, limit=limit
            )
        )
    # Under feedback, a bench may log another signal as its input.
    opened = [(r, r.u) for r in records if r.u is not None and r.kind != "closed_loop"]
    driven = [(r, float(np.abs(u).max())) for r, u in opened if np.any(u)]
    largest, run = _reached(driven)
    unit, volts = bench.units.input, conversion(bench.units.input, "V")
    headed = any(one.role == "input" for record in records for one in record.heading_units)
    if not (volts and driven):
        return found
    most, why = _LARGEST, "input_scale_large"
    if not headed and _is_ecp(records, bench=bench):
        most, why = _ECP_LARGEST, "input_scale_ecp"
    beyond = largest * volts / most
    if not headed and max(size for _, size in driven) * volts < _LEAST:
        beyond, why = _LEAST / (largest * volts), "input_scale_small"
    if beyond > 1.0:
        details = {"reach": f"{largest:.4g}", "unit": unit, "why": say(why)}
        found.append(
            RecordingFault(code="input_scale", run=run, details=details, value=beyond, limit=1.0)
        )
    return found


def find_other_steps(records: Sequence[Record], *, bench: Setup) -> RecordingFault | None:
    """Find positions whose encoder step is a power of ten times the known one of an ECP bench."""
    if any(one.role == "position" for record in records for one in record.heading_units):
        return None
    step = _encoder_step(records)
    metres = conversion(bench.units.position, "m") or 0.0
    if not _is_ecp(records, bench=bench) or (scale := _ecp_scale(step * metres)) == 1.0:
        return None
    details = {
        "step": f"{step:.3g}",
        "known": f"{_ECP_STEP / metres:.3g}",
        "unit": bench.units.position,
        "scale": f"{scale:g}",
    }
    return RecordingFault(
        code="other_step", run=records[0].id, details=details, value=scale, limit=1.0
    )


def _is_ecp(records: Sequence[Record], *, bench: Setup) -> bool:
    """Whether the encoder step is that of an ECP 210, in this unit or a power of ten of it."""
    step = _encoder_step(records) * (conversion(bench.units.position, "m") or 0.0)
    # Files round a step to two digits.
    return step > 0 and abs(np.log10(step / _ECP_STEP / _ecp_scale(step))) <= np.log10(1 + SAME)


def _ecp_scale(step: float) -> float:
    return float(10.0 ** round(np.log10(step / _ECP_STEP)))


def _encoder_step(records: Sequence[Record]) -> float:
    """Return the median encoder step; 0 if most channels do not show one."""
    steps = [float(step) for record in records for step in record.resolution]
    seen = [step for step in steps if step > 0]
    return float(np.median(seen)) if seen and 2 * len(seen) >= len(steps) else 0.0


def _reached(reaches: Iterable[tuple[Record, float]]) -> tuple[float, str]:
    """Return the second largest reach among the kinds of experiment, and its record.

    The largest one may be an accident. If there is only one kind, its reach is returned.
    """
    by_kind: dict[str, tuple[float, str]] = {}
    for record, reach in reaches:
        by_kind[record.kind] = max(by_kind.get(record.kind, (0.0, "")), (reach, record.id))
    return sorted(by_kind.values())[-2:][0] if by_kind else (0.0, "")


def why_other_frequency(ratio: float) -> str:
    """Return why the stated frequency may be `ratio` times the true one; "" if unknown."""
    turns = {2 * np.pi: "frequency_in_radians", 1 / (2 * np.pi): "frequency_divided"}
    for factor, key in turns.items():
        if abs(ratio / factor - 1) < OTHER_DWELL:
            return say(key)
    for factor, (unit, short) in TIME_UNITS.items():
        if abs(ratio / factor - 1) < OTHER_DWELL:
            return say("frequency_by_clock", unit=unit, short=short)
    return ""
