"""Recordings that do not hold what they should: left out, clipped, or at another frequency."""

from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.checks.channels import late_experiments
from pipeline.checks.recordings import SCALES, why_other_frequency
from pipeline.grading import limits
from pipeline.grading.references.reference import is_explained
from pipeline.ingest.channels import saturation
from pipeline.ingest.inspect import line_frequency
from pipeline.results import Analysis, Record
from pipeline.schemas.grade import Flag


def bad_runs(analysis: Analysis) -> dict[str, str]:
    """Return the runs that do not hold what they should, each with what is wrong, in words."""
    found = dict(analysis.unreadable)
    found |= {one.experiment: one.reason for one in analysis.left_out if one.is_wrong}
    setups = {
        check.id.partition(".")[2]: check.message.split(": ", 1)[-1]
        for check in analysis.checks
        if check.id.partition(".")[0] in ("setup", *SCALES) and check.outcome == "fail"
    }
    late = late_experiments(analysis.late_channels)
    sticky = not is_explained(analysis)
    for record in analysis.records:
        if record.id in setups:
            found[record.id] = setups[record.id]
            continue
        here = [late[record.id]] if record.id in late else []
        for problem in (*_problems(record, sticky=sticky), *here):
            found.setdefault(record.id, problem)
    return found


def data_flag(bad: Mapping[str, str]) -> Flag:
    """Return the flag for the runs that do not hold what they should."""
    first, problem = next(iter(bad.items()))
    others = len(bad) - 1
    have = "run has" if others == 1 else "runs have"
    more = f" ({others} more {have} a problem)" if others else ""
    return Flag(
        code="data_problem",
        parameters=tuple(bad),
        message=f"{first}: {problem.rstrip('.')}{more}.",
        evidence={"problems": dict(bad)},
    )


def _problems(record: Record, *, sticky: bool) -> Iterator[str]:
    for cart in record.carts:
        if cart not in record.free:
            continue
        y = record.position(cart)
        # A cart that sticks rests where it turns, which looks like a clipped reading.
        limit = None if sticky or record.kind not in ("sine", "sweep") else saturation(y)
        if limit is not None:
            yield f"the position of cart {cart} is clipped at {limit:.4g}"
    u = record.u
    if u is None or record.kind == "closed_loop":
        return
    if (limit := saturation(u)) is not None:
        yield f"the input is clipped at {limit:.4g}"
    if record.kind == "sine" and record.omega is not None and np.ptp(u) > 0:
        hertz, stated = line_frequency(record.t, u), record.omega / (2 * np.pi)
        resolution = 1.0 / float(record.t[-1] - record.t[0])
        if hertz is not None and abs(hertz - stated) > max(limits.OTHER_RUN * stated, resolution):
            why = why_other_frequency(stated / hertz) or "is it the file of another experiment?"
            yield f"the input has {hertz:.3g} Hz, {stated:.3g} Hz is stated: {why}"
