"""The search tries the right laws and hypotheses."""

import pytest

from pipeline.gap.judge import judge
from pipeline.gap.search import find_hypotheses
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
