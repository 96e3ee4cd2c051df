"""Find recordings that are damaged or contradict their description, check them, and remark on them.

No carts need be identified. Recordings contradict the stated free carts, units or frequencies;
their encoder is stuck or counts in another unit; their input or length is that of another
experiment; or one channel is read late. In addition, this module checks that recordings were read
and used.
"""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import ceil
from typing import Literal

import numpy as np

from pipeline.estimation.force_balance import find_channel_delays, without_releases
from pipeline.estimation.record_fit import LENGTH_SCALES, TIME_UNITS
from pipeline.identify.findings import (
    SAME,
    WITNESSES,
    by_kind,
    explain_ratio,
    first_by_run,
    say,
    valid_records,
)
from pipeline.ingest.channels import is_stepped, line_frequency, saturation, stuck_spans
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
    Record,
    SinePoint,
)
from pipeline.setup import Setup
from pipeline.words.numbers import group_messages, join_names
from pipeline.words.phrases import phrases

_OTHER_DWELL = 0.1  # relative; a dwell this far from its stated frequency is another dwell
# Share of a held cart's swing. If a cart that should be free moves less, it is not free.
_LEAST_SHARE = 0.2
# Share of the free carts' swing. A cart that is held firmly moves less.
_HELD_FIRMLY = 0.05
_LONGEST = 3.0  # metres; no bench has a longer track
# Metres per second, faster than a person runs. Carts of a bench reach 0.4, those of inverted
# pendulums 3. Centimetres read as metres give 15 to 40.
_FASTEST = 10.0
_ECP_STEP = 2.27e-5  # metres per count of the encoders of an ECP 210
# Volts. A converter of 16 bits and ± 10 V has steps of 0.3 mV.
_LEAST = 1e-3
_LATE, _SURE = 2.0, 4.0  # samples, and standard errors: a late channel exceeds both
# Correcting the delay must lower the residual of the carts' equation of motion by this factor.
# Friction, stops and stiff springs on benches of every kind look like delays, but correcting these
# lowers it by 1.7 times at most. Correcting a delay of 44 ms lowers it 8 times with much friction,
# and thousands of times without friction.
_BETTER = 5.0

_PLURAL = {"sine": "dwells", "step": "steps", "decay": "decays", "sweep": "sweeps"}
# Relative difference between a stated frequency and that of the input. A larger one means that the
# file belongs to another run.
_OTHER_RUN = 0.08
_WORDS = phrases("skipped")


# ------------------------------------------------------------------------- search


def _swings(record: Record) -> tuple[float, dict[int, float]]:
    """Return the largest swing of the free carts, and the swing of each held cart.

    If no free cart was measured, the held ones are left out.
    """
    swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
    free = [swing.pop(cart) for cart in record.measured_free]
    return (max(free), swing) if free else (0.0, {})


def _wrong_setup(record: Record) -> Finding | None:
    """Return what is wrong if a cart that should be held moves, but the free carts do not."""
    free, held = _swings(record)
    mover = max(held, key=lambda cart: held[cart], default=0)
    if not mover or free >= _LEAST_SHARE * held[mover]:
        return None
    return Finding(
        code="wrong_setup",
        kind="setup",
        run=record.id,
        details={"cart": mover, "free": ", ".join(map(str, record.free))},
        value=held[mover] / free if free > 0 else None,
        limit=1 / _LEAST_SHARE,
    )


def _loose_holds(record: Record) -> Iterator[Finding]:
    """Yield the carts that should be held but move much compared with the free ones."""
    free, held = _swings(record)
    for cart, swing in held.items():
        if _HELD_FIRMLY * free < swing <= free:
            yield Finding(
                code="moves_though_held",
                kind="held",
                run=record.id,
                cart=cart,
                details={"percent": f"{100 * swing / free:.0f}"},
                value=swing / free,
                limit=_HELD_FIRMLY,
            )


def _find_other_scales(records: Sequence[Record], *, bench: Setup) -> list[Finding]:
    """Find positions or inputs of a size that no bench has, and so must be in another unit.

    Examples are counts in place of a length, and millivolts in place of volts. A fit to such
    records looks as good as a fit to right ones; only the gains are wrong.
    """
    found = []
    unit, metres = bench.units.position, conversion(bench.units.position, "m")
    travel, run = _reached((r, float(np.ptp(r.y, axis=1).max())) for r in records)
    whole = all(np.array_equal(record.y, np.round(record.y)) for record in records)
    speeds = [np.abs(np.diff(r.y) / np.diff(r.t)).max(initial=0.0) for r in records]
    # If nothing moves faster than a person runs, a track may have 20 m.
    longest = 20.0 if max(speeds, default=0.0) * (metres or 0.0) < _FASTEST else _LONGEST
    # If all readings are whole numbers, as counts are, carts move by at most half a metre.
    if metres and travel > (limit := (0.5 if whole else longest) / metres):
        why = say("position_scale_whole" if whole else "position_scale_long")
        details = {"reach": f"{travel:.4g}", "unit": unit, "quoted": repr(unit), "why": why}
        found.append(_scale("position_scale", run, details=details, value=travel, limit=limit))
    # Under feedback, a bench may log another signal as its input.
    opened = [(r, r.u) for r in records if r.u is not None and r.kind != "closed_loop"]
    driven = [(r, float(np.abs(u).max())) for r, u in opened if np.any(u)]
    largest, run = _reached(driven)
    unit, volts = bench.units.input, conversion(bench.units.input, "V")
    headed = any(one.role == "input" for record in records for one in record.heading_units)
    if not (volts and driven):
        return found
    # No amplifier at a bench gives 100 V.
    most, why = 100.0, "input_scale_large"
    if not headed and _is_ecp(records, bench=bench):
        # The converter of an ECP 210 gives 10 V, and files round.
        most, why = 10.5, "input_scale_ecp"
    beyond = largest * volts / most
    if not headed and max(size for _, size in driven) * volts < _LEAST:
        beyond, why = _LEAST / (largest * volts), "input_scale_small"
    if beyond > 1.0:
        details = {"reach": f"{largest:.4g}", "unit": unit, "why": say(why)}
        found.append(_scale("input_scale", run, details=details, value=beyond, limit=1.0))
    return found


def _scale(
    code: Literal["position_scale", "input_scale"],
    run: str,
    *,
    details: Mapping[str, str],
    value: float,
    limit: float,
) -> Finding:
    return Finding(code=code, kind=code, run=run, details=details, value=value, limit=limit)


def _find_other_steps(records: Sequence[Record], *, bench: Setup) -> Finding | None:
    """Find positions whose encoder step is a power of ten times the known one of an ECP bench."""
    if any(one.role == "position" for record in records for one in record.heading_units):
        return None
    step = _encoder_step(records)
    metres = conversion(bench.units.position, "m") or 0.0
    if not _is_ecp(records, bench=bench) or (scale := _ecp_scale(step * metres)) == 1.0:
        return None
    details = {
        "step": f"{step:.3g}",
        "known": f"{_ECP_STEP / metres:.3g}",
        "unit": bench.units.position,
        "scale": f"{scale:g}",
    }
    return Finding(
        code="other_step",
        kind="position_unit",
        details=details,
        value=float(len(records)),
        limit=0.0,
    )


def _is_ecp(records: Sequence[Record], *, bench: Setup) -> bool:
    """Whether the encoder step is that of an ECP 210, in this unit or a power of ten of it."""
    step = _encoder_step(records) * (conversion(bench.units.position, "m") or 0.0)
    # Files round a step to two digits.
    return step > 0 and abs(np.log10(step / _ECP_STEP / _ecp_scale(step))) <= np.log10(1 + SAME)


def _ecp_scale(step: float) -> float:
    return float(10.0 ** round(np.log10(step / _ECP_STEP)))


def _encoder_step(records: Sequence[Record]) -> float:
    """Return the median encoder step; 0 if most channels do not show one."""
    steps = [float(step) for record in records for step in record.resolution]
    seen = [step for step in steps if step > 0]
    return float(np.median(seen)) if seen and 2 * len(seen) >= len(steps) else 0.0


def _reached(reaches: Iterable[tuple[Record, float]]) -> tuple[float, str]:
    """Return the second largest reach among the kinds of experiment, and its record.

    The largest one may be an accident. If there is only one kind, its reach is returned.
    """
    by_kind: dict[str, tuple[float, str]] = {}
    for record, reach in reaches:
        by_kind[record.kind] = max(by_kind.get(record.kind, (0.0, "")), (reach, record.id))
    return sorted(by_kind.values())[-2:][0] if by_kind else (0.0, "")


def _find_other_units(records: Sequence[Record], *, decays: bool = False) -> Iterator[Finding]:
    """Yield the records whose encoder step is the usual one converted to another unit.

    The usual step is that of most kinds of experiment, not of most records. A dozen dwells may have
    been exported together, and so may all be wrong. Steps of 0.01 and 0.001 differ only in the
    number of decimals. The unit of a decay does not matter, so decays are searched only if
    `decays` is true, and then nothing else.
    """
    for cart in sorted({cart for record in records for cart in record.carts}):
        measuring = [record for record in records if cart in record.carts]
        steps = [
            [step for r in alike if cart in r.carts and (step := r.encoder_step(cart))]
            for alike in by_kind(records).values()
        ]
        medians = [float(np.median(seen)) for seen in steps if seen]
        usual = max(medians, key=lambda step: sum(_alike(step, s) for s in medians), default=0.0)
        if sum(_alike(step, usual) for step in medians) < WITNESSES:
            continue
        scales = {s: f"{s:.3g}" for scale in LENGTH_SCALES for s in (scale, 1 / scale)}
        for record in [r for r in measuring if (r.kind == "decay") is decays]:
            step = record.encoder_step(cart)
            scale = explain_ratio(step / usual, scales, within=SAME)
            if scale and not (_is_decimal(step) and _is_decimal(usual)):
                details = {"scale": scale}
                yield Finding(code="other_unit", run=record.id, cart=cart, details=details)


def _alike(step: float, other: float) -> bool:
    return abs(step - other) <= SAME * other


def _is_decimal(step: float) -> bool:
    """Whether a step is a power of ten, so that it may come from the number of decimals."""
    return step > 0 and _alike(step, 10.0 ** round(np.log10(step)))


def find_shown(records: Sequence[Record], *, files: Mapping[str, str]) -> dict[str, Finding]:
    """Return, by id, the records that show by themselves or beside others that they are wrong.

    They are in another unit, or an encoder was stuck, or they are no complete recording of their
    kind. `files` has the digest of each data file.
    """
    faults = chain(_other_kinds(records, files=files), _stuck(records), _find_other_units(records))
    return {name: replace(one, excludes="wrong") for name, one in first_by_run(faults).items()}


def _stuck(records: Sequence[Record]) -> Iterator[Finding]:
    """Yield the records in which the encoder of a free cart was stuck.

    Static friction stops only a cart that is already slow, and the cart then starts from where it
    stopped. So the encoder was stuck if the reading stops while the cart is fast, or if it jumps
    when it changes again.
    """
    for record in records:
        for cart in record.measured_free:
            y = record.position(cart)
            for first, last in stuck_spans(y):
                moves = np.abs(np.diff(y))
                fastest = float(np.quantile(moves, 0.98))
                away = last < moves.size and moves[last] >= 1.5 * fastest
                if away or moves[first - 1] >= 0.6 * fastest:
                    details = span(record, first, last)
                    yield Finding(code="stuck", run=record.id, cart=cart, details=details)


def span(record: Record, first: int, last: int) -> dict[str, str]:
    """Return the times of two samples in words, for the sentence of a reading that stands still."""
    return {"first": f"{record.t[first]:.4g}", "last": f"{record.t[last]:.4g}"}


def _other_kinds(records: Sequence[Record], *, files: Mapping[str, str]) -> Iterator[Finding]:
    """Yield the records that are copies, truncated, or of another kind of experiment."""
    largest = max((float(np.abs(r.input).max()) for r in records), default=0.0)
    first: dict[str, str] = {}
    for record in records:
        original = first.setdefault(files.get(record.source, record.source), record.source)
        if original != record.source:
            details = {"source": record.source, "original": original}
            yield Finding(code="copied_file", run=record.id, details=details)
        if code := _another_input(record, largest=largest):
            yield Finding(code=code, run=record.id)
        yield from _cut(record, records)


def _another_input(record: Record, *, largest: float) -> str:
    """Return the code of an input that a record of its kind does not have, or ""."""
    u = record.u
    if u is None:
        return ""
    if record.kind == "step" and not (np.any(u) and is_stepped(u)):
        return "no_step"
    if record.kind == "sine" and not (np.ptp(u) > 0 and line_frequency(record.t, u) is not None):
        return "no_sine"
    driven = record.kind == "decay" and float(np.ptp(u[u.size // 2 :])) > 1e-3 * largest
    return "driven_decay" if driven else ""


def _cut(record: Record, records: Sequence[Record]) -> Iterator[Finding]:
    """Yield a fault if most similar records have one length, and this one less than half of it.

    Recordings that a person stops by hand differ in duration, so they are not compared. A
    truncated file must also have fewer samples; otherwise its clock may just be in another unit.
    """
    if record.kind not in ("decay", "step"):
        return
    alike = [r for r in records if (r.kind, r.free) == (record.kind, record.free)]
    others = [other for other in alike if other is not record]
    lengths = np.array([r.t[-1] - r.t[0] for r in others])
    usual = float(np.median(lengths)) if others else 0.0
    equal = np.abs(lengths - usual) <= SAME * usual
    samples = float(np.median([r.t.size for r in others] or [0]))
    length = float(record.t[-1] - record.t[0])
    known = equal.sum() >= max(WITNESSES, len(others) / 2)
    if known and length < 0.5 * usual and record.t.size < 0.5 * samples:
        details = {"length": f"{length:.3g}", "usual": f"{usual:.3g}"}
        yield Finding(code="cut", run=record.id, details=details)


def find_late_channels(records: Sequence[Record], *, carts: int) -> tuple[Finding, ...]:
    """Return the recordings in which a cart's channel is read later, or earlier, than the first's.

    Each kind of experiment is tested separately, since one kind may have been logged differently. A
    delay of the input moves all channels equally and is not found here.
    """
    kinds = by_kind(records)
    late = [
        one
        for kind in ("sine", "step", "sweep", "decay", "closed_loop")
        if kind in kinds
        for one in _late_in(kinds[kind], kind=kind, carts=carts)
    ]
    # Compared with a late channel, a right one looks early, so such results are dropped.
    named = {one.cart for one in late if one.details["than"] == 1}
    return tuple(one for one in late if one.details["than"] not in named)


def _late_in(records: Sequence[Record], *, kind: str, carts: int) -> Iterator[Finding]:
    sample = float(np.median([record.sample_time for record in records]))
    links = find_channel_delays(records, n=carts)
    first, delay, limit = 1, 0.0, 0.0
    for cart in range(2, carts + 1):
        if cart not in links:  # further channels are compared with this one
            first, delay, limit = cart, 0.0, 0.0
            continue
        link = links[cart]
        sure = _SURE * link.std
        if link.better >= _BETTER and abs(link.delay) > max(_LATE * sample, sure):
            delay, limit = delay + link.delay, max(limit, _LATE * sample, sure)
        elif abs(link.delay) + sure > _LATE * sample:
            # A delay of this channel is neither certain nor ruled out, so the comparison starts
            # again here.
            first, delay, limit = cart, 0.0, 0.0
        if abs(delay) > max(limit, _LATE * sample):
            when = "later" if delay > 0 else "earlier"
            details = {"delay": f"{1e3 * abs(delay):.3g}", "when": when, "than": first}
            for run in link.experiments:
                yield Finding(
                    code="late_channel",
                    kind="late_channel",
                    run=run,
                    cart=cart,
                    details={**details, "kind": kind},
                    value=delay,
                    limit=limit,
                )


def find_bad_recordings(analysis: Analysis) -> dict[str, Finding]:
    """Return the recordings with a fault, each with its first one."""
    valid = valid_records(analysis.records, analysis.left_out)
    # A cart that sticks rests at its turning points, which looks like a clipped reading.
    sticky = analysis.fit is not None and not analysis.fit.explains_data
    faults = [
        *filter(None, map(_wrong_setup, analysis.records)),
        *reversed(_find_other_scales(valid, bench=analysis.bench)),
        *(
            Finding(code="unreadable", run=name, details={"reason": why}, excludes="wrong")
            for name, why in analysis.unreadable.items()
        ),
        *(one for one in analysis.left_out if one.is_wrong),
        *(one for r in analysis.records for one in _channels_at_fault(r, sticky=sticky)),
        *analysis.late_channels,
    ]
    found = first_by_run(faults)
    order = [*analysis.unreadable, *(one.run for one in analysis.left_out if one.is_wrong)]
    order += [record.id for record in analysis.records]
    return {name: found[name] for name in dict.fromkeys(order) if name in found}


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
            look = _why_other_frequency(stated / hertz) or say("frequency_of_another")
            details = {"found": f"{hertz:.3g}", "stated": f"{stated:.3g}", "look": look}
            yield Finding(code="other_frequency", run=record.id, details=details)


def _why_other_frequency(ratio: float) -> str:
    """Return why the stated frequency may be `ratio` times the true one; "" if unknown."""
    reasons = {
        2 * np.pi: say("frequency_in_radians"),
        1 / (2 * np.pi): say("frequency_divided"),
        **{
            f: say("frequency_by_clock", unit=u, short=short)
            for f, (u, short) in TIME_UNITS.items()
        },
    }
    return explain_ratio(ratio, reasons, within=_OTHER_DWELL)


# ------------------------------------------------------------------------- checks


def check_recordings(
    data: Ingested,
    *,
    left_out: Sequence[Finding],
    sines: Sequence[SinePoint],
    late: Sequence[Finding],
    bench: Setup,
) -> list[Check]:
    """Return all checks of the recordings, those whose failure affects most numbers first."""
    valid = valid_records(data.records, left_out)
    return [
        *check_signs(data.signs, without={one.run for one in left_out if one.is_wrong}),
        *check_files(data.unreadable),
        *check_units(data.records, bench=bench),
        *(one.check for one in _find_other_scales(valid, bench=bench)),
        *check_left_out(left_out, records=data.records),
        *check_setup(data.records),
        *_check_dwells(data.records, sines),
        *check_channels(late),
    ]


def check_files(unreadable: Mapping[str, str]) -> list[Check]:
    """Return a failed check for each experiment whose file could not be read."""
    return [
        Finding(code="not_read", kind="data", run=run, details={"runs": run, "reason": why}).check
        for run, why in unreadable.items()
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
        finding, runs = None, list(headed) or fractions
        if not is_known(unit, known):
            details = {"role": role, "unit": repr(unit), "hint": _hint(unit, known=known)}
            checks.append(Finding(code="unknown_unit", kind=kind, details=details).check)
            continue
        details = {"runs": join_names(runs)}
        if headed:
            other = next(iter(headed.values()))
            details |= {"heading": repr(other.heading), "unit": unit}
            details |= {"other": other.unit, "role": role}
            finding = Finding(code="other_heading", kind=kind, details=details)
        elif role == "position" and (other_step := _find_other_steps(records, bench=bench)):
            checks.append(other_step.check)
        elif role == "position" and fractions:
            details |= {"gain_unit": bench.units.gain}
            finding = Finding(code="fractions", kind=kind, details=details)
        if finding:
            checks.append(replace(finding, value=float(len(runs)), limit=0.0).check)
    return checks


def _hint(unit: str, *, known: Sequence[str]) -> str:
    """Return which unit may be meant, or else all known units."""
    if meant := [one for one in known if one.casefold() == unit.casefold()]:
        return say("did_you_mean", unit=repr(meant[0]))
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
    details = {"shown": " ".join(says)}
    finding = Finding(
        code="sign", kind="input", part="sign", details=details, value=float(wrong), limit=0.0
    )
    return [finding.check] if says else []


def check_left_out(left_out: Sequence[Finding], *, records: Sequence[Record]) -> list[Check]:
    """Return a failed check for each reason for which records were left out."""
    runs: dict[str, list[str]] = {}
    for one in left_out:
        runs.setdefault(one.reason, []).append(one.run)
    checks = []
    for reason, names in sorted(runs.items(), key=lambda item: -len(item[1])):
        are = "is" if len(names) == 1 else "are"
        details = {"are": are, "runs": _named(names, records), "reason": reason}
        n = float(len(names))
        finding = Finding(code="left_out", run=names[0], details=details, value=n, limit=0.0)
        checks.append(finding.check)
    return checks


def _named(names: Sequence[str], records: Sequence[Record]) -> str:
    """Return the names of records in words, or the whole kind: "all 29 dwells, step-2"."""
    parts: list[str] = []
    for kind, alike in by_kind(records).items():
        of_kind = [record.id for record in alike if record.id in names]
        # Up to three records are listed by name, even if they are a whole kind.
        whole = len(of_kind) == len(alike) > 3
        parts += [f"all {len(alike)} {_PLURAL.get(kind, kind)}"] if whole else of_kind
    return ", ".join(parts)


def check_setup(records: Sequence[Record]) -> list[Check]:
    """Check that the carts that move are the free ones, if all carts were measured."""
    checks = []
    for record in records:
        free, held = _swings(record)
        if wrong := _wrong_setup(record):
            checks.append(wrong.check)
        elif held:
            named = ", ".join(map(str, record.free))
            check = Check(
                kind="setup",
                run=record.id,
                outcome="pass",
                value=max(held.values()) / free if free > 0 else None,
                limit=1 / _LEAST_SHARE,
                message=say("setup_right", run=record.id, free=named),
            )
            checks.append(check)
    return checks + [one.check for record in records for one in _loose_holds(record)]


def check_channels(late: Sequence[Finding]) -> list[Check]:
    """Return a failed check for each cart whose position is read late."""
    checks = []
    for cart in sorted({one.cart or 0 for one in late}):
        alike = [one for one in late if one.cart == cart]
        surest = min(alike, key=lambda one: (one.details["than"], one.limit))
        kinds = dict.fromkeys(str(one.details["kind"]) for one in alike)
        named = [f"the {_PLURAL[kind]}" if kind in _PLURAL else "closed loop" for kind in kinds]
        details = {**surest.details, "kinds": join_names(named)}
        checks.append(replace(surest, code="late_channel_in", run="", details=details).check)
    return checks


def _check_dwells(records: Sequence[Record], points: Sequence[SinePoint]) -> list[Check]:
    """Check that the dwells have their stated frequencies, all together or one by one."""
    stated = {record.id: record.omega for record in records if record.omega}
    ratios = {
        p.experiment: stated[p.experiment] / p.omega for p in points if p.experiment in stated
    }
    off = {name: r for name, r in ratios.items() if abs(np.log(r)) > _OTHER_DWELL}
    if not off:
        return []
    ratio = float(np.median(list(off.values())))
    look = _why_other_frequency(ratio)
    alike = all(abs(r / ratio - 1) < _OTHER_DWELL for r in off.values())
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


# ---------------------------------------------------------------------- remarks


def reading_remarks(data: Ingested, *, unit: str) -> list[str]:
    """Return the notes from reading the files, with warnings about units.

    There is one if `unit` seems wrong, and one for decays in other units. Their unit does not
    affect their results.
    """
    units = first_by_run(_find_other_units(data.records, decays=True)).items()
    notes = ((record.id, note) for record in data.records for note in record.notes)
    other = ((run, _WORDS.text("decay_in_other_unit", reason=one.reason)) for run, one in units)
    too_fast = _too_fast(data.records, unit=unit)
    return [*data.warnings, *too_fast, *group_messages(notes), *group_messages(other)]


def hand_remarks(interventions: Sequence[Intervention], *, records: Sequence[Record]) -> list[str]:
    """Return in which records and when a hand moves a cart, except for releases of decays."""
    notes = []
    for one in without_releases(interventions, records):
        times = {"start": f"{one.start:.2f}", "end": f"{one.end:.2f}"}
        notes.append((one.experiment, _WORDS.text("hand", cart=one.cart, what=one.what, **times)))
    return group_messages(notes)


def _too_fast(records: Sequence[Record], *, unit: str) -> list[str]:
    """Return a warning if the carts are impossibly fast in two kinds of experiments.

    If only one kind of experiment is too fast, it may be an accident.
    """
    metres = conversion(unit, "m")
    kinds = by_kind(records).values() if metres else ()
    fastest = sorted(max((_speed(record), record.id) for record in alike) for alike in kinds)
    speed, run = fastest[-2] if len(fastest) > 1 else (0.0, "")
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
    return [_WORDS.text("reversed")] if is_reversed(records) else []
