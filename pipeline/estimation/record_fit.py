"""How well records follow a chain, and what correction would make a record follow it.

Apart from start and encoder zeros, the residual of a record is linear in the record's columns. So
the best factors on the columns directly show which column has the wrong sign or unit.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.parametrisation import Modes, Parametrisation, find_modes
from pipeline.estimation.time_fit import FOLLOWED, FitWindow, compare, open_window
from pipeline.plant.chain import Chain
from pipeline.results import Record
from pipeline.setup import Setup

LENGTH_SCALES = (10.0, 100.0, 1000.0, 2.54, 25.4)  # between mm, cm, m and inches
# For each factor of a time column in another unit: the name of the unit, in full and in headings.
TIME_UNITS = {1e3: ("milliseconds", "ms"), 1e6: ("microseconds", "us")}
TIME_FACTORS = {
    **{factor: f"its time seems to be in {unit}" for factor, (unit, _) in TIME_UNITS.items()},
    1e-3: "its time looks to be in thousands of seconds, or in seconds under a heading that says "
    "ms (correct the heading)",
    2.0: "its clock seems to run at twice the right speed",
    0.5: "its clock seems to run at half the right speed",
}
FASTEST = 1e-4  # s between samples; no bench reads its encoders faster


_ModesOf = Callable[[tuple[int, ...]], Modes]


@dataclass(frozen=True, kw_only=True)
class RecordFit:
    """How well a record follows a chain.

    Attributes
    ----------
    unexplained_share : by cart, the share of its motion's power that neither chain nor noise
        explains.
    residual : by cart, simulated minus measured position (n,).
    chi_square : mean square of `residual` over the variance of encoder step and noise.
    amplitude_ratio : by cart, the root mean square of its motion, relative to the chain's motion.
    friction : by cart, the largest dry friction that is compatible with `unexplained_share`, in
        input units.
    """

    unexplained_share: dict[int, float]
    residual: dict[int, Array]
    chi_square: float
    amplitude_ratio: dict[int, float]
    friction: dict[int, float]

    @property
    def share(self) -> float:
        """The mean of `unexplained_share` over the carts."""
        return float(np.mean(list(self.unexplained_share.values())))

    @property
    def is_consistent(self) -> bool:
        """Whether the record follows the chain."""
        return self.share <= FOLLOWED


@dataclass(frozen=True, kw_only=True)
class Correction:
    """The correction that makes a record follow the chain.

    Attributes
    ----------
    words : a description of the mistake.
    legal : whether the record may be right as it is.
    remedy : what the student must do if all records of a bench contain the mistake.
    scale : the ratio of the motion's unit to the input's, given if nothing else is wrong.
    clock : the ratio of the record's time to the true time, given if nothing else is wrong.
    """

    words: str
    remedy: str = "correct it in the files"
    legal: bool = False
    scale: float | None = None
    clock: float | None = None


def is_driven(record: Record) -> bool:
    """Return whether a logged input that no controller chose moves the carts."""
    driven = record.kind in ("step", "sine", "sweep") and 1 in record.free
    return driven and bool(np.ptp(record.input) > 0)


def record_fits(records: Sequence[Record], chain: Chain) -> dict[str, RecordFit]:
    """Return, by id, how well each driven record follows the chain.

    Records in which no measured cart moves are skipped.
    """
    modes = _modes(chain)
    found = {r.id: _hold_against(r, chain, modes) for r in records if is_driven(r)}
    return {name: fit for name, fit in found.items() if fit}


def most_are_consistent(fits: Mapping[str, RecordFit]) -> bool:
    """Return whether at least half of the records follow the chain; true without records."""
    return 2 * sum(fit.is_consistent for fit in fits.values()) >= len(fits)


def fit_detuned(record: Record, chain: Chain) -> list[RecordFit]:
    """Return how well a record follows slightly slower or faster copies of the chain.

    A spring that stiffens, or an input that arrives late, shifts resonances by some percent. At a
    resonance, this changes the whole motion of a dwell.
    """
    modes = _modes(chain)
    # Scaling the time of the record is the same as scaling the chain's frequencies.
    detuned = [replace(record, t=factor * record.t) for factor in np.linspace(0.85, 1.15, 13)]
    return [fit for other in detuned if (fit := _hold_against(other, chain, modes))]


def find_correction(
    record: Record, chain: Chain, fit: RecordFit, *, better: float = 10.0
) -> Correction | None:
    """Return the correction with which a record follows the chain better by a given factor.

    Parameters
    ----------
    fit : how the record follows the chain without correction.
    better : smallest factor by which the residual must fall.
    """
    found, least = None, min(fit.share / better, FOLLOWED)
    # The rest of the residual of a good record is friction, which no correction removes.
    if better > 1 and fit.share < 0.005:
        return None
    # Use the sign convention of the bench: this record's own sign was found from its data.
    record = (
        replace(record, u=0.0 - record.u)
        if record.sign_reversed and record.u is not None
        else record
    )
    modes = _modes(chain)
    for misread, other in _readings(record, modes):
        held = _hold_against(other, chain, modes)
        # A different sign is legal, but then the residual must be below 2 %. With a long delay
        # instead, it would be larger.
        if held and held.share <= (min(least, 0.02) if misread.legal else least):
            found, least = misread, held.share
    return found


def _readings(record: Record, modes: _ModesOf) -> Iterator[tuple[Correction, Record]]:
    for i, j in combinations(record.measured_free, 2):
        rows = list(range(len(record.carts)))
        a, b = record.carts.index(i), record.carts.index(j)
        rows[a], rows[b] = b, a
        words = f"x{i} and x{j} look swapped"
        other = replace(record, y=record.y[rows], resolution=record.resolution[rows])
        remedy = f'state columns = {{ x{i} = "x{j}", x{j} = "x{i}" }} once, under [system]'
        yield Correction(words=words, remedy=remedy), other
    for factor, words in TIME_FACTORS.items():
        if record.sample_time >= factor * FASTEST:  # over too short a time, any curve fits
            yield Correction(words=words, clock=factor), replace(record, t=record.t / factor)
    try:
        window = open_window(record)
    except DataError:
        return
    # Rounding can change a motion below five encoder steps by any factor.
    if np.any(np.ptp(window.y, axis=1) < 5.0 * np.sqrt(12) * window.stated_sigma):
        return
    if (said := _describe_mistake(window.carts, _weights(window, modes(window.free)))) is not None:
        misread, factors = said
        by_cart = dict(zip(window.carts, factors, strict=True))
        rows = np.array([by_cart.get(cart, 1.0) for cart in record.carts])
        yield (
            misread,
            replace(record, y=rows[:, None] * record.y, resolution=abs(rows) * record.resolution),
        )


def _weights(window: FitWindow, modes: Modes) -> Array:
    """Return the factors (p,) on the columns of the record for which it follows the chain best."""
    driven = compare(replace(window, y=0 * window.y), modes).residual.ravel()
    alone = [
        compare(replace(window, drive_u=None, y=window.y * row[:, None]), modes).residual.ravel()
        for row in np.eye(len(window.carts))
    ]
    best, *_ = np.linalg.lstsq(-np.array(alone).T, driven, rcond=None)
    return np.asarray(best, dtype=np.float64)


def _describe_mistake(carts: Sequence[int], weights: Array) -> tuple[Correction, Array] | None:
    """Describe the mistake that these factors on the columns would correct; None if unknown.

    A wrong unit applies to the whole file. A single cart with a small motion is not a wrong unit:
    it may just be near its null.
    """
    sign, size = np.sign(weights), np.abs(weights)
    # Smaller factors do not count, since an amplifier at its limit reduces the input by 2 or 3.
    scales = [scale for scale in LENGTH_SCALES if scale >= 10.0]
    for scale in (*scales, *(1 / scale for scale in scales)):
        # A factor may be off by 10 %, as the known factors are at least 2.5 apart.
        if np.all(np.abs(size * scale - 1) < 0.1) and len(set(sign)) == 1:
            words = (
                "its positions or its input seem to be in another unit: the recorded motion is "
                f"{scale:.3g} times the motion that the input causes"
            )
            return Correction(words=words, scale=scale), sign / scale
    turned = [f"x{cart}" for cart, s in zip(carts, sign, strict=True) if s < 0]
    if len(turned) == len(carts):
        return Correction(words="its input seems to have the opposite sign", legal=True), sign
    if turned:
        return Correction(words=f"the sign of {' and '.join(turned)} looks reversed"), sign
    return None


# ---------------------------------------------------------- one record and the chain


def _modes(chain: Chain) -> _ModesOf:
    """Return a function that finds the chain's modes for given free carts, without derivatives."""
    every = Parametrisation(bench=Setup(springs=tuple(bool(k) for k in chain.k)))
    none = every.holding_at_zero(*every.names)
    return cache(
        lambda free: find_modes(chain, free=free, parametrisation=none, dp_dtheta=np.zeros(0))
    )


def _hold_against(record: Record, chain: Chain, modes: _ModesOf) -> RecordFit | None:
    try:
        window = open_window(record)
        residual = compare(window, modes(window.free)).residual * window.sigma[:, None]
    except DataError:  # nothing moves, or the motor does not reach the last cart
        return None
    power = np.var(window.y, axis=1)
    excess = np.mean(residual**2, axis=1) - window.stated_sigma**2  # beyond encoder steps and noise
    lost = np.maximum(excess, 0.0) / power
    reach = np.sqrt(power) / np.maximum(np.std(window.y + residual, axis=1), window.stated_sigma)
    # In simulations, carts with dry friction F under a force of amplitude A leave a share of at
    # least (F / 5A)² if they move at all. This is doubled here. Encoder steps and noise hide
    # smaller shares.
    return RecordFit(
        unexplained_share=dict(zip(window.carts, lost.tolist(), strict=True)),
        residual=dict(zip(window.carts, residual, strict=True)),
        chi_square=float(np.mean((residual / window.stated_sigma[:, None]) ** 2)),
        amplitude_ratio=dict(zip(window.carts, reach.tolist(), strict=True)),
        friction={
            cart: float(10.0 * np.sqrt(max(share, 1e-4)) * np.ptp(force) / 2)
            for cart, share in zip(window.carts, lost, strict=True)
            if share <= FOLLOWED and (force := force_on(record, chain, cart=cart)) is not None
        },
    )


def force_on(record: Record, chain: Chain, *, cart: int) -> Array | None:
    """Return the force (n,) on a cart from the input and its neighbours; None if unknown."""
    assert record.u is not None
    force = record.u if cart == 1 else np.zeros_like(record.u)
    for neighbour, k in ((cart - 1, chain.k[cart - 1]), (cart + 1, chain.k[cart])):
        if neighbour in record.carts:
            force = force + k * record.position(neighbour)
        elif neighbour in record.free:
            return None
    return force
