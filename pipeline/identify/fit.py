"""The fit of all carts: to the dwells, or to steps and sweeps where the dwells contradict them."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.estimation.chain.follow import Followed, find_misread, follow, most_follow, near
from pipeline.identify.limits import CONTRARY
from pipeline.identify.log import Log
from pipeline.identify.soundness.other_readings import without_lone_factors
from pipeline.names import own_zeta
from pipeline.results import ChainFit, Estimate, FrequencyResponse, LeftOut, Record
from pipeline.stages.bode_fit import fit_bode
from pipeline.stages.limits import FEW_COUNTS
from pipeline.stages.time_fit import fit_records


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """The fit of all carts, if any.

    Attributes
    ----------
    fits : how all records follow it, also those that it is made without.
    by_dwells : whether it rests on dwells, and they follow it.
    conflict : by id, the records that contradict one another so that nothing tells which are
        right, each with the reason: there is no fit then.
    """

    fit: ChainFit | None = None
    fits: Mapping[str, Followed] = field(default_factory=dict)
    by_dwells: bool = False
    conflict: Mapping[str, LeftOut] = field(default_factory=dict)


def fit_carts(
    responses: Sequence[FrequencyResponse],
    *,
    records: Sequence[Record],
    beside: Sequence[Record],
    driven: Sequence[Record],
    initial: dict[str, Estimate],
    n: int,
    springs: tuple[bool, ...],
    log: Log,
) -> Fitted:
    """Return the Bode fit where the records follow it, else the joint fit in time.

    `beside` are records that the fit is made without, but held against.
    """
    has_points = any(response.source != "records" for response in responses)
    dwells = [record for record in records if record.kind == "sine"]
    bode = None
    if has_points:
        values = {name: estimate.value for name, estimate in initial.items()}
        fit = log.attempt(
            "Bode fit",
            fit_bode,
            responses,
            n=n,
            springs=springs,
            initial=values,
            decays=_decay_dampings(initial, n=n),
        )
        bode = _held(fit, records, beside)
    mine = _kinds_that_follow(records, bode) if bode else set()
    if bode:
        bode = replace(bode, by_dwells="sine" in mine)
    if not driven:
        if bode is None:
            run = "step or sweep with all carts free" if n > 1 else "step or sweep"
            log.skip(
                "final estimates",
                f"the Bode fit gave none, and there is no {run} to fit them to"
                if has_points
                else f"there is no usable sine dwell, no table of amplitude ratios, and no {run}",
                missing=f"a {run}"
                if has_points
                else f"sine dwells over the resonances, or a {run}",
            )
        return bode or Fitted()
    if bode and not dwells:
        return bode
    contrary = bode is not None and bool(_contrary_kinds(records, bode))
    if bode and bode.by_dwells and not contrary and not _is_doubted(bode, dwells):
        return bode
    other = _held(
        log.attempt("final estimates", fit_records, driven, n=n, springs=springs), records, beside
    )
    if bode is None or other is None:
        return bode or other or Fitted()
    if other.fit is None or not other.fit.converged:
        return bode
    theirs = _kinds_that_follow(records, other)
    if bode.by_dwells and contrary and _votes(mine) == _votes(theirs):
        conflict = _conflict(records, bode, mine=mine, theirs=theirs)
        if conflict:
            log.skip("final estimates", next(iter(conflict.values())).reason)
            return Fitted(conflict=conflict)
    if contrary and _votes(mine) != _votes(theirs):
        better = _votes(mine) < _votes(theirs)
    else:  # one that dwells follow gives way only to one that they follow more closely yet
        better = not bode.by_dwells or _is_closer(other, bode, dwells)
    if not better:
        return bode
    kinds = {run.kind for run in driven if run.id in other.fit.experiments}
    used = " and ".join(f"{kind}s" for kind in ("step", "sweep") if kind in kinds)
    log.warn([f"the fit rests on the {used}: the dwells do not follow one chain"])
    return other


def _is_doubted(fitted: Fitted, dwells: Sequence[Record]) -> bool:
    """Whether the points are not explained, and most motions are few encoder steps.

    Rounding then hides the rest of a transient: beside a sharp resonance a dwell's amplitude is
    off by several of its errors.
    """
    assert fitted.fit is not None
    motions = [(r.position(cart), r.encoder_step(cart)) for r in dwells for cart in r.carts]
    counts = [float(np.ptp(y)) / step for y, step in motions if step > 0]
    coarse = bool(counts) and float(np.median(counts)) < 2 * FEW_COUNTS
    return coarse and not fitted.fit.explains_data


def _is_closer(fitted: Fitted, other: Fitted, dwells: Sequence[Record]) -> bool:
    """Whether a fit explains its own records, and the dwells follow it more closely."""
    assert fitted.fit is not None
    lost = [
        sum(one.fits[r.id].share for r in dwells if r.id in one.fits) for one in (fitted, other)
    ]
    return fitted.fit.explains_data and lost[0] < lost[1]


def _held(
    fit: ChainFit | None, records: Sequence[Record], beside: Sequence[Record]
) -> Fitted | None:
    return Fitted(fit=fit, fits=follow([*records, *beside], fit.chain)) if fit else None


def _kinds_that_follow(records: Sequence[Record], fitted: Fitted) -> set[str]:
    """Return the kinds of which most records follow."""
    return {
        kind
        for kind, ids in _by_kind(records, fitted).items()
        if most_follow({name: fitted.fits[name] for name in ids})
    }


def _votes(kinds: Set[str]) -> int:
    """Return how many ways of recording follow: steps and sweeps are logged in one way."""
    return len({"step" if kind == "sweep" else kind for kind in kinds})


def _contrary_kinds(records: Sequence[Record], fitted: Fitted) -> set[str]:
    """Return the kinds of which most records follow no carts like the fitted ones."""
    assert fitted.fit is not None
    chain, by_id = fitted.fit.chain, {record.id: record for record in records}

    def contrary(name: str) -> bool:
        return all(fit.share > CONTRARY for fit in near(by_id[name], chain))

    return {
        kind
        for kind, ids in _by_kind(records, fitted).items()
        if 2 * sum(not fitted.fits[name].belongs for name in ids) > len(ids)
        and 2 * sum(map(contrary, ids)) > len(ids)
    }


def _by_kind(records: Sequence[Record], fitted: Fitted) -> dict[str, list[str]]:
    kinds: dict[str, list[str]] = {}
    for record in records:
        if record.id in fitted.fits:
            kinds.setdefault(record.kind, []).append(record.id)
    return kinds


def _conflict(
    records: Sequence[Record], fitted: Fitted, *, mine: Set[str], theirs: Set[str]
) -> dict[str, LeftOut]:
    """Return why kinds that follow a chain and those that follow another may not be used.

    None are where no known mistake leads from the one to the other: the carts may be such.
    """
    assert fitted.fit is not None
    chain, ids = fitted.fit.chain, _by_kind(records, fitted)
    others = [r for r in records if r.id in fitted.fits and r.kind in theirs - mine]
    misread = {r.id: m for r in others if (m := find_misread(r, chain, fitted.fits[r.id]))}
    held = [record for record in records if record.id in fitted.fits]
    found = without_lone_factors(misread, held, fits=fitted.fits)
    if 2 * len(found) <= len(others):
        return {}
    example, misread = next(iter(found.items()))
    of_mine, of_theirs = (" and ".join(sorted(kinds)) for kinds in (mine - theirs, theirs - mine))
    reason = (
        f"the {of_mine} and the {of_theirs} records contradict one another, and nothing tells "
        f"which are right (of {example}, if the former are: {misread.words})"
    )
    return {
        name: LeftOut(experiment=name, reason=reason, is_wrong=True)
        for kind in mine ^ theirs
        for name in ids[kind]
    }


def _decay_dampings(initial: dict[str, Estimate], *, n: int) -> dict[int, Estimate]:
    """Return by cart the damping ratio it has alone, as far as decays tell."""
    own = {cart: initial.get(own_zeta(cart, n=n)) for cart in range(1, n + 1)}
    return {
        cart: zeta
        for cart, zeta in own.items()
        if zeta and zeta.source == "log_decrement" and zeta.value > 0 and zeta.std
    }
