"""What the search tries, and where: places that show, sides, an effect put in and taken out."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.data.runs import make_run
from pipeline.gap.fit.structure import Structure
from pipeline.gap.search.screen import candidates_at, shown_places
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.nonlinear.effects import CATALOGUE, find_effect
from tests.truth.cases import make_case


def runs_of(*free: tuple[bool, ...]) -> list[Any]:
    """Return what is looked at of runs: which carts move."""
    return [SimpleNamespace(free=one) for one in free]


@pytest.mark.parametrize(
    ("key", "free", "places"),
    [
        ("coulomb_friction", [(True, True)], [1, 2]),
        ("coulomb_friction", [(False, True), (False, True)], [2]),  # cart 1 is always held
        ("cubic_spring", [(True, True)], [1, 2, 3]),
        ("cubic_spring", [(True, False)], [1]),  # springs 1 and 2 stretch alike, 3 never
        ("dead_zone", [(False, True)], [0]),
    ],
)
def test_an_effect_is_looked_for_where_it_would_show(key, free, places):
    """Held carts show nothing; of springs that always stretch alike the first stands for all."""
    assert shown_places(find_effect(key), (True, True, True), runs_of(*free)) == places


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_an_effect_put_into_a_model_and_taken_out_leaves_it(effect):
    """Its trial values come back from the vector, each side on its own; the rest is untouched."""
    chain = PRESETS["throne-2dof"]
    case = make_case(seed=44, n=2, rate=113.1)
    runs = [make_run(record, n=2) for record in case.records[:2]]
    plain = Structure(springs=tuple(bool(k) for k in chain.k)).start(chain)
    place = {"cart": 1, "spring": 2, "input": 0}[effect.place]
    trials = candidates_at(effect, place, runs=runs, chain=chain)
    assert len(trials) == len(effect.trial_points) * 2 ** sum(p.side for p in effect.parameters)
    for candidate, values in trials:
        assert candidate.has_signs_of(values)

        grown = plain.with_effect(candidate, values)

        np.testing.assert_allclose(grown.terms[-1].values, values, rtol=1e-12)
        assert np.array_equal(grown.without(0).theta, plain.theta)
