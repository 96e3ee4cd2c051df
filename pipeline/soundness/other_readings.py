"""Records that follow the carts only if they are read differently, and who made the mistake.

A unit, or a clock, applies to everything that one program logged. A single record that moves a
tenth as far is odd and no more: an amplifier at its limit, a dead zone or friction has that effect
too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.estimation.chain.follow import Followed, Misread, find_misread
from pipeline.plant.linear.chain import Chain
from pipeline.results import Record
from pipeline.soundness.fault import SAME, SAME_SIZE, WITNESSES, RecordingFault


@dataclass(frozen=True, kw_only=True)
class OtherReadings:
    """The records that follow only if read differently, by id.

    Attributes
    ----------
    mistaken : as they are, they do not hold what happened.
    odd : … or the bench did something that no chain does.
    """

    mistaken: dict[str, Misread] = field(default_factory=dict)
    odd: dict[str, RecordingFault] = field(default_factory=dict)


def find_other_readings(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, Followed]
) -> OtherReadings:
    """Find the records that follow the chain only if they are read differently.

    If this holds for most of a kind, it holds for those of the kind that show it less clearly.
    """
    if chain is None:
        return OtherReadings()
    found: dict[str, Misread] = {}
    held = [record for record in records if record.id in fits]
    for alike in _by_kind(held):
        sure = {r.id: m for r in alike if (m := find_misread(r, chain, fits[r.id]))}
        if 2 * len(sure) > len(alike):
            sure |= {
                r.id: m
                for r in alike
                if r.id not in sure and (m := find_misread(r, chain, fits[r.id], better=1.0))
            }
        found |= sure
    legal = {name for name, misread in found.items() if misread.legal}
    if 2 * len(legal) > len(fits):  # then the bench counts that way
        found = {name: misread for name, misread in found.items() if name not in legal}
    agreeing = sum(fit.belongs for name, fit in fits.items() if name not in found) + len(found)
    if agreeing < WITNESSES:
        return OtherReadings()
    mistaken = without_lone_factors(found, held, fits=fits)
    lone = {name: m for name, m in found.items() if name not in mistaken and m.scale}
    return OtherReadings(
        mistaken=mistaken, odd={name: _odd(name, scale=m.scale or 1.0) for name, m in lone.items()}
    )


def without_lone_factors(
    found: Mapping[str, Misread], records: Sequence[Record], *, fits: Mapping[str, Followed]
) -> dict[str, Misread]:
    """Return the readings without factors that not every record of their kind shares.

    Parameters
    ----------
    records : all that are compared with the chain; `fits` is how each follows it unchanged.
    """
    kept = {name: m for name, m in found.items() if m.scale is None and m.clock is None}
    for alike in _by_kind(records):
        factors = {r.id: found[r.id] for r in alike if r.id in found and r.id not in kept}
        for words in dict.fromkeys(misread.words for misread in factors.values()):
            sharing = [r for r in alike if r.id in factors and factors[r.id].words == words]
            contrary = [
                r for r in alike if r not in sharing and (r.id in found or fits[r.id].belongs)
            ]
            misread = factors[sharing[0].id]
            shared = len(sharing) >= WITNESSES and not contrary
            if misread.scale is not None and shared:
                limited = misread.scale < 1 and _may_be_a_limit(sharing, records, fits)
                kept |= {} if limited else {r.id: misread for r in sharing}
            if misread.clock is not None:
                kept |= {
                    r.id: misread
                    for r in sharing
                    if shared or _is_sampled_so(r, records, factor=misread.clock)
                }
    return {name: misread for name, misread in found.items() if name in kept}


def _by_kind(records: Sequence[Record]) -> list[list[Record]]:
    kinds = dict.fromkeys(record.kind for record in records)
    return [[record for record in records if record.kind == kind] for kind in kinds]


def _may_be_a_limit(
    sharing: Sequence[Record], records: Sequence[Record], fits: Mapping[str, Followed]
) -> bool:
    """Whether no input so large moves the carts as far as it should, and all are of one size.

    Then an amplifier at its limit gives one factor for all. For inputs of several sizes it gives
    several.
    """
    sizes = [_size(record) for record in sharing]
    follows = [_size(r) for r in records if r not in sharing and fits[r.id].belongs]
    several = min(sizes) < (1 - SAME_SIZE) * max(sizes)
    return not several and max(follows, default=0.0) < (1 - SAME_SIZE) * max(sizes)


def _size(record: Record) -> float:
    return 0.0 if record.u is None else float(np.abs(record.u).max())


def _is_sampled_so(record: Record, records: Sequence[Record], *, factor: float) -> bool:
    """Whether a record's sample interval is this many times that of the others."""
    others = [other.sample_time for other in records if other is not record]
    usual = factor * float(np.median(others)) if others else 0.0
    return abs(record.sample_time - usual) <= SAME * usual


def _odd(name: str, *, scale: float) -> RecordingFault:
    code = "moves_too_little" if scale < 1 else "moves_too_far"
    return RecordingFault(code=code, run=name, said={"scale": f"{scale:.3g}"}, is_wrong=False)
