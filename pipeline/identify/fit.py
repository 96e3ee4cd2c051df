"""Fit all carts at once, and find recordings that want different carts.

The fit is to the dwells, or to steps and sweeps if the dwells contradict them. Groups of recordings
want different carts, for example, after masses were changed.
"""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.estimation.estimates import (
    SIGMA_LIMIT,
    motion_measured,
    points_measured,
    with_coverage,
)
from pipeline.estimation.parametrisation import Parametrisation
from pipeline.estimation.record_fit import (
    RecordFit,
    find_correction,
    fit_detuned,
    is_driven,
    most_are_consistent,
    record_fits,
)
from pipeline.estimation.sine import FEW_COUNTS
from pipeline.estimation.time_fit import evaluate_chain, fit_records, open_window
from pipeline.identify.corrections import without_lone_factors
from pipeline.identify.findings import by_kind
from pipeline.identify.log import Log
from pipeline.names import own_zeta, read_name
from pipeline.results import (
    EXPLAINED,
    ChainFit,
    Check,
    Estimate,
    Finding,
    FrequencyResponse,
    LogDecrement,
    ParameterRow,
    Record,
    RecordingGroup,
    Stage,
)
from pipeline.setup import Setup
from pipeline.words.numbers import join_names, listing, with_error
from pipeline.words.phrases import phrases

_WORDS = phrases("skipped")
# Relative difference of a mass or spring that matters, and of a frequency, its square root.
_DIFFERENT, _DETUNED = 0.05, 0.025
_MOST_SEEDS = 8  # recordings from which a group is started
_MOST_FAILED = 2  # recordings that no chain explains; after these, the carts are not linear
_MOST_GROUPS = 3
_ENOUGH = 0.9  # share of the driven recordings that must be in a group
_FARTHER = 1.5  # times the motion of another group
_MOST_DWELLS = 8  # dwells that are fitted if a group has no other recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """The fit of all carts, if there is one.

    Attributes
    ----------
    fits : how each record follows the fit, including unused records.
    by_dwells : whether the fit uses dwells and the dwells follow it.
    conflict : the records that contradict each other, by id, with the reason. If nothing shows
        which of them are right, there is no fit.
    """

    fit: ChainFit | None = None
    fits: Mapping[str, RecordFit] = field(default_factory=dict)
    by_dwells: bool = False
    conflict: Mapping[str, Finding] = field(default_factory=dict)

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


def find_groups(
    fitted: Fitted,
    *,
    decays: Sequence[LogDecrement],
    records: Sequence[Record],
    rows: Sequence[ParameterRow],
    bench: Setup,
) -> tuple[RecordingGroup, ...]:
    """Return the groups of recordings that want different carts, the largest first.

    There are groups only if the carts of each group explain its recordings down to the noise, and
    no set of carts explains them all. With hidden physics, a residual remains. If the
    driven recordings follow a fit that explains its data, only the decays are compared with it.
    """
    fit, fits = fitted.fit, fitted.fits
    explained = fit if fit and fit.converged and fit.explains_data else None
    driven = [r for r in records if is_driven(r) and len(r.free) == len(r.carts) == bench.n]
    one = explained and all(fits[r.id].chi_square <= EXPLAINED for r in driven if r.id in fits)
    groups = [] if one else _driven_groups(driven, start=explained, bench=bench)
    if told := _described(groups):
        return told
    if explained and all(fits[r.id].is_consistent for r in records if r.id in fits):
        return _against_decays(explained, decays=decays, rows=rows)
    return ()


def _driven_groups(
    driven: Sequence[Record], *, start: ChainFit | None, bench: Setup
) -> list[tuple[list[Record], ChainFit]]:
    """Return groups of driven recordings with the carts that explain each; none if they are one."""
    groups: list[tuple[list[Record], ChainFit]] = []
    rest = list(driven)
    while rest and len(groups) < _MOST_GROUPS:
        members, fit = _largest(rest, start=start, bench=bench)
        own = fit if fit is start else _fit(members, bench=bench)
        if own is None or not (own.converged and own.explains_data):
            break
        groups.append((members, own))
        rest = [record for record in rest if record not in members]
    most = len(rest) <= (1 - _ENOUGH) * len(driven)
    return groups if most and _overlap([members for members, _ in groups]) else []


def check_groups(groups: Sequence[RecordingGroup]) -> list[Check]:
    """Return a failed check if groups of recordings want different carts."""
    if not groups:
        return []
    told = []
    for group in groups:
        values = [f"{k} = {with_error(v, group.std.get(k))}" for k, v in group.values.items()]
        told.append(f"{join_names(list(group.experiments))}: {listing(values)}")
    details = {"groups": "; ".join(told)}
    finding = Finding(code="groups", kind="groups", details=details, value=len(groups), limit=1)
    return [finding.check]


def _against_decays(
    fit: ChainFit, *, decays: Sequence[LogDecrement], rows: Sequence[ParameterRow]
) -> tuple[RecordingGroup, ...]:
    """Return the fitted recordings and the decays, if these want other masses or springs.

    The springs are the same if all static gains agree. Other decays than exponential ones
    prove nothing.
    """
    gains = [row.consistent for row in rows if read_name(row.name).is_gain]
    bent = {d.experiment for d in decays if not d.law.is_exponential}
    pairs = {
        row.name: (row.initial, row.final)
        for row in rows
        if read_name(row.name).is_frequency
        if abs(row.change_percent or 0.0) > 100 * _DETUNED
        if row.change_sigmas is not None and row.change_sigmas > SIGMA_LIMIT
        if row.initial and row.initial.source == "log_decrement" and row.final
        if not bent & set(row.initial.experiments)
    }
    if not pairs or not all(gains):
        return ()
    swings = dict.fromkeys(run for one, _ in pairs.values() for run in one.experiments)
    return tuple(
        RecordingGroup(
            experiments=runs,
            values={name: pair[i].value for name, pair in pairs.items()},
            std={name: std for name, pair in pairs.items() if (std := pair[i].std) is not None},
        )
        for i, runs in ((1, fit.experiments), (0, tuple(swings)))
    )


def _largest(
    rest: Sequence[Record], *, start: ChainFit | None, bench: Setup
) -> tuple[list[Record], ChainFit | None]:
    """Return the largest group of recordings that follow one fit, and this fit."""
    largest: list[Record] = []
    best: ChainFit | None = None
    followed: set[str] = set()
    for fit in _fits(rest, followed, start=start, bench=bench):
        own = [record for record in rest if _follows(record, fit)]
        followed |= {record.id for record in own}
        if len(own) > len(largest):
            largest, best = own, fit
    return largest, best


def _fits(
    rest: Sequence[Record], followed: set[str], *, start: ChainFit | None, bench: Setup
) -> Iterator[ChainFit]:
    """Yield fits that recordings may follow: `start`, then those of single recordings.

    Recordings that are in `followed` by then are skipped. So are those that no chain explains. A
    single dwell does not determine the carts, so dwells are fitted together.
    """
    if start is not None:
        yield start
    whole = [record for record in rest if record.kind != "sine"][:_MOST_SEEDS]
    failed = 0
    for seed in [[record] for record in whole] or [rest]:
        if any(record.id in followed for record in seed):
            continue
        fit = _fit(seed, bench=bench)
        if fit and fit.explains_data:
            yield fit
        else:
            failed += 1
        if failed == _MOST_FAILED:
            return


def _follows(record: Record, fit: ChainFit) -> bool:
    """Return whether a recording follows a fit within the noise and the errors of the fit."""
    chain = fit.chain
    every = Parametrisation(bench=Setup(springs=tuple(bool(k) for k in chain.k)))
    sizes = zip(every.names, every.physical(chain), strict=True)
    P = replace(every, zero=tuple(name for name, size in sizes if not size > 0))
    try:
        attempt = evaluate_chain([open_window(record)], P, P.pack(chain))
    except DataError:  # nothing moves
        return True
    (misfit,) = attempt.misfits
    slopes = (misfit.jacobian / P.dp_dtheta(attempt.theta)[:, None, None]).reshape(len(P.names), -1)
    known = [name for name in P.names if name in fit.names]
    at, of = [P.names.index(x) for x in known], [fit.names.index(x) for x in known]
    doubt = np.sum(slopes[at] * (fit.covariance[np.ix_(of, of)] @ slopes[at]))
    # The doubt is the expected χ² due to the errors of the fit; few of them make up most of it.
    return bool(attempt.cost <= EXPLAINED * attempt.n_points + SIGMA_LIMIT**2 * doubt)


def _fit(members: Sequence[Record], *, bench: Setup) -> ChainFit | None:
    whole = [record for record in members if record.kind != "sine"]
    dwells = members[:: 1 + len(members) // _MOST_DWELLS]
    try:
        return fit_records(whole or dwells, bench=bench)
    except DataError:
        return None


def _overlap(groups: Sequence[Sequence[Record]]) -> bool:
    """Return whether no group moves far more, or far less, than another one does.

    With a spring that stiffens, small and large motion want different carts too.
    """
    sizes = [[float(np.ptp(record.position(1))) for record in members] for members in groups]
    return all(min(a) <= _FARTHER * max(b) for a in sizes for b in sizes)


def _described(groups: Sequence[tuple[Sequence[Record], ChainFit]]) -> tuple[RecordingGroup, ...]:
    """Return the groups with the numbers that differ, if any do."""
    if len(groups) < 2:
        return ()
    fits = [fit for _, fit in groups]
    values = [_physical(fit) for fit in fits]
    first, std = values[0], fits[0].std
    known = [name for name in first if all(name in one for one in values)]
    different = dict.fromkeys(
        name
        for name in known
        for one, fit in zip(values[1:], fits[1:], strict=True)
        if abs(one[name] - first[name])
        > max(SIGMA_LIMIT * np.hypot(fit.std[name], std[name]), _DIFFERENT * abs(first[name]))
    )
    if not different:
        return ()
    return tuple(
        RecordingGroup(
            experiments=tuple(record.id for record in members),
            values={name: one[name] for name in different},
            std={name: fit.std[name] for name in different},
        )
        for (members, fit), one in zip(groups, values, strict=True)
    )


def _physical(fit: ChainFit) -> dict[str, float]:
    """Return the masses and springs of a fit that have a standard error."""
    rows = {"m": fit.chain.m, "k": fit.chain.k}
    values = {f"{s}_{i}": float(v) for s, row in rows.items() for i, v in enumerate(row, start=1)}
    return {name: value for name, value in values.items() if name in fit.std}
