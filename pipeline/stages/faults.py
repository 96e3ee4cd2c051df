"""Recordings that do not hold what happened: a dead or exchanged channel, a wrong clock, a cut.

Friction may hold a cart still, a held cart is still by right, and a coarse encoder shows nothing
of a small motion. So a channel is called dead only where the identified carts would have moved it
far, and where runs that follow them leave friction too small to hold it.
"""

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pipeline.errors import DataError
from pipeline.plant.chain import Array, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import Check, LeftOut, Record
from pipeline.stages.chain_parameters import Parametrisation
from pipeline.stages.modal_response import find_modes
from pipeline.stages.time_window import compare, open_window

_ACROSS = 0.5  # of the input's range: a reading that stays while the input changes so far
_STILL_SHARE = 0.2  # … and for so long after it; of the record
# What a cart must move, as identified, while its reading stays: encoder steps, and the share of
# its motion in the record, as a delay or play may hold it for a moment.
_SEEN_COUNTS, _SEEN_SHARE = 5.0, 0.3
# Shares of a record's power (about its mean) that the identified carts leave unexplained.
FOLLOWED = 0.1
_EXCHANGED, _BETTER = 0.05, 5.0  # as recorded at least this, exchanged so many times less
_WITNESSES = 2  # records that follow the carts, as they are or exchanged: one does by chance
# Simulated carts with dry friction F under a force of amplitude A leave at least (F / 5A)² where
# they move at all, which is doubled here; encoder and noise hide shares below the least.
_FRICTION, _LEAST = 10.0, 1e-4
_CYCLES = 1.5  # a dwell with fewer holds no steady state, whatever its length
_CLOCKS = {1e3: "milliseconds", 1e6: "microseconds"}
_SAME_CLOCK = 0.02  # a bench samples at one rate, which a unit changes by exactly its factor


def standing_still(records: Sequence[Record]) -> set[str]:
    """Return the driven records in which a free cart's reading stays while the input changes."""
    return {
        record.id
        for record in records
        if _is_driven(record) and any(any(_still(record, cart)) for cart in _measured(record))
    }


def find_faults(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, "Followed"]
) -> dict[str, LeftOut]:
    """Return the records that do not hold what happened, by id, each with what is wrong.

    Parameters
    ----------
    chain : the carts as identified from the records that are not in doubt; None where they could
        not be: then only what no carts could do is found.
    fits : how the records follow it, as `follow` has it.
    """
    exchanged = _exchanged(records, chain=chain, fits=fits)
    copied = _copies(records)
    steps: dict[int, float] = {}  # a dead channel shows none
    moving: set[int] = set()
    for record in records:
        for cart in _measured(record):
            steps[cart] = max(steps.get(cart, 0.0), record.encoder_step(cart))
            if _is_driven(record) and np.ptp(record.position(cart)) > 0:
                moving.add(cart)
    friction = {
        cart: float(
            np.median([f.friction.get(cart, np.inf) for f in fits.values() if cart in f.lost])
        )
        for cart in {cart for fit in fits.values() for cart in fit.lost}
    }
    # However many are wrong: a bench is never sampled a thousand times as fast by mistake.
    usual_clock = min((record.sample_time for record in records), default=0.0)
    found: dict[str, LeftOut] = {}
    for record in records:
        for problem in (
            *_wrong_clock(record, usual=usual_clock),
            *_short_dwell(record),
            *([copied[record.id]] if record.id in copied else ()),
            *([exchanged[record.id]] if record.id in exchanged else ()),
            *_dead_channels(record, chain=chain, friction=friction, steps=steps, moving=moving),
        ):
            fault = LeftOut(experiment=record.id, reason=problem, is_wrong=True)
            found.setdefault(record.id, fault)
    return found


def check_left_out(left_out: Sequence[LeftOut]) -> list[Check]:
    """Return a failed check for each reason for which records are not used."""
    runs: dict[str, list[str]] = {}
    for one in left_out:
        runs.setdefault(one.reason, []).append(one.experiment)
    return [
        Check(
            id=f"record.{names[0]}",
            outcome="fail",
            value=float(len(names)),
            limit=0.0,
            message=f"Left out {'is' if len(names) == 1 else 'are'} {', '.join(names)}: {reason}.",
        )
        for reason, names in runs.items()
    ]


def follows(fits: Mapping[str, "Followed"]) -> bool:
    """Tell whether at least half of the records that tell follow a chain, if there are any."""
    return 2 * sum(fit.share <= FOLLOWED for fit in fits.values()) >= len(fits)


# ------------------------------------------------------------------------ witnesses


@dataclass(frozen=True, kw_only=True)
class Followed:
    """How a record follows a chain.

    Attributes
    ----------
    lost : by cart, the share of its motion's power that neither chain nor noise explains.
    friction : by cart, the most dry friction that this allows, in input units.
    """

    lost: dict[int, float]
    friction: dict[int, float]

    @property
    def share(self) -> float:
        """Their mean."""
        return float(np.mean(list(self.lost.values())))


def follow(records: Sequence[Record], chain: Chain | None) -> dict[str, Followed]:
    """Hold every driven record in which the measured carts move against the chain."""
    found = {}
    for record in records:
        if chain and _is_driven(record) and (fit := _held_against(record, chain)):
            found[record.id] = fit
    return found


def _held_against(record: Record, chain: Chain) -> Followed | None:
    springs = tuple(bool(k) for k in chain.k)
    try:
        window, P = open_window(record), Parametrisation(n=chain.n, springs=springs)
    except DataError:  # nothing moves, or the motor does not reach the last cart
        return None
    modes = find_modes(chain, free=window.free, parametrisation=P, slopes=np.zeros(len(P.names)))
    residual = compare(window, modes).residual * window.sigma[:, None]
    power = np.var(window.y, axis=1)
    left = np.mean(residual**2, axis=1) - window.stated_sigma**2  # beyond encoder and noise
    lost = np.maximum(left, 0.0) / power
    return Followed(
        lost=dict(zip(window.carts, lost.tolist(), strict=True)),
        friction={
            cart: float(_FRICTION * np.sqrt(max(share, _LEAST)) * np.ptp(force) / 2)
            for cart, share in zip(window.carts, lost, strict=True)
            if share <= FOLLOWED and (force := _force(record, chain, cart=cart)) is not None
        },
    )


def _force(record: Record, chain: Chain, *, cart: int) -> Array | None:
    """Return what pulls at a cart (n,) by input and neighbours; None where one is not known."""
    assert record.u is not None
    force = record.u if cart == 1 else np.zeros_like(record.u)
    for neighbour, k in ((cart - 1, chain.k[cart - 1]), (cart + 1, chain.k[cart])):
        if neighbour in record.carts:
            force = force + k * record.position(neighbour)
        elif neighbour in record.free:
            return None
    return force


# ------------------------------------------------------------------ single channels


def _is_driven(record: Record) -> bool:
    """Whether a logged input, which no controller chose, moves the carts."""
    driven = record.kind in ("step", "sine", "sweep") and 1 in record.free
    return driven and record.u is not None and bool(np.ptp(record.u) > 0)


def _measured(record: Record) -> list[int]:
    """Return the free carts that were measured."""
    return [cart for cart in record.carts if cart in record.free]


def _still(record: Record, cart: int) -> Iterator[slice]:
    """Yield the samples of one and the same reading over which the input changes far."""
    u, y = record.u, record.position(cart)
    if u is None:
        return
    edges = np.array([0, *(np.flatnonzero(np.diff(y)) + 1), y.size])
    long = _STILL_SHARE * y.size
    for i in np.flatnonzero(np.diff(edges) >= long):
        part = slice(int(edges[i]), int(edges[i + 1]))
        changed = np.abs(u[part] - u[part.start]) >= _ACROSS * np.ptp(u)
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
    for cart in _measured(record):
        y = record.position(cart)
        never = _is_driven(record) and cart not in moving
        if np.ptp(y) == 0 and (record.kind == "decay" or never):
            yield f"cart {cart} is said to be free and its encoder never changes"
        if chain is None or record.u is None or not _is_driven(record):
            continue
        force = _force(record, chain, cart=cart)
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


def _must_move(record: Record, chain: Chain, still: slice, *, cart: int, step: float) -> bool:
    """Whether the input moves a cart far within some samples, from rest and in steady state."""
    assert record.u is not None
    free = tuple(sorted(record.free))
    y = simulate_linear(chain, record.t, record.u, free=free, hold=record.hold)[free.index(cart)]
    far = float(np.ptp(y[still]))
    if record.kind == "sine" and record.omega is not None:  # it may start in motion
        G = chain.frequency_response(np.array([record.omega]))[cart - 1, 0]
        far = min(far, float(abs(G) * np.ptp(record.u)))
    return far >= max(_SEEN_COUNTS * step, _SEEN_SHARE * float(np.ptp(y)))


def _copies(records: Sequence[Record]) -> dict[str, str]:
    """Return the records that hold the very samples of one of their kind before them."""
    first: dict[tuple[object, ...], str] = {}
    copies = {}
    for record in records:
        what = (record.kind, record.free, record.t.tobytes(), record.y.tobytes())
        if first.setdefault(what, record.id) != record.id:
            copies[record.id] = (
                f"it holds the samples of {first[what]}: a repeat is a recording of its own"
            )
    return copies


def _short_dwell(record: Record) -> Iterator[str]:
    if record.kind == "sine" and record.omega is not None:
        duration = float(record.t[-1] - record.t[0]) + record.sample_time
        cycles = record.omega * duration / (2 * np.pi)
        if cycles < _CYCLES:
            yield f"fewer than {_CYCLES:g} cycles are no steady state: the file looks cut"


def _wrong_clock(record: Record, *, usual: float) -> Iterator[str]:
    """Yield the unit of a time column that makes this record's sampling the usual one."""
    for factor, unit in _CLOCKS.items():
        if abs(record.sample_time - factor * usual) < _SAME_CLOCK * factor * usual:
            yield (
                f"its samples are {record.sample_time:.3g} s apart, those of the others "
                f"{usual:.3g} s: its time looks to be in {unit}"
            )


# --------------------------------------------------------------- exchanged channels


def _exchanged(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, Followed]
) -> dict[str, str]:
    """Return the records that follow the chain with two columns exchanged, and not as they are.

    Where this is so of most of a kind, it is of those of the kind that tell it less clearly.
    """
    if chain is None:
        return {}
    looks: dict[str, str] = {}
    kinds = {record.kind for record in records if record.id in fits}
    for alike in ([r for r in records if r.kind == kind and r.id in fits] for kind in kinds):
        doubtful = [r for r in alike if fits[r.id].share >= _EXCHANGED]
        sure = {r.id: pair for r in doubtful if (pair := _pair(r, chain, better=_BETTER))}
        if 2 * len(sure) > len(alike):
            sure = {r.id: pair for r in alike if (pair := _pair(r, chain, better=1.0))}
        looks |= sure
    if sum(fit.share < _EXCHANGED for fit in fits.values()) + len(looks) < _WITNESSES:
        return {}
    return {
        name: f"{pair} look exchanged: read that way it follows the identified carts"
        for name, pair in looks.items()
    }


def _pair(record: Record, chain: Chain, *, better: float) -> str:
    """Return the two columns that, exchanged, follow the chain so many times better, or ""."""
    as_is = _held_against(record, chain)
    for i, j in combinations(_measured(record), 2):
        exchanged = _held_against(_with_exchanged(record, i, j), chain)
        if as_is and exchanged and exchanged.share <= min(as_is.share / better, FOLLOWED):
            return f"x{i} and x{j}"
    return ""


def _with_exchanged(record: Record, i: int, j: int) -> Record:
    rows = list(range(len(record.carts)))
    a, b = record.carts.index(i), record.carts.index(j)
    rows[a], rows[b] = b, a
    return replace(record, y=record.y[rows], resolution=record.resolution[rows])
