"""Find records that follow the carts only after a correction, and decide which of them are wrong.

A wrong unit or clock applies to everything that one program logged. A single record with a tenth of
the motion is only odd, because an amplifier at its limit, a dead zone or friction can cause this
too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.estimation.record_fit import Correction, RecordFit, find_correction
from pipeline.identify.fault import SAME, SAME_SIZE, WITNESSES, RecordingFault
from pipeline.plant.chain import Chain
from pipeline.results import Record


@dataclass(frozen=True, kw_only=True)
class OtherReadings:
    """The records that follow the chain only after a correction, by id.

    Attributes
    ----------
    mistaken : records that do not show what happened.
    odd : records in which the bench may have done something that no chain does.
    """

    mistaken: dict[str, Correction] = field(default_factory=dict)
    odd: dict[str, RecordingFault] = field(default_factory=dict)


def find_other_readings(
    records: Sequence[Record], *, chain: Chain | None, fits: Mapping[str, RecordFit]
) -> OtherReadings:
    """Find the records that follow the chain only after a correction.

    If most records of a kind need a correction, weaker evidence is enough for the other records of
    this kind.
    """
    if chain is None:
        return OtherReadings()
    found: dict[str, Correction] = {}
    held = [record for record in records if record.id in fits]
    for alike in _by_kind(held):
        sure = {r.id: m for r in alike if (m := find_correction(r, chain, fits[r.id]))}
        if 2 * len(sure) > len(alike):
            sure |= {
                r.id: m
                for r in alike
                if r.id not in sure and (m := find_correction(r, chain, fits[r.id], better=1.0))
            }
        found |= sure
    legal = {name for name, misread in found.items() if misread.legal}
    if 2 * len(legal) > len(fits):  # then the bench itself has this sign
        found = {name: misread for name, misread in found.items() if name not in legal}
    agreeing = sum(fit.is_consistent for name, fit in fits.items() if name not in found) + len(
        found
    )
    if agreeing < WITNESSES:
        return OtherReadings()
    mistaken = without_lone_factors(found, held, fits=fits)
    lone = {name: m for name, m in found.items() if name not in mistaken and m.scale}
    return OtherReadings(
        mistaken=mistaken, odd={name: _odd(name, scale=m.scale or 1.0) for name, m in lone.items()}
    )


def without_lone_factors(
    found: Mapping[str, Correction], records: Sequence[Record], *, fits: Mapping[str, RecordFit]
) -> dict[str, Correction]:
    """Return the corrections without unconfirmed factors on the unit or the clock.

    Several records of a kind must share a factor, and none may contradict it. A clock factor may
    instead be confirmed by the sample interval.

    Parameters
    ----------
    fits : how each record follows the chain without correction.
    """
    kept = {name: m for name, m in found.items() if m.scale is None and m.clock is None}
    for alike in _by_kind(records):
        factors = {r.id: found[r.id] for r in alike if r.id in found and r.id not in kept}
        for words in dict.fromkeys(misread.words for misread in factors.values()):
            sharing = [r for r in alike if r.id in factors and factors[r.id].words == words]
            contrary = [
                r for r in alike if r not in sharing and (r.id in found or fits[r.id].is_consistent)
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
    sharing: Sequence[Record], records: Sequence[Record], fits: Mapping[str, RecordFit]
) -> bool:
    """Whether these records may be due to an amplifier at its limit.

    Their inputs must be equally large, because only then does a limit give the same factor. And no
    record with such a large input may follow the chain.
    """
    sizes = [_size(record) for record in sharing]
    follows = [_size(r) for r in records if r not in sharing and fits[r.id].is_consistent]
    several = min(sizes) < (1 - SAME_SIZE) * max(sizes)
    return not several and max(follows, default=0.0) < (1 - SAME_SIZE) * max(sizes)


def _size(record: Record) -> float:
    return 0.0 if record.u is None else float(np.abs(record.u).max())


def _is_sampled_so(record: Record, records: Sequence[Record], *, factor: float) -> bool:
    """Whether a record's sample interval is `factor` times the usual one."""
    others = [other.sample_time for other in records if other is not record]
    usual = factor * float(np.median(others)) if others else 0.0
    return abs(record.sample_time - usual) <= SAME * usual


def _odd(name: str, *, scale: float) -> RecordingFault:
    code = "moves_too_little" if scale < 1 else "moves_too_far"
    return RecordingFault(code=code, run=name, details={"scale": f"{scale:.3g}"}, is_wrong=False)
