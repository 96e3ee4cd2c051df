"""Checks of the recordings: were they read, are they what is stated of them, which are left out."""

from collections.abc import Container, Iterable, Mapping, Sequence

import numpy as np

from pipeline.checks import limits
from pipeline.estimation.units_and_clocks import TIME_UNITS
from pipeline.ingest.columns import (
    conversion,
    input_units,
    is_count,
    is_known,
    position_units,
)
from pipeline.ingest.input_sign import FEW_NAMES, Signs
from pipeline.names import listed
from pipeline.results import SIGN, Check, LeftOut, Record, SinePoint
from pipeline.results_of_runs import HeadingUnit
from pipeline.submission import System

SCALES = POSITION_SCALE, INPUT_SCALE = "position_scale", "input_scale"  # then the record's id
_DWELL_FACTORS = {
    2 * np.pi: "the stated ones look to be in rad/s, and `frequency` is in Hz",
    1 / (2 * np.pi): "the stated ones look to be divided by 2π",
} | {
    factor: f"the time columns look to be in {unit}; head them `time [{short}]`"
    for factor, (unit, short) in TIME_UNITS.items()
}
_DWELLS_NAMED = 3
_SPELT_OUT = 3  # records of one kind, if all of it; more are told by their number
_PLURAL = {"sine": "dwells", "step": "steps", "decay": "decays", "sweep": "sweeps"}


def check_files(unreadable: Mapping[str, str]) -> list[Check]:
    """Fail for each experiment whose file could not be read."""
    return [
        Check.of(
            f"data.{name}", False, f"{name} could not be read, so all else is without it: {reason}"
        )
        for name, reason in unreadable.items()
    ]


def check_units(records: Sequence[Record], *, system: System) -> list[Check]:
    """Fail where a unit is unknown, or is not the one that headings or the numbers speak of."""
    position, drive = system.position.unit, system.input.unit
    fractions = [
        record.id for record in records if is_count(position) and _has_fractions_of_a_count(record)
    ]
    checks = []
    for role, unit, known in (
        ("position", position, position_units()),
        ("input", drive, input_units()),
    ):
        headed: dict[str, HeadingUnit] = {}
        for record in records:
            for other in record.heading_units:
                if other.role == role and not other.converts:
                    headed.setdefault(record.id, other)
        if not is_known(unit, known):
            checks.append(_unit_check(role, _unknown(unit, role=role, known=known)))
        elif headed:
            runs, other = list(headed), next(iter(headed.values()))
            checks.append(
                _unit_check(
                    role,
                    f"{listed(runs)}: {other.heading!r} is taken to be in {unit}, the unit in "
                    f"submission.toml. Is it in {other.unit}? If so, change {role} = "
                    f'{{ unit = "{other.unit}" }}; if not, change the heading.',
                    n=len(runs),
                )
            )
        elif role == "position" and fractions:
            checks.append(
                _unit_check(
                    role,
                    f"{listed(fractions)}: the positions hold fractions, and a count has none. In "
                    "which unit are they? No heading says it, so every static gain is said to be "
                    f"in {position}/{drive}. If they are in cm, write in submission.toml "
                    'position = { unit = "cm" }.',
                    n=len(fractions),
                )
            )
    return checks


def _unit_check(role: str, message: str, *, n: int | None = None) -> Check:
    value, limit = (None, None) if n is None else (float(n), 0.0)
    return Check.of(f"{role}_unit", False, message, value=value, limit=limit)


def _unknown(unit: str, *, role: str, known: Sequence[str]) -> str:
    """Return the question what an unknown unit is."""
    meant = next((one for one in known if one.casefold() == unit.casefold()), "")
    hint = f"did you mean {meant!r}?" if meant else f"known: {', '.join(known)}"
    return (
        f"The {role} unit {unit!r} is not known ({hint}), and every static gain is in it. Is it "
        f"right? If not, write {role} = {{ unit = … }} in submission.toml."
    )


def _has_fractions_of_a_count(record: Record) -> bool:
    return record.position_scale == 1.0 and not np.array_equal(record.y, np.round(record.y))


def check_scales(records: Sequence[Record], *, system: System) -> list[Check]:
    """Fail where positions or inputs reach further than any bench: they are in another unit.

    Counts for a length, millivolts for volts: the carts that such records give explain them as
    well as the right ones, and only every gain is off.
    """
    checks = []
    unit, metres = system.position.unit, conversion(system.position.unit, "m")
    travel, run = _reached((r, float(np.ptp(r.y, axis=1).max())) for r in records)
    whole = all(np.array_equal(record.y, np.round(record.y)) for record in records)
    if metres and travel > (limit := (limits.LONGEST_WHOLE if whole else limits.LONGEST) / metres):
        why = "in whole numbers only" if whole else "further than a bench is long"
        message = (
            f"{run}: the positions run through {travel:.4g} {unit}, {why}: these "
            "look like encoder counts, and every static gain is in them. Multiply them by the "
            "length of a count; or head the columns `Encoder 1 Pos` … and state position = "
            f"{{ unit = {unit!r}, per_count = … }}; or state position = {{ unit = 'count' }}."
        )
        checks.append(
            Check.of(f"{POSITION_SCALE}.{run}", False, message, value=travel, limit=limit)
        )
    unit, volts = system.input.unit, conversion(system.input.unit, "V")
    # Under feedback a bench may log another signal as its input.
    driven = [(r, r.u) for r in records if r.u is not None and r.kind != "closed_loop"]
    largest, run = _reached((r, float(np.abs(u).max())) for r, u in driven)
    if volts and largest * volts > limits.LARGEST:
        message = (
            f"{run}: the input reaches {largest:.4g} {unit}, more than a bench's amplifier "
            "gives, and every static gain is off as much: is it in mV, or in counts? Head the "
            f"column `input [mV]`, or state input = {{ unit = {unit!r}, per_count = … }}."
        )
        checks.append(
            Check.of(
                f"{INPUT_SCALE}.{run}", False, message, value=largest, limit=limits.LARGEST / volts
            )
        )
    return checks


def _reached(reaches: Iterable[tuple[Record, float]]) -> tuple[float, str]:
    """Return how far two kinds of experiment reach, and where: one alone may be a slip."""
    by_kind: dict[str, tuple[float, str]] = {}
    for record, reach in reaches:
        by_kind[record.kind] = max(by_kind.get(record.kind, (0.0, "")), (reach, record.id))
    return sorted(by_kind.values())[-2:][0] if by_kind else (0.0, "")


def check_signs(signs: Signs, *, without: Container[str]) -> list[Check]:
    """Return a failed check where records contradict the sign that is stated of them.

    `without` are records that do not hold what happened, so that their sign says nothing. A bench
    has one sign: what a few dwells say against the others, a long delay makes them say.
    """
    says, wrong = [], 0
    for sign in (1, -1):
        told = [
            name
            for name, found in signs.found.items()
            if signs.stated.get(name) == sign and found and name not in without
        ]
        contrary = [name for name in told if signs.found[name] == -sign]
        if contrary and 2 * len(contrary) >= len(told):
            those = "all" if contrary == told else f"{len(contrary)} of the {len(told)}"
            says.append(
                f"sign = {sign} of the input contradicts the data, which say {-sign:+d} in "
                f"{listed(contrary, most=FEW_NAMES)} ({those} that tell it): set sign = {-sign} "
                "there, or leave it out."
            )
            wrong += len(contrary)
    if not says:
        return []
    return [Check.of(SIGN, False, " ".join(says), value=float(wrong), limit=0.0)]


def check_left_out(left_out: Sequence[LeftOut], *, records: Sequence[Record]) -> list[Check]:
    """Return a failed check for each reason for which some of the records are not used."""
    runs: dict[str, list[str]] = {}
    for one in left_out:
        runs.setdefault(one.reason, []).append(one.experiment)
    return [
        Check.of(
            f"record.{names[0]}",
            False,
            f"Left out {'is' if len(names) == 1 else 'are'} {_named(names, records)}: {reason}.",
            value=float(len(names)),
            limit=0.0,
        )
        for reason, names in sorted(runs.items(), key=lambda item: -len(item[1]))
    ]


def _named(names: Sequence[str], records: Sequence[Record]) -> str:
    """Return names of records, those of a whole kind as such: "all 29 dwells, step-2"."""
    said: list[str] = []
    for kind in dict.fromkeys(record.kind for record in records):
        alike = [record.id for record in records if record.kind == kind]
        of_kind = [name for name in alike if name in names]
        whole = len(of_kind) == len(alike) > _SPELT_OUT
        said += [f"all {len(alike)} {_PLURAL.get(kind, kind)}"] if whole else of_kind
    return ", ".join(said)


def check_setup(records: Sequence[Record]) -> list[Check]:
    """Ask whether the carts that should be free are those that move (where all were measured)."""
    checks = []
    for record in records:
        swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
        free = max((swing[cart] for cart in record.carts if cart in record.free), default=0.0)
        held = {cart: swing[cart] for cart in record.carts if cart not in record.free}
        if not held or not any(cart in record.free for cart in record.carts):
            continue
        mover = max(held, key=lambda cart: held[cart])
        good = free >= limits.HELD_SHARE * held[mover]
        named = ", ".join(map(str, record.free))
        found = (
            f"the carts said to be free ({named}) are those that move."
            if good
            else f"cart {mover} moves and cart {named} does not, but cart {named} is said "
            "to be free: is `carts` right, and is each cart in its column?"
        )
        ratio = held[mover] / free if free > 0 else None
        message = f"{record.id}: {found}"
        checks.append(
            Check.of(f"setup.{record.id}", good, message, value=ratio, limit=1 / limits.HELD_SHARE)
        )
    return checks


def check_held(records: Sequence[Record]) -> list[Check]:
    """Fail for each record in which a cart that should be held moves much beside the free ones."""
    checks = []
    for record in records:
        swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
        free = max((swing[cart] for cart in record.carts if cart in record.free), default=0.0)
        for cart in (cart for cart in record.carts if cart not in record.free):
            if limits.HELD_FIRMLY * free < swing[cart] <= free:
                share = swing[cart] / free
                message = (
                    f"{record.id}: cart {cart} is said to be held, but it moves by "
                    f"{100 * share:.0f} % of what the free carts do: clamp it, for it drives its "
                    "neighbours"
                )
                checks.append(
                    Check.of(
                        f"held.{record.id}.cart_{cart}",
                        False,
                        message,
                        value=share,
                        limit=limits.HELD_FIRMLY,
                    )
                )
    return checks


def check_dwells(records: Sequence[Record], points: Sequence[SinePoint]) -> list[Check]:
    """Check that the dwells swing at the frequencies stated of them, as a class or one by one."""
    stated = {record.id: record.omega for record in records if record.omega}
    ratios = {
        point.experiment: stated[point.experiment] / point.omega
        for point in points
        if point.experiment in stated
    }
    off = {name: r for name, r in ratios.items() if abs(np.log(r)) > limits.OTHER_DWELL}
    if not off:
        return []
    ratio = float(np.median(list(off.values())))
    why = why_other_frequency(ratio)
    alike = all(abs(r / ratio - 1) < limits.OTHER_DWELL for r in off.values())
    told = f", {ratio:.4g} times: {why}" if why and alike else ""
    named = ", ".join(list(off)[:_DWELLS_NAMED]) + (" …" if len(off) > _DWELLS_NAMED else "")
    message = (
        f"{len(off)} of {len(ratios)} dwells ({named}) do not swing at the frequency stated{told}."
    )
    return [Check.of("dwells.frequency", False, message, value=ratio, limit=1.0)]


def why_other_frequency(ratio: float) -> str:
    """Return what a dwell stated at so many times its frequency looks to be, or ""."""
    close = (
        why
        for factor, why in _DWELL_FACTORS.items()
        if abs(ratio / factor - 1) < limits.OTHER_DWELL
    )
    return next(close, "")
