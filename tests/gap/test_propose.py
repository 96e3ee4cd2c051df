"""What a model that follows proposes, and when there is nothing left to search for."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.gap.explain import explain_gap
from pipeline.gap.limits import BIC_DROP
from pipeline.gap.search.hypothesis import judge
from pipeline.gap.search.propose import is_nothing, propose
from pipeline.gap.search.translate import make_candidate
from pipeline.plant.nonlinear.effects import CATALOGUE, find_effect
from tests.gap.test_beam import COULOMB, CUBIC, DELAY, begun
from tests.truth.bench import Hidden
from tests.truth.cases import make_case


def test_what_is_explained_by_following_is_not_searched_for():
    """A spring that bends is found at once, with rivals to hold against it."""
    fit, study = begun(Hidden(effect="cubic_spring", place=1, parameters={"coefficient": 0.003}))
    settled, proposed = propose(judge(fit, study), study)
    assert settled is not None
    assert settled.key == {CUBIC}
    assert study.is_noise(settled)
    rivals = [h for h in proposed if len(h.key) == 1 and h.key != settled.key]
    assert rivals
    assert all(h.bic > settled.bic for h in rivals)
    assert len({h.key for h in proposed}) == len(proposed)


@pytest.mark.parametrize(
    ("missing", "searched"), [((), False), (("cubic_spring", "slack_spring"), True)]
)
def test_a_search_begins_where_something_is_left(missing, searched):
    """What the catalogue has is followed and named; what it lacks is searched for."""
    case = make_case(seed=10700, n=1, effects=["cubic_spring"], rate=113.1)
    known = [effect for effect in CATALOGUE if effect.key not in missing]
    told: list[str] = []

    gap = explain_gap(case.records, springs=case.springs, catalogue=known, tell=told.append)

    assert any("searching" in line for line in told) == searched
    assert (gap.verdict == "named") != searched


def test_what_hides_below_the_floor_is_followed():
    """Hardly any friction, beside a delay that alone leaves what may be noise."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 2.4e-6}),
        Hidden(effect="input_delay", parameters={"delay": 0.014}),
        rate=884.7,
    )
    _, proposed = propose(judge(fit, study), study)
    found = {h.key: h for h in proposed}
    both = found[frozenset({DELAY, COULOMB})]
    assert all(both.bic < h.bic - BIC_DROP for key, h in found.items() if key < both.key)


@pytest.mark.parametrize(("value", "nothing"), [(0.015, False), (1e-4, True)])
def test_what_is_nothing_within_its_error_is_told(value, nothing):
    """A delay ends a search where it is three standard errors from none, and its error known."""
    fit, study = begun(Hidden(effect="input_delay", parameters={"delay": 0.015}))
    chain = fit.structure.chain(fit.theta)
    effect = find_effect("input_delay")
    delay = make_candidate(effect, 0, (value,), runs=study.training, chain=chain)
    model = fit.with_effect(delay, (value,))
    known = replace(fit, structure=model.structure, theta=model.theta)
    sure = np.diag(np.full(model.theta.size, (1e-3 / delay.scales[0]) ** 2))

    assert is_nothing(replace(known, covariance=sure)) == [nothing]
    assert is_nothing(known) == [True]
