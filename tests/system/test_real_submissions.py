"""The pipeline on recordings of a real ECP 210 with springs wall-1 and 1-2, and dry friction."""

import pytest
from numpy.testing import assert_allclose

from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.ucsd import write_one_cart_submission, write_two_cart_submission


@pytest.fixture(scope="module")
def two_carts(real_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ucsd") / "two"
    write_two_cart_submission(folder, real_data, steps=(1, 2, 3, 4, 5))
    return analyse(load_submission(folder))


def test_two_carts_have_the_masses_and_springs_found_before(two_carts):
    """Masses and springs agree within 10 % with those of an earlier fit with viscous damping."""
    chain = two_carts.chain
    assert_allclose(chain.m, [5.5e-6, 3.7e-6], rtol=0.1)
    assert_allclose(chain.k[:2], [1.79e-3, 1.03e-3], rtol=0.1)
    assert chain.k[2] == 0.0


def test_an_outlying_repeat_is_left_out(two_carts):
    """The first of five repeats, which moved differently, is left out by name."""
    assert [(one.experiment, one.is_wrong) for one in two_carts.left_out] == [("both-1", False)]


def test_single_carts_have_their_frequencies_and_friction(two_carts):
    """Each cart alone has its own frequency, and friction is found in all decays of cart 2."""
    alone = {d.experiment: d for d in two_carts.log_decrements}
    for i in range(1, 6):
        assert 23.2 <= alone[f"alone-1-{i}"].omega_n <= 23.7
        assert 15.6 <= alone[f"alone-2-{i}"].omega_n <= 15.9
        assert alone[f"alone-2-{i}"].law.is_friction


def test_a_wrongly_logged_input_is_found(two_carts):
    """The PID run's logged input is found to differ from the model's in sign or scale."""
    closed = {h.cart: h for h in two_carts.hardware if h.loop == "closed"}
    assert set(closed) == {1, 2}
    # On the bench and in the model, the loop holds cart 1 at the set point.
    assert_allclose(closed[1].steady_state_model, 1000, rtol=0.05)
    assert_allclose(closed[1].steady_state_measured, 1000, rtol=0.05)
    scales = [h.input_scale for h in two_carts.hardware if h.input_scale is not None]
    assert scales
    assert all(abs(scale) > 1.5 or scale < 0 for scale in scales)


def test_every_skipped_stage_says_why(two_carts):
    """Without dwells the sine stage is skipped with a reason, and all other stages run."""
    assert "sine steady state" in {skip.stage for skip in two_carts.skipped}
    assert two_carts.fit.method == "time_fit"
    assert two_carts.feedback is not None


def test_steps_alone_suffice_for_one_cart(real_data, tmp_path):
    """From steps of one cart alone, gain, frequency and damping get initial and final values."""
    folder = write_one_cart_submission(tmp_path / "one", real_data)
    analysis = analyse(load_submission(folder))
    initial = {row.name: row.initial.value for row in analysis.rows if row.initial}
    final = {row.name: row.final.value for row in analysis.rows if row.final}
    assert 23.2 <= initial["omega_n"] <= 23.7
    assert_allclose(final["omega_n"], initial["omega_n"], rtol=0.03)
    assert_allclose(final["K"], initial["K"], rtol=0.1)
