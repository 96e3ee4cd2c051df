"""Find groups of recordings that want different carts, for example after masses were changed."""

from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.errors import DataError
from pipeline.estimation.record_fit import follow, is_driven
from pipeline.identify.carts import Identified
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import ChainFit, Check, ParameterRow, Record, RecordingGroup
from pipeline.set_up import Bench
from pipeline.stages.compare import SIGMA_LIMIT
from pipeline.stages.time_fit import fit_records
from pipeline.words.numbers import abridge, listing, with_error
from pipeline.words.phrases import phrases

_WORDS = phrases("checks")
# Share of a recording's power that the chain of its group may leave. A chain fitted to one step is
# slightly off, but much less than one with a mass that is 10 % off.
_OWN = 0.01
_DIFFERENT = 0.05  # relative difference of a mass or spring that matters
_MOST_SEEDS = 8  # recordings from which a group is started
_MOST_FAILED = 2  # recordings that no chain explains; after these, the carts are not linear
_MOST_GROUPS = 3
_ENOUGH = 0.9  # share of the driven recordings that must be in a group
_MOST_DWELLS = 8  # dwells that are fitted if a group has no other recordings


def find_groups(
    found: Identified, *, records: Sequence[Record], rows: Sequence[ParameterRow], bench: Bench
) -> tuple[RecordingGroup, ...]:
    """Return the groups of recordings that want different carts, the largest first.

    There are groups only if the carts of each group explain its recordings down to the noise, and
    no set of carts explains them all. With hidden physics, a residual remains. If the
    driven recordings follow a fit that explains its data, only the decays are compared with it.
    """
    fit = found.fit
    explained = fit if fit and fit.converged and fit.explains_data else None
    fits = found.fitted.fits
    if explained and all(fits[r.id].belongs for r in records if r.id in fits):
        return _against_decays(explained, found=found, rows=rows)
    driven = [r for r in records if is_driven(r) and len(r.free) == len(r.carts) == bench.n]
    start = explained and explained.chain
    groups: list[tuple[list[Record], ChainFit]] = []
    rest = driven
    while len(rest) > (1 - _ENOUGH) * len(driven):
        members = _largest(rest, start=start, bench=bench)
        own = _fit(members, bench=bench) if len(members) > 1 else None
        if own is None or not (own.converged and own.explains_data) or len(groups) == _MOST_GROUPS:
            return ()
        groups.append((members, own))
        rest = [record for record in rest if record not in members]
    if len(groups) < 2 or not _overlap([members for members, _ in groups]):
        return ()
    return _described(groups)


def check_groups(groups: Sequence[RecordingGroup]) -> list[Check]:
    """Return a failed check if groups of recordings want different carts."""
    if not groups:
        return []
    told = [
        abridge(list(group.experiments))
        + ": "
        + listing([f"{k} = {with_error(v, group.std.get(k))}" for k, v in group.values.items()])
        for group in groups
    ]
    message = _WORDS.text("groups", groups="; ".join(told))
    return [Check(kind="groups", outcome="fail", message=message, value=len(groups), limit=1)]


def _against_decays(
    fit: ChainFit, *, found: Identified, rows: Sequence[ParameterRow]
) -> tuple[RecordingGroup, ...]:
    """Return the fitted recordings and the decays, if these want other masses.

    The springs are the same if all static gains agree. Other decays than exponential ones
    prove nothing.
    """
    gains = [row.consistent for row in rows if read_name(row.name).is_gain]
    bent = {d.experiment for d in found.decays if not d.law.is_exponential}
    pairs = {
        row.name: (row.initial, row.final)
        for row in rows
        if row.consistent is False and read_name(row.name).is_frequency
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


def _largest(rest: Sequence[Record], *, start: Chain | None, bench: Bench) -> list[Record]:
    """Return the largest group of recordings that follow one chain."""
    largest: list[Record] = []
    followed: set[str] = set()
    for chain in _chains(rest, followed, start=start, bench=bench):
        own = {name for name, one in follow(rest, chain).items() if one.share <= _OWN}
        followed |= own
        if len(own) > len(largest):
            largest = [record for record in rest if record.id in own]
    return largest


def _chains(
    rest: Sequence[Record], followed: set[str], *, start: Chain | None, bench: Bench
) -> Iterator[Chain]:
    """Yield chains that recordings may follow: `start`, then those of single recordings.

    Recordings that are in `followed` by then are skipped. So are those that no chain explains.
    """
    if start is not None:
        yield start
    failed = 0
    for record in [record for record in rest if record.kind != "sine"][:_MOST_SEEDS]:
        if record.id in followed:
            continue
        fit = _fit([record], bench=bench)
        if fit and fit.explains_data:
            yield fit.chain
        else:
            failed += 1
        if failed == _MOST_FAILED:
            return


def _fit(members: Sequence[Record], *, bench: Bench) -> ChainFit | None:
    whole = [record for record in members if record.kind != "sine"]
    dwells = members[:: 1 + len(members) // _MOST_DWELLS]
    try:
        return fit_records(whole or dwells, bench=bench)
    except DataError:
        return None


def _overlap(groups: Sequence[Sequence[Record]]) -> bool:
    """Return whether the motion of each group is as large as that of the others.

    With a spring that stiffens, small and large motion want different carts too.
    """
    sizes = [[float(np.ptp(record.position(1))) for record in members] for members in groups]
    return all(min(a) <= np.median(b) <= max(a) for a in sizes for b in sizes)


def _described(groups: Sequence[tuple[Sequence[Record], ChainFit]]) -> tuple[RecordingGroup, ...]:
    """Return the groups with the numbers that differ, if any do."""
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
