"""Every number that records give of the carts, and the fit of them all."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.errors import DataError
from pipeline.estimation.interventions import between
from pipeline.identify.fit import Fitted, fit_carts
from pipeline.identify.log import Log, Progress
from pipeline.identify.soundness.repeated_numbers import Repeats, compare_repeats
from pipeline.ingest.read import Ingested
from pipeline.names import by_note, listed
from pipeline.results import (
    ChainFit,
    Estimate,
    FrequencyResponse,
    LogDecrement,
    Record,
    SinePoint,
    StepGain,
)
from pipeline.results_of_runs import Intervention
from pipeline.stages.frequency_response import (
    collect_dwells,
    dwell_fault,
    find_resonances,
    response_from_records,
)
from pipeline.stages.initial import estimate_initially
from pipeline.stages.log_decrement import fit_log_decrement
from pipeline.stages.sine import Dwell
from pipeline.stages.step_gain import fit_step_gain
from pipeline.submission import System

UNTIED = "no spring ties the carts to a wall: they rest anywhere and have no static gain"


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """What the stages make of some records, up to the fit."""

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
    system: System,
    progress: Progress,
    measured: dict[str, Any],
) -> Identified:
    """Take the records, but for those without, through the stages up to the fit.

    `measured` keeps what single records tell, for the next call with other records left out.
    """
    n, springs, log = system.carts, system.springs, Log(measured=measured)
    records = [record for record in data.records if record.id not in without]
    out = [record for record in data.records if record.id in without]
    driven = _driven(records, n=n, log=log)

    progress("free decays: logarithmic decrement")
    decays = _log_decrements(
        records, out=out, springs=springs, interventions=interventions, log=log
    )
    progress("steps: static gains")
    gains = _step_gains(driven, out=out, system=system, log=log)
    progress("sine dwells: steady state")
    sines = _sine_points(records, log=log)
    # What a check says of a decay or a step in full is not said twice.
    log.warn(
        by_note(
            [
                *((f"{d.name}, cart {d.cart}", d.note) for d in decays if not _sticks(d)),
                *((f"{g.experiment}, cart {g.cart}", g.note) for g in gains if not g.interval),
                *((f"{p.experiment}, cart {p.cart}", p.note) for p in sines),
            ]
        )
    )
    progress("frequency response")
    responses = _frequency_response(data, sines=sines, driven=driven, out=out, log=log)
    resonances = _resonances(responses, system=system, log=log)
    alone = estimate_initially(carts=n, log_decrements=decays, step_gains=gains)

    progress("fitting all carts at once")
    fitted = Fitted()
    if _is_seen(n, records, responses):
        fitted = fit_carts(
            responses,
            records=records,
            beside=out,
            driven=driven,
            initial={**resonances, **alone},
            n=n,
            springs=springs,
            log=log,
        )
    else:
        log.skip("final estimates", f"cart {n} moves in no recording: is `carts = {n}` right?")
    fit = fitted.fit
    parameters = fit.parameters if fit and fit.converged else {}
    repeats = compare_repeats(
        decays, gains, carts=n, fitted=parameters, dwells=parameters if fitted.by_dwells else {}
    )
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


def _counted(carts: Sequence[int]) -> str:
    return ("cart " if len(carts) == 1 else "carts ") + ", ".join(map(str, carts))


def _driven(records: Sequence[Record], *, n: int, log: Log) -> list[Record]:
    """Return the steps and sweeps of all carts together.

    Runs of single carts are left to the initial estimates, so that initial and final estimates
    come from different data and comparing them is a check.
    """
    runs = [r for r in records if r.kind in ("step", "sweep") and r.u is not None]
    runs = [r for r in runs if len(r.free) == n]
    log.warn(
        by_note(
            (run.id, f"all carts are free, but of {n} only {_counted(run.carts)} was recorded")
            for run in runs
            if len(run.carts) < n
        )
    )
    return runs


def _is_seen(cart: int, records: Sequence[Record], responses: Sequence[FrequencyResponse]) -> bool:
    """Whether a cart moves in any recording: a last one that does not may not be there."""
    return cart in {response.cart for response in responses} or any(
        cart in record.carts and np.ptp(record.position(cart)) > 0 for record in records
    )


def _log_decrements(
    records: Sequence[Record],
    *,
    out: Sequence[Record],
    springs: Sequence[bool],
    interventions: Sequence[Intervention],
    log: Log,
) -> list[LogDecrement]:
    """Each cart alone: its decays, or the ring-down of its steps where there is no decay."""
    decays: list[LogDecrement] = []
    for cart, (before, after) in enumerate(pairwise(springs), start=1):
        if not (before or after):
            log.skip(f"log decrement, cart {cart}", f"no spring holds cart {cart}: it cannot swing")
            continue
        alone = [r for r in records if r.free == (cart,) and cart in r.carts]
        runs = [r for r in alone if r.kind == "decay"] or [r for r in alone if r.kind == "step"]
        if not runs:
            _skip_without(
                log,
                f"log decrement, cart {cart}",
                f"decay in which cart {cart} alone is free" if len(springs) > 2 else "decay",
                out=[r for r in out if r.free == (cart,) and r.kind in ("decay", "step")],
            )
        for run in runs:
            decays += (
                log.attempt_once(
                    f"log decrement, {run.id}, cart {cart}",
                    _decays_between,
                    between(run, interventions),
                    cart=cart,
                )
                or ()
            )
    return decays


def _decays_between(pieces: Sequence[Record], *, cart: int) -> list[LogDecrement]:
    """Return the decay of each piece of a record that shows one.

    Raises
    ------
    DataError : none of them does.
    """
    if not pieces:
        raise DataError("a force that was not measured acts on a cart throughout")
    decays: list[LogDecrement] = []
    fault: DataError | None = None
    for piece in pieces:
        try:
            decays.append(fit_log_decrement(piece, cart=cart))
        except DataError as error:
            fault = error
    if fault and not decays:
        raise fault
    if len(decays) == 1:
        return decays
    return [replace(decay, number=i) for i, decay in enumerate(decays, start=1)]


def _sticks(decay: LogDecrement) -> bool:
    return decay.friction is not None and decay.friction.present


def _skip_without(log: Log, stage: str, what: str, *, out: Sequence[Record]) -> None:
    """Note that there is none of some records, or that all of them are left out."""
    if out:
        log.skip(
            stage, f"every {what} is left out: {listed([r.id for r in out])} (the checks say why)"
        )
    else:
        log.skip(stage, f"no {what} was recorded", missing=f"a {what}")


def _step_gains(
    driven: Sequence[Record], *, out: Sequence[Record], system: System, log: Log
) -> list[StepGain]:
    if not system.tied:
        log.skip("step gain", UNTIED)
        return []
    runs = [record for record in driven if record.kind == "step"]
    if not runs:
        n = system.carts
        steps = [r for r in out if r.kind == "step" and len(r.free) == n]
        _skip_without(log, "step gain", "step with all carts free" if n > 1 else "step", out=steps)
    gains = []
    for run in runs:
        for cart in run.carts:
            gain = log.attempt_once(
                f"step gain, {run.id}, cart {cart}", fit_step_gain, run, cart=cart
            )
            if gain:
                gains.append(gain)
    return gains


def _sine_points(records: Sequence[Record], *, log: Log) -> list[SinePoint]:
    points = []
    for run in records:
        dwell = Dwell(run)
        for cart in run.carts if run.kind == "sine" else ():
            stage = f"sine steady state, {run.id}, cart {cart}"
            point = log.attempt_once(stage, dwell.fit, cart=cart)
            if point and (fault := dwell_fault(point)):
                log.skip(stage, fault)
            elif point:
                points.append(point)
    return points


def _frequency_response(
    data: Ingested,
    *,
    sines: Sequence[SinePoint],
    driven: Sequence[Record],
    out: Sequence[Record],
    log: Log,
) -> Sequence[FrequencyResponse]:
    """From dwells; else from the students' own table; else from steps and sweeps."""
    if sines:
        return collect_dwells(sines)
    if data.tables:
        return data.tables
    if not any(record.kind == "sine" and record not in out for record in data.records):
        dwells = [r for r in out if r.kind == "sine"]
        _skip_without(log, "sine steady state", "sine dwell", out=dwells)
    if not driven:
        log.skip(
            "frequency response",
            "no usable dwell, no table, and no step or sweep with all carts free to take it from",
        )
        return ()
    responses = log.attempt("frequency response", response_from_records, driven)
    if responses:
        used = {run for response in responses for run in response.experiments}
        kinds = {record.kind for record in driven if record.id in used}
        runs = " and ".join(f"{kind} records" for kind in ("step", "sweep") if kind in kinds)
        log.warn([f"the frequency response comes from the {runs}, not from dwells"])
    return responses or ()


def _resonances(
    responses: Sequence[FrequencyResponse], *, system: System, log: Log
) -> dict[str, Estimate]:
    if not system.tied:
        log.skip("resonances", f"{UNTIED}, and the slowest mode is no resonance")
        return {}
    return log.attempt("resonances", find_resonances, responses, n=system.carts) or {}
