"""Sample times: true ones are kept, rounded ones replaced by an even clock, broken ones found."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.ingest.clock import decimal_step, read_clock, time_stamps
from pipeline.ingest.files import parse_table

RNG = np.random.default_rng(3)


@settings(deadline=None)
@given(
    interval=st.floats(1e-3, 0.03),
    start=st.floats(0.0, 5.0),
    n=st.integers(200, 3000),
    rounded_down=st.booleans(),
)
def test_a_rounded_even_clock_is_straightened(interval, start, n, rounded_down):
    """From stamps rounded to whole ms, the even clock is recovered."""
    true = start + interval * np.arange(n, dtype=np.float64)
    stamps = np.floor(true * 1e3 + 1e-6) / 1e3 if rounded_down else np.round(true, 3)

    clock = read_clock(stamps)

    assert clock.stopped is None
    # Rounding errs most if it jumps once, by 1 ms in the middle of a record. The least-squares
    # slope then changes by 1.5 ms/n.
    assert_allclose(clock.mean_interval, interval, atol=1.6e-3 / n)
    offset = np.median(clock.t - true)  # rounding down may shift all by a whole step
    assert abs(offset) <= 1e-3
    assert_allclose(clock.t - true, offset, atol=0.5e-3)


def test_the_ecp_clock_is_found():
    """The ECP's interval of 8.854 ms is found to nanoseconds from stamps in whole ms."""
    true = 0.0088542 * np.arange(677, dtype=np.float64)
    clock = read_clock(np.round(true, 3))
    assert (clock.rounding, clock.pieces) == (1e-3, 1)
    assert_allclose(clock.mean_interval, 0.0088542, atol=5 * 12**0.5 * 0.29e-3 / 677**1.5)


def test_a_clock_that_missed_beats_is_straightened_in_pieces():
    """If a bench skipped samples, each part between gaps gets its own even clock."""
    steps = np.full(8000, 0.0011279)
    steps[[1500, 4200, 6100]] += 0.004
    true = np.cumsum(steps)

    clock = read_clock(true.round(3))

    assert clock.pieces > 1
    assert np.abs(clock.t - true).max() < 1e-3  # never farther off than the rounding of the stamps
    assert np.sqrt(np.mean((clock.t - true) ** 2)) < 1e-4  # the stamps alone differ by 0.29 ms


DRIFT = 1 + 0.05 * RNG.standard_normal(2000) + np.linspace(0, 0.1, 2000)
KEPT = {
    # name: stamps, their jitter in intervals
    **{f"{d} digits": (np.round(np.cumsum(0.005 * DRIFT), d), 0.06) for d in (9, 6, 5)},
    "whole ms": (np.round(np.cumsum(0.005 + 0.001 * RNG.standard_normal(2000)), 3), 0.2),
    "even": (0.001 * np.arange(500, dtype=np.float64), 0.0),
}


@pytest.mark.parametrize("name", KEPT)
def test_true_times_are_kept_as_they_are(name):
    """Even stamps, and those that jitter or drift by more than their rounding, are kept."""
    stamps, jitter = KEPT[name]
    clock = read_clock(stamps)
    assert clock.pieces == 0
    assert_array_equal(clock.t, stamps)
    assert clock.jitter / clock.mean_interval == pytest.approx(jitter, abs=1e-9, rel=0.3)


def test_samples_with_equal_stamps_get_an_even_clock():
    """From a log at 2.3 kHz, whose stamps in whole ms repeat, the even clock is recovered."""
    true = np.arange(2000, dtype=np.float64) / 2300
    clock = read_clock(np.floor(true * 1e3) / 1e3)
    assert clock.stopped is None
    assert (np.diff(clock.t) > 0).all()
    assert_allclose(clock.mean_interval, 1 / 2300, rtol=1e-3)  # 1 ms in a record of 870 ms


@pytest.mark.parametrize("at", [1, 37, 99])
def test_the_first_sample_that_does_not_advance_is_found(at):
    """The first sample whose time does not advance is found."""
    stamps = 0.01234567 * np.arange(100, dtype=np.float64)
    still, back = stamps.copy(), stamps.copy()
    still[at] = still[at - 1]
    back[at:] -= 0.5
    assert read_clock(still).stopped == at
    assert read_clock(back).stopped == at


def test_gaps_are_found():
    """An interval several times as long as usual is a gap, in even and in rounded stamps."""
    for stamps in (
        0.01 * np.arange(500, dtype=np.float64),
        np.round(0.0088542 * np.arange(500, dtype=np.float64), 3),
    ):
        late = stamps.copy()
        late[200:] += 0.5
        assert read_clock(stamps).gaps == ()
        assert read_clock(late).gaps == (200,)


@pytest.mark.parametrize(
    ("values", "step"),
    [([0.0, 0.009, 0.018], 1e-3), ([1.5, 2.0], 0.1), ([3.0, 4.0], 1.0), ([0.1 / 3, 1.0], 0.0)],
)
def test_the_decimal_step_of_stamps_is_found(values, step):
    """`decimal_step` is the last decimal place in use, and zero for full precision."""
    assert decimal_step(np.array(values)) == step


def test_a_stated_rate_gives_even_stamps():
    """Without a time column, `time_stamps` are those of the stated rate in Hz."""
    table = parse_table(b"x1\n" + b"1\n2\n" * 10, source="a.csv")
    assert_allclose(time_stamps(table, None, sample_rate=200.0), 0.005 * np.arange(20))
