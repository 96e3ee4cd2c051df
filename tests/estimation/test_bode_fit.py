"""The fit of a chain to frequency responses is tested on known, noisy and difficult data."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import binom

from benchmarks.identification import PAPER_STARTS, measure, quality
from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.plant.chain import PRESETS, Chain
from pipeline.results import Estimate, FrequencyResponse
from pipeline.setup import Setup

BENCH_BAND = 2 * np.pi * np.geomspace(0.3, 7.0, 30)
FOUR_CARTS = Chain(
    m=np.array([3e-4, 2.5e-4, 2e-4, 2.5e-4]),
    c=np.array([1e-3, 5e-4, 4e-4, 5e-4]),
    k=np.array([0.02, 0.12, 0.07, 0.06, 0.08]),
)


def exact(chain: Chain, omega: Array = BENCH_BAND) -> tuple[FrequencyResponse, ...]:
    """Return exact magnitudes with a stated error of 1 %."""
    size = np.abs(chain.frequency_response(omega))
    return tuple(
        FrequencyResponse(
            cart=i + 1,
            omega=omega,
            magnitude=size[i],
            magnitude_std=0.01 * size[i],
            phase=None,
            phase_std=None,
            source="dwells",
        )
        for i in range(chain.n)
    )


def noisy(preset: str, *, seed: int = 0, phases: bool = False) -> tuple[FrequencyResponse, ...]:
    return measure(PRESETS[preset], rng=np.random.default_rng(seed), phases=phases)


WALLS = {n: Setup(springs=(True,) * (n + 1)) for n in (1, 2, 3, 4)}


# ---------------------------------------------------------------------- exact data


@pytest.mark.parametrize("chain", [*PRESETS.values(), FOUR_CARTS], ids=lambda c: f"{c.n}-carts")
def test_exact_magnitudes_give_the_chain_without_a_start(chain):
    """From exact magnitudes and without a start value, the fit finds every named parameter."""
    got = fit_bode(exact(chain), bench=WALLS[chain.n])

    assert got.converged
    for name, value in chain.parameters().items():
        # The fit stops when its cost or step changes by less than 1e-8. The cost is quadratic, so a
        # parameter is then within about 1e-5 of its standard error.
        assert_allclose(got.parameters[name].value, value, rtol=1e-5)


def test_a_rigid_body_has_mass_and_damping():
    """If a single cart has no spring, the fit gives the cart's mass and damping."""
    cart = Chain(m=np.array([3e-4]), c=np.array([1e-3]), k=np.zeros(2))

    got = fit_bode(exact(cart), bench=Setup(springs=(False, False)))

    found = [got.parameters[name].value for name in ("mass", "damping")]
    assert_allclose(found, [3e-4, 1e-3], rtol=1e-5)
    assert got.staged == {}


def test_the_staged_fit_is_reported_as_well():
    """From exact data, the stage-by-stage fit finds all parameters, even the recomputed ones."""
    chain = PRESETS["throne-3dof"]

    got = fit_bode(exact(chain), bench=WALLS[3], initial=PAPER_STARTS[3])

    truth = chain.parameters()
    assert set(got.staged) == set(truth)
    for name, value in truth.items():
        # Each stage stops like the joint fit; recomputing omega_1 multiplies the error by about
        # ten.
        assert_allclose(got.staged[name], value, rtol=1e-3)


# ------------------------------------------------------------------ statistics


@pytest.mark.parametrize("phases", [False, True], ids=["magnitudes", "phases"])
@pytest.mark.parametrize("preset", PRESETS)
def test_intervals_contain_the_true_values(preset, phases):
    """Over 16 noisy data sets, 95 % intervals contain the true value as often as they should."""
    got = quality(PRESETS[preset], seeds=16, phases=phases)

    # For correct intervals, the coverage is below this limit once in 10,000 tries.
    assert np.all(got.coverage >= binom.ppf(1e-4, 16, 0.95) / 16)
    # The mean of 16 values of chi²/dof, each with at least 17 dof, has a standard error of at most
    # 0.086. The tolerance is four of these.
    assert_allclose(np.mean(got.chi_square), 1.0, atol=0.35)


# ------------------------------------------------------------------ hard cases


# All points are beside the sharp peak, so they do not show its damping.
SHARP = Chain(m=np.array([2e-3]), c=np.array([0.0]), k=np.array([0.6, 0.0]))
BESIDE = np.sqrt(300.0) * np.array([0.4, 0.6, 0.8, 1.25, 1.5, 2.0])


def test_a_missing_far_spring_and_damper_are_found_to_be_zero():
    """If the far spring and the damper of cart 2 are missing, the fit finds both to be zero."""
    chain = PRESETS["throne-2dof"]
    loose = Chain(m=chain.m, c=np.array([6e-4, 0.0]), k=np.array([0.05, 0.127, 0.0]))

    got = fit_bode(exact(loose), bench=WALLS[2])

    assert_allclose(got.chain.k, loose.k, atol=1e-5)
    assert_allclose(got.chain.c, loose.c, atol=1e-7)
    assert_allclose(got.parameters["K_1"].value, got.parameters["K_2"].value, rtol=1e-4)


def test_a_damping_at_its_bound_has_no_standard_error():
    """If the fit holds a damping at zero, a note says so, and the damping has no standard error.

    Gain and frequency are still found.
    """
    got = fit_bode(exact(SHARP, BESIDE), bench=WALLS[1])

    assert got.at_bound == ("c_1",)
    zeta = got.parameters["zeta"]
    assert (zeta.value, zeta.std, zeta.at_bound) == (0.0, None, True)
    assert not got.parameters["K"].at_bound
    assert_allclose(got.parameters["omega_n"].value, np.sqrt(300.0), rtol=1e-4)


def test_a_damping_that_the_response_leaves_open_is_the_decays():
    """If points near a sharp peak do not determine the damping, the decay's damping is used."""
    decay = Estimate(value=0.017, std=0.0005, source="log_decrement")
    got = fit_bode(exact(SHARP, BESIDE), bench=WALLS[1], decays={1: decay})

    zeta = got.parameters["zeta"]
    assert zeta.std is not None
    assert_allclose([zeta.value, zeta.std], [0.017, 0.0005], rtol=0.02)
    assert (zeta.source, zeta.at_bound, got.at_bound) == ("log_decrement", False, ("c_1",))
    assert_allclose(got.chain.zeta_carts, 0.017, rtol=0.02)


def test_if_one_damping_is_open_all_decays_are_used():
    """If the response leaves one of two dampings unknown, the fit also uses both carts' decays."""
    chain = PRESETS["throne-2dof"]
    decays = {
        cart: Estimate(value=float(zeta), std=0.02 * float(zeta), source="log_decrement")
        for cart, zeta in enumerate(chain.zeta_carts, start=1)
    }
    low = exact(replace(chain, c=np.array([0.0, 1.0]) * chain.c))
    vague = [replace(r, magnitude_std=0.3 * r.magnitude) for r in low]
    alone = fit_bode(vague, bench=Setup(springs=(False, True, True)))
    assert alone.at_bound == ("c_1",)

    got = fit_bode(vague, bench=Setup(springs=(False, True, True)), decays=decays)
    assert got.at_bound == ("c_1", "c_2")
    # Two standard errors of the decays. A response with 30 % error adds no information.
    assert_allclose(got.chain.zeta_carts, chain.zeta_carts, rtol=0.04)
    assert {got.parameters[f"zeta_{cart}"].source for cart in (1, 2)} == {"log_decrement"}


def test_a_decay_that_the_response_rules_out_is_not_used():
    """If a decay contradicts a clearly measured peak, the fit does not use the decay."""
    undamped = exact(SHARP, np.sqrt(300.0) * np.array([0.5, 0.9, 0.99, 0.998, 1.002, 1.01, 1.1]))
    decay = Estimate(value=0.05, std=0.001, source="log_decrement")
    got = fit_bode(undamped, bench=WALLS[1], decays={1: decay})

    assert got.parameters["zeta"].at_bound
    assert got.chain.c[0] == 0


def test_a_decay_is_not_used_if_the_response_gives_the_damping():
    """If the response determines the damping, the decay is not used.

    The initial and the final estimate then come from different data.
    """
    responses = noisy("throne-1dof")
    decay = Estimate(value=0.3, std=1e-4, source="log_decrement")
    alone, given = (
        fit_bode(responses, bench=WALLS[1], decays=decays) for decays in (None, {1: decay})
    )
    assert given.parameters == alone.parameters


@pytest.mark.parametrize("change", ["delay", "sign"])
def test_phases_that_contradict_the_magnitudes_are_left_out(change):
    """If the phases have a delay or a reversed sign, they are left out and change no parameter."""
    responses = noisy("throne-2dof", phases=True)
    wrong = [
        replace(r, phase=r.phase - 0.00884 * r.omega if change == "delay" else r.phase + np.pi)
        for r in responses
        if r.phase is not None
    ]

    got = fit_bode(wrong, bench=WALLS[2])

    bare = [replace(r, phase=None, phase_std=None) for r in responses]
    expected = fit_bode(bare, bench=WALLS[2])
    assert ["phases" in one.message for one in (got, expected)] == [True, False]
    assert got.parameters == expected.parameters


def test_a_misfit_widens_the_errors():
    """If points scatter by 5 % but state errors of 0.01 %, standard errors correspond to 5 %."""
    chain, rng = PRESETS["throne-2dof"], np.random.default_rng(4)
    bold = [replace(r, magnitude_std=1e-4 * r.magnitude) for r in exact(chain)]
    scattered = [
        replace(r, magnitude=r.magnitude * (1 + 0.05 * rng.standard_normal(r.omega.size)))
        for r in bold
    ]

    got, honest = (fit_bode(one, bench=WALLS[2]) for one in (scattered, bold))

    assert ["away from" in one.message for one in (got, honest)] == [True, False]
    assert got.chi_square_per_dof > 1e4
    for name, value in chain.parameters().items():
        estimate, claimed = got.parameters[name], honest.parameters[name].std
        assert estimate.std is not None
        assert claimed is not None
        # All ten parameters of one noisy data set are within 4 standard errors.
        assert abs(estimate.value - value) < 4 * estimate.std
        # The error is 500 times that of 0.01 %; a limit of 100 times is safe.
        assert estimate.std > 100 * claimed


def test_a_table_is_judged_by_its_own_scatter():
    """If a table rounded to three digits states no errors, the fit finds the error of rounding."""
    chain = PRESETS["throne-3dof"]
    rounded = [
        replace(r, magnitude=np.array([float(f"{m:.3g}") for m in r.magnitude]), source="table")
        for r in exact(chain)
    ]

    got = fit_bode(rounded, bench=WALLS[3])

    gain = got.parameters["K_1"]
    assert gain.std is not None
    # Rounding to 3 digits errs by at most 0.05 to 0.5 %, about 0.1 % rms; 90 points determine 10
    # values.
    assert 5e-5 < gain.std / gain.value < 1e-3
    assert abs(gain.value - chain.parameters()["K_1"]) < 4 * gain.std


def test_the_errors_of_a_table_grow_with_its_scatter():
    """If the points of a table scatter twice as far, the standard errors are twice as large."""
    rng = np.random.default_rng(5)
    scatter = [(r, rng.standard_normal(r.omega.size)) for r in exact(PRESETS["throne-2dof"])]
    small, large = (
        fit_bode(
            [
                replace(r, magnitude=r.magnitude * (1 + share * z), source="table")
                for r, z in scatter
            ],
            bench=WALLS[2],
        ).parameters
        for share in (0.01, 0.02)
    )
    for name in ("K_1", "K_2", "omega_a", "omega_b"):
        first, second = small[name].std, large[name].std
        assert first is not None
        # The derivatives change with the parameters, which move by less than 2 %.
        assert second == pytest.approx(2 * first, rel=0.05)


def test_one_measured_cart_may_be_enough():
    """If the near spring is missing, the response of cart 1 alone determines both carts."""
    got = fit_bode(
        noisy("throne-2dof")[:1], bench=Setup(springs=(False, True, True)), initial=PAPER_STARTS[2]
    )

    for name, value in PRESETS["throne-2dof"].parameters().items():
        estimate = got.parameters[name]
        assert estimate.std is not None
        assert abs(estimate.value - value) < 4 * estimate.std  # ten parameters of one data set
    assert set(got.standardised) == {"1"}


def test_the_last_cart_alone_does_not_determine_two():
    """The response of cart 2 alone cannot determine two carts, and the error says so.

    The response has five coefficients, but the carts have seven parameters.
    """
    with pytest.raises(DataError, match="does not determine"):
        fit_bode(noisy("throne-2dof")[1:], bench=WALLS[2])


(ONE,) = noisy("throne-1dof")


@pytest.mark.parametrize(
    ("responses", "message"),
    [
        ([replace(ONE, magnitude=np.full(20, np.nan))], "finite"),
        ([replace(ONE, omega=np.linspace(-1, 1, 20))], "finite"),
        ([replace(ONE, cart=2)], "cart 2"),
        (
            [
                replace(
                    ONE,
                    omega=ONE.omega[:2],
                    magnitude=ONE.magnitude[:2],
                    magnitude_std=ONE.magnitude_std[:2],
                )
            ],
            "found 2",
        ),
        ([], "found none"),
    ],
)
def test_impossible_responses_are_refused(responses, message):
    """Infinite values, negative frequencies, impossible carts and too few points are refused."""
    with pytest.raises(DataError, match=message):
        fit_bode(responses, bench=WALLS[1])


def test_residuals_belong_to_their_points():
    """If one magnitude is off by ten standard errors, only its own residual is near ten."""
    responses = list(noisy("throne-3dof"))
    raised = responses[1].magnitude.copy()
    raised[7] += 10 * responses[1].magnitude_std[7]
    responses[1] = replace(responses[1], magnitude=raised)

    got = fit_bode(responses, bench=WALLS[3])

    assert {name: z.shape for name, z in got.standardised.items()} == {
        str(r.cart): r.omega.shape for r in responses
    }
    # The point pulls the fit towards itself, but only a little, as 90 points share 10 parameters.
    assert 5 < got.standardised["2"][7] < 13
