"""Find recordings that contradict their description or are damaged; no carts need be identified.

They contradict the stated free carts, units or frequencies; their encoder is stuck or counts in
another unit; their input or length is that of another experiment; or one channel is read late.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.force_balance import ChannelDelay, find_channel_delays
from pipeline.estimation.record_fit import LENGTH_SCALES, TIME_UNITS, measured
from pipeline.identify.findings import SAME, WITNESSES, say
from pipeline.ingest.channels import is_stepped, line_frequency, stuck_spans
from pipeline.ingest.columns import conversion
from pipeline.results import Finding, LateChannel, Record
from pipeline.setup import Setup

OTHER_DWELL = 0.1  # relative; a dwell this far from its stated frequency is another dwell
# Share of a held cart's swing. If a cart that should be free moves less, it is not free.
LEAST_SHARE = 0.2
# Share of the free carts' swing. A cart that is held firmly moves less.
_HELD_FIRMLY = 0.05
_LONGEST = 3.0  # metres; no bench has a longer track
_LONGEST_SLOW = 20.0  # metres; the limit if nothing moves faster than a person runs
_SLOW = 10.0  # metres per second
_LONGEST_WHOLE = 0.5  # metres; the limit if all readings are whole numbers, as counts are
_ECP_STEP = 2.27e-5  # metres per count of the encoders of an ECP 210
_LARGEST = 100.0  # volts; no amplifier at a bench gives as much
_ECP_LARGEST = 10.5  # volts; the converter of an ECP 210 gives 10, and files round
# Volts. A converter of 16 bits and ± 10 V has steps of 0.3 mV.
_LEAST = 1e-3
_LATE, _SURE = 2.0, 4.0  # samples, and standard errors: a late channel exceeds both
# Correcting the delay must lower the residual of the carts' equation of motion by this factor.
# Friction, stops and stiff springs on benches of every kind look like delays, but correcting these
# lowers it by 1.7 times at most. Correcting a delay of 44 ms lowers it 8 times with much friction,
# and thousands of times without friction.
_BETTER = 5.0


def swings(record: Record) -> tuple[float, dict[int, float]]:
    """Return the largest swing of the free carts, and the swing of each held cart.

    If no free cart was measured, the held ones are left out.
    """
    swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
    free = [swing.pop(cart) for cart in record.carts if cart in record.free]
    return (max(free), swing) if free else (0.0, {})


def find_wrong_setups(records: Sequence[Record]) -> list[Finding]:
    """Find the records in which a cart that should be held moves, but the free carts do not."""
    found = []
    for record in records:
        free, held = swings(record)
        mover = max(held, key=lambda cart: held[cart], default=0)
        if mover and free < LEAST_SHARE * held[mover]:
            fault = Finding(
                code="wrong_setup",
                kind="setup",
                run=record.id,
                details={"cart": mover, "free": ", ".join(map(str, record.free))},
                value=held[mover] / free if free > 0 else None,
                limit=1 / LEAST_SHARE,
            )
            found.append(fault)
    return found


def find_loose_holds(records: Sequence[Record]) -> list[Finding]:
    """Find carts that should be held but move much compared with the free ones."""
    found = []
    for record in records:
        free, held = swings(record)
        for cart, swing in held.items():
            if _HELD_FIRMLY * free < swing <= free:
                share = swing / free
                fault = Finding(
                    code="moves_though_held",
                    kind="held",
                    run=record.id,
                    cart=cart,
                    details={"percent": f"{100 * share:.0f}"},
                    value=share,
                    limit=_HELD_FIRMLY,
                )
                found.append(fault)
    return found


def find_other_scales(records: Sequence[Record], *, bench: Setup) -> list[Finding]:
    """Find positions or inputs of a size that no bench has, and so must be in another unit.

    Examples are counts in place of a length, and millivolts in place of volts. A fit to such
    records looks as good as a fit to right ones; only the gains are wrong.
    """
    found = []
    unit, metres = bench.units.position, conversion(bench.units.position, "m")
    travel, run = _reached((r, float(np.ptp(r.y, axis=1).max())) for r in records)
    whole = all(np.array_equal(record.y, np.round(record.y)) for record in records)
    speeds = [np.abs(np.diff(r.y) / np.diff(r.t)).max(initial=0.0) for r in records]
    longest = _LONGEST_SLOW if max(speeds, default=0.0) * (metres or 0.0) < _SLOW else _LONGEST
    if metres and travel > (limit := (_LONGEST_WHOLE if whole else longest) / metres):
        why = say("position_scale_whole" if whole else "position_scale_long")
        details = {"reach": f"{travel:.4g}", "unit": unit, "quoted": repr(unit), "why": why}
        found.append(
            Finding(
                code="position_scale",
                kind="position_scale",
                run=run,
                details=details,
                value=travel,
                limit=limit,
            )
        )
    # Under feedback, a bench may log another signal as its input.
    opened = [(r, r.u) for r in records if r.u is not None and r.kind != "closed_loop"]
    driven = [(r, float(np.abs(u).max())) for r, u in opened if np.any(u)]
    largest, run = _reached(driven)
    unit, volts = bench.units.input, conversion(bench.units.input, "V")
    headed = any(one.role == "input" for record in records for one in record.heading_units)
    if not (volts and driven):
        return found
    most, why = _LARGEST, "input_scale_large"
    if not headed and _is_ecp(records, bench=bench):
        most, why = _ECP_LARGEST, "input_scale_ecp"
    beyond = largest * volts / most
    if not headed and max(size for _, size in driven) * volts < _LEAST:
        beyond, why = _LEAST / (largest * volts), "input_scale_small"
    if beyond > 1.0:
        details = {"reach": f"{largest:.4g}", "unit": unit, "why": say(why)}
        found.append(
            Finding(
                code="input_scale",
                kind="input_scale",
                run=run,
                details=details,
                value=beyond,
                limit=1.0,
            )
        )
    return found


def find_other_steps(records: Sequence[Record], *, bench: Setup) -> Finding | None:
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


def why_other_frequency(ratio: float) -> str:
    """Return why the stated frequency may be `ratio` times the true one; "" if unknown."""
    turns = {2 * np.pi: "frequency_in_radians", 1 / (2 * np.pi): "frequency_divided"}
    for factor, key in turns.items():
        if abs(ratio / factor - 1) < OTHER_DWELL:
            return say(key)
    for factor, (unit, short) in TIME_UNITS.items():
        if abs(ratio / factor - 1) < OTHER_DWELL:
            return say("frequency_by_clock", unit=unit, short=short)
    return ""


def find_other_units(records: Sequence[Record], *, decays: bool = False) -> dict[str, Finding]:
    """Find, by id, the records whose encoder step is the usual one converted to another unit.

    The usual step is that of most kinds of experiment, not of most records. A dozen dwells may have
    been exported together, and so may all be wrong. Steps of 0.01 and 0.001 differ only in the
    number of decimals. The unit of a decay does not matter, so decays are searched only if
    `decays` is true, and then nothing else.
    """
    found: dict[str, Finding] = {}
    for cart in sorted({cart for record in records for cart in record.carts}):
        steps = {r.id: r.encoder_step(cart) for r in records if cart in r.carts}
        by_kind = [
            float(np.median(seen))
            for kind in dict.fromkeys(record.kind for record in records)
            if (seen := [s for r in records if r.kind == kind and (s := steps.get(r.id, 0.0))])
        ]
        usual = max(by_kind, key=lambda step: sum(_alike(step, s) for s in by_kind), default=0.0)
        if sum(_alike(step, usual) for step in by_kind) < WITNESSES:
            continue
        scales = [s for scale in LENGTH_SCALES for s in (scale, 1 / scale)]
        for record in [r for r in records if r.id in steps and (r.kind == "decay") is decays]:
            step = steps[record.id]
            if _is_decimal(step) and _is_decimal(usual):
                continue
            for scale in [s for s in scales if _alike(step, s * usual)]:
                details = {"scale": f"{scale:.3g}"}
                fault = Finding(
                    code="other_unit", run=record.id, cart=cart, details=details, excludes="wrong"
                )
                found.setdefault(record.id, fault)
    return found


def _alike(step: float, other: float) -> bool:
    return abs(step - other) <= SAME * other


def _is_decimal(step: float) -> bool:
    """Whether a step is a power of ten, so that it may come from the number of decimals."""
    return step > 0 and _alike(step, 10.0 ** round(np.log10(step)))


def find_stuck(records: Sequence[Record]) -> dict[str, Finding]:
    """Return the records in which the encoder of a free cart was stuck, by id.

    Static friction stops only a cart that is already slow, and the cart then starts from where it
    stopped. So the encoder was stuck if the reading stops while the cart is fast, or if it jumps
    when it changes again.
    """
    found: dict[str, Finding] = {}
    for record in records:
        for cart in measured(record):
            y = record.position(cart)
            for first, last in stuck_spans(y):
                moves = np.abs(np.diff(y))
                fastest = float(np.quantile(moves, 0.98))
                away = last < moves.size and moves[last] >= 1.5 * fastest
                if away or moves[first - 1] >= 0.6 * fastest:
                    details = {"first": f"{record.t[first]:.4g}", "last": f"{record.t[last]:.4g}"}
                    fault = Finding(
                        code="stuck", run=record.id, cart=cart, details=details, excludes="wrong"
                    )
                    found.setdefault(record.id, fault)
    return found


def find_other_kinds(records: Sequence[Record], *, files: Mapping[str, str]) -> dict[str, Finding]:
    """Return the records that are not a complete recording of their kind, by id.

    `files` has the digest of each data file.
    """
    largest = max((float(np.abs(r.u).max()) for r in records if r.u is not None), default=0.0)
    first: dict[str, str] = {}
    found: dict[str, Finding] = {}
    for record in records:
        original = first.setdefault(files.get(record.source, record.source), record.source)
        if original != record.source:
            details = {"source": record.source, "original": original}
            found[record.id] = Finding(
                code="copied_file", run=record.id, details=details, excludes="wrong"
            )
        for fault in (*_another_input(record, largest=largest), *_cut(record, records)):
            found.setdefault(record.id, fault)
    return found


def _another_input(record: Record, *, largest: float) -> Iterator[Finding]:
    u = record.u
    if u is None:
        return
    if record.kind == "step" and not (np.any(u) and is_stepped(u)):
        yield Finding(code="no_step", run=record.id, excludes="wrong")
    if record.kind == "sine" and not _is_sine(record.t, u):
        yield Finding(code="no_sine", run=record.id, excludes="wrong")
    if record.kind == "decay" and float(np.ptp(u[u.size // 2 :])) > 1e-3 * largest:
        yield Finding(code="driven_decay", run=record.id, excludes="wrong")


def _is_sine(t: Array, u: Array) -> bool:
    return bool(np.ptp(u) > 0) and line_frequency(t, u) is not None


def _cut(record: Record, records: Sequence[Record]) -> Iterator[Finding]:
    """Yield a fault if most similar records have one length, and this one less than half of it.

    Recordings that a person stops by hand differ in duration, so they are not compared. A
    truncated file must also have fewer samples; otherwise its clock may just be in another unit.
    """
    if record.kind not in ("decay", "step"):
        return
    others = [
        other
        for other in records
        if (other.kind, other.free) == (record.kind, record.free) and other is not record
    ]
    lengths = np.array([r.t[-1] - r.t[0] for r in others])
    usual = float(np.median(lengths)) if others else 0.0
    alike = np.abs(lengths - usual) <= SAME * usual
    samples = float(np.median([r.t.size for r in others] or [0]))
    length = float(record.t[-1] - record.t[0])
    if alike.sum() < max(WITNESSES, len(others) / 2):
        return
    if length < 0.5 * usual and record.t.size < 0.5 * samples:
        details = {"length": f"{length:.3g}", "usual": f"{usual:.3g}"}
        yield Finding(code="cut", run=record.id, details=details, excludes="wrong")


def find_late_channels(records: Sequence[Record], *, carts: int) -> tuple[LateChannel, ...]:
    """Find the carts whose channel is read later, or earlier, than the first cart's.

    Each kind of experiment is tested separately, since one kind may have been logged differently. A
    delay of the input moves all channels equally and is not found here.
    """
    late: list[LateChannel] = []
    for kind in ("sine", "step", "sweep", "decay", "closed_loop"):
        alike = [record for record in records if record.kind == kind]
        if alike:
            late += _late_in(alike, kind=kind, carts=carts)
    # Compared with a late channel, a right one looks early, so such results are dropped.
    named = {one.cart for one in late if one.than == 1}
    return tuple(one for one in late if one.than not in named)


def _late_in(records: Sequence[Record], *, kind: str, carts: int) -> list[LateChannel]:
    sample = float(np.median([record.sample_time for record in records]))
    links = find_channel_delays(records, n=carts)
    first, delay, limit = 1, 0.0, 0.0
    found: list[LateChannel] = []
    for cart in range(2, carts + 1):
        if cart not in links:  # further channels are compared with this one
            first, delay, limit = cart, 0.0, 0.0
            continue
        link = links[cart]
        if _shows(link, sample=sample):
            delay, limit = delay + link.delay, max(limit, _limit(link, sample=sample))
        elif abs(link.delay) + _SURE * link.std > _LATE * sample:
            # A delay of this channel is neither certain nor ruled out, so the comparison starts
            # again here.
            first, delay, limit = cart, 0.0, 0.0
        if abs(delay) > max(limit, _LATE * sample):
            found.append(
                LateChannel(
                    cart=cart,
                    than=first,
                    kind=kind,
                    delay=delay,
                    limit=limit,
                    experiments=link.experiments,
                )
            )
    return found


def _limit(link: ChannelDelay, *, sample: float) -> float:
    return max(_LATE * sample, _SURE * link.std)


def _shows(link: ChannelDelay, *, sample: float) -> bool:
    return link.better >= _BETTER and abs(link.delay) > _limit(link, sample=sample)


def late_finding(late: LateChannel) -> Finding:
    """Return the delay of a cart's channel."""
    when = "later" if late.delay > 0 else "earlier"
    details = {"delay": f"{1e3 * abs(late.delay):.3g}", "when": when, "than": late.than}
    return Finding(
        code="late_channel",
        kind="late_channel",
        cart=late.cart,
        details=details,
        value=late.delay,
        limit=late.limit,
    )


def late_experiments(late: Sequence[LateChannel]) -> Mapping[str, Finding]:
    """Return the experiments in which a cart is late, each with its finding."""
    return {
        name: replace(late_finding(one), run=name)
        for one in reversed(late)
        for name in one.experiments
    }
