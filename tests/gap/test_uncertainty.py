"""Standard errors of what a gap names: as large as the errors are."""

import numpy as np
import pytest

from pipeline.bench.planning.propose import propose_plan
from pipeline.gap.data.sides import prepare
from pipeline.gap.fit.baseline import measure_noise
from pipeline.gap.fit.levenberg_marquardt import fit_model
from pipeline.gap.fit.structure import Structure
from pipeline.gap.fit.uncertainty import covariance
from pipeline.gap.search.screen import candidates_at
from pipeline.submission import load_submission
from pipeline.synthesis.hidden import prepare_bench
from pipeline.workflow import analyse
from tests.helpers.virtual import VirtualBench, new_folder


def standardised(folder, *, preset, hide, seed):
    """Return by how many standard errors each parameter of the true model is off."""
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
        trials = candidates_at(term.effect, term.place, runs=runs, chain=hidden.chain)
        here = next(one for one, _ in trials if one.has_signs_of(term.values))
        start = start.with_effect(here, term.values)
    fit = fit_model(start, runs, scatter_free=False)
    runs = measure_noise(fit, runs, runs)
    fit = fit_model(fit, runs, nuisance=fit.nuisance, scatter_free=False, tolerance=1e-6)
    fit = covariance(fit, runs)
    assert fit.covariance is not None
    return (fit.theta - start.theta) / np.sqrt(np.diag(fit.covariance))


@pytest.mark.parametrize(
    ("preset", "hide", "seeds"),
    [
        pytest.param("throne-1dof", ["coulomb_friction"], 4, marks=pytest.mark.slow),
        ("throne-2dof", ["coulomb_friction", "input_delay"], 2),
    ],
)
def test_parameters_are_off_by_what_is_stated(tmp_path, preset, hide, seeds):
    """A cart that friction holds reads the same for seconds: that is one reading, not a thousand.

    Of so few numbers a root mean square scatters by a quarter; with white noise it was four.
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
