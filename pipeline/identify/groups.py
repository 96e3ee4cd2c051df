"""Find recordings that want different carts, for example, after masses were changed.

Two searches look for them. Groups that the carts of each explain down to the noise are found
beside the fit. Set-ups that differ so much that no fit of all recordings makes sense are found
before it: a cart is held, another program ran, or the carts are others. Their carts need only
explain most of the motion, as with dry friction.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import PurePosixPath

import numpy as np

from pipeline.errors import DataError
from pipeline.estimation.estimates import SIGMA_LIMIT
from pipeline.estimation.parametrisation import Parametrisation
from pipeline.estimation.record_fit import (
    RecordFit,
    find_correction,
    is_driven,
    record_fits,
)
from pipeline.estimation.time_fit import (
    FOLLOWED,
    WIDTHS,
    evaluate_chain,
    fit_records,
    minimise_from,
    open_window,
    regress_chain,
)
from pipeline.identify.findings import say
from pipeline.ingest.channels import little_motion, settles_at_input
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import (
    EXPLAINED,
    ChainFit,
    Check,
    Finding,
    LogDecrement,
    ParameterRow,
    Record,
    RecordingGroup,
)
from pipeline.setup import Setup
from pipeline.submission.models import is_named
from pipeline.words.numbers import first_few, join_names, listing, with_error

_MOST_SEEDS = 8  # recordings from which a group is started
_MOST_FAILED = 2  # recordings that no chain explains; after these, the carts are not linear
_MOST_GROUPS = 3
_FARTHER = 1.5  # times the motion of another group
_CONTRARY = 0.3  # share of the motion that the carts of another set-up leave unexplained
_SAME_INPUT = 0.95  # share of another input's range that an equally large input reaches
# A date in the name of a file or folder, or the day of a time stamp.
_DATE = re.compile(
    r"(?<!\d)\d{4}([-_.]?)[01]\d\1[0-3]\d(?!\d)|(?<!\d)\d{1,2}[-_.]\d{1,2}[-_.]\d{4}(?!\d)"
    r"|(?<!\d)\d{1,2}[-_. ]?(?:jan(?:uary)?|feb(?:ruary)?|mar(?:ch)?|apr(?:il)?|may|june?|july?"
    r"|aug(?:ust)?|sept?(?:ember)?|oct(?:ober)?|nov(?:ember)?|dec(?:ember)?)(?![a-z])"
    r"(?:[-_. ]?\d{4})?(?!\d)",
    re.IGNORECASE,
)


def find_groups(
    fit: ChainFit | None,
    *,
    fits: Mapping[str, RecordFit],
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
    explained = fit if fit and fit.converged and fit.explains_data else None
    driven = [r for r in records if is_driven(r) and len(r.free) == len(r.carts) == bench.n]
    one = explained and all(fits[r.id].chi_square <= EXPLAINED for r in driven if r.id in fits)
    groups = [] if one else _driven_groups(driven, start=explained, bench=bench)
    if told := _described(groups):
        return told
    if not (fit and fit.converged) and (told := find_setups(driven, bench=bench)):
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
    most = 10 * len(rest) < len(driven)  # more than nine tenths are in a group
    return groups if most and _overlap([members for members, _ in groups]) else []


def _against_decays(
    fit: ChainFit, *, decays: Sequence[LogDecrement], rows: Sequence[ParameterRow]
) -> tuple[RecordingGroup, ...]:
    """Return the fitted recordings and the decays, if these want other masses or springs.

    The springs are the same if all static gains agree. Other decays than exponential ones
    prove nothing.
    """
    gains = [row.consistent for row in rows if read_name(row.name).is_gain]
    bent = {d.experiment for d in decays if not d.law.is_exponential}
    # A frequency must differ by 2.5 %, as with a mass or spring that differs by 5 %.
    pairs = {
        row.name: (row.initial, row.final)
        for row in rows
        if read_name(row.name).is_frequency
        if abs(row.change_percent or 0.0) > 2.5
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
    # Eight dwells are enough if a group has no other recordings.
    dwells = members[:: 1 + len(members) // 8]
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
        > max(SIGMA_LIMIT * np.hypot(fit.std[name], std[name]), 0.05 * abs(first[name]))
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


# ------------------------------------------------------------ set-ups, before the fit


@dataclass(frozen=True, kw_only=True, eq=False)
class _Setup:
    """Recordings of one set-up, without the carts that hardly move, and a chain they follow."""

    held: tuple[int, ...]
    members: Sequence[Record]
    chain: Chain


def find_setups(driven: Sequence[Record], *, bench: Setup) -> tuple[RecordingGroup, ...]:
    """Return the set-ups of steps and sweeps that contradict each other, the largest first.

    There are set-ups only if at least two of them have two recordings or more, and each pair of
    them differs for no reason that a nonlinear bench or a known mistake in the files gives. The
    search costs some seconds at most, however many recordings there are.

    Parameters
    ----------
    driven : steps and sweeps in which all carts are stated as free.
    """
    by_held: dict[tuple[int, ...], list[Record]] = {}
    for record in driven:
        held = _seems_held(record)
        # The carts before the first held one are a chain of their own.
        alone = not held or held == tuple(range(held[0], bench.n + 1))
        if is_driven(record) and 1 not in held and alone:
            by_held.setdefault(held, []).append(record)
    setups = [s for held, alike in by_held.items() for s in _setups(alike, held, bench=bench)]
    setups.sort(key=lambda one: len(one.members), reverse=True)
    if len(setups) < 2 or not all(_contradict(a, b) for a, b in combinations(setups, 2)):
        return ()
    names = [{record.id for record in one.members} for one in setups]
    others = tuple(one.id for one in driven if not any(one.id in own for own in names))
    # A quarter of the recordings may follow none of the set-ups.
    if len(others) > 0.25 * len(driven):
        return ()
    values = _setup_values([one.chain for one in setups])
    groups = [
        RecordingGroup(
            experiments=tuple(record.id for record in driven if record.id in own),
            values=value,
            std={},
            remark=_remark(one),
        )
        for one, own, value in zip(setups, names, values, strict=True)
    ]
    if others:
        remark = say("group_others")
        groups.append(
            RecordingGroup(experiments=others, values={}, std={}, remark=remark, is_rest=True)
        )
    return tuple(groups)


def steps_disagree(driven: Sequence[Record]) -> bool:
    """Return whether carts move much farther in some steps than in others, or only in some."""
    steps = [record for record in driven if record.kind == "step" and is_driven(record)]
    ratios = [np.ptp(r.position(1)) / np.ptp(r.u) for r in steps if r.u is not None]
    # Dry friction and play change a gain by less than this factor.
    apart = len(ratios) > 3 and max(ratios) > 1.6 * min(ratios)
    return bool(apart) or len({_seems_held(record) for record in steps}) > 1


def _seems_held(record: Record) -> tuple[int, ...]:
    """Return the free carts that hardly move."""
    swings = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
    return tuple(cart for cart in little_motion(swings) if cart in record.free)


def _setups(records: Sequence[Record], held: tuple[int, ...], *, bench: Setup) -> list[_Setup]:
    """Return the set-ups among recordings in which the same carts hardly move."""
    n = held[0] - 1 if held else bench.n
    # Of two springs on one cart, only the sum shows.
    springs = bench.springs[: n + 1] if n > 1 or not held else (True, False)
    part = replace(bench, springs=springs)
    rest = [_only(record, n) for record in records]
    setups: list[_Setup] = []
    while len(rest) > 1 and len(setups) < _MOST_GROUPS:
        best, chain = [], None
        followed: set[str] = set()
        failed = 0
        for seed in rest[:_MOST_SEEDS]:
            if seed.id in followed or failed > _MOST_FAILED:
                continue
            if (own := _quick_chain(seed, bench=part)) is None:
                failed += 1
                continue
            fits = record_fits(rest, own)
            members = [r for r in rest if r.id in fits and fits[r.id].share <= FOLLOWED]
            followed |= {record.id for record in members}
            if len(members) > len(best):
                best, chain = members, own
        if chain is None or len(best) < 2:
            break
        rest = [record for record in rest if record not in best]
        setups.append(_Setup(held=held, members=best, chain=chain))
    return _with_stragglers(setups, rest)


def _with_stragglers(setups: Sequence[_Setup], rest: Sequence[Record]) -> list[_Setup]:
    """Return the set-ups with the recordings that can only belong to one of them.

    They contradict the carts of the others, or are the only ones with the same held carts or with
    the same program.
    """
    shares = [record_fits(rest, one.chain) for one in setups]
    programs = [_is_at_input(one.members) for one in setups]
    joined = list(setups)
    for record in rest:
        near = [i for i, fits in enumerate(shares) if record.id in fits]
        near = [i for i in near if not _is_contrary(shares[i][record.id])]
        alike = [i for i, program in enumerate(programs) if program and _is_at_input([record])]
        for home in (near, alike, range(len(setups)) if setups and setups[0].held else ()):
            if len(home) == 1:
                one = joined[home[0]]
                joined[home[0]] = replace(one, members=[*one.members, record])
                break
    return joined


def _only(record: Record, n: int) -> Record:
    """Return the record with its first n carts only."""
    rows = [i for i, cart in enumerate(record.carts) if cart <= n]
    return replace(
        record,
        carts=tuple(record.carts[i] for i in rows),
        free=tuple(cart for cart in record.free if cart <= n),
        y=record.y[rows],
        resolution=record.resolution[rows],
    )


def _quick_chain(record: Record, *, bench: Setup) -> Chain | None:
    """Return a chain that one recording follows, found from a regression; None without one."""
    parametrisation = Parametrisation(bench=bench)
    try:
        window = open_window(record)
        few = window.thinned(150)
    except DataError:  # nothing moves
        return None
    regressed = [regress_chain([window], bench=bench, width=width) for width in WIDTHS]
    starts = [parametrisation.pack(chain) for chain in regressed if chain]
    if not starts:
        return None
    start = min(starts, key=lambda theta: evaluate_chain([few], parametrisation, theta).cost)
    attempt = minimise_from([few], parametrisation, start)
    return attempt.chain if attempt.follows else None


def _contradict(one: _Setup, other: _Setup) -> bool:
    """Return whether no bench can be the cause of both set-ups, and no known mistake either."""
    pairs = [(a, b) for a in one.members for b in other.members]
    less = any(_farther_by_less(a, b) or _farther_by_less(b, a) for a, b in pairs)
    if one.held != other.held:
        # A larger input would move a cart that only sticks.
        fewer_held = len(one.held) < len(other.held)
        return less or any(_covers(b, a) if fewer_held else _covers(a, b) for a, b in pairs)
    if not less and not any(_covers(a, b) and _covers(b, a) for a, b in pairs):
        return False
    if not less and not _overlap([one.members, other.members]):
        return False
    for members, chain in ((other.members, one.chain), (one.members, other.chain)):
        fits = record_fits(members, chain)
        if not all(map(_is_contrary, fits.values())):
            return False
        if any(find_correction(r, chain, fits[r.id]) for r in members[:2] if r.id in fits):
            return False
    return True


def _is_contrary(fit: RecordFit) -> bool:
    """Return whether a chain and a record disagree, compared with the larger of their motions."""
    farther = max(1.0, *fit.amplitude_ratio.values())
    return fit.share * farther**2 > _CONTRARY


def _covers(one: Record, other: Record) -> bool:
    """Return whether a record's input reaches at least as far as another's, to both sides."""
    assert one.u is not None
    assert other.u is not None
    if one.kind != "step" or other.kind != "step":
        return False
    a, b = ((min(0.0, u.min()), max(0.0, u.max())) for u in (one.u, other.u))
    return bool(a[0] <= _SAME_INPUT * b[0] and a[1] >= _SAME_INPUT * b[1])


def _farther_by_less(one: Record, other: Record) -> bool:
    """Return whether cart 1 moves much farther in one step than in another with a larger input.

    A spring that stiffens or a bearing that sticks does not cause this.
    """
    swings = [float(np.ptp(record.position(1))) for record in (one, other)]
    return _covers(other, one) and swings[0] > _FARTHER * swings[1]


def _setup_values(chains: Sequence[Chain]) -> list[dict[str, float]]:
    """Return the numbers that differ between chains: the static gain, else masses and springs."""
    gains = [float(chain.static_gains()[0]) if any(chain.k) else np.inf for chain in chains]
    name = "K_1" if len(chains) and max(chain.n for chain in chains) > 1 else "K"
    if np.all(np.isfinite(gains)) and max(gains) > (1 + _CONTRARY / 2) * min(gains):
        return [{name: gain} for gain in gains]
    if len({chain.n for chain in chains}) > 1:
        return [{} for _ in chains]
    rows = [
        {f"{s}_{i}": float(v) for s, row in (("m", c.m), ("k", c.k)) for i, v in enumerate(row, 1)}
        for c in chains
    ]
    different = [k for k in rows[0] if max(r[k] for r in rows) > 1.1 * min(r[k] for r in rows)]
    return [{name: row[name] for name in different} for row in rows]


def _is_at_input(records: Sequence[Record]) -> bool:
    """Return whether cart 1 settles at the number in the input column in most records."""
    settled = [
        settles_at_input(r.u / r.input_scale, r.position(1) / r.position_scale)
        for r in records
        if r.u is not None and r.kind == "step"
    ]
    return 2 * sum(settled) > len(records)


def _remark(one: _Setup) -> str:
    """Return why a set-up may differ, and what to state in submission.toml; "" if unknown."""
    if one.held:
        return say("group_held", cart=one.held[0], free=list(range(1, one.held[0])))
    return say("group_at_input") if _is_at_input(one.members) else ""


# ------------------------------------------------------------------------------ words


def name_groups(
    groups: Sequence[RecordingGroup], records: Sequence[Record]
) -> tuple[RecordingGroup, ...]:
    """Return the groups with the day or folder that only their recordings share."""
    places = {record.id: _places(record) for record in records}
    named = []
    for group in groups:
        inside = [places[name] for name in group.experiments if name in places]
        outside = [
            places[name]
            for other in groups
            if other is not group
            for name in other.experiments
            if name in places
        ]
        shared = [
            place
            for place in (inside[0] if inside else ())
            if all(place in one for one in inside) and not any(place in one for one in outside)
        ]
        named.append(replace(group, label=shared[0] if shared else ""))
    return tuple(named)


def _places(record: Record) -> tuple[str, ...]:
    """Return what a recording may share with others of its set-up: day, folder."""
    source = PurePosixPath(record.source)
    day = _DATE.search(source.stem) or _DATE.search(record.id) or _DATE.search(record.source)
    folder = str(source.parent)
    return tuple(filter(None, (day and day.group(0).strip("-_. "), folder)))


def leave_out_lines(groups: Sequence[RecordingGroup]) -> dict[int, str]:
    """Return, by a group's number, the line of submission.toml that uses its recordings alone.

    The largest group comes first. Recordings that belong to no group get no line.
    """
    known = [name for group in groups for name in group.experiments]
    numbered = [(i, group) for i, group in enumerate(groups, start=1) if not group.is_rest]
    numbered.sort(key=lambda one: len(one[1].experiments), reverse=True)
    lines = {}
    for number, kept in numbered:
        names: list[str] = []
        for group in groups:
            pattern = f"*{group.label}*"
            is_exact = {name for name in known if is_named(name, pattern)} == {*group.experiments}
            if group is not kept:
                names += [pattern] if group.label and is_exact else group.experiments
        lines[number] = f"leave_out = {json.dumps(names, ensure_ascii=False)}"
    return lines


def group_name(group: RecordingGroup) -> str:
    """Return the day or folder of a group, else its first recording and how many more it has."""
    return group.label or first_few(group.experiments, 1)


def check_groups(groups: Sequence[RecordingGroup]) -> list[Check]:
    """Return a failed check if groups of recordings want different carts."""
    if not groups:
        return []
    told = []
    for number, group in enumerate(groups, start=1):
        values = [f"{k} = {with_error(v, group.std.get(k))}" for k, v in group.values.items()]
        names = join_names(list(group.experiments))
        named = f"{group.label}: {names}" if group.label else names
        about = "; ".join(filter(None, [listing(values), group.remark]))
        told.append(f"({number}) {named}: {about}")
    lines = [f"to keep ({number}), {line}" for number, line in leave_out_lines(groups).items()]
    details = {"groups": ". ".join(told), "lines": "; ".join(lines)}
    finding = Finding(code="groups", kind="groups", details=details, value=len(groups), limit=1)
    return [finding.check]
