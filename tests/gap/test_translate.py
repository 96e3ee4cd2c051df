"""Effects are translated to laws of the fit and back."""

import numpy as np
import pytest

from pipeline.gap.judge import filled, make_candidate
from pipeline.gap.parameters import Structure
from pipeline.gap.pem.model import PemSetup, smooth_laws
from pipeline.gap.runs import make_run
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulator.terms import EffectKind
from tests.truth.cases import make_case

ALL = frozenset().union(*(filled(effect) for effect in CATALOGUE))


@pytest.mark.parametrize(
    ("kind", "free", "places"),
    [
        (EffectKind.COULOMB_FRICTION, [(True, True)], [0, 1]),
        (EffectKind.COULOMB_FRICTION, [(False, True), (False, True)], [1]),  # cart 1 is always held
        (EffectKind.CUBIC_SPRING, [(True, True)], [0, 1, 2]),
        (EffectKind.CUBIC_SPRING, [(True, False)], [0]),  # springs 1, 2 stretch equally
    ],
)
def test_an_effect_is_tried_only_where_it_would_show(kind, free, places):
    """An effect is tried only where it would show, and on one of springs that stretch equally."""
    bench = PemSetup(
        chain=PRESETS["throne-2dof"], springs=(True,) * 3, largest=1.0, free=tuple(free)
    )
    laws = smooth_laws(bench, columns=ALL)
    assert [place for one, place in laws.keys if one == kind] == places


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_adding_and_removing_an_effect_changes_nothing(effect):
    """An effect added to a model and removed again leaves the model unchanged."""
    chain = PRESETS["throne-2dof"]
    case = make_case(seed=44, n=2, rate=113.1)
    runs = [make_run(record, n=2) for record in case.records[:2]]
    plain = Structure(springs=tuple(bool(k) for k in chain.k)).start(chain)
    place = {"cart": 1, "spring": 2, "input": 0}[effect.place]
    sides = (1.0, -1.0) if any(p.side for p in effect.parameters) else (1.0,)
    for side in sides:
        values = tuple(side * 0.5 if p.side else 0.5 for p in effect.parameters)
        candidate = make_candidate(effect, place, values, runs=runs, chain=chain)

        grown = plain.with_effect(candidate, values)

        np.testing.assert_allclose(grown.terms[-1].values, values, rtol=1e-12)
        assert np.array_equal(grown.without(0).theta, plain.theta)
