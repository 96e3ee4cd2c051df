"""Guess which column is what where the file names none."""

import numpy as np

from pipeline.arrays import Array
from pipeline.ingest.channels import mirrors
from pipeline.ingest.clock import SLOW, read_clock
from pipeline.ingest.formats.table import Table

_QUICK = 1e-5  # s between samples; no bench records faster, a slow signal that only rises does
_MOST_CARTS = 4


def suggest_columns(table: Table) -> dict[str, int]:
    """Return each role's column, counted from 1; {} without a clock and encoders to be seen.

    After the clock come the encoders, which hold whole numbers, the first perhaps a commanded
    position that only mirrors encoder 1; the input stands last, as in the exports of the ECP.
    """
    time = next((i for i, column in enumerate(table.values) if _looks_like_a_clock(column)), None)
    if time is None:
        return {}
    after = [i for i in range(time + 1, len(table.names)) if np.ptp(table.values[i]) > 0]
    given = {"time": time}
    if len(after) > 1:
        given["input"] = after.pop()
    encoders = [i for i in after if table.whole[i]]
    if len(encoders) > 1 and mirrors(*table.values[encoders[:2]]):
        encoders = encoders[1:]
    if not encoders or len(encoders) > _MOST_CARTS:
        return {}
    given |= {f"x{cart}": i for cart, i in enumerate(encoders, start=1)}
    return {role: i + 1 for role, i in given.items()}


def _looks_like_a_clock(values: Array) -> bool:
    if values.size < 3 or values[-1] <= values[0] or (np.diff(values) < 0).any():
        return False
    clock = read_clock(values)
    regular = bool(clock.jitter < clock.mean_interval)
    return clock.stopped is None and _QUICK < clock.mean_interval < SLOW and regular
