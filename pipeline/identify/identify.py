"""Identify the carts from the records that show what happened.

Single recordings give estimates, then all recordings are fitted together. Records that contradict
the fitted carts or their own repeats are left out.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise

from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.estimation.decay import fit_log_decrement
from pipeline.estimation.estimates import compare, estimate_initially, undetermined_reason
from pipeline.estimation.force_balance import between
from pipeline.estimation.frequency_response import (
    collect_dwells,
    dwell_fault,
    find_resonances,
    response_from_records,
)
from pipeline.estimation.record_fit import RecordFit, most_are_consistent, record_fits
from pipeline.estimation.sine import Dwell
from pipeline.estimation.static_gain import fit_static_gain
from pipeline.identify.corrections import (
    find_faults,
    find_impossible_gains,
    standing_still,
)
from pipeline.identify.fit import Fitted, Runs, fit_carts
from pipeline.identify.groups import find_setups, steps_disagree
from pipeline.identify.log import Log, Measured
from pipeline.identify.recording_checks import find_shown
from pipeline.identify.repeats import Repeats, compare_repeats, find_outlier_repeats
from pipeline.ingest.read import Ingested
from pipeline.names import parameter_names
from pipeline.plant.chain import Chain
from pipeline.results import (
    ChainFit,
    Estimate,
    Finding,
    FrequencyResponse,
    Intervention,
    LogDecrement,
    ParameterRow,
    Record,
    RecordingGroup,
    SinePoint,
    Skipped,
    Stage,
    StepGain,
)
from pipeline.setup import Setup
from pipeline.words.numbers import group_messages, join_names
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress

_WORDS = phrases("skipped")


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """The results of all stages up to the fit, for one choice of records."""

    decays: Sequence[LogDecrement]
    gains: Sequence[StepGain]
    sines: Sequence[SinePoint]
    responses: Sequence[FrequencyResponse]
    repeats: Repeats
    initial: dict[str, Estimate]
    fitted: Fitted
    log: Log

    @property
    def fit(self) -> ChainFit | None:
        """The fit of all carts."""
        return self.fitted.fit


def identify(
    data: Ingested,
    *,
    interventions: Sequence[Intervention],
    without: Set[str],
    bench: Setup,
    progress: Progress,
    measured: Measured,
) -> Identified:
    """Run all stages up to the fit on the records, except those in `without`.

    `measured` is a cache of results that depend on a single record. It is filled here and can be
    passed to the next call.
    """
    log = Log(measured=measured)
    used = [record for record in data.records if record.id not in without]
    runs = Runs(
        used=used,
        left_out=[record for record in data.records if record.id in without],
        driven=_driven(used, n=bench.n, log=log),
    )

    progress("free decays: logarithmic decrement")
    decays = _log_decrements(runs, bench=bench, interventions=interventions, log=log)
    progress("steps: static gains")
    gains = _step_gains(runs, bench=bench, log=log)
    progress("sine dwells: steady state")
    sines = _sine_points(used, log=log)
    # A note is dropped if a check of the same step says the same thing in full.
    notes = [
        *((f"{d.name} (cart {d.cart})", d.note) for d in decays),
        *((f"{g.experiment} (cart {g.cart})", g.note) for g in gains if not g.interval),
        *((f"{p.experiment} (cart {p.cart})", p.note) for p in sines),
    ]
    log.warn(group_messages(notes))
    ended_early = {point.experiment for point in sines if not point.settled}
    short = [r for r in used if r.id in ended_early and len(r.free) == bench.n]
    runs = replace(runs, short=short)
    progress("frequency response")
    groups = _setups_apart(data, sines=sines, runs=runs, bench=bench)
    if groups:
        for stage in (Stage.FREQUENCY_RESPONSE, Stage.FINAL_ESTIMATES):
            log.skip(stage, _WORDS.text("groups", count=len(groups)))
    responses = () if groups else _frequency_response(data, sines=sines, runs=runs, log=log)
    resonances = _resonances(responses, bench=bench, log=log)
    alone = estimate_initially(carts=bench.n, log_decrements=decays, step_gains=gains)

    progress("fitting all carts at once")
    fitted = Fitted(groups=groups)
    if not groups:
        initial = {**resonances, **alone}
        fitted = fit_carts(responses, runs=runs, initial=initial, bench=bench, log=log)
    parameters = fitted.fit.parameters if fitted.fit and fitted.fit.converged else {}
    dwells = parameters if fitted.by_dwells else {}
    repeats = compare_repeats(decays, gains, carts=bench.n, fitted=parameters, dwells=dwells)
    agreed = {name: one for name, one in alone.items() if name not in repeats.undecided}
    return Identified(
        decays=decays,
        gains=gains,
        sines=sines,
        responses=responses,
        repeats=repeats,
        initial={**resonances, **agreed},
        fitted=fitted,
        log=log,
    )


def compare_estimates(found: Identified, *, bench: Setup) -> tuple[ParameterRow, ...]:
    """Return the initial and final estimates side by side.

    Estimates that the fit does not determine are skipped. A failed fit determines none.
    """
    fit, final = found.fit, found.fit.parameters if found.fit and found.fit.converged else {}
    if fit and not fit.converged:
        found.log.skip(Stage.FINAL_ESTIMATES, _WORDS.text("fit_failed", message=fit.message))
    elif fit and not final:
        found.log.skip(Stage.NAMED_PARAMETERS, _WORDS.text("untied"))
    for name, estimate in final.items():
        if reason := undetermined_reason(name, estimate):
            skip = Skipped(stage=Stage.FINAL_PARAMETER, parameter=name, reason=reason)
            found.log.skipped.append(skip)
    return compare(
        found.initial,
        final=final,
        names=list(final) or parameter_names(bench.n, rigid=bench.rigid),
        bench=bench,
        fitted_to=fit.experiments if fit else (),
    )


def _driven(records: Sequence[Record], *, n: int, log: Log) -> list[Record]:
    """Return the steps and sweeps in which all carts are free.

    Runs of single carts are used for initial estimates only. So initial and final estimates use
    different data, and comparing them is a check.
    """
    runs = [r for r in records if r.kind in ("step", "sweep") and r.u is not None]
    runs = [r for r in runs if len(r.free) == n]
    notes = []
    for run in (run for run in runs if len(run.carts) < n):
        seen = f"cart{'s' * (len(run.carts) != 1)} {', '.join(map(str, run.carts))}"
        notes.append((run.id, _WORDS.text("carts_unseen", all=n, carts=seen)))
    log.warn(group_messages(notes))
    return runs


def _log_decrements(
    runs: Runs, *, bench: Setup, interventions: Sequence[Intervention], log: Log
) -> list[LogDecrement]:
    """Return the decays of each cart alone; a cart without one is judged by its step ringing."""
    decays: list[LogDecrement] = []
    for cart, (before, after) in enumerate(pairwise(bench.springs), start=1):
        if not (before or after):
            log.skip(Stage.LOG_DECREMENT, _WORDS.text("no_spring_at_cart", cart=cart), cart=cart)
            continue
        alone = [r for r in runs.used if r.free == (cart,) and cart in r.carts]
        swinging = [r for r in alone if r.kind == "decay"] or [r for r in alone if r.kind == "step"]
        if not swinging:
            what = f"decay in which cart {cart} alone is free" if bench.n > 1 else "decay"
            out = [r for r in runs.left_out if r.free == (cart,) and r.kind in ("decay", "step")]
            _skip_without(log, Stage.LOG_DECREMENT, what, out=out, cart=cart)
        for run in swinging:
            find = partial(_decays_between, between(run, interventions), cart=cart)
            decays += log.attempt(Stage.LOG_DECREMENT, find, of=run.id, cart=cart) or ()
    return decays


def _decays_between(pieces: Sequence[Record], *, cart: int) -> list[LogDecrement]:
    """Return the decay of each piece of a record that shows one.

    Raises
    ------
    DataError : no piece shows a decay.
    """
    decays: list[LogDecrement] = []
    fault = DataError("a force that was not measured acts on a cart throughout")
    for piece in pieces:
        try:
            decays.append(fit_log_decrement(piece, cart=cart))
        except DataError as error:
            fault = error
    if not decays:
        raise fault
    if len(decays) == 1:
        return decays
    return [replace(decay, number=i) for i, decay in enumerate(decays, start=1)]


def _skip_without(
    log: Log, stage: Stage, what: str, *, out: Sequence[Record], cart: int | None = None
) -> None:
    """Note that records of some kind are missing, or that all of them were left out."""
    reason = _WORDS.text("none_recorded", what=what)
    if out:
        reason = _WORDS.text("all_left_out", what=what, runs=join_names([r.id for r in out]))
    log.skip(stage, reason, cart=cart, missing="" if out else f"a {what}")


def _step_gains(runs: Runs, *, bench: Setup, log: Log) -> list[StepGain]:
    if not bench.tied:
        log.skip(Stage.STEP_GAIN, _WORDS.text("untied"))
        return []
    steps = [record for record in runs.driven if record.kind == "step"]
    if not steps:
        out = [r for r in runs.left_out if r.kind == "step" and len(r.free) == bench.n]
        what = "step with all carts free" if bench.n > 1 else "step"
        _skip_without(log, Stage.STEP_GAIN, what, out=out)
    gains = []
    for run in steps:
        for cart in run.carts:
            fit = partial(fit_static_gain, run, cart=cart)
            gain = log.attempt(Stage.STEP_GAIN, fit, of=run.id, cart=cart)
            if gain:
                gains.append(gain)
    return gains


def _sine_points(records: Sequence[Record], *, log: Log) -> list[SinePoint]:
    points = []
    for run in records:
        dwell = Dwell(run)
        for cart in run.carts if run.kind == "sine" else ():
            fit = partial(dwell.fit, cart=cart)
            point = log.attempt(Stage.SINE, fit, of=run.id, cart=cart)
            if point and (fault := dwell_fault(point)):
                log.skip(Stage.SINE, fault, run=run.id, cart=cart)
            elif point:
                points.append(point)
    return points


def _setups_apart(
    data: Ingested, *, sines: Sequence[SinePoint], runs: Runs, bench: Setup
) -> tuple[RecordingGroup, ...]:
    """Return the groups of steps and sweeps that no fit can unite, if no dwells decide."""
    if data.tables or any(point.settled for point in sines) or not steps_disagree(runs.driven):
        return ()
    return find_setups(runs.driven, bench=bench)


def _frequency_response(
    data: Ingested, *, sines: Sequence[SinePoint], runs: Runs, log: Log
) -> Sequence[FrequencyResponse]:
    """Return the response from dwells; otherwise from the students' table or from other records.

    Before its steady state, a dwell has no amplitude ratio.
    """
    if steady := [point for point in sines if point.settled]:
        return collect_dwells(steady)
    if data.tables:
        return data.tables
    if not any(record.kind == "sine" for record in runs.used):
        dwells = [r for r in runs.left_out if r.kind == "sine"]
        _skip_without(log, Stage.SINE, "sine dwell", out=dwells)
    if not runs.driven:
        log.skip(Stage.FREQUENCY_RESPONSE, _WORDS.text("no_response"))
        return ()
    from_runs = partial(response_from_records, runs.driven)
    responses = log.attempt(Stage.FREQUENCY_RESPONSE, from_runs)
    if responses:
        used = {run for response in responses for run in response.experiments}
        kinds = {record.kind for record in runs.driven if record.id in used}
        kinds_text = " and ".join(f"{kind} records" for kind in ("step", "sweep") if kind in kinds)
        log.warn([_WORDS.text("response_from", runs=kinds_text)])
    return responses or ()


def _resonances(
    responses: Sequence[FrequencyResponse], *, bench: Setup, log: Log
) -> dict[str, Estimate]:
    if not bench.tied:
        log.skip(Stage.RESONANCES, _WORDS.text("untied_modes"))
        return {}
    find = partial(find_resonances, responses, n=bench.n)
    return log.attempt(Stage.RESONANCES, find) or {}


def identify_with_rejection(
    data: Ingested,
    *,
    interventions: Sequence[Intervention],
    bench: Setup,
    progress: Progress,
) -> tuple[Identified, list[Finding]]:
    """Identify the carts; leave out records that contradict these carts or their own repeats.

    A record with a constant reading is used only if carts identified from the other records would
    have this reading too.
    """
    driven = [r for r in data.records if r.kind in ("step", "sweep")]
    # Faults that input or encoder show by themselves are kept, because later rounds do not see
    # their records.
    shown = find_shown(data.records, files=data.files)
    contradicted = []
    chain: Chain | None = None
    fits: Mapping[str, RecordFit] = {}
    left_out = find_outlier_repeats(driven, unit=bench.units.position) | shown
    without = left_out.keys() | standing_still(data.records)
    again = partial(identify, data, interventions=interventions, bench=bench, progress=progress)
    again = partial(again, measured={})
    found = again(without=without)
    # In each round, the used records may show that others are wrong.
    for _ in range(4):
        # If too few records remain to identify the carts, the earlier result is kept.
        chain, fits = _reference_chain(found, data, bench=bench) or (chain, fits)
        faults = find_faults(data.records, chain=chain, fits=fits)
        shown |= find_impossible_gains(found.gains)
        shown |= {**found.repeats.odd, **found.fitted.conflict}
        # Search for odd repeats only among good records, because otherwise most repeats may be
        # wrong.
        valid = [record for record in driven if record.id not in faults]
        odd = find_outlier_repeats(valid, unit=bench.units.position)
        # A fault that says how a record is wrong has priority over a fault that only calls it odd.
        sure = {name: one for name, one in faults.items() if one.is_wrong}
        left_out = odd | faults | shown | sure
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
    ordered = [left_out[record.id] for record in data.records if record.id in left_out]
    return replace(found, repeats=repeats), ordered


def _reference_chain(
    found: Identified, data: Ingested, *, bench: Setup
) -> tuple[Chain, Mapping[str, RecordFit]] | None:
    """Return the chain that the records follow, and how each record follows it.

    If a chain explains the data only after two columns are swapped, it is returned.
    """
    fitted = None
    if found.fit and found.fit.converged:
        fitted = found.fit.chain, found.fitted.fits
    if fitted and most_are_consistent(found.fitted.fits):
        return fitted
    for i, j in combinations(sorted(response.cart for response in found.responses), 2):
        turned = [replace(r, cart={i: j, j: i}.get(r.cart, r.cart)) for r in found.responses]
        try:
            fit = fit_bode(sorted(turned, key=lambda response: response.cart), bench=bench)
        except DataError:
            continue
        if fit.explains_data:
            return fit.chain, record_fits(data.records, fit.chain)
    return fitted
