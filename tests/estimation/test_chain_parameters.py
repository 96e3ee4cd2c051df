"""A chain is converted to a fit's vector and back, and named parameters get standard errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.estimation.parametrisation import (
    Parametrisation,
    even_chain,
    named_estimates,
    physical_start,
)
from pipeline.plant.chain import PRESETS, Chain
from pipeline.setup import Setup


@pytest.mark.parametrize(
    ("springs", "names", "plain"),
    [
        ((True, True, True), "m_1 m_2 c_1 c_2 k_1 k_2 k_3", "k_1"),  # which may be missing
        ((True, True, False), "m_1 m_2 c_1 c_2 k_1 k_2", ""),
        ((False, True), "m_1 c_1 k_1", ""),
        ((False, False), "m_1 c_1", ""),
    ],
)
def test_the_vector_has_what_the_springs_allow(springs, names, plain):
    """The vector has logarithms, but k_1 itself if it may be missing; one cart has one k."""
    P = Parametrisation(bench=Setup(springs=springs))

    assert P.names == tuple(names.split())
    assert [n for n, log in zip(P.names, P.logarithmic, strict=True) if not log] == plain.split()


def test_a_missing_spring_between_carts_is_refused():
    """If the spring between two carts is missing, the error names the two carts."""
    with pytest.raises(DataError, match="2 and 3"):
        Parametrisation(bench=Setup(springs=(True, True, False, True)))


def test_standard_errors_agree_with_a_sample():
    """In 1000 random chains, the named parameters scatter as much as their standard errors say."""
    chain = PRESETS["throne-3dof"]
    P = Parametrisation(bench=Setup(springs=(True,) * 4))
    p = P.physical(chain)
    std = 1e-3 * np.where(p > 0, p, 0.05)
    got = named_estimates(chain, names=P.names, covariance=np.diag(std**2), source="bode_fit")
    rng = np.random.default_rng(0)

    sample = [
        list(P.chain(p + std * rng.standard_normal(p.size)).parameters().values())
        for _ in range(1000)
    ]

    # A standard deviation from 1000 draws has an error of 2.2 %; the limit is four times that.
    ratio = np.std(sample, axis=0) / [estimate.std for estimate in got.values()]
    assert_allclose(ratio, 1.0, rtol=0.09)


def test_a_start_is_a_possible_chain():
    """The start of a fit keeps the masses and gets positive springs and dampings of 5 %.

    A spring declared as missing stays zero.
    """
    found = Chain(m=np.array([3e-4, 2e-4]), c=np.array([-1.0, 1.0]), k=np.array([-0.01, 0.1, 0.05]))

    got = physical_start(found, bench=Setup(springs=(True, True, False)))

    assert np.all(got.k[:2] > 0)
    assert got.k[2] == 0
    assert_allclose(got.m, found.m, rtol=1e-15)
    assert_allclose(got.zeta_carts, 0.05, rtol=1e-12)


@settings(max_examples=20)
@given(n=st.integers(1, 4), gain=st.floats(0.1, 1e4), omega=st.floats(0.5, 300.0))
def test_an_even_chain_has_the_given_gain_and_frequency(n, gain, omega):
    """The chain of equal carts has the given gain of cart 1 and the given lowest frequency."""
    got = even_chain({"K_1": gain, "omega_a": omega}, bench=Setup(springs=(True,) * (n + 1)))

    values = got.parameters()
    # The solution has about ten rounding errors; the added damping does not change omega_a.
    assert_allclose(values["K" if n == 1 else "K_1"], gain, rtol=1e-12)
    assert_allclose(np.min(np.abs(got.poles)), omega, rtol=1e-6)
