"""The linear plant: matrices, poles, zeros, and conversion to named parameters and back."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.plant.chain import PRESETS, Chain, parameter_names, quadratic_factors
from pipeline.plant.identities import recover_from_parameters

# The paper's final estimates. No real chain agrees with Table 3.
TABLE_1 = {"K": 28.9, "omega_n": 13.2, "zeta": 0.10}
TABLE_2 = {
    "K_1": 24.3, "K_2": 16.4, "omega_a": 10.1, "omega_b": 37.3,
    "zeta_a": 0.11, "zeta_b": 0.03, "omega_2": 32.9, "zeta_2": 0.04,
}  # fmt: skip
TABLE_3 = {
    "K_1": 39.4, "K_2": 30.6, "K_3": 16.0, "omega_a": 6.9, "omega_b": 24.1, "omega_c": 34.1,
    "zeta_a": 0.25, "zeta_b": 0.03, "zeta_c": 0.03, "omega_x": 20.2, "omega_y": 31.6,
    "zeta_x": 0.04, "zeta_y": 0.03, "omega_3": 25.6, "zeta_3": 0.04,
}  # fmt: skip


def logarithmic(low, high):
    """Draw numbers spread evenly over decades."""
    return st.floats(np.log(low), np.log(high)).map(lambda x: float(np.exp(x)))


@st.composite
def chains(draw, min_carts=1, max_carts=4, max_zeta=0.3):
    """Draw chains like those of the laboratory: masses and springs within a factor of four."""
    n = draw(st.integers(min_carts, max_carts))
    m = np.array([draw(logarithmic(1e-4, 4e-4)) for _ in range(n)])
    k = np.array([draw(logarithmic(0.03, 0.12)) for _ in range(n + 1)])
    if n == 1:
        k = np.array([k.sum(), 0.0])
    elif draw(st.booleans()):
        k[0] = 0.0
    zeta = np.array([draw(logarithmic(0.005, max_zeta)) for _ in range(n)])
    return Chain(m=m, c=2 * zeta * np.sqrt(m * (k[:-1] + k[1:])), k=k)


def assert_same_chain(got, chain, *, rtol):
    # A spring is a difference of terms as large as its neighbours, so its error is as large as
    # theirs.
    assert_allclose(got.m, chain.m, rtol=rtol)
    assert_allclose(got.c, chain.c, rtol=rtol, atol=rtol * chain.c.max())
    assert_allclose(got.k, chain.k, rtol=rtol, atol=rtol * chain.k.max())


# ---------------------------------------------------------------------- maps


@given(chains(max_carts=3))
def test_chain_to_parameters_and_back(chain):
    """The named parameters of one to three carts give the chain back, with zero redundancies."""
    got = recover_from_parameters(chain.parameters())

    # Poles have errors near 1e-14. A weak coupling is the difference of numbers up to 100 times as
    # large, so its error is hundreds of times larger.
    assert_same_chain(got, chain, rtol=1e-9)
    assert max(got.residuals.values(), default=0.0) < 1e-9


@pytest.mark.parametrize(
    ("name", "broken"),
    [("zeta_x", {"R1"}), ("zeta_b", {"R2", "R4"}), ("K_2", {"R5"}), ("omega_3", {"R3"})],
)
def test_an_inconsistent_table_shows_in_the_redundancies(name, broken):
    """Changing one parameter by 10 % breaks the redundancies in which it appears."""
    values = PRESETS["throne-3dof"].parameters()
    got = recover_from_parameters(values | {name: 1.1 * values[name]})

    assert all(got.residuals[key] > 1e-3 for key in broken)


def test_the_names_of_the_tables():
    """Names are in the order of the paper's tables; a rigid body has only mass and damping."""
    assert parameter_names(2) == [
        "K_1", "K_2", "omega_a", "omega_b", "zeta_a", "zeta_b",
        "omega_1", "omega_2", "zeta_1", "zeta_2",
    ]  # fmt: skip
    assert set(TABLE_3) < set(parameter_names(3))
    assert list(PRESETS["throne-3dof"].parameters()) == parameter_names(3)
    assert parameter_names(1, rigid=True) == ["mass", "damping"]
    assert parameter_names(4)[-1] == "zeta_4"


# ----------------------------------------------------------- independent computations


@given(chains())
@settings(max_examples=40)
def test_poles_are_roots_of_the_common_denominator(chain):
    """All poles are stable roots of the common denominator."""
    got = chain.poles

    T = chain.subchain_polynomials()[0]
    # An error of 1e-13 in a root changes |T| by about as much, relative to the terms of T.
    for pole in got:
        terms = np.abs(T * pole ** np.arange(T.size - 1, -1, -1))
        assert abs(np.polyval(T, pole)) < 1e-9 * terms.sum()
    assert np.all(got.real < 0)
    assert got.size == 2 * chain.n


@given(chains(min_carts=2))
@settings(max_examples=30)
def test_zeros_make_each_response_vanish(chain):
    """From force to cart i there are 2 (n - i) zeros, the same as python-control finds."""
    for cart in range(1, chain.n):
        zeros = chain.zeros(cart)
        assert zeros.size == 2 * (chain.n - cart)
        A, B, C, D = chain.state_space()
        oracle = control.zeros(control.ss(A, B, C[[cart - 1]], D[[cart - 1]]))
        finite = oracle[np.abs(oracle) < 1e4]  # infinite zeros come out as huge numbers
        matched = [np.min(np.abs(finite - zero)) / abs(zero) for zero in zeros]
        # python-control's eigenvalue routine mixes scales of 1 and 1e4 (k/m), which limits it to
        # 1e-6.
        assert max(matched) < 1e-6


@given(chains())
@settings(max_examples=30)
def test_frequency_response_matches_state_space(chain):
    """The response computed from impedances equals the state model's, C (sI - A)^-1 B."""
    omega = np.geomspace(1.0, 100.0, 25)

    got = chain.frequency_response(omega)

    A, B, C, _ = chain.state_space()
    eye = np.eye(A.shape[0])
    expected = np.stack([(C @ np.linalg.solve(1j * w * eye - A, B))[:, 0] for w in omega], axis=1)
    # Near a sharp null, the terms of both methods cancel to a hundredth.
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert_allclose(got / scale, expected / scale, atol=1e-10)


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_transfer_functions_are_the_frequency_response(preset):
    """Numerator over denominator of each cart's transfer function is its frequency response."""
    chain, omega = PRESETS[preset], np.array([0.5, 7.0, 20.0, 50.0])
    for cart, G in enumerate(chain.frequency_response(omega), start=1):
        numerator, denominator = chain.transfer_function(cart)
        ratio = np.polyval(numerator, 1j * omega) / np.polyval(denominator, 1j * omega)
        assert_allclose(ratio, G, rtol=1e-9)


def test_the_response_at_an_undamped_pole_is_infinite():
    """The response is infinite only at an undamped pole, whatever the number of carts."""
    one = Chain(m=np.array([1.0]), c=np.array([0.0]), k=np.array([4.0, 0.0]))
    two = Chain(m=np.ones(2), c=np.zeros(2), k=np.array([1.0, 1.5, 1.0]))
    for chain in (one, two):
        got = chain.frequency_response(np.array([1.5, 2.0, 2.5]))
        assert np.isfinite(got[:, [0, 2]]).all()
        assert np.isinf(got[:, 1]).all()


def test_rows_of_the_state_matrix():
    """The state matrix of two carts is the paper's 4x4 matrix, entry by entry."""
    m, c, k = [2.0, 4.0], [0.6, 0.8], [1.0, 3.0, 5.0]
    A, B, C, D = Chain(m=np.array(m), c=np.array(c), k=np.array(k)).state_space()

    assert_allclose(
        A, [[0, 1, 0, 0], [-2.0, -0.3, 1.5, 0], [0, 0, 0, 1], [0.75, 0, -2.0, -0.2]], rtol=1e-15
    )
    assert_allclose(B, [[0], [0.5], [0], [0]])
    assert_allclose(C, [[1, 0, 0, 0], [0, 0, 1, 0]])
    assert_allclose(D, [[0], [0]])


# ------------------------------------------------------- laws of a real chain


@given(chains(max_zeta=0.05))
def test_gains_fall_along_the_chain(chain):
    """Static gains fall along the chain, and their ratios follow from the springs."""
    K, k = chain.static_gains(), chain.k

    assert np.all(K > 0)
    assert np.all(np.diff(K) <= 1e-12 * K[0])
    beyond = k[-1]  # stiffness behind a cart, from the far wall inwards
    for i in range(chain.n - 1, 0, -1):
        assert_allclose(K[i] / K[i - 1], k[i] / (k[i] + beyond), rtol=1e-9)
        beyond = k[i] * beyond / (k[i] + beyond)


@given(chains(min_carts=2), st.data())
def test_a_held_cart_is_a_wall(chain, data):
    """If all other carts are held, cart i has the frequency omega_i and damping ratio zeta_i."""
    cart = data.draw(st.integers(1, chain.n))

    A, B, _, _ = chain.state_space(free=[cart])

    omega, zeta = chain.omega_carts[cart - 1], chain.zeta_carts[cart - 1]
    assert_allclose(A[1], [-(omega**2), -2 * zeta * omega])
    assert B[1, 0] == (1 / chain.m[0] if cart == 1 else 0.0)


def test_free_carts_are_named_in_any_order():
    """The order in which free carts are named changes nothing; a missing cart cannot be free."""
    chain = PRESETS["throne-3dof"]
    assert_allclose(chain.state_space(free=[3, 1])[0], chain.state_space(free=(1, 3))[0])
    with pytest.raises(ValueError, match=r"free carts \[3\]"):
        PRESETS["throne-2dof"].state_space(free=[3])


def test_a_missing_spring_uncouples():
    """If the spring between two carts is missing, the second cart does not move and has no gain."""
    chain = Chain(m=np.array([2e-4, 3e-4]), c=np.array([1e-4, 1e-4]), k=np.array([0.1, 0.0, 0.1]))

    assert_allclose(chain.static_gains(), [10.0, 0.0], atol=1e-15)
    assert_allclose(chain.frequency_response(np.array([5.0, 20.0]))[1], 0.0, atol=1e-15)


def test_a_rigid_body():
    """One cart without springs has a mass and a damping, but no static gain.

    Neither have carts with a spring between them but none to a wall.
    """
    body = Chain(m=np.array([2e-4]), c=np.array([5e-4]), k=np.zeros(2))

    assert body.parameters() == {"mass": 2e-4, "damping": 5e-4}
    omega = np.array([10.0])
    expected = 1 / (2e-4 * (1j * 10.0) ** 2 + 5e-4 * 1j * 10.0)
    assert_allclose(body.frequency_response(omega)[0, 0], expected, rtol=1e-12)
    with pytest.raises(DataError, match="no static gain"):
        body.static_gains()
    pair = Chain(m=np.array([2e-4, 3e-4]), c=np.array([1e-4, 1e-4]), k=np.array([0.0, 0.1, 0.0]))
    with pytest.raises(DataError, match="no static gain"):
        pair.parameters()


def test_an_overdamped_factor_has_zeta_above_one():
    """Two real roots make one quadratic factor with a damping ratio above one."""
    omega, zeta = quadratic_factors(np.array([-2.0 + 0j, -8.0 + 0j, -1 + 9j, -1 - 9j]))

    assert_allclose(omega, [4.0, np.sqrt(82)], rtol=1e-12)
    assert_allclose(zeta, [1.25, 1 / np.sqrt(82)], rtol=1e-12)


# ------------------------------------------------------------ the paper's tables


@pytest.mark.parametrize(("preset", "table"), [("throne-1dof", TABLE_1), ("throne-2dof", TABLE_2)])
def test_presets_round_to_the_paper(preset, table):
    """Rounded, the presets give each independent final value printed in Tables 1 and 2."""
    values = PRESETS[preset].parameters()

    for name, printed in table.items():
        decimals = 2 if name.startswith("zeta") else 1
        assert round(values[name], decimals) == printed, name


def test_table_2_obeys_its_redundancy_within_rounding():
    """Table 2 obeys its redundancy R1 up to rounding, and its springs give ω_1 = 20.27."""
    got = recover_from_parameters(TABLE_2)

    assert got.residuals["R1"] < 0.15
    assert_allclose(np.sqrt((got.k[0] + got.k[1]) / got.m[0]), 20.27, atol=0.005)
