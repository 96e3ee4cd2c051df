"""The last step of a search: removing needless effects."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.gap.judge import SURE, enrich, fit_free_run, judge, prune, significance
from tests.gap.begun import COULOMB, DAHL, DELAY, begun, with_effects
from tests.truth.bench import Hidden


def test_a_richer_law_that_explains_no_more_is_replaced():
    """Presliding friction that yields over almost no distance is replaced by plain dry friction."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 0.0006}),
        Hidden(effect="input_delay", parameters={"delay": 0.015}),
    )
    start = with_effects(fit, study, (DELAY, (0.015,)), (DAHL, (0.0006, 1e-4)))
    rich = judge(fit_free_run(start, study), study)

    pruned = prune(rich, study, [judge(fit, study)])

    assert rich.key == {DAHL, DELAY}
    assert pruned.key == {COULOMB, DELAY}
    assert pruned.error < 1.01 * rich.error


@pytest.mark.parametrize(
    ("effect", "parameters", "key"),
    [
        ("presliding_friction", {"force": 0.0006, "distance": 0.04}, DAHL),
        ("coulomb_friction", {"force": 0.0006}, COULOMB),
    ],
)
def test_a_plain_law_becomes_a_richer_one_only_if_that_is_true(effect, parameters, key):
    """Dry friction becomes presliding friction if the cart's friction builds up over a distance."""
    fit, study = begun(Hidden(effect=effect, place=1, parameters=parameters))
    plain = with_effects(fit, study, (COULOMB, (0.0006,)))
    plain = judge(fit_free_run(plain, study), study)

    rich = enrich(plain, study, found=[])

    assert rich.key == {key}
    assert (rich is plain) == (key == COULOMB)


@pytest.mark.parametrize(("value", "nothing"), [(0.015, False), (1e-4, True)])
def test_an_effect_of_zero_within_its_error_is_not_significant(value, nothing):
    """With a standard error of 1 ms, a delay of 15 ms is significant, and one of 0.1 ms is not."""
    fit, study = begun(Hidden(effect="input_delay", parameters={"delay": 0.015}))
    model = with_effects(fit, study, (DELAY, (value,)))
    known = replace(fit, structure=model.structure, theta=model.theta)
    sure = np.diag(np.full(model.theta.size, (1e-3 / model.structure.effects[0].scales[0]) ** 2))

    (found,) = significance(replace(known, covariance=sure))
    assert (found < SURE) == nothing
    assert significance(known) == [np.inf]  # without a standard error it counts as significant


@pytest.mark.parametrize(("gain", "nothing"), [(1.05, False), (1.001, True), (0.95, False)])
def test_a_sensor_gain_is_significant_by_its_distance_from_one(gain, nothing):
    """With a standard error of 0.01, only a gain far from 1 is significant."""
    fit, study = begun()
    model = with_effects(fit, study, (("sensor_gain", 1), (gain,)))
    known = replace(fit, structure=model.structure, theta=model.theta)
    by_theta = known.structure.physical_derivative(known.theta)
    sure = np.diag((0.01 / np.where(by_theta == 0, 1.0, by_theta)) ** 2)

    (found,) = significance(replace(known, covariance=sure))
    assert (found < SURE) == nothing
