"""How well records follow a chain, and how one would have to be read to follow it.

Start and encoder zeros aside, what a chain leaves of a record is linear in its columns. So the
weights with which they follow best tell at once which column is turned or in another unit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.chain.modal_response import Modes, find_modes
from pipeline.estimation.chain.parametrisation import Parametrisation
from pipeline.estimation.chain.time_search import FOLLOWED
from pipeline.estimation.chain.time_window import FitWindow, compare, open_window
from pipeline.estimation.units_and_clocks import FASTEST, LENGTH_SCALES, TIME_FACTORS
from pipeline.plant.linear.chain import Chain
from pipeline.results import Record
from pipeline.set_up import Bench

_ModesOf = Callable[[tuple[int, ...]], Modes]


@dataclass(frozen=True, kw_only=True)
class Followed:
    """How a record follows a chain.

    Attributes
    ----------
    lost : by cart, the share of its motion's power that neither chain nor noise explains.
    missed : by cart, (n,) where the chain is minus where the cart was read to be.
    reach : by cart, how far it moves over how far the chain does, root-mean-square.
    friction : by cart, the most dry friction that this allows, in input units.
    """

    lost: dict[int, float]
    missed: dict[int, Array]
    reach: dict[int, float]
    friction: dict[int, float]

    @property
    def share(self) -> float:
        """Their mean."""
        return float(np.mean(list(self.lost.values())))

    @property
    def belongs(self) -> bool:
        """Whether the record follows."""
        return self.share <= FOLLOWED


@dataclass(frozen=True, kw_only=True)
class Misread:
    """What makes a record follow: `words` say it; a `legal` one need not be a mistake.

    `remedy` : what mends it where all records of a bench are so. `scale` : how far it moves over
    how far its input moves the carts, where only that differs. `clock` : its time over the true
    one, where only that differs.
    """

    words: str
    remedy: str = "mend it in the files"
    legal: bool = False
    scale: float | None = None
    clock: float | None = None


def is_driven(record: Record) -> bool:
    """Whether a logged input, which no controller chose, moves the carts."""
    driven = record.kind in ("step", "sine", "sweep") and 1 in record.free
    return driven and record.u is not None and bool(np.ptp(record.u) > 0)


def measured(record: Record) -> list[int]:
    """Return the free carts that were measured."""
    return [cart for cart in record.carts if cart in record.free]


def follow(records: Sequence[Record], chain: Chain) -> dict[str, Followed]:
    """Hold every driven record in which the measured carts move against the chain, by id."""
    modes = _modes(chain)
    found = {r.id: _hold_against(r, chain, modes) for r in records if is_driven(r)}
    return {name: fit for name, fit in found.items() if fit}


def most_follow(fits: Mapping[str, Followed]) -> bool:
    """Tell whether at least half of some records follow, if there are any."""
    return 2 * sum(fit.belongs for fit in fits.values()) >= len(fits)


def near(record: Record, chain: Chain) -> list[Followed]:
    """Return how a record follows carts like those of the chain, a little slower or faster.

    A spring that stiffens, or an input that comes late, shifts resonances by some percent, and at
    one of them that is all of the motion.
    """
    modes = _modes(chain)
    # A spring that stiffens, or an input that is late, shifts resonances by some percent.
    detuned = [replace(record, t=factor * record.t) for factor in np.linspace(0.85, 1.15, 13)]
    return [fit for other in detuned if (fit := _hold_against(other, chain, modes))]


def find_misread(
    record: Record, chain: Chain, fit: Followed, *, better: float = 10.0
) -> Misread | None:
    """Return how a record must be read to follow the chain, so many times better than as it is.

    Parameters
    ----------
    fit : how it follows as it is.
    """
    found, least = None, min(fit.share / better, FOLLOWED)
    # What stays of a good record is friction, and no other reading takes that away.
    if better > 1 and fit.share < 0.005:
        return None
    # As the bench counts its input: a record's own sign was found by what it holds.
    record = replace(record, u=0.0 - record.u) if record.turned and record.u is not None else record
    modes = _modes(chain)
    for misread, other in _readings(record, modes):
        held = _hold_against(other, chain, modes)
        # What a record that counts the other way leaves at most; a long delay leaves more.
        if held and held.share <= (min(least, 0.02) if misread.legal else least):
            found, least = misread, held.share
    return found


def _readings(record: Record, modes: _ModesOf) -> Iterator[tuple[Misread, Record]]:
    for i, j in combinations(measured(record), 2):
        rows = list(range(len(record.carts)))
        a, b = record.carts.index(i), record.carts.index(j)
        rows[a], rows[b] = b, a
        words = f"x{i} and x{j} look exchanged"
        other = replace(record, y=record.y[rows], resolution=record.resolution[rows])
        remedy = f'state columns = {{ x{i} = "x{j}", x{j} = "x{i}" }} for each'
        yield Misread(words=words, remedy=remedy), other
    for factor, words in TIME_FACTORS.items():
        if record.sample_time >= factor * FASTEST:  # too short a time is any short curve
            yield Misread(words=words, clock=factor), replace(record, t=record.t / factor)
    try:
        window = open_window(record)
    except DataError:
        return
    # Encoder steps of motion: rounding changes a smaller one by any factor.
    if np.any(np.ptp(window.y, axis=1) < 5.0 * np.sqrt(12) * window.stated_sigma):
        return
    if (said := _say(window.carts, _weights(window, modes(window.free)))) is not None:
        misread, factors = said
        by_cart = dict(zip(window.carts, factors, strict=True))
        rows = np.array([by_cart.get(cart, 1.0) for cart in record.carts])
        yield (
            misread,
            replace(record, y=rows[:, None] * record.y, resolution=abs(rows) * record.resolution),
        )


def _weights(window: FitWindow, modes: Modes) -> Array:
    """Return the factors (p,) with which the columns follow best."""
    driven = compare(replace(window, y=0 * window.y), modes).residual.ravel()
    alone = [
        compare(replace(window, drive_u=None, y=window.y * row[:, None]), modes).residual.ravel()
        for row in np.eye(len(window.carts))
    ]
    best, *_ = np.linalg.lstsq(-np.array(alone).T, driven, rcond=None)
    return np.asarray(best, dtype=np.float64)


def _say(carts: Sequence[int], weights: Array) -> tuple[Misread, Array] | None:
    """Say what is wrong where columns need about these factors, and which; None if nothing known.

    A unit is that of the whole file: one cart near its null moves by any factor too little.
    """
    sign, size = np.sign(weights), np.abs(weights)
    # An amplifier at its limit makes less of the input by a factor of 2 or 3.
    scales = [scale for scale in LENGTH_SCALES if scale >= 10.0]
    for scale in (*scales, *(1 / scale for scale in scales)):
        # Relative, of a unit's factor: the known ones lie 2.5 times apart.
        if np.all(np.abs(size * scale - 1) < 0.1) and len(set(sign)) == 1:
            words = (
                "its positions or its input look to be in another unit: they move "
                f"{scale:.3g} times as far as its input moves the carts"
            )
            return Misread(words=words, scale=scale), sign / scale
    turned = [f"x{cart}" for cart, s in zip(carts, sign, strict=True) if s < 0]
    if len(turned) == len(carts):
        return Misread(words="its input looks to count the other way", legal=True), sign
    if turned:
        return Misread(words=f"the sign of {' and '.join(turned)} looks turned"), sign
    return None


# ------------------------------------------------------------------ one record held


def _modes(chain: Chain) -> _ModesOf:
    """Return what finds the chain's modes by its free carts, without derivatives."""
    P = Parametrisation(bench=Bench(springs=tuple(bool(k) for k in chain.k)))

    @cache
    def find(free: tuple[int, ...]) -> Modes:
        modes = find_modes(chain, free=free, parametrisation=P, dp_dtheta=np.zeros(len(P.names)))
        return replace(
            modes,
            d_poles=modes.d_poles[:0],
            d_shapes=modes.d_shapes[:0],
            d_entry=modes.d_entry[:0],
            d_drive=modes.d_drive[:0],
        )

    return find


def _hold_against(record: Record, chain: Chain, modes: _ModesOf) -> Followed | None:
    try:
        window = open_window(record)
        residual = compare(window, modes(window.free)).residual * window.sigma[:, None]
    except DataError:  # nothing moves, or the motor does not reach the last cart
        return None
    power = np.var(window.y, axis=1)
    excess = np.mean(residual**2, axis=1) - window.stated_sigma**2  # beyond encoder and noise
    lost = np.maximum(excess, 0.0) / power
    reach = np.sqrt(power) / np.maximum(np.std(window.y + residual, axis=1), window.stated_sigma)
    # Simulated carts with dry friction F under a force of amplitude A leave at least (F / 5A)²
    # where they move at all, which is doubled here; encoder and noise hide shares below the least.
    return Followed(
        lost=dict(zip(window.carts, lost.tolist(), strict=True)),
        missed=dict(zip(window.carts, residual, strict=True)),
        reach=dict(zip(window.carts, reach.tolist(), strict=True)),
        friction={
            cart: float(10.0 * np.sqrt(max(share, 1e-4)) * np.ptp(force) / 2)
            for cart, share in zip(window.carts, lost, strict=True)
            if share <= FOLLOWED and (force := force_on(record, chain, cart=cart)) is not None
        },
    )


def force_on(record: Record, chain: Chain, *, cart: int) -> Array | None:
    """Return what pulls at a cart (n,) by input and neighbours; None where one is not known."""
    assert record.u is not None
    force = record.u if cart == 1 else np.zeros_like(record.u)
    for neighbour, k in ((cart - 1, chain.k[cart - 1]), (cart + 1, chain.k[cart])):
        if neighbour in record.carts:
            force = force + k * record.position(neighbour)
        elif neighbour in record.free:
            return None
    return force
