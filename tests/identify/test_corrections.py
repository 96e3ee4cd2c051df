"""A wrong factor is reported as a wrong unit only if all records of a kind share it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.record_fit import Correction, RecordFit
from pipeline.identify.corrections import without_lone_factors
from pipeline.results import Record

TENTH = Correction(words="a tenth as far", scale=0.1)
TENFOLD = Correction(words="ten times as far", scale=10.0)
SLOW = Correction(words="half its speed", clock=2.0)
TURNED = Correction(words="x1 turned")


def record(name: str, *, size: float = 1.0, step: float = 0.01) -> Record:
    t = np.linspace(0.0, 99 * step, 100)
    return Record(
        id=name,
        kind="step" if name.startswith("step") else "sine",
        t=t,
        u=size * np.sin(t),
        y=np.sin(t)[None],
        carts=(1,),
        free=(1,),
        resolution=np.array([0.001]),
    )


def kept(found: Mapping[str, Correction], *others: Record, sizes: Mapping[str, float]) -> set[str]:
    """Return the suspected mistakes that remain if all other records fit as they are."""
    records = [*(record(name, size=size) for name, size in sizes.items()), *others]
    follows = {r.id: 1.0 if r.id in found else 0.0 for r in records}
    fits = {
        name: RecordFit(
            unexplained_share={1: lost},
            residual={},
            chi_square=1.0,
            amplitude_ratio={1: 1.0},
            friction={},
        )
        for name, lost in follows.items()
    }
    return set(without_lone_factors(found, records, fits=fits))


@pytest.mark.parametrize(
    ("misread", "sizes", "others", "unit"),
    [
        (TENTH, {"step-1": 1.0, "step-2": 2.0}, (), True),
        (TENTH, {"step-1": 1.0, "step-2": 1.0}, (), False),  # an input limit has the same effect
        (TENTH, {"step-1": 1.0, "step-2": 1.0}, (record("sine-1", size=1.0),), True),
        (TENTH, {"step-1": 1.0, "step-2": 1.0}, (record("sine-1", size=0.1),), False),
        (TENFOLD, {"step-1": 1.0, "step-2": 1.0}, (), True),  # a limit never adds motion
        (TENFOLD, {"step-1": 1.0}, (record("sine-1"),), False),
        (TENTH, {"step-1": 1.0, "step-2": 2.0}, (record("step-3"),), False),
        (TENFOLD, {"step-1": 1.0, "step-2": 1.0}, (record("step-3"),), False),
    ],
)
def test_a_unit_must_be_wrong_in_all_records_of_a_kind(misread, sizes, others, unit):
    """A factor is called a wrong unit if all records of a kind share it and no limit causes it."""
    found = {name: misread for name in sizes}
    assert kept(found, *others, sizes=sizes) == (set(sizes) if unit else set())


def test_another_clock_needs_another_sampling_rate():
    """The clock of a single dwell is called wrong only if the dwell's sampling rate differs too."""
    others = [record("sine-2"), record("sine-3")]
    assert kept({"sine-1": SLOW}, *others, sizes={"sine-1": 1.0}) == set()
    slow = replace(record("sine-1"), t=np.linspace(0.0, 1.98, 100))
    fits = {
        name: RecordFit(
            unexplained_share={1: lost},
            residual={},
            chi_square=1.0,
            amplitude_ratio={1: 1.0},
            friction={},
        )
        for name, lost in (("sine-1", 1.0), ("sine-2", 0.0), ("sine-3", 0.0))
    }
    assert without_lone_factors({"sine-1": SLOW}, [slow, *others], fits=fits) == {"sine-1": SLOW}


def test_an_inverted_channel_counts_even_in_one_record():
    """An inverted channel counts even in one record, as no limit or friction inverts a channel."""
    assert kept({"step-1": TURNED}, record("step-2"), sizes={"step-1": 1.0}) == {"step-1"}
