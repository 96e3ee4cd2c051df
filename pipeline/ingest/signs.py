"""The sign of the input, record by record: stated, found from the data, or as in the others."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.ingest.drive import find_signs
from pipeline.names import listed
from pipeline.results import Record
from pipeline.submission import Submission

FEW_NAMES = 6  # more are not listed one by one


@dataclass(frozen=True, kw_only=True)
class Signs:
    """By record, the sign that is stated, and the one that its data tell: 0 where they do not."""

    stated: Mapping[str, int]
    found: Mapping[str, int]


def with_signs(
    records: list[Record], submission: Submission
) -> tuple[list[Record], list[str], Signs]:
    """Return the records with signed inputs, what is to be said of signs found, and those stated.

    Where a record does not tell, it takes the sign of most others of its sort (under feedback or
    not: a controller's log may count the other way), else of most others. A record whose own sign
    is another than that of the system has the one that its data tell, else its own.
    """
    stated: dict[str, int] = {}
    disputed: set[str] = set()
    for experiment in submission.experiments:
        own = experiment.input.sign if experiment.input is not None else None
        if (sign := own or submission.system.input.sign) is not None:
            stated[experiment.id] = sign
        if own and submission.system.input.sign == -own and experiment.kind != "closed_loop":
            disputed.add(experiment.id)
    driven = [r for r in records if r.u is not None and np.ptp(r.u) > 0]
    found = find_signs(driven, stated=stated)

    def usual(record: Record) -> int:
        alike = [r for r in driven if (r.kind == "closed_loop") == (record.kind == "closed_loop")]
        votes = [
            sum(stated.get(r.id) or found.get(r.id, 0) for r in group) for group in (alike, driven)
        ]
        return next((1 if vote > 0 else -1 for vote in votes if vote), 1)

    told = {**found, **{n: s for n, s in stated.items() if n not in disputed or not found.get(n)}}
    signs = {r.id: told.get(r.id) or usual(r) for r in records}
    others = [r.id for r in driven if r.kind != "closed_loop"] or [r.id for r in driven]
    bench = 1 if sum(signs[name] for name in others) >= 0 else -1
    signed = [
        replace(
            record,
            u=record.u if signs[record.id] == 1 else 0.0 - record.u,
            input_scale=signs[record.id] * record.input_scale,
            turned=record.id not in stated and found.get(record.id) == -bench,
        )
        if record.u is not None
        else record
        for record in records
    ]
    says = _say_signs([r.id for r in driven], stated=stated, found=found, signs=signs)
    return signed, says, Signs(stated=stated, found=found)


def _say_signs(
    driven: list[str], *, stated: dict[str, int], found: dict[str, int], signs: dict[str, int]
) -> list[str]:
    """Return what was found, and what was only taken."""
    searched = [name for name in driven if name not in stated]
    if not searched:
        return []
    if not any(found.get(name) for name in searched):
        return [
            "the data do not tell the sign of the input: it is taken as "
            f"{signs[searched[0]]:+d}; state it if it is not"
        ]
    usual = 1 if sum(signs[name] for name in searched) >= 0 else -1
    text = f"sign of the input found from the data: {usual:+d}"
    if others := [name for name in searched if signs[name] != usual]:
        text += f", but {-usual:+d} in {listed(others, most=FEW_NAMES)}"
    if unsure := [name for name in searched if not found.get(name)]:
        text += (
            f"; taken from the others where the data do not tell: {listed(unsure, most=FEW_NAMES)}"
        )
    return [text]
