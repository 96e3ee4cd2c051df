"""A repeat that differs from the others is named, and no other repeat is named."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.identify.repeats import find_outlier_repeats
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS, Chain
from pipeline.submission import load_submission
from tests.helpers.time_records import decay_record, step_record
from tests.helpers.ucsd import write_two_cart_submission

CHAIN = PRESETS["throne-2dof"]


def repeats(count, *, rng, swing=1.0):
    """Return honest repeats that were stopped by hand a little earlier or later."""
    whole = [step_record(CHAIN, rng=rng, swing=swing, id=f"{swing}-{i}") for i in range(count)]
    return [cut(record, int(rng.integers(0, 60))) for record in whole]


def cut(record, samples):
    kept = slice(0, record.t.size - samples)
    return replace(record, t=record.t[kept], u=record.u[kept], y=record.y[:, kept])


def strange(record, rng):
    """Return the same experiment on a cart with an additional weight."""
    heavier = Chain(m=CHAIN.m * [1.4, 1.0], c=CHAIN.c, k=CHAIN.k)
    return step_record(heavier, rng=rng, id=record.id)


@pytest.mark.parametrize("count", [3, 4, 5, 8])
def test_a_repeat_with_another_mass_is_named(count):
    """If a weight was left on cart 1 in one of several repeats, this repeat is named."""
    rng = np.random.default_rng(count)
    records = repeats(count, rng=rng)
    records[1] = strange(records[1], rng)
    (outlier,) = find_outlier_repeats(records, unit="cm").values()
    assert outlier.run == records[1].id
    assert outlier.excludes == "odd"  # a cart with a weight still moves like a real cart
    others = ", ".join(r.id for r in records if r is not records[1])
    assert (outlier.code, outlier.details["others"]) == ("odd_repeat", others)


def test_neither_of_two_repeats_is_named():
    """If two repeats differ, neither is named, as nobody can know which one is wrong."""
    rng = np.random.default_rng(0)
    records = repeats(2, rng=rng)
    assert find_outlier_repeats([records[0], strange(records[1], rng)], unit="cm") == {}


def test_repeats_that_differ_only_by_noise_are_accepted():
    """In 200 sets of 3 to 6 honest repeats, no repeat is named."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        assert (
            find_outlier_repeats(repeats(int(rng.integers(3, 7)), rng=rng, swing=0.05), unit="cm")
            == {}
        )


def test_other_experiments_are_not_repeats():
    """A run with another step size, free cart or kind is not counted as a repeat."""
    rng = np.random.default_rng(2)
    others = [
        *repeats(2, rng=rng, swing=2.0),
        step_record(CHAIN, rng=rng, free=(1,), id="alone"),
        replace(step_record(CHAIN, rng=rng, id="sweep"), kind="sweep"),
        *(decay_record(CHAIN, free=(1, 2), rng=rng, id=f"decay-{i}") for i in range(4)),
    ]
    assert find_outlier_repeats([*repeats(4, rng=rng), *others], unit="cm") == {}


def test_a_run_with_another_input_is_not_odd():
    """A run is not odd if it differs only because its input differs."""
    rng = np.random.default_rng(4)
    records = [step_record(CHAIN, rng=rng, id=f"{i}") for i in range(4)]
    # The input ends at half time, but in the last run 0.1 s later.
    records.append(step_record(CHAIN, rng=rng, duration=6.2, id="longer"))
    assert find_outlier_repeats(records, unit="cm") == {}


def test_an_encoder_that_was_not_zeroed_is_not_odd():
    """Positions are compared from the start of each record, so encoders need not start at zero."""
    rng = np.random.default_rng(3)
    records = repeats(5, rng=rng)
    records[2] = replace(records[2], y=records[2].y + 3.0)
    assert find_outlier_repeats(records, unit="cm") == {}


def test_only_the_first_real_repeat_is_named(real_data, tmp_path):
    """Of five real repeats with two carts the first is odd; repeats with one cart all agree."""
    folder = write_two_cart_submission(tmp_path / "two", real_data, steps=(1, 2, 3, 4, 5))
    records = read_data(load_submission(folder)).records
    (outlier,) = find_outlier_repeats(records, unit="cm").values()
    assert outlier.run == "both-1"
    assert outlier.details["others"] == ", ".join(f"both-{i}" for i in range(2, 6))
    assert find_outlier_repeats([r for r in records if r.id != "both-1"], unit="cm") == {}
