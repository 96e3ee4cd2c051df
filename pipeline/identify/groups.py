"""Find groups of recordings that want different carts, for example after masses were changed."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import DataError
from pipeline.estimation.parametrisation import Parametrisation
from pipeline.estimation.record_fit import is_driven
from pipeline.estimation.time_search import evaluate_chain
from pipeline.estimation.time_window import open_window
from pipeline.identify.carts import Identified
from pipeline.names import read_name
from pipeline.results import EXPLAINED, ChainFit, Check, ParameterRow, Record, RecordingGroup
from pipeline.setup import Setup
from pipeline.stages.compare import SIGMA_LIMIT
from pipeline.stages.time_fit import fit_records
from pipeline.words.numbers import join_names, listing, with_error
from pipeline.words.phrases import phrases

_WORDS = phrases("checks")
# Relative difference of a mass or spring that matters, and of a frequency, its square root.
_DIFFERENT, _DETUNED = 0.05, 0.025
_MOST_SEEDS = 8  # recordings from which a group is started
_MOST_FAILED = 2  # recordings that no chain explains; after these, the carts are not linear
_MOST_GROUPS = 3
_ENOUGH = 0.9  # share of the driven recordings that must be in a group
_FARTHER = 1.5  # times the motion of another group
_MOST_DWELLS = 8  # dwells that are fitted if a group has no other recordings


def find_groups(
    found: Identified, *, records: Sequence[Record], rows: Sequence[ParameterRow], bench: Setup
) -> tuple[RecordingGroup, ...]:
    """Return the groups of recordings that want different carts, the largest first.

    There are groups only if the carts of each group explain its recordings down to the noise, and
    no set of carts explains them all. With hidden physics, a residual remains. If the
    driven recordings follow a fit that explains its data, only the decays are compared with it.
    """
    fit, fits = found.fit, found.fitted.fits
    explained = fit if fit and fit.converged and fit.explains_data else None
    driven = [r for r in records if is_driven(r) and len(r.free) == len(r.carts) == bench.n]
    one = explained and all(fits[r.id].chi_square <= EXPLAINED for r in driven if r.id in fits)
    groups = [] if one else _driven_groups(driven, start=explained, bench=bench)
    if told := _described(groups):
        return told
    if explained and all(fits[r.id].is_consistent for r in records if r.id in fits):
        return _against_decays(explained, found=found, rows=rows)
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
    told = [
        join_names(list(group.experiments))
        + ": "
        + listing([f"{k} = {with_error(v, group.std.get(k))}" for k, v in group.values.items()])
        for group in groups
    ]
    message = _WORDS.text("groups", groups="; ".join(told))
    return [Check(kind="groups", outcome="fail", message=message, value=len(groups), limit=1)]


def _against_decays(
    fit: ChainFit, *, found: Identified, rows: Sequence[ParameterRow]
) -> tuple[RecordingGroup, ...]:
    """Return the fitted recordings and the decays, if these want other masses or springs.

    The springs are the same if all static gains agree. Other decays than exponential ones
    prove nothing.
    """
    gains = [row.consistent for row in rows if read_name(row.name).is_gain]
    bent = {d.experiment for d in found.decays if not d.law.is_exponential}
    pairs = {
        row.name: (row.initial, row.final)
        for row in rows
        if read_name(row.name).is_frequency and _differs(row)
        if row.initial and row.initial.source == "log_decrement" and row.final
        if not bent & set(row.initial.experiments)
    }
    if not pairs or not all(gains):
        return ()
    decays = dict.fromkeys(run for one, _ in pairs.values() for run in one.experiments)
    return tuple(
        RecordingGroup(
            experiments=runs,
            values={name: pair[i].value for name, pair in pairs.items()},
            std={name: std for name, pair in pairs.items() if (std := pair[i].std) is not None},
        )
        for i, runs in ((1, fit.experiments), (0, tuple(decays)))
    )


def _differs(row: ParameterRow) -> bool:
    """Return whether initial and final frequency differ by more than chance and by enough."""
    return (
        abs(row.change_percent or 0.0) > 100 * _DETUNED
        and row.change_sigmas is not None
        and row.change_sigmas > SIGMA_LIMIT
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
    names = [
        name
        for name in values[0]
        if all(name in one and name in fit.std for one, fit in zip(values, fits, strict=True))
        and read_name(name).symbol != "c"
    ]
    different = [
        name
        for name in names
        if any(
            abs(one[name] - values[0][name])
            > max(
                SIGMA_LIMIT * np.hypot(fit.std[name], fits[0].std[name]),
                _DIFFERENT * abs(values[0][name]),
            )
            for one, fit in zip(values[1:], fits[1:], strict=True)
        )
    ]
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
    rows = {"m": fit.chain.m, "k": fit.chain.k}
    return {f"{s}_{i}": float(v) for s, row in rows.items() for i, v in enumerate(row, start=1)}
