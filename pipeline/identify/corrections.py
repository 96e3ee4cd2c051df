"""Find recordings that contradict the identified carts, and the correction that some of them need.

The faults are a dead or swapped channel, a wrong clock or unit, or a truncated file. A constant
reading is not always a fault: friction may hold a cart, a held cart should not move, and a coarse
encoder does not show a small motion. So a channel is called dead only if the identified carts would
have moved it far. In addition, the records that follow these carts must show too little friction to
hold it.

A wrong unit or clock applies to everything that one program logged. A single record with a tenth of
the motion is only odd, because an amplifier at its limit, a dead zone or friction can cause this
too.
"""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from itertools import chain as chained

import numpy as np

from pipeline.estimation.record_fit import (
    FASTEST,
    TIME_FACTORS,
    Correction,
    RecordFit,
    find_correction,
    fit_detuned,
    force_on,
    is_driven,
    most_are_consistent,
)
from pipeline.estimation.time_fit import FOLLOWED
from pipeline.identify.findings import (
    SAME,
    SAME_SIZE,
    SIGMAS,
    WITNESSES,
    by_kind,
    explain_ratio,
    first_by_run,
)
from pipeline.identify.recording_checks import span
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import Finding, Record, StepGain

# A reading is suspicious if it is constant while the input changes by half its range, and for this
# share of the record afterwards. It is a fault if the identified carts meanwhile move by this many
# encoder steps and by three tenths of their motion. A delay or play holds a cart only briefly.
_STILL, _SEEN_COUNTS = 0.2, 5.0
_FEWEST_CYCLES = 1.5  # cycles of a dwell; with fewer there is no steady state at any damping


def find_corrections(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, RecordFit]
) -> dict[str, Correction]:
    """Return, by id, the corrections with which records follow the chain.

    If most records of a kind need a correction, weaker evidence is enough for the other records of
    this kind.
    """
    if chain is None:
        return {}
    found: dict[str, Correction] = {}
    for alike in by_kind(record for record in records if record.id in fits).values():
        sure = {r.id: m for r in alike if (m := find_correction(r, chain, fits[r.id]))}
        if 2 * len(sure) > len(alike):
            rest = [r for r in alike if r.id not in sure]
            weak = {r.id: find_correction(r, chain, fits[r.id], better=1.0) for r in rest}
            sure |= {name: m for name, m in weak.items() if m}
        found |= sure
    legal = {name for name, misread in found.items() if misread.legal}
    if 2 * len(legal) > len(fits):  # then the bench itself has this sign
        found = {name: misread for name, misread in found.items() if name not in legal}
    agreeing = sum(fit.is_consistent for name, fit in fits.items() if name not in found)
    return found if agreeing + len(found) >= WITNESSES else {}


def without_lone_factors(
    found: Mapping[str, Correction], records: Sequence[Record], *, fits: Mapping[str, RecordFit]
) -> dict[str, Correction]:
    """Return the corrections without unconfirmed factors on the unit or the clock.

    Several records of a kind must share a factor, and none may contradict it. A clock factor may
    instead be confirmed by the sample interval.

    Parameters
    ----------
    fits : how each record follows the chain without correction.
    """
    kept = {name: m for name, m in found.items() if m.scale is None and m.clock is None}
    for alike in by_kind(records).values():
        factors = {r.id: found[r.id] for r in alike if r.id in found and r.id not in kept}
        for words in dict.fromkeys(misread.words for misread in factors.values()):
            sharing = [r for r in alike if r.id in factors and factors[r.id].words == words]
            contrary = [
                r for r in alike if r not in sharing and (r.id in found or fits[r.id].is_consistent)
            ]
            misread = factors[sharing[0].id]
            shared = len(sharing) >= WITNESSES and not contrary
            if misread.scale is not None and shared:
                limited = misread.scale < 1 and _may_be_a_limit(sharing, records, fits)
                kept |= {} if limited else {r.id: misread for r in sharing}
            if misread.clock is not None:
                kept |= {
                    r.id: misread
                    for r in sharing
                    if shared or _is_sampled_so(r, records, factor=misread.clock)
                }
    return {name: misread for name, misread in found.items() if name in kept}


def _may_be_a_limit(
    sharing: Sequence[Record], records: Sequence[Record], fits: Mapping[str, RecordFit]
) -> bool:
    """Whether these records may be due to an amplifier at its limit.

    Their inputs must be equally large, because only then does a limit give the same factor. And no
    record with such a large input may follow the chain.
    """
    size = {r.id: float(np.abs(r.input).max()) for r in records}
    sizes = [size[record.id] for record in sharing]
    follows = [size[r.id] for r in records if r not in sharing and fits[r.id].is_consistent]
    equal = (1 - SAME_SIZE) * max(sizes)
    return min(sizes) >= equal > max(follows, default=0.0)


def _is_sampled_so(record: Record, records: Sequence[Record], *, factor: float) -> bool:
    """Whether a record's sample interval is `factor` times the usual one."""
    others = [other.sample_time for other in records if other is not record]
    usual = factor * float(np.median(others)) if others else 0.0
    return abs(record.sample_time - usual) <= SAME * usual


def standing_still(records: Sequence[Record]) -> set[str]:
    """Return the driven records in which the reading of a free cart may show nothing.

    It is constant while the input changes, or only noise.
    """
    return {
        record.id
        for record in records
        if is_driven(record)
        and any(
            _is_noise(record, cart) or any(_still(record, cart)) for cart in record.measured_free
        )
    }


def find_faults(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, RecordFit]
) -> dict[str, Finding]:
    """Return the records that do not show what happened, by id, each with its fault.

    Parameters
    ----------
    chain : the carts identified from records that are not in doubt. None if this failed;
        then only faults are found that no carts could cause.
    fits : how each record follows the chain, from `follow`.
    """
    held = [record for record in records if record.id in fits]
    corrections = find_corrections(records, chain=chain, fits=fits)
    misread = without_lone_factors(corrections, held, fits=fits)
    legal = {name for name, correction in misread.items() if correction.legal}
    steps: dict[int, float] = {}  # the largest of all records, as a dead channel shows no step
    moving: set[int] = set()
    for record in records:
        for cart in record.measured_free:
            steps[cart] = max(steps.get(cart, 0.0), record.encoder_step(cart))
            y = record.position(cart)
            if is_driven(record) and np.ptp(y) > 0 and not _is_noise(record, cart):
                moving.add(cart)
    friction = _most_friction(held, fits)
    wrong = chained(
        _wrong_clocks(records),
        _short_dwells(records),
        _copies(records),
        _misread(misread, everywhere=misread.keys() == fits.keys()),
        _frozen(held, fits, chain, friction=friction, steps=steps),
        _dead_channels(records, chain=chain, friction=friction, steps=steps, moving=moving),
    )
    odd = chained(_lone_factors(corrections, misread), _strays(held, chain=chain, fits=fits))
    found = [replace(one, excludes="odd" if one.run in legal else "wrong") for one in wrong]
    return first_by_run([*found, *(replace(one, excludes="odd") for one in odd)])


def _most_friction(records: Sequence[Record], fits: Mapping[str, RecordFit]) -> dict[int, float]:
    """Return, by cart, the largest friction that the records allow; noise shows no friction."""
    allowed: dict[int, list[float]] = {}
    for record in records:
        fit = fits[record.id]
        for cart in (cart for cart in fit.unexplained_share if not _is_noise(record, cart)):
            allowed.setdefault(cart, []).append(fit.friction.get(cart, np.inf))
    return {cart: float(np.median(values)) for cart, values in allowed.items()}


def find_impossible_gains(gains: Sequence[StepGain]) -> dict[str, Finding]:
    """Return the steps in which a cart moves further than the cart that pulls it, by id.

    The input acts on cart 1, and springs pull the other carts. So a cart's static gain is at most
    that of the cart before it.
    """
    found: dict[str, Finding] = {}
    by_cart = {(gain.experiment, gain.cart): gain for gain in gains if gain.interval is None}
    for (run, cart), gain in by_cart.items():
        before = by_cart.get((run, cart - 1))
        least = abs(gain.gain) - SIGMAS * gain.gain_std
        # The difference must exceed the amount by which friction may hold the carts off.
        if before and least > 1.3 * (abs(before.gain) + SIGMAS * before.gain_std):
            details = {"times": f"{abs(gain.gain / before.gain):.3g}", "before": cart - 1}
            found[run] = Finding(
                code="too_far", run=run, cart=cart, details=details, excludes="wrong"
            )
    return found


# ------------------------------------------------------------------ single channels


def _is_noise(record: Record, cart: int) -> bool:
    """Return whether the reading of a cart changes from sample to sample like noise."""
    y = record.position(cart)
    change = float(np.mean(np.diff(y) ** 2))
    # For noise, the mean square change is twice the variance. A motion with 0.8 of this has a
    # period of at most five samples (J. von Neumann, Annals of Mathematical Statistics 12, 1941).
    return change > 0 and change >= 1.6 * float(np.var(y))


def _edges(y: np.ndarray) -> np.ndarray:
    """Return the starts of stretches of constant reading, and the end of the last one."""
    return np.concatenate([[0], np.flatnonzero(np.diff(y)) + 1, [y.size]])


def _still(record: Record, cart: int) -> Iterator[slice]:
    """Yield stretches of constant reading while the input changes by half its range."""
    u, y = record.u, record.position(cart)
    if u is None:
        return
    edges = _edges(y)
    long = _STILL * y.size
    for i in np.flatnonzero(np.diff(edges) >= long):
        part = slice(int(edges[i]), int(edges[i + 1]))
        changed = np.abs(u[part] - u[part.start]) >= 0.5 * np.ptp(u)
        if changed.any() and changed.size - np.argmax(changed) >= long:
            yield part


def _dead_channels(
    records: Sequence[Record],
    *,
    chain: Chain | None,
    friction: Mapping[int, float],
    steps: Mapping[int, float],
    moving: Set[int],
) -> Iterator[Finding]:
    """Yield a fault for each free cart that must have moved, although its reading shows no motion.

    The reading is constant, or only noise. For each cart, `friction` is the largest friction that
    the records allow, and `steps` the encoder step. `moving` are the carts that any input ever
    moved.
    """
    for record, cart in ((r, cart) for r in records for cart in r.measured_free):
        y, run, driven = record.position(cart), record.id, is_driven(record)
        noise = _is_noise(record, cart)
        if noise and (record.kind == "decay" or cart not in moving):
            yield Finding(code="only_noise", run=run, cart=cart)
        elif np.ptp(y) == 0 and (record.kind == "decay" or (driven and cart not in moving)):
            others = [free for free in record.free if free != cart]
            code = "never_changes_held" if others else "never_changes"
            yield Finding(code=code, run=run, cart=cart, details={"others": others})
        if chain is None or not driven or (force := force_on(record, chain, cart=cart)) is None:
            continue
        for still in [slice(0, y.size)] if noise else _still(record, cart):
            # Friction holds a cart equally in both directions.
            if 2 * friction.get(cart, np.inf) < np.ptp(force[still]) and _must_move(
                record, chain, still, cart=cart, step=steps[cart]
            ):
                code = "only_noise" if noise else "dead" if np.ptp(y) == 0 else "froze_at_input"
                details = span(record, still.start, still.stop - 1)
                yield Finding(code=code, run=run, cart=cart, details=details)


def _frozen(
    records: Sequence[Record],
    fits: Mapping[str, RecordFit],
    chain: Chain | None,
    *,
    friction: Mapping[int, float],
    steps: Mapping[int, float],
) -> Iterator[Finding]:
    """Yield a fault for each reading that is constant for a while although the carts moved it far.

    The reading is constant for ten samples or more. Meanwhile the identified cart moves by at least
    a fifth of the recorded range, and the force on it exceeds any friction. At other times the
    reading follows the identified cart.
    """
    if chain is None:
        return
    for record in records:
        for cart, missed in fits[record.id].residual.items():
            force = force_on(record, chain, cart=cart)
            y = record.position(cart)
            far = max(_SEEN_COUNTS * steps[cart], 0.2 * float(np.ptp(y)))
            edges = _edges(y)
            for i in np.flatnonzero(np.diff(edges) >= 10):
                part = slice(int(edges[i]), int(edges[i + 1]))
                moved, rest = float(np.ptp(missed[part])), np.delete(missed, part)
                if moved < far or not rest.size or force is None:
                    continue
                # A cart at rest stays there for a moment after the input steps, so only the first
                # half counts.
                early = force[part][: (part.stop - part.start) // 2]
                if 2 * friction.get(cart, np.inf) >= np.ptp(early):
                    continue
                elsewhere = float(np.mean(rest**2))
                follows = elsewhere < FOLLOWED * float(np.var(np.delete(y, part)))
                # The reading follows the carts if its error elsewhere is below a quarter of the
                # missed motion.
                if follows and np.sqrt(elsewhere) < 0.25 * moved:
                    details = span(record, part.start, part.stop - 1)
                    yield Finding(code="froze_in_motion", run=record.id, cart=cart, details=details)


def _must_move(record: Record, chain: Chain, still: slice, *, cart: int, step: float) -> bool:
    """Whether the cart moves far in a simulation while its reading stands `still`.

    In a dwell, it must also move far in steady state.
    """
    assert record.u is not None
    free = tuple(sorted(record.free))
    y = simulate_linear(chain, record.t, record.u, free=free, hold=record.hold)[free.index(cart)]
    far = float(np.ptp(y[still]))
    if record.kind == "sine" and record.omega is not None:  # a dwell may start in motion
        G = chain.frequency_response(np.array([record.omega]))[cart - 1, 0]
        far = min(far, float(abs(G) * np.ptp(record.u)))
    return far >= max(_SEEN_COUNTS * step, 0.3 * float(np.ptp(y)))


def _copies(records: Sequence[Record]) -> Iterator[Finding]:
    """Yield the records with exactly the samples of an earlier record of their kind."""
    first: dict[tuple[object, ...], str] = {}
    for record in records:
        what = (record.kind, record.free, record.t.tobytes(), record.y.tobytes())
        if (original := first.setdefault(what, record.id)) != record.id:
            yield Finding(code="copied_samples", run=record.id, details={"original": original})


def _short_dwells(records: Sequence[Record]) -> Iterator[Finding]:
    for record in records:
        duration = float(record.t[-1] - record.t[0]) + record.sample_time
        cycles = (record.omega or np.inf) * duration / (2 * np.pi)
        if record.kind == "sine" and cycles < _FEWEST_CYCLES:
            details = {"cycles": f"{_FEWEST_CYCLES:g}"}
            yield Finding(code="short_dwell", run=record.id, details=details)


def _wrong_clocks(records: Sequence[Record]) -> Iterator[Finding]:
    """Yield the records whose time column is in an unusual unit.

    That is so if the sample interval, converted from this unit, is the usual one. All records are
    compared, because no bench samples some of them a thousand times more slowly.
    """
    clocks = [record.sample_time for record in records]
    usual = min((dt for dt in clocks if dt >= FASTEST), default=np.inf)
    # A factor of 100 or more is another unit of time; a factor of 2 may be another setting.
    units = {f: said for f, said in TIME_FACTORS.items() if max(f, 1 / f) >= 100.0}
    for record, apart in zip(records, clocks, strict=True):
        if look := explain_ratio(apart / usual, units, within=SAME):
            details = {"apart": f"{apart:.3g}", "usual": f"{usual:.3g}", "look": look}
            yield Finding(code="other_clock", run=record.id, details=details)


# ------------------------------------------------------- records that follow no carts


def _misread(misread: Mapping[str, Correction], *, everywhere: bool) -> Iterator[Finding]:
    """Yield the records that follow the chain after a correction; `everywhere` if all do."""
    same = everywhere and len({correction.words for correction in misread.values()}) == 1
    for name, correction in misread.items():
        code = "misread_everywhere" if same else "misread"
        details = {"look": correction.words, "remedy": correction.remedy}
        yield Finding(code=code, run=name, details=details)


def _lone_factors(
    corrections: Mapping[str, Correction], misread: Mapping[str, Correction]
) -> Iterator[Finding]:
    """Yield the records with an unconfirmed factor, of which the bench may be the cause."""
    for name, correction in corrections.items():
        if name not in misread and correction.scale:
            code = "moves_too_little" if correction.scale < 1 else "moves_too_far"
            yield Finding(code=code, run=name, details={"scale": f"{correction.scale:.3g}"})


def _strays(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, RecordFit]
) -> Iterator[Finding]:
    """Yield the records that follow neither the chain nor a slightly slower or faster one.

    It is enough if one cart follows, because another one may be near its null and hardly move. A
    cart that moves less than it should proves nothing, because friction may hold it.
    """
    if chain is None or not most_are_consistent(fits):
        return
    for record in records:
        fit = fits[record.id]
        # Friction makes no cart move further, so a record whose carts all move less is not judged.
        if fit.is_consistent or max(fit.amplitude_ratio.values()) < 0.8:
            continue
        # More than half of the power of every cart must be unexplained.
        near_by = fit_detuned(record, chain)
        if all(min(one.unexplained_share.values()) > 0.5 for one in near_by):
            details = {"percent": f"{100 * min(fit.share, 1.0):.0f}"}
            yield Finding(code="stray", run=record.id, details=details)
