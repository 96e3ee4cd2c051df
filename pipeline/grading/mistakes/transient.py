"""The mistake of reading amplitudes before the steady state, and fitting a table to them."""

from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.grading import limits
from pipeline.grading.mistakes.catalogue import Mistake
from pipeline.grading.reference import Reference
from pipeline.names import read_name
from pipeline.results import Analysis, FrequencyResponse, Record

Reading = Callable[[Record, Array], float]


def transient_fits(
    analysis: Analysis, table: Mapping[str, Decimal], known: Mapping[str, Reference]
) -> list[Mistake]:
    """Return the mistakes of reading amplitudes too early, one for each way to do so."""
    runs = {r.id: r for r in analysis.records if r.kind == "sine" and r.u is not None}
    if analysis.fit is None or not runs or len(runs) < len(analysis.sine_points) / analysis.bench.n:
        return []
    found = []
    for reading in early_readings():
        predicted = _refit(analysis, runs, reading)
        moved = {
            name: r
            for name, r in predicted.items()
            if name in known and known[name].low > 0 and _is_new(name, r.value / known[name].value)
        }
        asked = [name for name in moved if name in table]
        if asked:
            found.append(
                Mistake(
                    codes=("transient_used",),
                    predicted=moved,
                    tolerance=0.06,  # relative; a student's fit may weigh the points differently
                    advice_keys=("early",),
                    # No parameters fit such amplitudes exactly, so not every number of the table
                    # matches.
                    least=max(2, round(0.65 * len(asked))),
                    table_wide=True,
                    from_time_records=True,
                )
            )
    return found


def _is_new(name: str, ratio: float) -> bool:
    # If the mistake changes a number less than this, the right number would match too.
    return abs(np.log(ratio)) > np.log1p(0.5 if read_name(name).is_damping else 0.12)


def early_readings() -> Iterator[Reading]:
    """Yield functions that read an amplitude too early from a dwell."""
    yield lambda record, y: float(np.max(np.abs(y - np.median(y))))
    for cycles in (1.0, 2.0, 3.0, 5.0):
        yield lambda record, y, cycles=cycles: _half_swing(record, y, cycles=cycles)


def _half_swing(record: Record, y: Array, *, cycles: float) -> float:
    """Return half the distance from the lowest to the highest point in the first cycles."""
    end = record.t[0] + cycles * 2 * np.pi / (record.omega or np.inf)
    first = y[record.t <= end]
    return float(np.ptp(first)) / 2


def _refit(
    analysis: Analysis, runs: Mapping[str, Record], reading: Reading
) -> dict[str, Reference]:
    """Return the parameters fitted to amplitudes that `reading` gives; empty if the fit fails."""
    responses = []
    for response in analysis.frequency_responses:
        points = [
            (p.omega, reading(runs[p.experiment], runs[p.experiment].position(p.cart)), p)
            for p in analysis.sine_points
            if p.cart == response.cart and p.experiment in runs and runs[p.experiment].omega
        ]
        if not points or response.source != "dwells":
            return {}
        points.sort(key=lambda point: point[0])
        magnitude = np.array([amplitude / p.input_amplitude for _, amplitude, p in points])
        if not np.all(magnitude > 0):
            return {}
        responses.append(
            FrequencyResponse(
                cart=response.cart,
                omega=np.array([omega for omega, _, _ in points]),
                magnitude=magnitude,
                magnitude_std=0.01 * magnitude,
                phase=None,
                phase_std=None,
                source="table",
            )
        )
    assert analysis.fit is not None
    chain = analysis.fit.chain
    try:
        fit = fit_bode(responses, bench=analysis.bench, near=chain)
    except DataError:
        return {}
    references = {}
    for name, estimate in fit.parameters.items():
        if estimate.value <= 0:
            continue
        slack = limits.DAMPING if read_name(name).is_damping else 0.0
        reference = Reference.at(estimate.value, source="transient")
        references[name] = reference.widened(1 + slack)
    return references
