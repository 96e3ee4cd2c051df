"""Records with a known mistake are left out, each with the reason that says most."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.record_fit import Correction, RecordFit, record_fits
from pipeline.identify.corrections import (
    find_faults,
    find_impossible_gains,
    without_lone_factors,
)
from pipeline.identify.identify import identify_with_rejection
from pipeline.ingest.read import Ingested
from pipeline.ingest.sign import Signs
from pipeline.plant.chain import PRESETS
from pipeline.results import Record
from pipeline.setup import Setup
from pipeline.words.progress import silent
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.time_records import decay_record, record_of, step_record

CHAIN = PRESETS["throne-2dof"]
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
    return set(without_lone_factors(found, records, fits=fits_of(records, found)))


def fits_of(records: Sequence[Record], found: Mapping[str, Correction]) -> dict[str, RecordFit]:
    """Return fits that nothing explains for the records in `found`, and exact ones for others."""
    return {
        record.id: RecordFit(
            unexplained_share={1: float(record.id in found)},
            residual={},
            chi_square=1.0,
            amplitude_ratio={1: 1.0},
            friction={},
        )
        for record in records
    }


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
    records = [replace(record("sine-1"), t=np.linspace(0.0, 1.98, 100)), *others]
    found = {"sine-1": SLOW}
    assert without_lone_factors(found, records, fits=fits_of(records, found)) == found


def test_an_inverted_channel_counts_even_in_one_record():
    """An inverted channel counts even in one record, as no limit or friction inverts a channel."""
    assert kept({"step-1": TURNED}, record("step-2"), sizes={"step-1": 1.0}) == {"step-1"}


def steps(*durations: float) -> list[Record]:
    """Return honest steps of two carts, "step-1" and so on, that last so many seconds."""
    rng = np.random.default_rng(0)
    return [
        step_record(CHAIN, rng=rng, id=f"step-{i}", duration=duration)
        for i, duration in enumerate(durations, start=1)
    ]


def turned(record: Record) -> Record:
    """Return a record whose cart 2 has the opposite sign."""
    return replace(record, y=record.y * [[1], [-1]])


def test_an_input_may_have_the_opposite_sign_but_a_channel_may_not():
    """A reversed input is only odd, because it may be logged so; a reversed channel is wrong."""
    first, second, third, fourth = steps(*[6.0] * 4)
    assert second.u is not None
    records = [first, replace(second, u=-second.u), turned(third), fourth]
    found = find_faults(records, chain=CHAIN, fits=record_fits(records, CHAIN))
    assert {run: (one.code, one.excludes) for run, one in found.items()} == {
        "step-2": ("misread", "odd"),
        "step-3": ("misread", "wrong"),
    }


def left_out(*records: Record) -> list[tuple[str, str, str]]:
    """Return which records are left out, with the code of the finding and what it excludes."""
    data = Ingested(
        records=records,
        tables=(),
        files={},
        unreadable={},
        signs=Signs(stated={}, found={}),
        warnings=(),
    )
    bench = Setup(springs=tuple(bool(k) for k in CHAIN.k))
    _, found = identify_with_rejection(data, interventions=(), bench=bench, progress=silent)
    return [(one.run, one.code, one.excludes) for one in found]


def test_a_record_in_another_unit_is_wrong_and_not_only_odd():
    """An encoder step in mm says why a step moves ten times too far, so this reason is given."""
    first, second, third, fourth = steps(*[6.0] * 4)
    in_mm = replace(second, y=10 * second.y, resolution=10 * second.resolution)
    decay = decay_record(CHAIN, free=(1, 2), rng=np.random.default_rng(1))
    found = left_out(first, in_mm, third, fourth, decay)
    assert found == [("step-2", "other_unit", "wrong")]


@pytest.mark.slow
@pytest.mark.sample
def test_a_reversed_channel_is_wrong_and_its_gain_not_only_odd():
    """A reversed channel says why one static gain is odd, so this reason is given."""
    first, second, third, fourth = steps(3.0, 4.0, 5.2, 6.8)  # too different to be repeats
    found = left_out(first, second, turned(third), fourth)
    assert found == [("step-3", "misread", "wrong")]


@pytest.mark.parametrize(("factor", "wrong"), [(1e3, True), (60.0, False), (2.0, False)])
def test_a_clock_in_another_unit_is_found_without_carts(factor, wrong):
    """Samples 1000 times as far apart show milliseconds; other settings of a clock are possible."""
    first, second, third = steps(*[6.0] * 3)
    records = [first, replace(second, t=factor * second.t), third]
    found = find_faults(records, chain=None, fits={})
    expected = [("step-2", "other_clock", "wrong")] if wrong else []
    assert [(one.run, one.code, one.excludes) for one in found.values()] == expected


@pytest.mark.parametrize(("gain", "wrong"), [(0.5, False), (1.25, False), (1.45, True)])
def test_no_cart_moves_much_further_than_the_cart_that_pulls_it(gain, wrong):
    """A static gain of cart 2 above 1.3 times that of cart 1 is impossible, friction included."""
    one = make_analysis(2).step_gains[0]
    gains = [
        replace(one, experiment="step-1", cart=cart, gain=K, gain_std=0.01, interval=None)
        for cart, K in ((1, 1.0), (2, gain))
    ]
    found = find_impossible_gains(gains)
    expected = [("step-1", 2, "too_far", "wrong")] if wrong else []
    assert [(one.run, one.cart, one.code, one.excludes) for one in found.values()] == expected


@pytest.mark.parametrize(("cycles", "short"), [(0.5, True), (1.45, True), (1.6, False)])
def test_a_dwell_needs_more_than_a_cycle(cycles, short):
    """A dwell of less than 1.5 cycles has no steady state, whatever its length in seconds."""
    t, omega = np.arange(0.0, 6.0, 0.01), 2 * np.pi * cycles / 6.0
    wave = np.sin(omega * t)
    run = record_of(t, wave, wave[None], kind="sine", id="dwell", omega=omega)
    found = find_faults([run], chain=None, fits={})
    assert [one.code for one in found.values()] == ["short_dwell"] * short
