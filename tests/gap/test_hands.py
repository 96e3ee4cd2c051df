"""Only the samples in which a hand moves a cart are left out of fits and errors."""

import numpy as np
import pytest

from pipeline.gap.explain import explain_gap
from pipeline.gap.types import Gap
from pipeline.json_files import plain
from pipeline.setup import Setup
from tests.truth.cases import Case, make_case


@pytest.fixture(scope="module", params=[1, 2])
def explained(request) -> tuple[Case, Gap]:
    """Return the gap of a linear bench on which hands pluck, nudge and loosely hold the carts."""
    n = request.param
    case = make_case(seed=8999 + n, n=n, rate=200.0, handled=True)
    return case, explain_gap(case.records, Setup(springs=case.springs))


def test_a_hand_on_a_linear_bench_is_not_an_effect(explained):
    """On a linear bench, neither a pluck nor a loose hold is taken for an effect."""
    _, gap = explained

    assert gap.verdict == "none"
    assert gap.final == pytest.approx(gap.noise_floor, rel=0.1)


def test_interventions_by_hand_are_reported(explained):
    """`gap.json` lists each touch by hand with its record, cart and times."""
    case, gap = explained
    hands = [(name, h) for name, laid in case.hands.items() for h in laid if h.end < 1e9]
    told = plain(gap)["interventions"]

    assert len(told) == len(hands)
    for name, hand in hands:
        own = [one for one in told if one["from"] < hand.end and one["to"] > hand.start]
        assert (name, hand.cart) in {(one["experiment"], one["cart"]) for one in own}


def test_data_after_an_intervention_by_hand_are_used(explained):
    """Every plucked record is used in the gap, except for the samples in which a hand acts."""
    case, gap = explained

    assert {*gap.training, *gap.held_out} == {record.id for record in case.records}
    for trace in gap.traces:
        for hand in case.hands.get(trace.experiment, ()):
            if hand.end < 1e9:
                middle = slice(*np.searchsorted(trace.t, [hand.start + 0.06, hand.end - 0.06]))
                assert trace.t[middle].size == 0
    rows = [(row.experiment, row.cart, row.held_out) for row in gap.by_record]
    assert len(rows) == len(set(rows))
