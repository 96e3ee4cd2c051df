"""The assumptions behind all numbers: springs, units, scales, sign, held carts.

Each assumption comes with the support that the data give it.
"""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from pipeline.identify.model_checks import physical_values
from pipeline.ingest.channels import little_motion
from pipeline.ingest.columns import is_count
from pipeline.ingest.read import DUTY_COUNT, Ingested
from pipeline.results import Assumption, ChainFit, Check, Record
from pipeline.submission import Submission, System
from pipeline.submission.load import spring_names
from pipeline.words.numbers import join_names, with_error

Support = Literal["supported", "contradicted", "open"]


def list_assumptions(
    submission: Submission, *, data: Ingested, fit: ChainFit | None, checks: Sequence[Check]
) -> tuple[Assumption, ...]:
    """Return the statements and assumptions about the bench, in the order of `submission.toml`."""
    system, failed = submission.system, [c for c in checks if c.outcome == "fail"]
    return (
        *_springs(system, fit=fit, failed=failed),
        *_units(system, data.records, failed=failed),
        *_scales(submission, data.records),
        *_sign(system, data, failed=failed),
        *_free_carts(data.records, n=system.carts, failed=failed),
    )


def _springs(
    system: System, *, fit: ChainFit | None, failed: Sequence[Check]
) -> Iterator[Assumption]:
    n, names = system.carts, spring_names(system.carts)
    springs = [any(system.springs)] if n == 1 else system.springs
    abouts = [" and ".join(names)] if n == 1 else names  # for one cart, only the sum is known
    values = physical_values(fit.chain, bench=system.bench) if fit else {}
    vanishing = {check.parameter for check in failed if check.kind == "vanishing"}
    contrary = {check.parameter: check.message for check in failed if check.kind == "springs"}
    unit = system.bench.units.stiffness
    for i, (about, present) in enumerate(zip(abouts, springs, strict=True), start=1):
        name = f"k_{i}"
        value = values.get(name)
        std = fit.std.get(name) if fit and value is not None else None
        number = "" if value is None else f"{name} = {with_error(value, std)} {unit}"
        wrong, shown, misfit = contrary.get(name, ""), "", "leaves a residual above the noise"
        if fit is None or not fit.converged:
            unknown = "no carts were identified"
        elif not present:
            shown = "the fit without it explains the data" if fit.explains_data else ""
            unknown = f"the fit without it {misfit}"
        else:
            wrong = wrong or (f"{number}: it may not exist" if name in vanishing else "")
            # A standard error includes the misfit of the carts.
            shown = number if fit.explains_data or std else ""
            unknown = f"{number}; the fit {misfit}"
        support, reason = _judge(wrong=wrong, shown=shown, unknown=unknown)
        yield Assumption(
            key="system.springs",
            about=about,
            value=present,
            origin="stated" if system.states_springs else "default",
            support=support,
            found=value,
            found_std=std,
            reason=reason,
        )


def _judge(*, wrong: str, shown: str, unknown: str) -> tuple[Support, str]:
    """Return the support of an assumption and its reason, the first of these that there is.

    Parameters
    ----------
    wrong, shown, unknown : what contradicts it, what supports it, and why nothing does.
    """
    if wrong:
        return "contradicted", wrong
    return ("supported", shown) if shown else ("open", unknown)


def _units(
    system: System, records: Sequence[Record], *, failed: Sequence[Check]
) -> Iterator[Assumption]:
    doubts = {check.kind: check.message for check in failed}
    for role, side in (("position", system.position), ("input", system.input)):
        headed = list(
            dict.fromkeys(
                record.id
                for record in records
                for one in record.heading_units
                if one.role == role and one.converts
            )
        )
        shown, unknown = "", "no heading states a unit"
        if headed:
            unknown = f"only the headings of {join_names(headed)} state a unit"
        if 2 * len(headed) >= sum(role == "position" or r.u is not None for r in records) > 0:
            shown = f"the headings of {join_names(headed)} state a unit"
        elif not headed and role == "position" and is_count(side.unit) and records:
            shown = "the positions are whole numbers, as counts are"
        wrong = doubts.get(f"{role}_unit") or doubts.get(f"{role}_scale") or ""
        support, reason = _judge(wrong=wrong, shown=shown, unknown=unknown)
        yield Assumption(
            key=f"system.{role}.unit",
            value=side.unit,
            origin="stated" if "unit" in side.model_fields_set else "default",
            support=support,
            experiments=tuple(headed),
            reason=reason,
        )


def _scales(submission: Submission, records: Sequence[Record]) -> Iterator[Assumption]:
    """Yield how much one count is worth, if the counts of any recording were converted."""
    system = submission.system
    own = {e.id: e.input.per_count for e in submission.experiments if e.input}
    for role, stated, scales in (
        ("position", system.position.per_count, {r.id: r.position_scale for r in records}),
        ("input", system.input.per_count, {r.id: abs(r.input_scale) for r in records}),
    ):
        per_count = stated or (DUTY_COUNT if role == "input" else None)
        used = [name for name, scale in scales.items() if scale == per_count and not own.get(name)]
        if used and per_count is not None:
            yield Assumption(
                key=f"system.{role}.per_count",
                value=per_count,
                origin="stated" if stated else "default",
                support="open",
                experiments=tuple(used),
                reason="no recording shows the size of a count",
            )


def _sign(system: System, data: Ingested, *, failed: Sequence[Check]) -> Iterator[Assumption]:
    driven = [r for r in data.records if np.ptp(r.input) > 0]
    if not driven:
        return
    stated = system.input.sign
    usual = 1 if sum(1 if r.input_scale > 0 else -1 for r in driven) >= 0 else -1
    sign = stated or usual
    shown_by = [name for name, found in data.signs.found.items() if found == sign]
    others = [name for name, found in data.signs.found.items() if found == -sign]
    wrong = next((check.message for check in failed if check.kind == "input"), "")
    but = f"; the opposite sign is shown by {join_names(others)}" if others else ""
    unseen = [r.id for r in driven if not stated and not data.signs.found.get(r.id)]
    taken = f"; taken over for {join_names(unseen)}, which do not show it" if unseen else ""
    shown = f"shown by {join_names(shown_by)}{but}{taken}" if shown_by else ""
    support, reason = _judge(wrong=wrong, shown=shown, unknown="no recording shows it")
    yield Assumption(
        key="system.input.sign",
        value=float(sign),
        origin="stated" if stated else "data" if shown_by else "default",
        support=support,
        experiments=tuple(shown_by),
        reason=reason,
    )


def _free_carts(
    records: Sequence[Record], *, n: int, failed: Sequence[Check]
) -> Iterator[Assumption]:
    """Yield one assumption for each set of free carts, with its recordings."""
    if n == 1:
        return
    wrong = {check.run for check in failed if check.kind == "setup"}
    for free in dict.fromkeys(record.free for record in records):
        alike = [record for record in records if record.free == free]
        names = tuple(record.id for record in alike)
        held = [cart for cart in range(1, n + 1) if cart not in free]
        unseen = [r.id for r in alike if not set(held or free) <= set(r.carts)]
        still = [
            r.id
            for r in alike
            if any(np.ptp(r.position(cart)) == 0 for cart in free if cart in r.carts)
        ]
        contrary = [name for name in names if name in wrong]
        shown, unknown = "", ""
        if still:
            unknown = f"in {join_names(still)} a cart stated as free does not move"
        elif little := [record.id for record in alike if _hardly_moving(record)]:
            unknown = f"in {join_names(little)} a cart stated as free hardly moves"
        elif unseen:
            what = "a held cart" if held else "a cart"
            unknown = f"in {join_names(unseen)} the position of {what} was not recorded"
        else:
            shown = "the held carts hardly move" if held else "all carts move"
        moves = f"in {join_names(contrary)} another cart moves" if contrary else ""
        support, reason = _judge(wrong=moves, shown=shown, unknown=unknown)
        yield Assumption(
            key="experiments.carts",
            value=free,
            origin="stated" if held else "default",
            support=support,
            experiments=names,
            reason=reason,
        )


def _hardly_moving(record: Record) -> bool:
    """Return whether a free cart moves so little that it may have been held."""
    if record.kind == "sine":  # near a null, a free cart hardly moves
        return False
    ranges = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
    return any(cart in record.free for cart in little_motion(ranges))
