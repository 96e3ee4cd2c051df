"""The delay of one cart's channel against its neighbour's, from the carts' own law of motion.

A cart without a motor is moved by its neighbours alone, whatever the input is and however late it
arrives. Its law of motion is

    k_i x_{i-1} = m_i x_i'' + c_i x_i' + (k_i + k_{i+1}) x_i - k_{i+1} x_{i+1}.

The best delay of a cart's channel, against the channel of the cart before it, is the one for which
this law fits best. No data are differentiated: both sides are averaged with a bump that slides
along the records (`modulating`). The coefficients may have any sign and size. So a cart in another
unit, or with a reversed sign, gives the same delay.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump, motion_period
from pipeline.results import Record

_FEWEST_PLACES = 30
_MOST_LATE = 15  # grid steps tried in each direction
_PARTS = 8  # fewest records, or parts of records, for a standard error


@dataclass(frozen=True, kw_only=True)
class ChannelDelay:
    """The delay of one cart's channel against the channel of the cart before it.

    Attributes
    ----------
    delay, std : delay in s, and its standard error by jackknife over records. The delay is positive
        if the cart's channel is read later.
    better : factor by which this delay lowers the residual of the cart's law. Friction, backlash
        and end stops look like a small delay, but no delay removes their residual.
    """

    cart: int
    delay: float
    std: float
    better: float
    experiments: tuple[str, ...]


def find_channel_delays(records: Sequence[Record], *, n: int) -> dict[int, ChannelDelay]:
    """Return, by cart, the delay of its channel against the channel before it, if significant.

    The search begins at the last cart, because the law of each cart uses the corrected times of the
    cart after it.
    """
    found: dict[int, ChannelDelay] = {}
    for cart in range(n, 1, -1):
        after = found[cart + 1].delay if cart + 1 in found else 0.0
        one = _channel_delay(records, cart, after=after)
        if one is not None:
            found[cart] = one
    return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Normal:
    """Normal equations of the law in a part of a record, for every trial delay.

    Attributes
    ----------
    power : sum of squares (n_d,) of the left side.
    cross : products (n_d, 4) of the left side with the columns of the right side.
    square : products (4, 4) of the columns of the right side.
    """

    power: Array
    cross: Array
    square: Array

    def without(self, other: "_Normal") -> "_Normal":
        """Return these equations minus the equations of one part."""
        return _Normal(
            power=self.power - other.power,
            cross=self.cross - other.cross,
            square=self.square - other.square,
        )

    def left(self) -> Array:
        """Return the power (n_d,) of the left side that the best law does not explain."""
        used = np.diag(self.square) > 0
        size = np.sqrt(np.diag(self.square)[used])
        cross = self.cross[:, used] / size
        square = self.square[np.ix_(used, used)] / size / size[:, None]
        weights = np.linalg.lstsq(square, cross.T, rcond=None)[0]
        return self.power - np.sum(cross * weights.T, axis=1)


def _channel_delay(records: Sequence[Record], cart: int, *, after: float) -> ChannelDelay | None:
    usable = [record for record in records if _shows_delay(record, cart)]
    periods = [motion_period(one.position(cart)) * one.sample_time for one in usable]
    if not usable:
        return None
    # The grid has 240 steps in a period of the motion, unless the samples are closer.
    finest = float(np.median(periods)) / 240
    step = max(float(np.median([record.sample_time for record in usable])), finest)
    parts = -(-_PARTS // len(usable))
    equations: list[_Normal] = []
    experiments: list[str] = []
    for record, period in zip(usable, periods, strict=True):
        if found := _equations(record, cart, after=after, step=step, period=period, parts=parts):
            equations += found
            experiments.append(record.id)
    if len(equations) < _PARTS:
        return None
    total = _Normal(
        power=np.sum([one.power for one in equations], axis=0),
        cross=np.sum([one.cross for one in equations], axis=0),
        square=np.sum([one.square for one in equations], axis=0),
    )
    left = total.left()
    best, least = _lowest(left)
    if abs(best) >= _MOST_LATE:  # a still longer delay would fit better, so this is not a delay
        return None
    others = np.array([_lowest(total.without(one).left())[0] for one in equations])
    spread = float(np.sum((others - others.mean()) ** 2))
    return ChannelDelay(
        cart=cart,
        delay=best * step,
        std=step * float(np.sqrt(spread * (others.size - 1) / others.size)),
        better=float(left[_MOST_LATE]) / max(least, np.finfo(float).tiny),
        experiments=tuple(experiments),
    )


def _shows_delay(record: Record, cart: int) -> bool:
    """Return whether the record can show the delay.

    All forces on the cart must have been measured, and both this cart and the cart before it must
    move far.
    """
    if any(c not in record.carts or c not in record.free for c in (cart - 1, cart)):
        return False
    if cart + 1 in record.free and cart + 1 not in record.carts:
        return False
    # The motion must span at least this many encoder steps.
    return all(np.ptp(record.position(c)) > 20.0 * record.encoder_step(c) for c in (cart - 1, cart))


def _equations(
    record: Record, cart: int, *, after: float, step: float, period: float, parts: int
) -> list[_Normal]:
    """Return the equations of each part of a record, or [] if the record is too short."""
    t = np.arange(record.t[0], record.t[-1], step)
    # A bump lasts a quarter of the motion's period, because wider bumps would suppress fast motion,
    # which is the most informative. With fewer than 16 samples under a bump, only the encoder's
    # steps would count.
    width = max(round(0.25 * period / step), 16)
    first, last = _MOST_LATE, t.size - width - _MOST_LATE
    places = np.arange(first, last, max(width // 6, (last - first) // 400, 1))
    if places.size < max(_FEWEST_PLACES, parts):
        return []
    weight, slope, bend = bump((np.arange(width) + 0.5) / width, span=width)

    def at(cart: int, *, late: float = 0.0) -> Array:
        return np.interp(t + late, record.t, record.position(cart))

    own = sliding_window_view(at(cart), width)[places]
    right = [own @ bend, -(own @ slope), own @ weight, np.zeros(places.size)]
    if cart + 1 in record.free:
        right[3] = sliding_window_view(at(cart + 1, late=after), width)[places] @ weight
    before = np.correlate(at(cart - 1), weight)
    shifts = np.arange(-_MOST_LATE, _MOST_LATE + 1)
    left = before[places - shifts[:, None]]
    # Encoder zeros cancel, and each record has the same weight.
    left = left - left.mean(axis=1, keepdims=True)
    size = float(np.linalg.norm(left[_MOST_LATE]))
    if size == 0:
        return []
    a = left / size
    b = (np.array(right) - np.mean(right, axis=1)[:, None]) / size
    return [
        _Normal(
            power=np.sum(a[:, part] ** 2, axis=1),
            cross=a[:, part] @ b[:, part].T,
            square=b[:, part] @ b[:, part].T,
        )
        for part in np.array_split(np.arange(places.size), parts)
    ]


def _lowest(left: Array) -> tuple[float, float]:
    """Return the delay (in grid steps, interpolated) with the least residual, and this residual."""
    i = int(np.argmin(left))
    between = 0.0
    if 0 < i < left.size - 1 and (bend := left[i - 1] - 2 * left[i] + left[i + 1]) > 0:
        between = 0.5 * float((left[i - 1] - left[i + 1]) / bend)
    return i + between - _MOST_LATE, float(left[i])
