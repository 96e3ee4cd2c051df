"""The fit to frequency responses is tested on many benches.

It is as accurate as the data allow, states true standard errors, and works from poor starts.
"""

import numpy as np
import pytest

from benchmarks.identification import converged_share, quality
from pipeline.plant.chain import PRESETS


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("phases", [False, True], ids=["magnitudes", "phases"])
@pytest.mark.parametrize("preset", PRESETS)
def test_the_fit_is_efficient_and_its_errors_are_right(preset, phases):
    """Over 400 noisy data sets, intervals are right and accuracy is nearly the best possible."""
    got = quality(PRESETS[preset], seeds=400, phases=phases)

    # The share of 400 intervals has a standard error of 1.1 %. The lower limit is three of these
    # below 95 %. The upper limit is 1 % higher, since k_1 >= 0 may make the true share 96 %.
    assert np.all((got.coverage > 0.917) & (got.coverage < 0.99))
    # A variance from 400 draws has an error of 7 %; the true efficiencies are above 0.97.
    assert np.exp(np.mean(np.log(got.efficiency))) >= 0.9
    assert np.min(got.efficiency) >= 0.75


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(("kind", "least"), [("paper", 0.995), ("random", 0.99), ("wide", 0.94)])
@pytest.mark.parametrize("preset", PRESETS)
def test_the_fit_converges_from_poor_starts(preset, kind, least):
    """From at least 94 % of poor starting values, the fit finds the right resonances."""
    assert converged_share(PRESETS[preset], kind=kind, seeds=400) >= least
