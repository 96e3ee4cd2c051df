"""Compare channels with each other to find one that is logged late."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.estimation.channel_delay import ChannelDelay, find_channel_delays
from pipeline.identify.fault import RecordingFault
from pipeline.results import LateChannel, Record

_LATE, _SURE = 2.0, 4.0  # samples, and standard errors: a late channel exceeds both
# Correcting the delay must lower the residual of the carts' equation of motion by this factor.
# Friction, stops and stiff springs on benches of every kind look like delays, but correcting these
# lowers it by 1.7 times at most. Correcting a delay of 44 ms lowers it 8 times with much friction,
# and thousands of times without friction.
_BETTER = 5.0


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


def late_fault(late: LateChannel) -> RecordingFault:
    """Return the delay of a cart's channel as a fault of the first recording that shows it."""
    when = "later" if late.delay > 0 else "earlier"
    details = {"delay": f"{1e3 * abs(late.delay):.3g}", "when": when, "than": str(late.than)}
    return RecordingFault(
        code="late_channel", run=late.experiments[0], cart=late.cart, details=details
    )


def late_experiments(late: Sequence[LateChannel]) -> Mapping[str, str]:
    """Return the experiments in which a cart is late, each with its sentence."""
    return {name: late_fault(one).reason for one in reversed(late) for name in one.experiments}
