"""The time-domain fit finds unknown chains without starting values."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.estimation.noise import long_run_variance, score_covariance
from pipeline.estimation.parametrisation import Parametrisation, find_modes
from pipeline.estimation.time_fit import compare, fit_records, open_window, usable_segment
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ChainFit, Record
from pipeline.setup import Setup
from pipeline.submission import load_submission
from tests.helpers.time_records import decay_record, random_chain, record_of, step_record
from tests.helpers.ucsd import write_two_cart_submission


def std(fit: ChainFit, name: str) -> float:
    """Return the standard error of a named parameter, which must have one."""
    found = fit.parameters[name].std
    assert found is not None
    return found


def errors(fit: ChainFit, chain: Chain) -> np.ndarray:
    """Return the error of each named parameter, divided by its standard error."""
    return np.array(
        [
            (fit.parameters[name].value - v) / std(fit, name)
            for name, v in chain.parameters().items()
        ]
    )


def misfit(record: Record, chain: Chain, parametrisation: Parametrisation, *, at_rest: bool = True):
    theta = parametrisation.pack(chain)
    modes = find_modes(
        chain,
        free=record.free,
        parametrisation=parametrisation,
        dp_dtheta=parametrisation.dp_dtheta(theta),
    )
    return compare(replace(open_window(record), at_rest=at_rest), modes)


# ------------------------------------------------------- response and Jacobian


@pytest.mark.parametrize("zeta", [0.1, 1.0, 1.5])
@pytest.mark.parametrize("at_rest", [True, False])
def test_the_jacobian_is_that_of_the_misfit(zeta, at_rest):
    """The Jacobian agrees with finite differences, even if two poles of a cart coincide."""
    m, k = np.array([2e-4, 1e-4]), np.array([0.03, 0.04, 0.02])
    chain = Chain(m=m, c=2 * zeta * np.sqrt(m * (k[:-1] + k[1:])), k=k)
    record = step_record(chain, rng=np.random.default_rng(1), noise=0.01)
    parametrisation = Parametrisation(bench=Setup(springs=(True, True, True)))
    theta = parametrisation.pack(chain) + 0.01

    def cost(theta):
        return 0.5 * np.sum(
            misfit(record, parametrisation.unpack(theta), parametrisation, at_rest=at_rest).residual
            ** 2
        )

    here = misfit(record, parametrisation.unpack(theta), parametrisation, at_rest=at_rest)
    gradient = np.einsum("pij,ij->p", here.jacobian, here.residual)
    step = 1e-5 * np.eye(theta.size)
    numeric = [(cost(theta + e) - cost(theta - e)) / 2e-5 for e in step]
    # Central differences err by the squared step times the third derivative: 1e-10 of a cost of 1e5
    # to 1e6, compared with gradients of 1e3 to 1e5.
    assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-5 * np.max(np.abs(gradient)))


def test_a_band_limited_input_is_used_as_such():
    """If an input is declared band-limited, its response is computed to 1e-4 of the motion.

    If the input were treated as held between samples, the error would be above 1e-2.
    """
    chain, t = PRESETS["throne-2dof"], np.arange(600) / 113.0
    u = 0.05 * np.sin(15 * t) * np.sin(np.pi * t / t[-1]) ** 2
    y = simulate_linear(chain, t, u, hold="band_limited")
    record = record_of(t, u, y, kind="sweep", count=0.0, hold="band_limited")
    parametrisation = Parametrisation(bench=Setup(springs=(True, True, True)))

    def off(record):
        left = misfit(record, chain, parametrisation)
        return np.max(np.abs(left.residual * open_window(record).sigma[:, None])) / np.ptp(y)

    # The input is held at eight times the rate, which errs by (15 rad/s / 8 / 113 Hz)² / 24 = 1e-5.
    assert off(record) < 1e-4
    assert off(replace(record, hold="zero_order")) > 1e-2


# ------------------------------------------------------------------- convergence


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_exact_records_give_the_chain(n):
    """From records without noise or rounding, the fit finds the chain without starting values."""
    rng = np.random.default_rng(n)
    chain, springs = random_chain(n, rng)
    record = step_record(chain, rng=rng, noise=0.0, count=0.0)
    fit = fit_records([record], bench=Setup(springs=springs))
    assert fit.converged
    assert fit.n_starts == 1
    # The search stops at 1e-9 of the cost; rounding times to 1e-12 s keeps the cost above zero.
    assert_allclose(fit.chain.m, chain.m, rtol=1e-6)
    assert_allclose(fit.chain.c, chain.c, rtol=1e-5)
    assert_allclose(fit.chain.k, chain.k, rtol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("all_springs", [False, True])
def test_unseen_chains_are_found_from_noisy_records(n, all_springs):
    """Three steps determine a random chain, even if a missing spring is declared as present."""
    rng = np.random.default_rng(10 + n)
    for _ in range(3):
        chain, springs = random_chain(n, rng)
        records = [
            step_record(chain, rng=rng, swing=swing, jitter=0.2, noise=0.001, id=f"step {swing}")
            for swing in (1.0, 0.6, -1.0)
        ]
        fit = fit_records(
            records, bench=Setup(springs=(True,) * (n + 1) if all_springs else springs)
        )
        assert fit.converged
        # Of 3 × 4 × at most 17 errors, one exceeds 4.5 standard errors in only 1 of 700 such tests.
        assert np.max(np.abs(errors(fit, chain))) < 4.5
        # chi² of over 2000 positions is within 0.1 of 1. A cart at rest stays on one count, which
        # lowers chi² by up to 0.3.
        assert 0.6 < fit.chi_square_per_dof < 1.15


def test_held_carts_and_decays_are_fitted_together_with_steps():
    """Steps with a held cart and decays of single carts are fitted together with other steps."""
    rng = np.random.default_rng(3)
    chain = PRESETS["throne-3dof"]
    records = [
        step_record(chain, rng=rng, id="all"),
        step_record(chain, rng=rng, free=(1, 2), id="two", duration=5.0, rate=200.0),
        decay_record(chain, free=(2,), rng=rng, id="second"),
        decay_record(chain, free=(2, 3), rng=rng, id="last two"),
    ]
    fit = fit_records(records, bench=Setup(springs=(True,) * 4))
    assert fit.converged
    assert np.max(np.abs(errors(fit, chain))) < 4
    alone = fit_records(records[:1], bench=Setup(springs=(True,) * 4))
    # Decays of cart 3 determine it better than a step that acts through two springs.
    assert std(fit, "zeta_3") < 0.8 * std(alone, "zeta_3")


def test_a_record_that_starts_in_motion_is_fitted_with_a_note():
    """If a record begins in motion, a note says so, and the fit is as good as from rest."""
    rng = np.random.default_rng(4)
    chain = PRESETS["throne-2dof"]
    x0 = np.array([0.3, -4.0, -0.2, 3.0])  # cm, cm/s
    records = [
        step_record(chain, rng=rng, id="quiet"),
        step_record(chain, rng=rng, x0=x0, id="cut"),
    ]
    fit = fit_records(records, bench=Setup(springs=(True,) * 3))
    assert "start: cut" in fit.message
    assert np.max(np.abs(errors(fit, chain))) < 4


def test_a_record_whose_input_is_always_on_starts_from_rest():
    """If the log begins at the step and the input never changes, the gain is found all the same."""
    rng = np.random.default_rng(7)
    chain = PRESETS["throne-1dof"]
    t = np.arange(600) / 113.0
    u = np.full(t.size, 1.0 / chain.static_gains()[0])
    y = simulate_linear(chain, t, u)
    record = record_of(t, u, y + 0.0005 * rng.standard_normal(y.shape), kind="step")
    fit = fit_records([record], bench=Setup(springs=(True, False)))
    assert fit.converged
    assert np.max(np.abs(errors(fit, chain))) < 4


def test_a_cart_that_was_not_measured_is_still_found():
    """If the middle cart was not measured, the other two still determine it."""
    rng = np.random.default_rng(5)
    chain = PRESETS["throne-3dof"]
    whole = [step_record(chain, rng=rng, swing=swing, id=f"{swing}") for swing in (1.0, 0.5)]
    records = [replace(r, y=r.y[[0, 2]], carts=(1, 3), resolution=r.resolution[:2]) for r in whole]
    fit = fit_records(records, bench=Setup(springs=(False, True, True, True)))
    assert fit.converged
    assert np.max(np.abs(errors(fit, chain))) < 4


def test_a_body_on_no_spring_has_mass_and_damping():
    """A cart without springs is fitted as a rigid body, even if springs were declared."""
    truth = Chain(m=np.array([2e-4]), c=np.array([5e-4]), k=np.zeros(2))
    t = np.arange(500) / 113.0
    u = 0.01 * np.sign(np.sin(4 * t))
    y = simulate_linear(truth, t, u)
    rng = np.random.default_rng(6)
    record = record_of(t, u, y + 0.0005 * rng.standard_normal(y.shape), kind="step")
    for springs in ((False, False), (True, True)):
        fit = fit_records([record], bench=Setup(springs=springs))
        assert np.max(np.abs(errors(fit, truth))) < 4
    assert "zero: k_1" in fit.message


def test_a_damping_at_its_bound_has_no_standard_error():
    """If the fit holds the damping of an undamped cart at zero, it has no standard error."""
    chain = Chain(m=np.array([2e-3]), c=np.array([0.0]), k=np.array([0.6, 0.0]))
    fits = [
        fit_records(
            [step_record(chain, rng=np.random.default_rng(seed))], bench=Setup(springs=(True,) * 2)
        )
        for seed in range(6)
    ]
    held = [fit for fit in fits if fit.at_bound]
    assert held
    for fit in held:
        zeta = fit.parameters["zeta"]
        assert (zeta.value, zeta.std, zeta.at_bound) == (0.0, None, True)
        assert fit.at_bound == ("c_1",)
        assert fit.names == ("m_1", "c_1", "k_1")  # c_1 is still a parameter
        assert fit.covariance[1, 1] > 0


# ------------------------------------------------------------- what cannot be done


TWO_CARTS = PRESETS["throne-2dof"]


@pytest.mark.parametrize(
    ("record", "springs", "missing"),
    [
        # decays give no mass in units of the input
        (decay_record(TWO_CARTS, free=(1, 2), rng=np.random.default_rng(8)), 3, "drives cart 1"),
        # cart 2 was held, so its mass is unknown
        (step_record(TWO_CARTS, rng=np.random.default_rng(9), free=(1,)), 3, r"\w_\d"),
        # the motor moves only the first cart
        (step_record(TWO_CARTS, rng=np.random.default_rng(9)), 0, "spring between carts 1 and 2"),
    ],
)
def test_what_the_records_do_not_determine_is_named(record, springs, missing):
    """Decays alone, a held cart and a broken chain are refused, with what is missing."""
    with pytest.raises(DataError, match=missing):
        fit_records([record], bench=Setup(springs=(True, bool(springs), True)))


def test_a_record_without_motion_is_left_out_with_a_message():
    """A record without motion is left out of the fit, and the message names it."""
    rng = np.random.default_rng(11)
    chain = PRESETS["throne-1dof"]
    good = step_record(chain, rng=rng)
    still = replace(good, id="still", kind="decay", u=None, y=np.zeros_like(good.y))
    fit = fit_records([good, still], bench=Setup(springs=(True, True)))
    assert "left out: still:" in fit.message
    assert np.max(np.abs(errors(fit, chain))) < 4


def test_records_that_no_chain_explains_give_no_fit():
    """If no chain explains the records, as with a reversed input, the fit says so."""
    rng = np.random.default_rng(12)
    record = step_record(PRESETS["throne-1dof"], rng=rng)
    assert record.u is not None
    fit = fit_records([replace(record, u=-record.u)], bench=Setup(springs=(True, True)))
    assert not fit.converged
    assert "no chain reproduces" in fit.message


def test_a_decay_is_used_from_its_release_on():
    """A decay is used from less than a quarter of a period after its release."""
    record = decay_record(PRESETS["throne-1dof"], free=(1,), rng=np.random.default_rng(13))
    start = record.t[usable_segment(record)][0]
    # The release is at 1.5 s; a quarter of the period of 0.48 s later, half the swing is lost.
    assert 1.5 < start < 1.5 + 0.12


# ------------------------------------------------------------- standard errors


def test_readings_at_rest_share_the_rounding_of_the_encoder():
    """While nothing moves, all readings share a rounding error, whose variance is step²/12."""
    window = open_window(step_record(PRESETS["throne-2dof"], rng=np.random.default_rng(1)))
    got = window.informed(np.zeros_like(window.y), at_rest=True)  # no noise dithers the rounding
    assert_allclose(got.shared * got.sigma**2, window.step**2 / 12, rtol=1e-12)


def test_correlated_residuals_widen_the_error():
    """The variance of a sum of correlated residuals is found from their spectrum."""
    rng = np.random.default_rng(14)
    n, phi, runs = 1000, 0.8, 60
    slow, fast = np.ones((1, 1, n)), (-1.0) ** np.arange(n, dtype=np.float64)[None, None]
    ratios = np.zeros(3)
    for _ in range(runs):
        residual = np.zeros((1, n))
        for i, shock in enumerate(rng.standard_normal(n - 1), start=1):
            residual[0, i] = phi * residual[0, i - 1] + shock
        ratios[0] += long_run_variance(residual) * (1 - phi) ** 2
        ratios[1] += score_covariance(residual, slow)[0, 0] / n * (1 - phi) ** 2
        ratios[2] += score_covariance(residual, fast)[0, 0] / n * (1 + phi) ** 2
    # Parzen's window over n/3 lags has 11 degrees of freedom, but only half as many at either end
    # of the spectrum: one ratio errs by sqrt(2/5.5) = 0.6, and the mean of 60 by 0.08.
    assert_allclose(ratios / runs, 1.0, atol=0.3)
    assert long_run_variance(fast[0]) == 1.0  # not below the mean square


# -------------------------------------------------------------------- real carts


def test_real_steps_give_the_known_masses_and_springs(real_data, tmp_path):
    """Four real steps give the masses and springs that an independent fit also found."""
    folder = write_two_cart_submission(tmp_path / "two", real_data, steps=(2, 3, 4, 5))
    records = [r for r in read_data(load_submission(folder)).records if r.free == (1, 2)]
    steps = [record for record in records if record.kind == "step"]
    fit = fit_records(steps, bench=Setup(springs=(True, True, False)))
    assert fit.converged
    # The reference values have two digits, and real carts have friction, unlike the chain.
    assert_allclose(fit.chain.m, [5.5e-6, 3.7e-6], rtol=0.1)
    assert_allclose(fit.chain.k, [1.79e-3, 1.03e-3, 0], rtol=0.1)
    assert_allclose(fit.parameters["omega_1"].value, 22.6, rtol=0.1)
    assert_allclose(fit.parameters["omega_2"].value, 16.6, rtol=0.1)
    # Friction leaves residuals far above the encoder noise.
    assert fit.chi_square_per_dof > 10
