"""Fit all carts at once.

The fit is to the dwells, or to steps and sweeps if the dwells contradict them.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.bode_fit import fit_bode
from pipeline.estimation.estimates import (
    motion_measured,
    points_measured,
    with_coverage,
)
from pipeline.estimation.record_fit import (
    RecordFit,
    find_correction,
    fit_detuned,
    most_are_consistent,
    record_fits,
)
from pipeline.estimation.sine import FEW_COUNTS
from pipeline.estimation.time_fit import fit_records
from pipeline.identify.corrections import without_lone_factors
from pipeline.identify.findings import by_kind
from pipeline.identify.log import Log
from pipeline.names import own_zeta
from pipeline.results import (
    ChainFit,
    Estimate,
    Finding,
    FrequencyResponse,
    Record,
    RecordingGroup,
    Stage,
)
from pipeline.setup import Setup
from pipeline.words.phrases import phrases

_WORDS = phrases("skipped")


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """The fit of all carts, if there is one.

    Attributes
    ----------
    fits : how each record follows the fit, including unused records.
    by_dwells : whether the fit uses dwells and the dwells follow it.
    conflict : the records that contradict each other, by id, with the reason. If nothing shows
        which of them are right, there is no fit.
    groups : the groups of steps and sweeps that want different carts. If there are some, there is
        no fit to them.
    """

    fit: ChainFit | None = None
    fits: Mapping[str, RecordFit] = field(default_factory=dict)
    by_dwells: bool = False
    conflict: Mapping[str, Finding] = field(default_factory=dict)
    groups: tuple[RecordingGroup, ...] = ()

    def compared(self, records: Sequence[Record]) -> list[Record]:
        """Return the records that are compared with the fit."""
        return [record for record in records if record.id in self.fits]


@dataclass(frozen=True, kw_only=True, eq=False)
class Runs:
    """The records of a submission, as used in one round of identification.

    Attributes
    ----------
    used : the records that identify the carts.
    left_out : records that are only compared with the fit.
    driven : the steps and sweeps among the used records, with all carts free.
    short : the dwells among the used records that end before their steady state, with all carts
        free. Only their whole records can be used.
    """

    used: Sequence[Record]
    left_out: Sequence[Record]
    driven: Sequence[Record]
    short: Sequence[Record] = ()


def fit_carts(
    responses: Sequence[FrequencyResponse],
    *,
    runs: Runs,
    initial: dict[str, Estimate],
    bench: Setup,
    log: Log,
) -> Fitted:
    """Return the Bode fit if the records follow it, or else the joint time-domain fit."""
    if not _is_seen(bench.n, [*runs.used, *runs.left_out], responses):
        log.skip(Stage.FINAL_ESTIMATES, _WORDS.text("unseen_cart", cart=bench.n))
        return Fitted()
    has_points = any(response.source != "records" for response in responses)
    bode = _fit_points(responses, runs, initial, bench, log) if has_points else None
    timed = [*runs.driven, *runs.short]
    if not timed and bode is None:
        run = "step or sweep with all carts free" if bench.n > 1 else "step or sweep"
        reason = _WORDS.text("no_run_beside_bode" if has_points else "no_run_no_dwell", run=run)
        missing = f"a {run}" if has_points else _WORDS.text("dwells_or_run", run=run)
        log.skip(Stage.FINAL_ESTIMATES, reason, missing=missing)
    dwells = [record for record in runs.used if record.kind == "sine"]
    if not timed or (bode and not dwells):
        return bode or Fitted()
    contrary = bode is not None and bool(_contrary_kinds(runs.used, bode))
    beyond = bode is not None and _misses_transients(bode, runs, dwells)
    doubted = contrary or beyond or (bode is not None and _is_doubted(bode, dwells))
    if bode and bode.by_dwells and not doubted:
        return bode
    other = _fit_records(timed, runs, bench=bench, log=log)
    if bode is None or other is None:
        return bode or other or Fitted()
    if other.fit is None or not other.fit.converged:
        return bode
    mine, theirs = (_kinds_that_follow(runs.used, one) for one in (bode, other))
    if bode.by_dwells and contrary and _votes(mine) == _votes(theirs):
        if conflict := _conflict(runs.used, bode, mine=mine, theirs=theirs):
            log.skip(Stage.FINAL_ESTIMATES, next(iter(conflict.values())).reason)
            return Fitted(conflict=conflict)
    if contrary and _votes(mine) != _votes(theirs):
        better = _votes(mine) < _votes(theirs)
    elif beyond:
        better = other.fit.explains_data and not _extrapolates(other)
    else:  # if dwells follow the Bode fit, they must follow the other fit more closely
        better = not bode.by_dwells or _is_closer(other, bode, dwells)
    if not better:
        return bode
    kinds = {run.kind for run in timed if run.id in other.fit.experiments}
    nouns = {"step": "steps", "sweep": "sweeps", "sine": "whole dwells"}
    used = " and ".join(noun for kind, noun in nouns.items() if kind in kinds)
    log.warn([_WORDS.text("fit_rests_on_whole" if beyond else "fit_rests_on", kinds=used)])
    return other


def _is_seen(cart: int, records: Sequence[Record], responses: Sequence[FrequencyResponse]) -> bool:
    """Whether a cart moves in any recording. If the last cart does not, it may not exist."""
    return cart in {response.cart for response in responses} or any(
        cart in record.carts and np.ptp(record.position(cart)) > 0 for record in records
    )


def _fit_points(
    responses: Sequence[FrequencyResponse],
    runs: Runs,
    initial: Mapping[str, Estimate],
    bench: Setup,
    log: Log,
) -> Fitted | None:
    """Return the fit to the frequency response, and whether the dwells follow it."""
    own = {cart: initial.get(own_zeta(cart, n=bench.n)) for cart in range(1, bench.n + 1)}
    dampings = {
        cart: zeta
        for cart, zeta in own.items()
        if zeta and zeta.source == "log_decrement" and zeta.value > 0 and zeta.std
    }
    values = {name: estimate.value for name, estimate in initial.items()}
    to_points = partial(fit_bode, responses, bench=bench, initial=values, decays=dampings)
    bode = _held(log.attempt(Stage.BODE_FIT, to_points), runs, measured=points_measured(responses))
    return bode and replace(bode, by_dwells="sine" in _kinds_that_follow(runs.used, bode))


def _fit_records(records: Sequence[Record], runs: Runs, *, bench: Setup, log: Log) -> Fitted | None:
    """Return the fit to whole records in the time domain."""
    fit = log.attempt(Stage.FINAL_ESTIMATES, partial(fit_records, records, bench=bench))
    used = [record for record in records if fit and record.id in fit.experiments]
    return _held(fit, runs, measured=motion_measured(used)) if fit else None


def _misses_transients(fitted: Fitted, runs: Runs, dwells: Sequence[Record]) -> bool:
    """Whether the whole records of short dwells may tell more than the steady ones.

    If many dwells are short, the steady state of others is not certain either.
    """
    return bool(runs.short) and (5 * len(runs.short) >= len(dwells) or _extrapolates(fitted))


def _extrapolates(fitted: Fitted) -> bool:
    """Whether a resonance or null of the fit has no measurement near it."""
    assert fitted.fit is not None
    return any(estimate.extrapolated for estimate in fitted.fit.parameters.values())


def _is_doubted(fitted: Fitted, dwells: Sequence[Record]) -> bool:
    """Whether the fit does not explain the points, and most motions are only a few encoder steps.

    Rounding then hides the end of a transient. Near a sharp resonance, this changes the amplitude
    of a dwell by several standard errors.
    """
    assert fitted.fit is not None
    motions = [(r.position(cart), r.encoder_step(cart)) for r in dwells for cart in r.carts]
    counts = [float(np.ptp(y)) / step for y, step in motions if step > 0]
    coarse = bool(counts) and float(np.median(counts)) < 2 * FEW_COUNTS
    return coarse and not fitted.fit.explains_data


def _is_closer(fitted: Fitted, other: Fitted, dwells: Sequence[Record]) -> bool:
    """Whether `fitted` explains its own records, and dwells follow it more closely than `other`."""
    assert fitted.fit is not None
    lost = [
        sum(one.fits[r.id].share for r in dwells if r.id in one.fits) for one in (fitted, other)
    ]
    return fitted.fit.explains_data and lost[0] < lost[1]


def _held(fit: ChainFit | None, runs: Runs, *, measured: Array) -> Fitted | None:
    """Return a fit with its coverage, and how all records follow it, whether used or not.

    Parameters
    ----------
    measured : frequencies, rad/s, at which the fit's data have a measurement.
    """
    if fit is None:
        return None
    records = [*runs.used, *runs.left_out]
    return Fitted(fit=with_coverage(fit, measured), fits=record_fits(records, fit.chain))


def _kinds_that_follow(records: Sequence[Record], fitted: Fitted) -> set[str]:
    """Return the kinds of experiment of which most records follow the fit."""
    return {
        kind
        for kind, alike in by_kind(fitted.compared(records)).items()
        if most_are_consistent({record.id: fitted.fits[record.id] for record in alike})
    }


def _votes(kinds: Set[str]) -> int:
    """Return the number of kinds, with steps and sweeps as one kind.

    Steps and sweeps count as one kind because they are logged in the same way.
    """
    return len({"step" if kind == "sweep" else kind for kind in kinds})


def _contrary_kinds(records: Sequence[Record], fitted: Fitted) -> set[str]:
    """Return the kinds of record of which most follow no chain similar to the fitted one."""
    assert fitted.fit is not None
    chain = fitted.fit.chain

    def contrary(record: Record) -> bool:
        # With inches in place of centimetres, this share is 0.37.
        return all(fit.share > 0.3 for fit in fit_detuned(record, chain))

    return {
        kind
        for kind, alike in by_kind(fitted.compared(records)).items()
        if 2 * sum(not fitted.fits[record.id].is_consistent for record in alike) > len(alike)
        and 2 * sum(map(contrary, alike)) > len(alike)
    }


def _conflict(
    records: Sequence[Record], fitted: Fitted, *, mine: Set[str], theirs: Set[str]
) -> dict[str, Finding]:
    """Return, by record, why kinds of experiment that follow different chains may not be used.

    There is a conflict only if a known mistake would turn one chain into the other. Otherwise the
    carts may really behave in both ways.
    """
    assert fitted.fit is not None
    chain, fits, held = fitted.fit.chain, fitted.fits, fitted.compared(records)
    others = [record for record in held if record.kind in theirs - mine]
    misread = {r.id: m for r in others if (m := find_correction(r, chain, fits[r.id]))}
    found = without_lone_factors(misread, held, fits=fits)
    if 2 * len(found) <= len(others):
        return {}
    example, correction = next(iter(found.items()))
    of_mine, of_theirs = (" and ".join(sorted(kinds)) for kinds in (mine - theirs, theirs - mine))
    details = {"mine": of_mine, "theirs": of_theirs, "example": example, "look": correction.words}
    return {
        r.id: Finding(code="contradicting_kinds", run=r.id, details=details, excludes="wrong")
        for r in held
        if r.kind in mine ^ theirs
    }
