"""The search tries the right laws and hypotheses."""

from pipeline.gap.judge import judge
from pipeline.gap.limits import BIC_DROP
from pipeline.gap.search import find_hypotheses
from tests.gap.begun import COULOMB, DELAY, begun
from tests.truth.bench import Hidden


def test_friction_below_the_noise_floor_is_tried():
    """Small friction is tried even if a delay alone already reduces the error to the noise."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 2.4e-6}),
        Hidden(effect="input_delay", parameters={"delay": 0.014}),
        rate=884.7,
    )
    _, judged = find_hypotheses(judge(fit, study), study)
    found = {h.key: h for h in judged}
    alone, both = found[frozenset({DELAY})], found[frozenset({DELAY, COULOMB})]
    assert alone.at_floor
    assert both.bic < alone.bic - BIC_DROP
