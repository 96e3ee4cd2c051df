"""What a reader must know of the records as such, beside what the checks say."""

from collections.abc import Sequence
from math import ceil

import numpy as np

from pipeline.estimation.interventions import but_releases
from pipeline.identify import limits
from pipeline.identify.soundness.encoders import find_other_units
from pipeline.ingest.columns import conversion
from pipeline.ingest.read import Ingested
from pipeline.names import by_note
from pipeline.results import Record
from pipeline.results_of_runs import Intervention


def reading_remarks(data: Ingested, *, unit: str) -> list[str]:
    """Return what reading mended, which decays are in another unit, and a `unit` of none of them.

    That of the decays does no harm.
    """
    harmless = "a decay gives no length, so no number is off"
    units = find_other_units(data.records, decays=True)
    return [
        *data.warnings,
        *_too_fast(data.records, unit=unit),
        *by_note((record.id, note) for record in data.records for note in record.notes),
        *by_note((name, f"{one.reason}; {harmless}") for name, one in units.items()),
    ]


def hand_remarks(interventions: Sequence[Intervention], *, records: Sequence[Record]) -> list[str]:
    """Return in which records a hand acts on a cart, and when; but not that a decay is let go."""
    return by_note(
        (
            one.experiment,
            f"cart {one.cart} is {one.what} from {one.start:.2f} to {one.end:.2f} s (a hand?); "
            "what follows a hand counts as a decay of its own; the gap leaves the stretch out",
        )
        for one in but_releases(interventions, records)
    )


def _too_fast(records: Sequence[Record], *, unit: str) -> list[str]:
    """Return that the carts run faster than any, in two kinds of experiments: one may be a slip."""
    metres = conversion(unit, "m")
    fastest: dict[str, tuple[float, str]] = {}
    for record in records if metres else ():
        there = fastest.get(record.kind, (0.0, ""))
        fastest[record.kind] = max(there, (_speed(record), record.id))
    speed, run = sorted(fastest.values())[-2] if len(fastest) > 1 else (0.0, "")
    if not metres or speed * metres <= limits.FASTEST:
        return []
    return [
        f"{run}: a cart runs at {speed:.2g} {unit}/s, and no cart at a bench runs so fast: are the "
        f"positions in another unit than {unit}, such as cm or mm, or the times in another than s? "
        "State the unit that they are in; every static gain is in it"
    ]


def _speed(record: Record) -> float:
    """Return how fast the fastest cart runs, position units/s, but for what jumps for a moment."""
    span = max(1, ceil(limits.SPEED_OVER / record.sample_time))
    moved, took = record.y[:, span:] - record.y[:, :-span], record.t[span:] - record.t[:-span]
    if not took.size:
        return 0.0
    return float(np.quantile(np.abs(moved) / took, limits.SPEED_SHARE, axis=1).max())


def is_reversed(records: Sequence[Record]) -> bool:
    """Whether a positive input, as the bench counts it, drives cart 1 towards negative x."""
    signs = [r.input_scale for r in records if r.u is not None and r.kind != "closed_loop"]
    return sum(1 if sign > 0 else -1 for sign in signs) < 0


def turn_of_the_gains(records: Sequence[Record]) -> list[str]:
    """Return that the bench's input counts against the designed gains, where it does."""
    if not is_reversed(records):
        return []
    return [
        "state feedback: the gains are for an input that pushes cart 1 towards positive x; "
        "the bench's own input pushes the other way, so negate what the controller sends"
    ]
