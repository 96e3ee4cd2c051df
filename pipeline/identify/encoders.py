"""Find faults that the encoder alone shows: another unit of length, or a stuck encoder."""

from collections.abc import Sequence

import numpy as np

from pipeline.estimation.record_fit import LENGTH_SCALES, measured
from pipeline.identify.fault import SAME, WITNESSES, RecordingFault
from pipeline.ingest.channels import stuck_spans
from pipeline.results import Record


def find_other_units(
    records: Sequence[Record], *, decays: bool = False
) -> dict[str, RecordingFault]:
    """Find, by id, the records whose encoder step is the usual one converted to another unit.

    The usual step is that of most kinds of experiment, not of most records. A dozen dwells may have
    been exported together, and so may all be wrong. Steps of 0.01 and 0.001 differ only in the
    number of decimals. The unit of a decay does not matter, so decays are searched only if
    `decays` is true, and then nothing else.
    """
    found: dict[str, RecordingFault] = {}
    for cart in sorted({cart for record in records for cart in record.carts}):
        steps = {r.id: r.encoder_step(cart) for r in records if cart in r.carts}
        by_kind = [
            float(np.median(seen))
            for kind in dict.fromkeys(record.kind for record in records)
            if (seen := [s for r in records if r.kind == kind and (s := steps.get(r.id, 0.0))])
        ]
        usual = max(by_kind, key=lambda step: sum(_alike(step, s) for s in by_kind), default=0.0)
        if sum(_alike(step, usual) for step in by_kind) < WITNESSES:
            continue
        scales = [s for scale in LENGTH_SCALES for s in (scale, 1 / scale)]
        for record in [r for r in records if r.id in steps and (r.kind == "decay") is decays]:
            step = steps[record.id]
            if _is_decimal(step) and _is_decimal(usual):
                continue
            for scale in [s for s in scales if _alike(step, s * usual)]:
                details = {"scale": f"{scale:.3g}"}
                fault = RecordingFault(code="other_unit", run=record.id, cart=cart, details=details)
                found.setdefault(record.id, fault)
    return found


def _alike(step: float, other: float) -> bool:
    return abs(step - other) <= SAME * other


def _is_decimal(step: float) -> bool:
    """Whether a step is a power of ten, so that it may come from the number of decimals."""
    return step > 0 and _alike(step, 10.0 ** round(np.log10(step)))


def find_stuck(records: Sequence[Record]) -> dict[str, RecordingFault]:
    """Return the records in which the encoder of a free cart was stuck, by id.

    Static friction stops only a cart that is already slow, and the cart then starts from where it
    stopped. So the encoder was stuck if the reading stops while the cart is fast, or if it jumps
    when it changes again.
    """
    found: dict[str, RecordingFault] = {}
    for record in records:
        for cart in measured(record):
            y = record.position(cart)
            for first, last in stuck_spans(y):
                moves = np.abs(np.diff(y))
                fastest = float(np.quantile(moves, 0.98))
                away = last < moves.size and moves[last] >= 1.5 * fastest
                if away or moves[first - 1] >= 0.6 * fastest:
                    details = {"first": f"{record.t[first]:.4g}", "last": f"{record.t[last]:.4g}"}
                    fault = RecordingFault(code="stuck", run=record.id, cart=cart, details=details)
                    found.setdefault(record.id, fault)
    return found
