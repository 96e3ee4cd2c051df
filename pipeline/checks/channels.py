"""Check of the channels against each other: is one of them logged later than the others?"""

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np

from pipeline.checks import limits
from pipeline.estimation.chain.channel_delay import ChannelDelay, find_channel_delays
from pipeline.names import listed
from pipeline.results import Check, LateChannel, Record

LATE_CHANNEL = "late_channel"  # then the cart
_KINDS = {
    "sine": "the dwells",
    "step": "the steps",
    "sweep": "the sweeps",
    "decay": "the decays",
    "closed_loop": "closed loop",
}


def find_late_channels(records: Sequence[Record], *, carts: int) -> tuple[LateChannel, ...]:
    """Find the carts whose channel is read later, or earlier, than that of the first one.

    Each kind of experiment is asked alone: one may have been logged otherwise than another. A
    delay of the input moves all channels alike, and is none of theirs.
    """
    late: list[LateChannel] = []
    for kind in _KINDS:
        alike = [record for record in records if record.kind == kind]
        if alike:
            late += _late_in(alike, kind=kind, carts=carts)
    # Beside a late channel a right one is early.
    named = {one.cart for one in late if one.than == 1}
    return tuple(one for one in late if one.than not in named)


def _late_in(records: Sequence[Record], *, kind: str, carts: int) -> list[LateChannel]:
    sample = float(np.median([record.sample_time for record in records]))
    links = find_channel_delays(records, n=carts)
    first, delay, limit = 1, 0.0, 0.0
    found: list[LateChannel] = []
    for cart in range(2, carts + 1):
        if cart not in links:  # what comes after is held against this one
            first, delay, limit = cart, 0.0, 0.0
            continue
        link = links[cart]
        if _shows(link, sample=sample):
            delay, limit = delay + link.delay, max(limit, _limit(link, sample=sample))
        elif abs(link.delay) + limits.LATE_SURE * link.std > limits.LATE * sample:
            # It tells neither a delay nor that there is none.
            first, delay, limit = cart, 0.0, 0.0
        if abs(delay) > max(limit, limits.LATE * sample):
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
    return max(limits.LATE * sample, limits.LATE_SURE * link.std)


def _shows(link: ChannelDelay, *, sample: float) -> bool:
    return link.better >= limits.LATE_BETTER and abs(link.delay) > _limit(link, sample=sample)


def check_channels(late: Sequence[LateChannel]) -> list[Check]:
    """Fail for each cart whose channel is late."""
    checks = []
    for cart, of_cart in groupby(sorted(late, key=lambda one: one.cart), key=lambda one: one.cart):
        alike = list(of_cart)
        surest = min(alike, key=lambda one: (one.than, one.limit))
        kinds = [_KINDS[one.kind] for one in alike]
        checks.append(
            Check.of(
                f"{LATE_CHANNEL}.cart-{cart}",
                False,
                f"{say_late(surest)} in {listed(kinds)}. No carts do that: a filter on one channel "
                "does, or channels that are not read at one time. Positions and velocities that a "
                "controller feeds back must be of one moment.",
                value=surest.delay,
                limit=surest.limit,
            )
        )
    return checks


def say_late(late: LateChannel) -> str:
    """Return in words by how much a cart is read late."""
    word = "later" if late.delay > 0 else "earlier"
    return f"cart {late.cart} is read {1e3 * abs(late.delay):.3g} ms {word} than cart {late.than}"


def late_experiments(late: Sequence[LateChannel]) -> Mapping[str, str]:
    """Return the experiments in which a cart is late, each with what is to be said of it."""
    return {name: say_late(one) for one in reversed(late) for name in one.experiments}
