"""Warnings about records, in addition to those of the checks."""

from collections.abc import Sequence
from math import ceil

import numpy as np

from pipeline.estimation.interventions import without_releases
from pipeline.identify.encoders import find_other_units
from pipeline.ingest.formats.headings import conversion
from pipeline.ingest.read import Ingested
from pipeline.results import Intervention, Record
from pipeline.words.numbers import group_messages
from pipeline.words.phrases import phrases

_WORDS = phrases("skipped")
# m/s. The carts of a bench reach 0.4, and those of inverted pendulums 3. Centimetres read as metres
# give 15 to 40.
_FASTEST = 10.0


def reading_remarks(data: Ingested, *, unit: str) -> list[str]:
    """Return the notes from reading the files, with warnings about units.

    There is one if `unit` seems wrong, and one for decays in other units. Their unit does not
    affect their results.
    """
    units = find_other_units(data.records, decays=True)
    return [
        *data.warnings,
        *_too_fast(data.records, unit=unit),
        *group_messages((record.id, note) for record in data.records for note in record.notes),
        *group_messages(
            (name, _WORDS.text("decay_in_other_unit", reason=one.reason))
            for name, one in units.items()
        ),
    ]


def hand_remarks(interventions: Sequence[Intervention], *, records: Sequence[Record]) -> list[str]:
    """Return in which records and when a hand moves a cart, except for releases of decays."""
    return group_messages(
        (
            one.experiment,
            _WORDS.text(
                "hand",
                cart=one.cart,
                what=one.what,
                start=f"{one.start:.2f}",
                end=f"{one.end:.2f}",
            ),
        )
        for one in without_releases(interventions, records)
    )


def _too_fast(records: Sequence[Record], *, unit: str) -> list[str]:
    """Return a warning if the carts are impossibly fast in two kinds of experiments.

    If only one kind of experiment is too fast, it may be an accident.
    """
    metres = conversion(unit, "m")
    fastest: dict[str, tuple[float, str]] = {}
    for record in records if metres else ():
        there = fastest.get(record.kind, (0.0, ""))
        fastest[record.kind] = max(there, (_speed(record), record.id))
    speed, run = sorted(fastest.values())[-2] if len(fastest) > 1 else (0.0, "")
    if not metres or speed * metres <= _FASTEST:
        return []
    return [_WORDS.text("too_fast", run=run, speed=f"{speed:.2g}", unit=unit)]


def _speed(record: Record) -> float:
    """Return the speed of the fastest cart, position units/s, without momentary jumps."""
    span = max(1, ceil(0.02 / record.sample_time))
    moved, took = record.y[:, span:] - record.y[:, :-span], record.t[span:] - record.t[:-span]
    if not took.size:
        return 0.0
    # The speed is taken over 20 ms and without the fastest hundredth, because a jump of the encoder
    # is not a speed.
    return float(np.quantile(np.abs(moved) / took, 0.99, axis=1).max())


def is_reversed(records: Sequence[Record]) -> bool:
    """Whether a positive input, with the bench's sign, pushes cart 1 towards negative x."""
    signs = [r.input_scale for r in records if r.u is not None and r.kind != "closed_loop"]
    return sum(1 if sign > 0 else -1 for sign in signs) < 0


def gain_sign_warning(records: Sequence[Record]) -> list[str]:
    """Return a warning if the bench's input has the opposite sign of the designed gains."""
    if not is_reversed(records):
        return []
    return [_WORDS.text("reversed")]
