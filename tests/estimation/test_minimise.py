"""For one set of parameters, the model is computed only once for residual and derivatives."""

import numpy as np

from pipeline.estimation.least_squares import fit_separable


class _Decay:
    """A model exp(-p t) that stores the array p itself and not a copy."""

    def __init__(self, t, p):
        self.t, self.p = t, p

    @property
    def columns(self):
        return np.exp(-self.p[0] * self.t)[:, None]

    def derivatives(self, linear):
        return -self.t[:, None] * self.columns * linear


def test_a_separable_fit_finds_a_rate_and_an_amplitude_to_rounding():
    t = np.linspace(0.0, 2.0, 200)
    fit = fit_separable(
        3.0 * np.exp(-1.7 * t),
        lambda p: _Decay(t, p),
        start=np.array([0.2]),
        max_evaluations=50,
    )
    assert fit.converged
    np.testing.assert_allclose([fit.p[0], fit.linear[0]], [1.7, 3.0], rtol=1e-9)
    assert not fit_separable(
        3.0 * np.exp(-1.7 * t), lambda p: _Decay(t, p), start=np.array([0.2]), max_evaluations=2
    ).converged
