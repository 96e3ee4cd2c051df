"""Choose the records that identify the carts: those that show what happened."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

from pipeline.errors import DataError
from pipeline.estimation.record_fit import RecordFit, most_are_consistent, record_fits
from pipeline.identify.carts import Identified, identify
from pipeline.identify.encoders import find_other_units, find_stuck
from pipeline.identify.model_contradictions import (
    find_faults,
    find_impossible_gains,
    standing_still,
)
from pipeline.identify.other_kind import find_other_kinds
from pipeline.identify.repeats import find_outlier_repeats
from pipeline.ingest.read import Ingested
from pipeline.plant.chain import Chain
from pipeline.results import Intervention, LeftOut
from pipeline.setup import Setup
from pipeline.stages.bode_fit import fit_bode
from pipeline.words.progress import Progress

_ROUNDS = 4  # In each round, the used records may show that others are wrong


def identify_with_rejection(
    data: Ingested,
    *,
    interventions: Sequence[Intervention],
    bench: Setup,
    progress: Progress,
) -> tuple[Identified, list[LeftOut]]:
    """Identify the carts; leave out records that contradict these carts or their own repeats.

    A record with a constant reading is used only if carts identified from the other records would
    have this reading too.
    """
    driven = [r for r in data.records if r.kind in ("step", "sweep")]
    # Faults that input or encoder show by themselves are kept, because later rounds do not see
    # their records.
    shown = {
        **find_other_units(data.records),
        **find_stuck(data.records),
        **find_other_kinds(data.records, files=data.files),
    }
    contradicted = []
    chain: Chain | None = None
    fits: Mapping[str, RecordFit] = {}
    left_out = find_outlier_repeats(driven, unit=bench.units.position) | shown
    without = left_out.keys() | standing_still(data.records)
    again = partial(
        identify,
        data,
        interventions=interventions,
        bench=bench,
        progress=progress,
        measured={},
    )
    found = again(without=without)
    for _ in range(_ROUNDS):
        # If too few records remain to identify the carts, the earlier result is kept.
        chain, fits = _reference_chain(found, data, bench=bench) or (chain, fits)
        faults = find_faults(data.records, chain=chain, fits=fits)
        shown |= find_impossible_gains(found.gains)
        shown |= {**found.repeats.odd, **found.fitted.conflict}
        # Search for odd repeats only among good records, because otherwise most repeats may be
        # wrong.
        sound = [record for record in driven if record.id not in faults]
        odd = find_outlier_repeats(sound, unit=bench.units.position)
        # A fault that says how a record is wrong has priority over a fault that only calls it odd.
        doubted = {name: one for name, one in faults.items() if not one.is_wrong}
        left_out = {**odd, **doubted, **shown, **{n: f for n, f in faults.items() if f.is_wrong}}
        if left_out.keys() == without:
            break
        without = left_out.keys()
        contradicted += [
            check
            for check in found.repeats.checks
            if check.outcome == "fail" and check.parameter not in found.repeats.undecided
        ]
        found = again(without=without)
    checks = {check.id: check for check in (*found.repeats.checks, *contradicted)}
    repeats = replace(found.repeats, checks=tuple(checks.values()))
    return (
        replace(found, repeats=repeats),
        [left_out[record.id].left_out for record in data.records if record.id in left_out],
    )


def _reference_chain(
    found: Identified, data: Ingested, *, bench: Setup
) -> tuple[Chain, Mapping[str, RecordFit]] | None:
    """Return the chain that the records follow, and how each record follows it.

    If a chain explains the data only after two columns are swapped, it is returned.
    """
    if found.fit and found.fit.converged and most_are_consistent(found.fitted.fits):
        return found.fit.chain, found.fitted.fits
    for i, j in combinations(sorted(response.cart for response in found.responses), 2):
        turned = [replace(r, cart={i: j, j: i}.get(r.cart, r.cart)) for r in found.responses]
        try:
            fit = fit_bode(sorted(turned, key=lambda response: response.cart), bench=bench)
        except DataError:
            continue
        if fit.explains_data:
            return fit.chain, record_fits(data.records, fit.chain)
    if found.fit is None or not found.fit.converged:
        return None
    return found.fit.chain, found.fitted.fits
