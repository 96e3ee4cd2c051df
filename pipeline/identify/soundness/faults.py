"""Recordings that do not hold what happened: a dead or exchanged channel, a wrong clock, a cut.

Friction may hold a cart still, a held cart is still by right, and a coarse encoder shows nothing
of a small motion. So a channel is called dead only where the identified carts would have moved it
far, and where runs that follow them leave friction too small to hold it.
"""

from collections.abc import Iterator, Mapping, Sequence, Set

import numpy as np

from pipeline.estimation.chain.follow import (
    Followed,
    Misread,
    force_on,
    is_driven,
    measured,
    most_follow,
    near,
)
from pipeline.estimation.limits import FOLLOWED
from pipeline.estimation.units_and_clocks import FASTEST, TIME_FACTORS
from pipeline.identify import limits
from pipeline.identify.soundness.other_readings import find_other_readings
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.simulate import simulate_linear
from pipeline.results import LeftOut, Record, StepGain


def standing_still(records: Sequence[Record]) -> set[str]:
    """Return the driven records in which a free cart's reading stays while the input changes."""
    return {
        record.id
        for record in records
        if is_driven(record) and any(any(_still(record, cart)) for cart in measured(record))
    }


def find_faults(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, Followed]
) -> dict[str, LeftOut]:
    """Return the records that do not hold what happened, by id, each with what is wrong.

    Parameters
    ----------
    chain : the carts as identified from the records that are not in doubt; None where they could
        not be: then only what no carts could do is found.
    fits : how the records follow it, as `follow` has it.
    """
    readings = find_other_readings(records, chain=chain, fits=fits)
    misread = readings.mistaken
    everywhere = len({m.words for m in misread.values()}) == 1 and misread.keys() == fits.keys()
    copied = _copies(records)
    steps: dict[int, float] = {}  # a dead channel shows none
    moving: set[int] = set()
    for record in records:
        for cart in measured(record):
            steps[cart] = max(steps.get(cart, 0.0), record.encoder_step(cart))
            if is_driven(record) and np.ptp(record.position(cart)) > 0:
                moving.add(cart)
    friction = {
        cart: float(
            np.median([f.friction.get(cart, np.inf) for f in fits.values() if cart in f.lost])
        )
        for cart in {cart for fit in fits.values() for cart in fit.lost}
    }
    # However many are wrong: no bench is read a thousand times as slowly in some recordings.
    clocks = [record.sample_time for record in records]
    usual_clock = min((dt for dt in clocks if dt >= FASTEST), default=0.0)
    found: dict[str, LeftOut] = {}
    for record in records:
        for problem in (
            *_wrong_clock(record, usual=usual_clock),
            *_short_dwell(record),
            *([copied[record.id]] if record.id in copied else ()),
            *([_so_read(misread[record.id], everywhere)] if record.id in misread else ()),
            *(
                _frozen(record, fits[record.id], chain, friction=friction, steps=steps)
                if chain and record.id in fits
                else ()
            ),
            *_dead_channels(record, chain=chain, friction=friction, steps=steps, moving=moving),
        ):
            legal = record.id in misread and misread[record.id].legal
            fault = LeftOut(experiment=record.id, reason=problem, is_wrong=not legal)
            found.setdefault(record.id, fault)
    for name, one in readings.odd.items():
        found.setdefault(name, one)
    for name, reason in _strays(records, chain=chain, fits=fits):
        found.setdefault(name, LeftOut(experiment=name, reason=reason, is_wrong=False))
    return found


def find_impossible_gains(gains: Sequence[StepGain]) -> dict[str, LeftOut]:
    """Return the steps in which a cart moves farther than the one that pulls it, by id.

    The input acts on cart 1, springs do the rest: a static gain is at most that of the cart before.
    """
    found: dict[str, LeftOut] = {}
    by_cart = {(gain.experiment, gain.cart): gain for gain in gains if gain.interval is None}
    for (run, cart), gain in by_cart.items():
        before = by_cart.get((run, cart - 1))
        if before is None:
            continue
        least = abs(gain.gain) - limits.SIGMAS * gain.gain_std
        if least > limits.FARTHER * (abs(before.gain) + limits.SIGMAS * before.gain_std):
            reason = (
                f"cart {cart} comes to rest {abs(gain.gain / before.gain):.3g} times as far out as "
                f"cart {cart - 1}, which pulls it: no springs do that, so a column looks to be in "
                "another unit or another cart's"
            )
            found[run] = LeftOut(experiment=run, reason=reason, is_wrong=True)
    return found


# ------------------------------------------------------------------ single channels


def _edges(y: np.ndarray) -> np.ndarray:
    """Return where each stretch of one and the same reading starts, and where the last ends."""
    return np.concatenate([[0], np.flatnonzero(np.diff(y)) + 1, [y.size]])


def _still(record: Record, cart: int) -> Iterator[slice]:
    """Yield the samples of one and the same reading over which the input changes far."""
    u, y = record.u, record.position(cart)
    if u is None:
        return
    edges = _edges(y)
    long = limits.STILL_SHARE * y.size
    for i in np.flatnonzero(np.diff(edges) >= long):
        part = slice(int(edges[i]), int(edges[i + 1]))
        changed = np.abs(u[part] - u[part.start]) >= limits.STILL_INPUT * np.ptp(u)
        if changed.any() and changed.size - np.argmax(changed) >= long:
            yield part


def _dead_channels(
    record: Record,
    *,
    chain: Chain | None,
    friction: Mapping[int, float],
    steps: Mapping[int, float],
    moving: Set[int],
) -> Iterator[str]:
    """Yield what is said of a free cart's reading that stays where the cart must have moved.

    By cart, `friction` is the most that the records allow, `steps` has the encoder step; `moving`
    are the carts that any input ever moved.
    """
    for cart in measured(record):
        y = record.position(cart)
        never = is_driven(record) and cart not in moving
        if np.ptp(y) == 0 and (record.kind == "decay" or never):
            others = [free for free in record.free if free != cart]
            held = f"; if it was held, write carts = {others}" if others else ""
            yield f"the encoder of cart {cart} never changes{held}"
        if chain is None or record.u is None or not is_driven(record):
            continue
        force = force_on(record, chain, cart=cart)
        for still in _still(record, cart):
            # Friction that holds a cart pulls at most as far to one side as then to the other.
            if force is None or 2 * friction.get(cart, np.inf) >= np.ptp(force[still]):
                continue
            if not _must_move(record, chain, still, cart=cart, step=steps[cart]):
                continue
            first, last = record.t[still.start], record.t[still.stop - 1]
            yield (
                f"the encoder of cart {cart} never changes, although the input moves the cart"
                if np.ptp(y) == 0
                else f"the encoder of cart {cart} stands still from {first:.4g} s to {last:.4g} s, "
                "although the input moves the cart: it froze"
            )


def _frozen(
    record: Record,
    fit: Followed,
    chain: Chain,
    *,
    friction: Mapping[int, float],
    steps: Mapping[int, float],
) -> Iterator[str]:
    """Yield what is said of a reading that stays for a while in which the carts moved it far.

    Before and after it follows them, and what pulls at it meanwhile no friction can hold.
    """
    for cart, missed in fit.missed.items():
        y = record.position(cart)
        far = max(limits.SEEN_COUNTS * steps[cart], limits.FROZEN_SHARE * float(np.ptp(y)))
        edges = _edges(y)
        for i in np.flatnonzero(np.diff(edges) >= limits.FROZEN_SAMPLES):
            part = slice(int(edges[i]), int(edges[i + 1]))
            moved = float(np.ptp(missed[part]))
            if moved < far:
                continue
            rest, force = np.delete(missed, part), force_on(record, chain, cart=cart)
            if not rest.size or force is None:
                continue
            # A cart at rest stays there for a moment after the input steps.
            early = force[part][: (part.stop - part.start) // 2]
            if 2 * friction.get(cart, np.inf) >= np.ptp(early):
                continue
            elsewhere = float(np.mean(rest**2))
            follows = elsewhere < FOLLOWED * float(np.var(np.delete(y, part)))
            if follows and np.sqrt(elsewhere) < limits.FROZEN_ELSEWHERE * moved:
                first, last = record.t[part.start], record.t[part.stop - 1]
                yield (
                    f"the encoder of cart {cart} stands still from {first:.4g} s to {last:.4g} s, "
                    "although the cart moves on: it froze"
                )


def _must_move(record: Record, chain: Chain, still: slice, *, cart: int, step: float) -> bool:
    """Whether the input moves a cart far within some samples, from rest and in steady state."""
    assert record.u is not None
    free = tuple(sorted(record.free))
    y = simulate_linear(chain, record.t, record.u, free=free, hold=record.hold)[free.index(cart)]
    far = float(np.ptp(y[still]))
    if record.kind == "sine" and record.omega is not None:  # it may start in motion
        G = chain.frequency_response(np.array([record.omega]))[cart - 1, 0]
        far = min(far, float(abs(G) * np.ptp(record.u)))
    return far >= max(limits.SEEN_COUNTS * step, limits.SEEN_SHARE * float(np.ptp(y)))


def _copies(records: Sequence[Record]) -> dict[str, str]:
    """Return the records that hold the very samples of one of their kind before them."""
    first: dict[tuple[object, ...], str] = {}
    copies = {}
    for record in records:
        what = (record.kind, record.free, record.t.tobytes(), record.y.tobytes())
        if first.setdefault(what, record.id) != record.id:
            copies[record.id] = (
                f"it holds the samples of {first[what]}: take it out, for a repeat is a recording "
                "of its own"
            )
    return copies


def _short_dwell(record: Record) -> Iterator[str]:
    if record.kind == "sine" and record.omega is not None:
        duration = float(record.t[-1] - record.t[0]) + record.sample_time
        cycles = record.omega * duration / (2 * np.pi)
        if cycles < limits.FEWEST_CYCLES:
            most = f"{limits.FEWEST_CYCLES:g}"
            yield f"fewer than {most} cycles are no steady state: the file looks cut"


def _wrong_clock(record: Record, *, usual: float) -> Iterator[str]:
    """Yield the unit of a time column that makes this record's sampling the usual one."""
    for factor, words in TIME_FACTORS.items():
        is_unit = max(factor, 1 / factor) >= limits.CLOCK_UNIT  # twice as fast may be by right
        if is_unit and abs(record.sample_time - factor * usual) < limits.SAME * factor * usual:
            yield (
                f"its samples are {record.sample_time:.3g} s apart, those of the others "
                f"{usual:.3g} s: {words}"
            )


# ------------------------------------------------------- records that follow no carts


def _so_read(misread: Misread, everywhere: bool) -> str:
    if everywhere:
        return (
            f"{misread.words}, in every recording of carts that the input moves: {misread.remedy}; "
            "read that way they follow one model, as they are they follow none"
        )
    return f"{misread.words}: read that way it follows the identified carts"


def _strays(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, Followed]
) -> Iterator[tuple[str, str]]:
    """Yield the records that follow no carts like those that most records follow, and by how far.

    Any cart that follows counts for the record: another may be near its null, and hardly move.
    One that moves less than it should says nothing: friction may hold it.
    """
    if chain is None or not most_follow(fits):
        return
    for record in records:
        fit = fits.get(record.id)
        if fit is None or fit.belongs or max(fit.reach.values()) < limits.STRAY_REACH:
            continue
        if all(min(near_by.lost.values()) > limits.STRAY for near_by in near(record, chain)):
            yield (
                record.id,
                "it does not move as the carts do that the other records show: "
                f"{100 * min(fit.share, 1.0):.0f} % of its motion stays unexplained",
            )
