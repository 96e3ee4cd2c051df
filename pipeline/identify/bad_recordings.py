"""List every recording with a fault: left out, clipped, or not as stated."""

from collections.abc import Iterator

import numpy as np

from pipeline.identify.fault import RecordingFault, say, valid_records
from pipeline.identify.late_channels import late_experiments
from pipeline.identify.stated import find_other_scales, find_wrong_setups, why_other_frequency
from pipeline.ingest.channels import saturation
from pipeline.ingest.inspect import line_frequency
from pipeline.results import Analysis, Record

# Relative difference between a stated frequency and that of the input. A larger one means that the
# file belongs to another run.
_OTHER_RUN = 0.08


def find_bad_recordings(analysis: Analysis) -> dict[str, str]:
    """Return the recordings with a fault, each with the fault in words."""
    found = dict(analysis.unreadable)
    found |= {one.experiment: one.reason for one in analysis.left_out if one.is_wrong}
    sound = valid_records(analysis.records, analysis.left_out)
    setups = {
        fault.run: fault.reason
        for fault in (
            *find_other_scales(sound, bench=analysis.bench),
            *find_wrong_setups(analysis.records),
        )
    }
    late = late_experiments(analysis.late_channels)
    # A cart that sticks rests at its turning points, which looks like a clipped reading.
    sticky = analysis.fit is not None and not analysis.fit.explains_data
    for record in analysis.records:
        if record.id in setups:
            found[record.id] = setups[record.id]
            continue
        here = [late[record.id]] if record.id in late else []
        reasons = (fault.reason for fault in _channels_at_fault(record, sticky=sticky))
        for problem in (*reasons, *here):
            found.setdefault(record.id, problem)
    return found


def _channels_at_fault(record: Record, *, sticky: bool) -> Iterator[RecordingFault]:
    """Yield a fault for each clipped channel, and for an input with a wrong frequency."""
    for cart in record.carts:
        if cart not in record.free or sticky or record.kind not in ("sine", "sweep"):
            continue
        if (limit := saturation(record.position(cart))) is not None:
            details = {"limit": f"{limit:.4g}"}
            yield RecordingFault(code="clipped_position", run=record.id, cart=cart, details=details)
    u = record.u
    if u is None or record.kind == "closed_loop":
        return
    if (limit := saturation(u)) is not None:
        yield RecordingFault(code="clipped_input", run=record.id, details={"limit": f"{limit:.4g}"})
    if record.kind == "sine" and record.omega is not None and np.ptp(u) > 0:
        hertz, stated = line_frequency(record.t, u), record.omega / (2 * np.pi)
        resolution = 1.0 / float(record.t[-1] - record.t[0])
        if hertz is not None and abs(hertz - stated) > max(_OTHER_RUN * stated, resolution):
            look = why_other_frequency(stated / hertz) or say("frequency_of_another")
            details = {"found": f"{hertz:.3g}", "stated": f"{stated:.3g}", "look": look}
            yield RecordingFault(code="other_frequency", run=record.id, details=details)
