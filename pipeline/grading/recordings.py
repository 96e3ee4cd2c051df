"""Recordings that do not hold what they should: stuck, clipped, cut, or another experiment."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from pipeline.grading.grade import Flag
from pipeline.grading.reference import is_explained
from pipeline.ingest.inspect import is_stepped, line_frequency
from pipeline.ingest.problems import saturation
from pipeline.ingest.scales import SCALES
from pipeline.plant.chain import Array
from pipeline.results import Analysis, Record

_FREQUENCY = 0.08  # relative: a stated frequency further from that of the input is another run's
_CUT = 0.5  # of the usual length of the repeats
_DRIVEN = 1e-3  # of the largest input of any run: a decay with more is driven


def bad_runs(analysis: Analysis) -> dict[str, str]:
    """Return the runs that do not hold what they should, each with what is wrong, in words."""
    found = dict(analysis.unreadable)
    found |= {one.experiment: one.reason for one in analysis.left_out if one.is_wrong}
    sound = [record for record in analysis.records if record.id not in found]
    setups = {
        check.id.partition(".")[2]: check.message.split(": ", 1)[-1]
        for check in analysis.checks
        if check.id.partition(".")[0] in ("setup", *SCALES) and check.outcome == "fail"
    }
    sticky = not is_explained(analysis)
    largest = max(
        (float(np.abs(r.u).max()) for r in analysis.records if r.u is not None), default=0
    )
    for record in analysis.records:
        if record.id in setups:
            found[record.id] = setups[record.id]
            continue
        for problem in _problems(record, sound, sticky=sticky, largest=largest):
            found.setdefault(record.id, problem)
    for record, problem in _copies(analysis):
        found.setdefault(record, problem)
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


def _problems(
    record: Record, sound: Sequence[Record], *, sticky: bool, largest: float
) -> Iterator[str]:
    t, u = record.t, record.u
    for cart in record.carts:
        if cart not in record.free:
            continue
        y = record.position(cart)
        # A cart that sticks rests where it turns, which looks like a clipped reading.
        limit = None if sticky or record.kind not in ("sine", "sweep") else saturation(y)
        if limit is not None:
            yield f"the position of cart {cart} is clipped at {limit:.4g}"
    if u is not None and record.kind != "closed_loop":
        yield from _input_problems(record, u, largest=largest)
    siblings = [
        float(other.t[-1] - other.t[0])
        for other in sound
        if other.kind == record.kind and other.free == record.free and other is not record
    ]
    length = float(t[-1] - t[0])
    if record.kind in ("decay", "step") and len(siblings) >= 1:
        typical = float(np.median(siblings))
        if length < _CUT * typical:
            yield f"it lasts {length:.3g} s, its repeats {typical:.3g} s: the file looks cut"


def _input_problems(record: Record, u: Array, *, largest: float) -> Iterator[str]:
    """Yield where the input is not that of the kind of run."""
    if (limit := saturation(u)) is not None:
        yield f"the input is clipped at {limit:.4g}"
    moves = float(np.ptp(u)) > 0
    if record.kind == "step" and not (np.any(u) and is_stepped(u)):
        yield "the input is no step: is it the file of another experiment?"
    if record.kind == "sine":
        hertz = line_frequency(record.t, u) if moves else None
        if hertz is None:
            yield "the input is no sine: is it the file of another experiment?"
        elif record.omega is not None:
            stated = record.omega / (2 * np.pi)
            resolution = 1.0 / float(record.t[-1] - record.t[0])
            if abs(hertz - stated) > max(_FREQUENCY * stated, resolution):
                yield (
                    f"the input has {hertz:.3g} Hz, {stated:.3g} Hz is stated: is it the file of "
                    "another experiment?"
                )
    if record.kind == "decay":
        late = u[u.size // 2 :]
        if float(np.ptp(late)) > _DRIVEN * largest and largest > 0:
            yield "the input is at work in what should be a free decay"


def _copies(analysis: Analysis) -> Iterator[tuple[str, str]]:
    """Yield every run whose file is a copy of another run's."""
    first: dict[str, Record] = {}
    for record in analysis.records:
        digest = analysis.files.get(record.source, record.source)
        original = first.setdefault(digest, record)
        if original.source != record.source:
            yield record.id, f"{record.source} is a copy of {original.source}"
