"""Standard errors match the actual errors; with backlash none are stated."""

import numpy as np
import pytest

from pipeline.experiments.propose import propose_plan
from pipeline.gap.explain import explain_gap
from pipeline.gap.fit import Fitting, covariance, fit_model, measure_noise
from pipeline.gap.judge import make_candidate
from pipeline.gap.parameters import Structure
from pipeline.gap.runs import prepare
from pipeline.setup import Setup
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.virtual import VirtualBench, new_folder
from tests.truth.cases import make_case


def standardised(folder, *, preset, hide, seed):
    """Fit the true model, and return each parameter's error in standard errors."""
    bench = VirtualBench(prepare_bench(preset=preset, model=None, hide=hide), seed=seed)
    hidden = bench.carts._bench
    springs = tuple(bool(k > 0) for k in hidden.chain.k)
    folder = new_folder(folder, bench, springs=springs)
    plan = propose_plan(load_submission(folder), bench=bench.description)
    first = [r for r in plan.recordings if r.kind != "decay"]
    bench.record(folder, first, limits=plan.limits)
    records = analyse(load_submission(folder)).records
    runs = prepare(records, springs=springs, notes=[])
    start = Structure(springs=springs).start(hidden.chain)
    for term in hidden.effects:
        here = make_candidate(term.effect, term.place, term.values, runs=runs, chain=hidden.chain)
        start = start.with_effect(here, term.values)
    fit = fit_model(start, runs, Fitting(scatter_free=False))
    runs = measure_noise(fit, runs, runs)
    fit = fit_model(fit, runs, Fitting(scatter_free=False, tolerance=1e-6))
    fit = covariance(fit, runs)
    assert fit.covariance is not None
    return (fit.theta - start.theta) / np.sqrt(np.diag(fit.covariance))


@pytest.mark.parametrize(
    ("preset", "hide", "seeds"),
    [
        pytest.param("throne-1dof", ["coulomb_friction"], 4, marks=pytest.mark.slow),
        pytest.param(
            "throne-2dof",
            ["coulomb_friction", "input_delay"],
            2,
            marks=[pytest.mark.slow, pytest.mark.sample],
        ),
    ],
)
def test_stated_standard_errors_are_right(tmp_path, preset, hide, seeds):
    """Standard errors are right even if friction holds a cart still for seconds.

    The root mean square of so few errors scatters by a quarter around one. If the noise were
    treated as white, it would be about four.
    """
    z = np.array(
        [
            standardised(tmp_path / str(seed), preset=preset, hide=hide, seed=seed)
            for seed in range(seeds)
        ]
    )
    assert np.mean(np.abs(z) < 2) > 0.8
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.sqrt(np.mean(z[:, -1] ** 2)) < 2.0


@pytest.mark.parametrize(("effect", "stated"), [("end_stop", True), ("backlash", False)])
def test_standard_errors_with_a_contact(effect, stated):
    """Those of an end stop are right; a fit with backlash states none and says why."""
    case = make_case(seed=900_147, n=1, effects=[effect], severity=0.3)
    gap = explain_gap(case.records, Setup(springs=case.springs))
    (found,), (hidden,) = gap.effects, case.hidden
    assert found.effect.key == effect
    told = found.parameters | found.details
    assert [value.std is not None for value in told.values()] == [stated] * len(told)
    assert bool(gap.chain_std) == (gap.chain_covariance is not None) == stated
    assert any("no standard errors are stated" in note for note in gap.notes) != stated
    for name, true in hidden.parameters.items() if stated else ():
        value = found.parameters[name]
        assert value.std is not None
        assert value.std < 0.3 * abs(value.value)  # that of the stiffness is 13 %
        assert abs(value.value - float(true)) < 4.0 * value.std
