"""The fit to time records finds many kinds of chains, and its intervals are right."""

import numpy as np
import pytest

from pipeline.estimation.time_fit import fit_records
from pipeline.plant.chain import PRESETS
from pipeline.setup import Setup
from tests.estimation.test_time_fit import errors
from tests.helpers.time_records import random_chain, step_record


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.0005, 0.00227])
@pytest.mark.parametrize("preset", PRESETS)
def test_95_percent_intervals_contain_95_percent_of_the_true_values(preset, noise):
    """The 95 % intervals contain 95 % of true values, even if rounding is the only error."""
    chain, rng = PRESETS[preset], np.random.default_rng(15)
    seeds = 120
    inside = np.zeros(len(chain.parameters()))
    for _ in range(seeds):
        records = [
            step_record(
                chain,
                rng=rng,
                swing=swing * rng.uniform(0.8, 1.2),
                duration=rng.uniform(6, 10),
                rate=rng.choice([113.0, 226.0, 500.0]),
                noise=noise,
                id=f"{swing}",
            )
            for swing in (1.0, 0.6)
        ]
        fit = fit_records(records, bench=Setup(springs=(True,) * (chain.n + 1)))
        assert fit.converged
        inside += np.abs(errors(fit, chain)) < 1.96
    # Each count is binomial, with 120 draws at 0.95 and a standard error of 0.02. The worst of 19
    # counts is within 3.5 standard errors.
    assert np.min(inside / seeds) > 0.88
    # The mean over parameters varies less. If rounding is the only error, intervals are too wide.
    assert 0.92 < np.mean(inside / seeds) < 0.995


@pytest.mark.slow
def test_every_random_chain_is_found():
    """The fit finds each of 200 random chains with 1 to 4 carts."""
    rng = np.random.default_rng(16)
    for i in range(200):
        n = 1 + i % 4
        chain, springs = random_chain(n, rng)
        records = [
            step_record(
                chain,
                rng=rng,
                swing=swing,
                duration=rng.uniform(4, 8),
                rate=rng.choice([113.0, 226.0, 500.0]),
                jitter=rng.choice([0.0, 0.2]),
                noise=0.001,
                id=f"{swing}",
            )
            for swing in (1.0, 0.6, -1.0)
        ]
        fit = fit_records(records, bench=Setup(springs=springs))
        assert fit.converged
        # Of 200 × about 10 errors, one is beyond 5.5 standard errors once in 10 000 such tests.
        assert np.max(np.abs(errors(fit, chain))) < 5.5
