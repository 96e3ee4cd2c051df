"""A search from its first step to its last, on one cart."""

from dataclasses import replace

import pytest

from pipeline.gap.judge import judge
from pipeline.gap.search import Deadline, Search, find_hypotheses
from pipeline.gap.summary import find_windows
from tests.gap.begun import COULOMB, DELAY, begun
from tests.truth.bench import Hidden

FRICTION = Hidden(effect="coulomb_friction", place=1, parameters={"force": 0.0006})
LATE = Hidden(effect="input_delay", parameters={"delay": 0.015})


def searched(*hidden: Hidden, seconds: float | None = None) -> Search:
    """Return a search after all its steps."""
    fit, study = begun(*hidden)
    search = Search(study, fit, Deadline(map, seconds=seconds))
    search.find_effects()
    search.remeasure_noise()
    search.change_sides()
    search.add_constant_force()
    search.reach_verdict()
    return search


@pytest.mark.parametrize(
    ("hidden", "verdict", "found"),
    [
        ((), "none", set()),
        ((FRICTION,), "named", {COULOMB}),
        pytest.param(
            (LATE, FRICTION),
            "named",
            {COULOMB, DELAY},
            marks=[pytest.mark.slow, pytest.mark.sample],
        ),
    ],
)
def test_hidden_effects_are_named(hidden, verdict, found):
    """The search names the hidden effects, if there are any, one at each step."""
    search = searched(*hidden)

    assert search.verdict == verdict
    assert search.chosen.key == found
    assert [len(step.key) for step in search.path] == list(range(len(found) + 1))
    errors = [step.error for step in search.path]
    assert errors == sorted(errors, reverse=True)
    assert search.final.covariance is not None
    assert {run.id for run, _ in search.judged} == {
        run.id for run in (*search.study.training, *search.study.held_out)
    }


@pytest.mark.slow
@pytest.mark.sample
def test_overestimated_noise_is_measured_again():
    """If the assumed noise is three times too large, friction is still found."""
    fit, study = begun(FRICTION)
    loud = study.with_noise([replace(run, sigma=3.0 * run.sigma) for run in study.training])
    search = Search(loud, fit, Deadline(map, seconds=None))

    search.find_effects()
    search.remeasure_noise()

    assert search.study.floor == pytest.approx(study.floor, rel=0.1)
    assert search.chosen.fit.chi > 0.7


@pytest.mark.slow
@pytest.mark.sample
def test_friction_below_the_noise_floor_is_not_named():
    """Friction that changes no error is no effect, if a delay alone leaves only noise."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 2.4e-6}),
        Hidden(effect="input_delay", parameters={"delay": 0.014}),
        rate=884.7,
    )
    chosen, _ = find_hypotheses(judge(fit, study), study)
    assert chosen.key == {DELAY}
    assert chosen.at_floor


def test_the_gap_is_located_on_its_cart_and_in_its_recording():
    """The windows of the only cart of a bench are its own, and lie within their recordings."""
    fit, study = begun(FRICTION)
    windows = find_windows(fit, study.training)
    spans = {run.id: (run.t[0], run.t[-1]) for run in study.training}
    assert {window.cart for window in windows} == {1}
    for window in windows:
        first, last = spans[window.experiment]
        assert first <= window.start < window.end <= last
        assert 0.15 < window.share <= 1.0
