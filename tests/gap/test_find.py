"""The search tries the right laws and hypotheses."""

import pytest

from pipeline.gap.judge import judge
from pipeline.gap.search import find_hypotheses
from pipeline.gap.summary import find_windows
from tests.gap.begun import DELAY, begun
from tests.truth.bench import Hidden


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
    friction = Hidden(effect="coulomb_friction", place=1, parameters={"force": 2.4e-3})
    fit, study = begun(friction)
    windows = find_windows(fit, study.training)
    spans = {run.id: (run.t[0], run.t[-1]) for run in study.training}
    assert {window.cart for window in windows} == {1}
    for window in windows:
        first, last = spans[window.experiment]
        assert first <= window.start < window.end <= last
        assert 0.15 < window.share <= 1.0
