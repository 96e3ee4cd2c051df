"""Standard errors of friction and delay, without contacts, match the actual errors."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.experiments.propose import propose_plan
from pipeline.gap.fit import Fitting, covariance, evaluate, fit_model, measure_noise
from pipeline.gap.judge import make_candidate
from pipeline.gap.parameters import Structure
from pipeline.gap.runs import make_run, prepare
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import Chain
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


def fitted(case):
    """Return the linear chain fitted to a case, and its runs."""
    runs = [make_run(record, n=case.n) for record in case.records]
    true = Chain(m=np.array(case.m), c=np.array(case.c), k=np.array(case.k))
    return fit_model(Structure(springs=case.springs).start(true), runs, Fitting()), runs


def test_a_model_that_runs_away_has_no_errors():
    """If a spring softens until the cart runs away, there are no standard errors."""
    fit, runs = fitted(make_case(seed=42, n=1, rate=113.1))
    chain = fit.structure.chain(fit.theta)
    soft = make_candidate(find_effect("cubic_spring"), 1, (-1.0,), runs=runs, chain=chain)
    away = evaluate(fit.with_effect(soft, (-1.0,)), runs, fit.nuisance, spread=fit.spread)
    assert not np.isfinite(away.cost)
    assert covariance(away, runs).covariance is None


def test_every_record_has_encoder_errors_of_its_own():
    """If a record is listed twice, each copy gets its own encoder errors."""
    fit, runs = fitted(make_case(seed=42, n=1, rate=113.1))
    once = covariance(replace(fit, nuisance=fit.nuisance[:1]), runs[:1]).covariance
    twice = covariance(replace(fit, nuisance=fit.nuisance[:1] * 2), runs[:1] * 2).covariance
    assert once is not None
    assert twice is not None
    assert np.all(np.diag(twice) < np.diag(once))
    assert not np.allclose(twice, once / 2, rtol=1e-3, atol=0.0)
