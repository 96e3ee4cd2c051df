"""What a reader must know of the records as such, beside what the checks say."""

from collections.abc import Sequence

from pipeline.identify.log import by_note
from pipeline.identify.soundness.encoders import find_other_units
from pipeline.ingest.read import Ingested
from pipeline.results import Record


def reading_remarks(data: Ingested) -> list[str]:
    """Return what reading mended, and which decays are in another unit, which does no harm."""
    harmless = "a decay gives no length, so no number is off"
    units = find_other_units(data.records, decays=True)
    return [
        *data.warnings,
        *by_note((record.id, note) for record in data.records for note in record.notes),
        *by_note((name, f"{one.reason}; {harmless}") for name, one in units.items()),
    ]


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
