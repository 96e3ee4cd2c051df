"""Touches by hand are found in recordings, and effects of the bench are not taken for touches."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.force_balance import (
    WindowMeans,
    between,
    find_interventions,
    record_residual_forces,
)
from pipeline.plant.chain import PRESETS
from pipeline.results import Intervention
from tests.helpers.time_records import COUNT, record_of, step_record
from tests.truth.bench import Hand
from tests.truth.cases import EFFECTS, Case, make_case

TO = 0.08  # s; half a window of 0.1 s plus the time in which a hand lets go


def pulls(case: Case) -> list[tuple[str, Hand]]:
    """Return the touches that pull or push, with their records, but not those that only hold."""
    return [(name, hand) for name, laid in case.hands.items() for hand in laid if hand.end < 1e9]


def unmatched(case: Case) -> tuple[list[tuple[str, Hand]], list[Intervention]]:
    """Return the touches that were not found, and the interventions found without a touch."""
    found = list(find_interventions(case.records))
    missed = []
    for name, hand in pulls(case):
        own = [
            one
            for one in found
            if (one.experiment, one.cart) == (name, hand.cart)
            and one.start < hand.end
            and one.end > hand.start
        ]
        if not own:
            missed.append((name, hand))
        found = [one for one in found if one not in own]
    return missed, found


def test_the_usual_residual_of_a_linear_cart_is_its_rounding():
    """A record without noise leaves twice the acceleration that rounding causes, of step/√12."""
    run = step_record(PRESETS["throne-2dof"], rng=np.random.default_rng(1), noise=0.0)
    means = WindowMeans(run)
    for cart in run.carts:
        _, size = record_residual_forces(cart, [means])
        # A cart at rest has smaller errors, but no size below that of white errors is used.
        assert size == pytest.approx(2 * means.gain * COUNT / np.sqrt(12), rel=0.1)


def test_the_acceleration_of_noise_is_known():
    """White noise of size 1 causes accelerations whose standard deviation is the stated gain."""
    t = np.arange(20_000) / 113.0
    noise = np.random.default_rng(2).standard_normal((1, t.size))
    means = WindowMeans(record_of(t, None, noise, kind="decay", count=0.0))
    # The mean of some thousand independent windows errs by 2 %.
    assert np.std(means.acceleration) == pytest.approx(means.gain, rel=0.06)


@pytest.mark.parametrize(
    ("seed", "n", "rate", "effect"),
    [
        *((61, 1, 113.1, ()), (62, 2, 250.0, ()), (63, 3, 1000.0, ())),
        (62, 2, 250.0, ("coulomb_friction",)),
        *((71, 1, 50.0, ()), (71, 1, 25.0, ())),  # windows are one sample apart
    ],
)
def test_hands_are_found_and_nothing_else(seed, n, rate, effect):
    """Plucks, a nudge and a push are found, even with dry friction, and nothing else is found.

    One short pull may be missed; in a larger sample, 476 of 486 touches were found.
    """
    case = make_case(seed=seed, n=n, rate=rate, effects=effect, handled=True, dirt=rate > 100)
    missed, more = unmatched(case)

    assert len(missed) <= 1
    assert more == []


def test_the_start_and_end_of_a_touch_are_found():
    """The start and end of a touch are found to within the length of a window."""
    case = make_case(seed=71, n=1, rate=250.0, handled=True)
    found = find_interventions(case.records)
    hands = sorted(pulls(case), key=lambda pair: (pair[0], pair[1].start))

    at = sorted((one.experiment, one.start, one.end) for one in found)
    assert [name for name, *_ in at] == [name for name, _ in hands]
    np.testing.assert_allclose([start for _, start, _ in at], [h.start for _, h in hands], atol=TO)
    np.testing.assert_allclose([end for *_, end in at], [h.end for _, h in hands], atol=TO)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(
    "effect",
    [
        *(("backlash",), ("end_stop",), ("slack_spring",), ("saturation",), ("extra_mode",)),
        *(("stiction",), ("load_friction",), ("input_delay",), ()),
    ],
)
def test_no_effect_is_taken_for_a_hand(effect):
    """Stops, play, sticking, resonances and late inputs are not taken for touches."""
    case = make_case(seed=80, n=2, rate=200.0, effects=effect, severity=1.5, dirt=True)

    assert find_interventions(case.records) == ()


def test_a_record_is_cut_at_its_touches():
    """A record is cut at its touches, and no sample outside the touches is lost."""
    record = make_case(seed=71, n=1, rate=113.1).records[0]
    hands = [
        Intervention(experiment=record.id, cart=1, start=1.0, end=1.5),
        Intervention(experiment=record.id, cart=1, start=4.0, end=9.0),
        Intervention(experiment="another", cart=1, start=2.0, end=3.0),
    ]

    pieces = between(record, hands)

    assert [(p.t[0] < 1.0, p.t[-1] < 1.0) for p in pieces] == [(True, True), (False, False)]
    away = ((record.t >= 1.0) & (record.t <= 1.5)) | (record.t >= 4.0)
    np.testing.assert_array_equal(np.concatenate([p.t for p in pieces]), record.t[~away])
    np.testing.assert_array_equal(np.concatenate([p.y for p in pieces], axis=1), record.y[:, ~away])
    assert between(record, hands[2:]) == [record]


def test_closed_loops_and_unmeasured_carts_have_no_touches():
    """No touch is reported for closed-loop runs, or if a neighbouring cart was not measured."""
    case = make_case(seed=62, n=2, rate=250.0, handled=True)
    assert find_interventions(case.records) != ()

    under_feedback = [replace(record, kind="closed_loop") for record in case.records]
    alone = [
        replace(record, carts=(1,), y=record.y[:1], resolution=record.resolution[:1])
        for record in case.records
        if record.free == (1, 2)
    ]

    assert find_interventions(under_feedback) == ()
    assert find_interventions(alone) == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(38))
def test_no_effect_of_any_size_is_taken_for_a_hand(seed):
    """Neither single effects nor pairs of them, small or large, are taken for touches."""
    effects = [EFFECTS[seed % len(EFFECTS)], *EFFECTS[(5 * seed) % 17 : (5 * seed) % 17 + seed % 2]]
    case = make_case(seed=300 + seed, n=2 + seed % 2, effects=effects, dirt=True, wide=True)

    assert find_interventions(case.records) == ()
