"""The time of a record: which column tells it, and what is to be said of its clock."""

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.clock import SLOW, Clock
from pipeline.ingest.columns import Column, conversion
from pipeline.ingest.formats.table import Table

FEWEST_SAMPLES = 8
_RATE_DIFFERS = 0.01  # of the rate: a stated one that is farther off is worth a word


def time_stamps(table: Table, column: Column | None, *, sample_rate: float | None) -> Array:
    """Return the sample times (n,) in s as they stand in the file, or from the stated rate.

    Raises
    ------
    SubmissionError : too few samples; no time column and no rate (Hz), or one in no unit of time.
    """
    n = table.values.shape[1]
    if n < FEWEST_SAMPLES:
        raise SubmissionError(
            f"{table.source}: expected at least {FEWEST_SAMPLES} samples, found {n}"
        )
    if column is None:
        if sample_rate is None:
            raise SubmissionError(
                f"{table.source}: no time column; it has {table.headings()}; name it in "
                "`columns`, or state `sample_rate` in Hz"
            )
        return np.arange(n) / sample_rate
    factor = conversion(column.unit, "s")
    if factor is None:
        raise SubmissionError(
            f"{table.source}: {column.name!r} is in {column.unit}, which is no unit of time"
        )
    return table.values[column.index] * factor


def clock_notes(
    table: Table, column: Column, clock: Clock, *, sample_rate: float | None
) -> list[str]:
    """Return what is to be said of the clock behind a time column.

    Raises
    ------
    SubmissionError : time stands still or goes back; names the line.
    """
    if clock.stopped is not None:
        i = clock.stopped
        before, after = clock.t[i - 1], clock.t[i]
        what = "stands still" if after == before else "goes back"
        hint = "; two records pasted together?" if after < before else ""
        raise SubmissionError(
            f"{table.source} {table.place(i)}: time {what}, from {before:g} s to {after:g} s{hint}"
        )
    notes = []
    if clock.mean_interval > SLOW:
        notes.append(
            f"samples are {clock.mean_interval:.4g} s apart: is {column.name!r} in other units?"
        )
    if clock.pieces:
        even = "" if clock.pieces == 1 else f", in {clock.pieces} pieces"
        notes.append(
            f"time stamps rounded to {clock.rounding:g} s were straightened: "
            f"one sample every {1e3 * (clock.period or clock.mean_interval):.6g} ms{even}"
        )
    for i in clock.gaps[:3]:
        notes.append(f"time is missing between {clock.t[i - 1]:.4g} s and {clock.t[i]:.4g} s")
    if len(clock.gaps) > 3:
        notes.append(f"and {len(clock.gaps) - 3} more gaps in time")
    if sample_rate is not None and abs(sample_rate * clock.mean_interval - 1) > _RATE_DIFFERS:
        notes.append(
            f"sample_rate = {sample_rate:g} Hz is not used: the time column says "
            f"{1 / clock.mean_interval:.5g} Hz"
        )
    return notes
