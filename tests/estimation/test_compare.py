"""Two estimates of each parameter are compared, and tables are checked for physical laws."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.estimation.estimates import (
    DAMPING_LIMIT,
    GAIN_AND_FREQUENCY_LIMIT,
    combine_repeats,
    compare,
    motion_measured,
)
from pipeline.identify.model_checks import check_carts, check_rows
from pipeline.plant.chain import PRESETS, Chain
from pipeline.results import ChainFit, Estimate
from pipeline.setup import Setup
from tests.helpers.time_records import record_of


def _estimate(value, std=None, source="step"):
    return Estimate(value=value, std=std, source=source)


WALLS = Setup(springs=(True, True))


def _compared(before, after, *, name="zeta"):
    (row,) = compare({name: before}, final={name: after}, names=[name], bench=WALLS)
    return row


def _row(before, after, *, name="K", std=None, source="step"):
    first, second = _estimate(before, std, source), _estimate(after, std, "bode_fit")
    return _compared(first, second, name=name)


def _fit(chain, parameters=None):
    values = parameters or chain.parameters()
    names = (*(f"m_{i + 1}" for i in range(chain.n)), "k_1")
    return ChainFit(
        method="bode_fit",
        chain=chain,
        names=names,
        covariance=np.diag(np.full(len(names), 1e-12)),
        parameters={name: _estimate(value, 0.0, "bode_fit") for name, value in values.items()},
        chi_square_per_dof=1.0,
        dof=10,
        n_points=30,
        n_starts=1,
        converged=True,
        message="",
    )


def test_change_is_signed_and_in_percent_of_the_initial_value():
    """The change has a sign and is in percent of the initial value: 30.6 to 28.9 is −5.6 %."""
    row = _row(30.6, 28.9)
    assert row.change_percent == pytest.approx(100 * (28.9 - 30.6) / 30.6)
    assert (row.unit, row.consistent) == ("cm/V", True)


@pytest.mark.parametrize(
    ("name", "limit"), [("omega_n", GAIN_AND_FREQUENCY_LIMIT), ("zeta", DAMPING_LIMIT)]
)
def test_limits_are_tight_for_frequencies_and_loose_for_damping(name, limit):
    """For each kind of number, a change within its limit agrees and one beyond it disagrees."""
    assert _row(1.0, 1.0 + 0.999 * limit / 100, name=name).consistent
    assert not _row(1.0, 1.0 + 1.001 * limit / 100, name=name).consistent


@pytest.mark.parametrize(("std", "outcome"), [(0.05, "fail"), (0.1, "skip")])
def test_a_large_error_does_not_make_two_numbers_agree(std, outcome):
    """Two numbers 30 % apart never agree; if their errors are large, there is no verdict."""
    row = _row(1.0, 1.3, std=std)
    assert row.consistent is (False if outcome == "fail" else None)
    (check,) = check_rows([row])
    assert check.outcome == outcome


def test_a_final_value_at_its_bound_is_not_used():
    """If the fit holds a damping at zero, the table has no final value and no verdict."""
    final = Estimate(value=0.0, std=None, source="bode_fit", at_bound=True)
    row = _compared(_estimate(0.017, 1e-4, "log_decrement"), final)
    assert (row.final, row.consistent, row.change_percent) == (None, None, None)
    assert row.note


@pytest.mark.parametrize(
    ("name", "std", "there"), [("K", 0.19, True), ("K", 0.21, False), ("zeta", 0.6, True)]
)
def test_a_very_uncertain_final_value_is_not_determined(name, std, there):
    """If a final value's error is as large as the limit, the value is called "not determined".

    The limit is 15 % for a gain and 50 % for a damping ratio.
    """
    row = _row(1.0, 1.3, name=name, std=std)
    assert (row.final is not None) is there
    assert (row.note.startswith("not determined")) is not there
    assert len(check_rows([row])) == there


def test_an_estimate_is_not_compared_with_itself():
    """If the final damping comes from the decay, it is not compared with the initial one."""
    (row,) = compare(
        {"zeta": _estimate(0.017, 1e-4, "log_decrement")},
        final={"zeta": _estimate(0.017, 1e-4, "log_decrement")},
        names=["zeta"],
        bench=Setup(springs=(True, True)),
    )
    assert row.final is not None
    assert (row.consistent, row.change_percent) == (None, None)


def test_an_assumed_value_is_never_judged():
    """If the initial value was only assumed, the change is shown without a verdict.

    An example is the paper's ζ = 0.1.
    """
    row = _row(0.1, 0.03, name="zeta_b", source="assumed")
    assert row.consistent is None
    assert row.change_percent == pytest.approx(-70.0)
    assert not check_rows([row])


positive = st.floats(0.2, 5.0)


@given(st.integers(2, 4), st.data())
def test_real_chains_pass_every_law(n, data):
    """Whatever the masses and springs, a real lightly damped chain breaks no law."""
    draw = lambda size: np.array(data.draw(st.lists(positive, min_size=size, max_size=size)))  # noqa: E731
    chain = Chain(m=draw(n), c=0.02 * draw(n), k=draw(n + 1))
    checks = check_carts(_fit(chain), bench=Setup(springs=(True,) * (n + 1)))
    assert [check.id for check in checks if check.outcome == "fail"] == []


def test_a_negative_spring_is_named():
    """If a fitted spring is negative by more than its standard error, a failed check names it."""
    chain = PRESETS["throne-3dof"]
    negative = replace(chain, k=np.array([-0.003, *chain.k[1:]]))
    checks = {c.id: c for c in check_carts(_fit(negative), bench=Setup(springs=(True,) * 4))}
    assert checks["physical.signs"].outcome == "fail"
    assert "k_1" in checks["physical.signs"].message


def test_the_papers_third_table_breaks_two_redundancies():
    """The paper's Table 3 violates the redundancies R4 and R5, but passes every check of order."""
    table = {
        "K_1": 39.4, "K_2": 30.6, "K_3": 16.0,
        "omega_a": 6.9, "omega_b": 24.1, "omega_c": 34.1,
        "zeta_a": 0.25, "zeta_b": 0.03, "zeta_c": 0.03,
        "omega_x": 20.2, "omega_y": 31.6, "zeta_x": 0.04, "zeta_y": 0.03,
        "omega_1": 20.0, "omega_2": 27.2, "omega_3": 25.6,
        "zeta_1": 0.08, "zeta_2": 0.02, "zeta_3": 0.04,
    }  # fmt: skip
    checks = check_carts(_fit(PRESETS["throne-3dof"], table), bench=Setup(springs=(True,) * 4))
    assert all(c.outcome == "pass" for c in checks if c.id.startswith("order."))
    value = {c.id: c.value for c in checks if c.value is not None}
    assert value["redundancy.R4"] > 0.1
    assert value["redundancy.R5"] > 0.02


@pytest.mark.parametrize(
    ("values", "std", "error"),
    [
        ([1.00, 1.02, 0.98, 1.01, 0.99], [1e-4] * 5, np.sqrt(2.5e-4 / 5)),  # of their spread
        ([1.0, 1.0], [0.3, 0.4], 0.25),  # √(0.3² + 0.4²) / 2
    ],
)
def test_repeats_have_the_error_of_their_spread_or_of_their_errors(values, std, error):
    """The mean of repeats has the larger one of both errors."""
    got = combine_repeats(values, std=std, source="step")
    assert (got.value, got.std) == pytest.approx((1.0, error), rel=1e-12)


def test_a_drift_and_a_sine_are_measured_where_they_are():
    """A motion counts at its own frequency, but not below two periods of the record."""
    t = np.arange(2000) / 113.0
    lowest = 2 * 2 * np.pi / (t.size / 113.0)
    for motion in (0.3 * t, np.sin(20 * t)):
        assert motion_measured([record_of(t, None, motion[None], kind="decay")]).min() > lowest
    exact = motion_measured([record_of(t, None, np.sin(20 * t)[None], kind="decay", count=0.0)])
    assert np.abs(exact - 20.0).min() < lowest / 4
