"""The laws that are searched for, and the hypotheses that are judged."""

from pipeline.gap.limits import BIC_DROP
from pipeline.gap.search.find import find_hypotheses
from pipeline.gap.search.hypothesis import judge
from tests.gap.search.begun import COULOMB, DELAY, begun
from tests.truth.bench import Hidden


def test_what_hides_below_the_floor_is_looked_for():
    """Small friction is looked for even if, with a delay, only noise seems to be left."""
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
