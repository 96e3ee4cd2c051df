"""Standard errors of dry friction include its variation from run to run."""

import numpy as np
import pytest

from pipeline.gap.explain import explain_gap
from pipeline.gap.fit import _between_runs
from pipeline.setup import Setup
from tests.truth.cases import make_case


def test_the_variance_between_runs_is_that_beyond_their_errors():
    """Over many draws, the mean of the estimate is the true variance; it is never negative."""
    rng = np.random.default_rng(1)
    truth, runs, draws = 0.04, 8, 4000
    std = rng.uniform(0.5, 1.5, runs) * truth

    found = [
        _between_runs(truth * rng.standard_normal(runs) + std * rng.standard_normal(runs), std**-2)
        for _ in range(draws)
    ]

    assert min(found) == 0.0
    spread = np.std(found) / np.sqrt(draws)
    # Estimates below zero are raised to zero, which adds a few percent here.
    assert truth**2 - 4 * spread < np.mean(found) < 1.2 * truth**2
    assert _between_runs(np.array([0.3]), np.array([1.0])) == 0.0


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(
    ("seed", "n", "effect"), [(900_004, 2, "stiction"), (81, 1, "coulomb_friction")]
)
def test_errors_of_friction_that_varies_contain_the_truth(seed, n, effect):
    """Friction varies by 4 % between runs; the stated errors of its force allow for that."""
    case = make_case(seed=seed, n=n, effects=[effect], dirt=True)
    gap = explain_gap(case.records, Setup(springs=case.springs))

    (found,), (hidden,) = gap.effects, case.hidden
    assert found.effect.key == effect
    force = found.parameters["force"]
    assert force.std is not None
    # With 3 to 6 runs the mean factor is known to 4 % / sqrt(6) at best.
    assert 0.005 * force.value < force.std < 0.05 * force.value
    assert abs(force.value - hidden.parameters["force"]) < 4 * force.std
