"""Check that the recordings were read, match their description, and were used; remark on them."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from math import ceil

import numpy as np

from pipeline.estimation.force_balance import without_releases
from pipeline.identify.findings import say, valid_records
from pipeline.identify.recording_faults import (
    LEAST_SHARE,
    OTHER_DWELL,
    find_loose_holds,
    find_other_scales,
    find_other_steps,
    find_other_units,
    find_wrong_setups,
    late_experiments,
    late_finding,
    swings,
    why_other_frequency,
)
from pipeline.ingest.channels import line_frequency, saturation
from pipeline.ingest.columns import conversion, input_units, is_count, is_known, position_units
from pipeline.ingest.read import Ingested
from pipeline.ingest.sign import FEW_NAMES, Signs
from pipeline.results import (
    Analysis,
    Check,
    CheckKind,
    Finding,
    HeadingUnit,
    Intervention,
    LateChannel,
    Record,
    SinePoint,
)
from pipeline.setup import Setup
from pipeline.words.numbers import group_messages, join_names
from pipeline.words.phrases import phrases

_SPELT_OUT = 3  # up to so many records are listed by name, even if they are a whole kind
_PLURAL = {"sine": "dwells", "step": "steps", "decay": "decays", "sweep": "sweeps"}
# Relative difference between a stated frequency and that of the input. A larger one means that the
# file belongs to another run.
_OTHER_RUN = 0.08
_WORDS = phrases("skipped")
# m/s. The carts of a bench reach 0.4, and those of inverted pendulums 3. Centimetres read as metres
# give 15 to 40.
_FASTEST = 10.0


def check_recordings(
    data: Ingested,
    *,
    left_out: Sequence[Finding],
    sines: Sequence[SinePoint],
    late: Sequence[LateChannel],
    bench: Setup,
) -> list[Check]:
    """Return all checks of the recordings, those whose failure affects most numbers first."""
    sound = valid_records(data.records, left_out)
    return [
        *check_signs(data.signs, without={one.experiment for one in left_out if one.is_wrong}),
        *check_files(data.unreadable),
        *check_units(data.records, bench=bench),
        *(one.check for one in find_other_scales(sound, bench=bench)),
        *check_left_out(left_out, records=data.records),
        *check_setup(data.records),
        *(one.check for one in find_loose_holds(data.records)),
        *check_dwells(data.records, sines),
        *check_channels(late),
    ]


def check_files(unreadable: Mapping[str, str]) -> list[Check]:
    """Return a failed check for each experiment whose file could not be read."""
    return [
        Finding(
            code="not_read", kind="data", run=name, details={"runs": name, "reason": reason}
        ).check
        for name, reason in unreadable.items()
    ]


def check_units(records: Sequence[Record], *, bench: Setup) -> list[Check]:
    """Return failed checks if a unit is unknown, or if headings or numbers contradict it."""
    counted = is_count(bench.units.position)
    fractions = [r.id for r in records if counted and _has_fractions_of_a_count(r)]
    checks = []
    sides: tuple[tuple[str, CheckKind, str, Sequence[str]], ...] = (
        ("position", "position_unit", bench.units.position, position_units()),
        ("input", "input_unit", bench.units.input, input_units()),
    )
    for role, kind, unit, known in sides:
        headed: dict[str, HeadingUnit] = {}
        for record in records:
            for other in record.heading_units:
                if other.role == role and not other.converts:
                    headed.setdefault(record.id, other)
        if not is_known(unit, known):
            details = {"role": role, "unit": repr(unit), "hint": _hint(unit, known=known)}
            finding = Finding(code="unknown_unit", kind=kind, details=details)
            checks.append(finding.check)
        elif headed:
            other = next(iter(headed.values()))
            details = {"heading": repr(other.heading), "unit": unit}
            details |= {"other": other.unit, "role": role}
            checks.append(_unit_check("other_heading", kind, runs=list(headed), details=details))
        elif role == "position" and (other_step := find_other_steps(records, bench=bench)):
            checks.append(other_step.check)
        elif role == "position" and fractions:
            details = {"gain_unit": bench.units.gain}
            checks.append(_unit_check("fractions", kind, runs=fractions, details=details))
    return checks


def _unit_check(
    code: str, kind: CheckKind, *, runs: Sequence[str], details: Mapping[str, str]
) -> Check:
    return Finding(
        code=code,
        kind=kind,
        details={"runs": join_names(runs), **details},
        value=float(len(runs)),
        limit=0.0,
    ).check


def _hint(unit: str, *, known: Sequence[str]) -> str:
    """Return which unit may be meant, or else all known units."""
    meant = next((one for one in known if one.casefold() == unit.casefold()), None)
    if meant:
        return say("did_you_mean", unit=repr(meant))
    return say("known_units", units=", ".join(known))


def _has_fractions_of_a_count(record: Record) -> bool:
    return record.position_scale == 1.0 and not np.array_equal(record.y, np.round(record.y))


def check_signs(signs: Signs, *, without: Container[str]) -> list[Check]:
    """Return a failed check if records contradict the stated sign of the input.

    Records in `without` are ignored, because they do not show what happened. A bench has only one
    sign. If just a few dwells contradict it, the cause is a long delay, so the check does not fail.
    """
    says, wrong = [], 0
    for sign in (1, -1):
        determined = [
            name
            for name, found in signs.found.items()
            if signs.stated.get(name) == sign and found and name not in without
        ]
        contrary = [name for name in determined if signs.found[name] == -sign]
        if contrary and 2 * len(contrary) >= len(determined):
            those = f"{len(contrary)} of the {len(determined)}"
            shown = say(
                "sign_shown",
                stated=sign,
                found=f"{-sign:+d}",
                found_plain=-sign,
                runs=join_names(contrary, most=FEW_NAMES),
                those="all" if contrary == determined else those,
            )
            says.append(shown)
            wrong += len(contrary)
    if not says:
        return []
    details = {"shown": " ".join(says)}
    finding = Finding(
        code="sign", kind="input", part="sign", details=details, value=float(wrong), limit=0.0
    )
    return [finding.check]


def check_left_out(left_out: Sequence[Finding], *, records: Sequence[Record]) -> list[Check]:
    """Return a failed check for each reason for which records were left out."""
    runs: dict[str, list[str]] = {}
    for one in left_out:
        runs.setdefault(one.reason, []).append(one.experiment)
    return [
        Finding(
            code="left_out",
            run=names[0],
            details={
                "are": "is" if len(names) == 1 else "are",
                "runs": _named(names, records),
                "reason": reason,
            },
            value=float(len(names)),
            limit=0.0,
        ).check
        for reason, names in sorted(runs.items(), key=lambda item: -len(item[1]))
    ]


def _named(names: Sequence[str], records: Sequence[Record]) -> str:
    """Return the names of records in words, or the whole kind: "all 29 dwells, step-2"."""
    parts: list[str] = []
    for kind in dict.fromkeys(record.kind for record in records):
        alike = [record.id for record in records if record.kind == kind]
        of_kind = [name for name in alike if name in names]
        whole = len(of_kind) == len(alike) > _SPELT_OUT
        parts += [f"all {len(alike)} {_PLURAL.get(kind, kind)}"] if whole else of_kind
    return ", ".join(parts)


def check_setup(records: Sequence[Record]) -> list[Check]:
    """Check that the carts that move are the free ones, if all carts were measured."""
    wrong = {fault.run: fault for fault in find_wrong_setups(records)}
    checks = []
    for record in records:
        free, held = swings(record)
        if record.id in wrong:
            checks.append(wrong[record.id].check)
        elif held:
            named = ", ".join(map(str, record.free))
            check = Check(
                kind="setup",
                run=record.id,
                outcome="pass",
                value=max(held.values()) / free if free > 0 else None,
                limit=1 / LEAST_SHARE,
                message=say("setup_right", run=record.id, free=named),
            )
            checks.append(check)
    return checks


def check_channels(late: Sequence[LateChannel]) -> list[Check]:
    """Return a failed check for each cart whose position is read late."""
    kinds = {
        "sine": "the dwells",
        "step": "the steps",
        "sweep": "the sweeps",
        "decay": "the decays",
        "closed_loop": "closed loop",
    }
    checks = []
    for _, of_cart in groupby(sorted(late, key=lambda one: one.cart), key=lambda one: one.cart):
        alike = list(of_cart)
        surest = min(alike, key=lambda one: (one.than, one.limit))
        kinds_text = join_names([kinds[one.kind] for one in alike])
        finding = late_finding(surest)
        details = {**finding.details, "kinds": kinds_text}
        checks.append(replace(finding, code="late_channel_in", details=details).check)
    return checks


def check_dwells(records: Sequence[Record], points: Sequence[SinePoint]) -> list[Check]:
    """Check that the dwells have their stated frequencies, all together or one by one."""
    stated = {record.id: record.omega for record in records if record.omega}
    ratios = {
        point.experiment: stated[point.experiment] / point.omega
        for point in points
        if point.experiment in stated
    }
    off = {name: r for name, r in ratios.items() if abs(np.log(r)) > OTHER_DWELL}
    if not off:
        return []
    ratio = float(np.median(list(off.values())))
    look = why_other_frequency(ratio)
    alike = all(abs(r / ratio - 1) < OTHER_DWELL for r in off.values())
    details = {
        "off": len(off),
        "all": len(ratios),
        "runs": ", ".join(list(off)[:3]) + (" …" if len(off) > 3 else ""),
        "why": say("dwells_why", ratio=f"{ratio:.4g}", look=look) if look and alike else "",
    }
    finding = Finding(
        code="dwells", kind="dwells", part="frequency", details=details, value=ratio, limit=1.0
    )
    return [finding.check]


def find_bad_recordings(analysis: Analysis) -> dict[str, Finding]:
    """Return the recordings with a fault, each with its first one."""
    found = {
        name: Finding(code="unreadable", run=name, details={"reason": why}, excludes="wrong")
        for name, why in analysis.unreadable.items()
    }
    found |= {one.run: one for one in analysis.left_out if one.is_wrong}
    sound = valid_records(analysis.records, analysis.left_out)
    scales = find_other_scales(sound, bench=analysis.bench)
    setups = {one.run: one for one in (*scales, *find_wrong_setups(analysis.records))}
    late = late_experiments(analysis.late_channels)
    # A cart that sticks rests at its turning points, which looks like a clipped reading.
    sticky = analysis.fit is not None and not analysis.fit.explains_data
    for record in analysis.records:
        name = record.id
        if name in setups:
            found[name] = setups[name]
            continue
        faults = [*_channels_at_fault(record, sticky=sticky), late.get(name)]
        first = next(filter(None, faults), None)
        if first:
            found.setdefault(name, first)
    return found


def _channels_at_fault(record: Record, *, sticky: bool) -> Iterator[Finding]:
    """Yield a fault for each clipped channel, and for an input with a wrong frequency."""
    for cart in record.carts:
        if cart not in record.free or sticky or record.kind not in ("sine", "sweep"):
            continue
        if (limit := saturation(record.position(cart))) is not None:
            details = {"limit": f"{limit:.4g}"}
            yield Finding(code="clipped_position", run=record.id, cart=cart, details=details)
    u = record.u
    if u is None or record.kind == "closed_loop":
        return
    if (limit := saturation(u)) is not None:
        details = {"limit": f"{limit:.4g}"}
        yield Finding(code="clipped_input", run=record.id, details=details)
    if record.kind == "sine" and record.omega is not None and np.ptp(u) > 0:
        hertz, stated = line_frequency(record.t, u), record.omega / (2 * np.pi)
        resolution = 1.0 / float(record.t[-1] - record.t[0])
        if hertz is not None and abs(hertz - stated) > max(_OTHER_RUN * stated, resolution):
            look = why_other_frequency(stated / hertz) or say("frequency_of_another")
            details = {"found": f"{hertz:.3g}", "stated": f"{stated:.3g}", "look": look}
            yield Finding(code="other_frequency", run=record.id, details=details)


# ---------------------------------------------------------------------- remarks


def reading_remarks(data: Ingested, *, unit: str) -> list[str]:
    """Return the notes from reading the files, with warnings about units.

    There is one if `unit` seems wrong, and one for decays in other units. Their unit does not
    affect their results.
    """
    units = find_other_units(data.records, decays=True)
    return [
        *data.warnings,
        *_too_fast(data.records, unit=unit),
        *group_messages((record.id, note) for record in data.records for note in record.notes),
        *group_messages(
            (name, _WORDS.text("decay_in_other_unit", reason=one.reason))
            for name, one in units.items()
        ),
    ]


def hand_remarks(interventions: Sequence[Intervention], *, records: Sequence[Record]) -> list[str]:
    """Return in which records and when a hand moves a cart, except for releases of decays."""
    return group_messages(
        (
            one.experiment,
            _WORDS.text(
                "hand",
                cart=one.cart,
                what=one.what,
                start=f"{one.start:.2f}",
                end=f"{one.end:.2f}",
            ),
        )
        for one in without_releases(interventions, records)
    )


def _too_fast(records: Sequence[Record], *, unit: str) -> list[str]:
    """Return a warning if the carts are impossibly fast in two kinds of experiments.

    If only one kind of experiment is too fast, it may be an accident.
    """
    metres = conversion(unit, "m")
    fastest: dict[str, tuple[float, str]] = {}
    for record in records if metres else ():
        there = fastest.get(record.kind, (0.0, ""))
        fastest[record.kind] = max(there, (_speed(record), record.id))
    speed, run = sorted(fastest.values())[-2] if len(fastest) > 1 else (0.0, "")
    if not metres or speed * metres <= _FASTEST:
        return []
    return [_WORDS.text("too_fast", run=run, speed=f"{speed:.2g}", unit=unit)]


def _speed(record: Record) -> float:
    """Return the speed of the fastest cart, position units/s, without momentary jumps."""
    span = max(1, ceil(0.02 / record.sample_time))
    moved, took = record.y[:, span:] - record.y[:, :-span], record.t[span:] - record.t[:-span]
    if not took.size:
        return 0.0
    # The speed is taken over 20 ms and without the fastest hundredth, because a jump of the encoder
    # is not a speed.
    return float(np.quantile(np.abs(moved) / took, 0.99, axis=1).max())


def is_reversed(records: Sequence[Record]) -> bool:
    """Whether a positive input, with the bench's sign, pushes cart 1 towards negative x."""
    signs = [r.input_scale for r in records if r.u is not None and r.kind != "closed_loop"]
    return sum(1 if sign > 0 else -1 for sign in signs) < 0


def gain_sign_warning(records: Sequence[Record]) -> list[str]:
    """Return a warning if the bench's input has the opposite sign of the designed gains."""
    if not is_reversed(records):
        return []
    return [_WORDS.text("reversed")]
