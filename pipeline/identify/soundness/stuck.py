"""Encoders that stuck: a reading that stays at speed, or jumps when it goes on."""

from collections.abc import Sequence

import numpy as np

from pipeline.estimation.chain.follow import measured
from pipeline.ingest.problems import stuck_spans
from pipeline.results import LeftOut, Record

_FASTEST = 0.98  # quantile of the moves from sample to sample: the odd jump does not count
_AT_SPEED, _AWAY = 0.6, 1.5  # of the fastest


def find_stuck(records: Sequence[Record]) -> dict[str, LeftOut]:
    """Return the records in which a free cart's encoder stuck, by id.

    Static friction stops a cart from a crawl; it does not stop one at speed, nor is it elsewhere
    when it moves on.
    """
    found: dict[str, LeftOut] = {}
    for record in records:
        for cart in measured(record):
            y = record.position(cart)
            moves = np.abs(np.diff(y))
            fastest = float(np.quantile(moves, _FASTEST))
            for first, last in stuck_spans(y):
                away = last < moves.size and moves[last] >= _AWAY * fastest
                if away or moves[first - 1] >= _AT_SPEED * fastest:
                    reason = (
                        f"the encoder of cart {cart} stands still at speed from "
                        f"{record.t[first]:.4g} s to {record.t[last]:.4g} s: it stuck"
                    )
                    one = LeftOut(experiment=record.id, reason=reason, is_wrong=True)
                    found.setdefault(record.id, one)
    return found
