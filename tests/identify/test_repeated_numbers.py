"""Repeats of one number are compared: whether they agree, which run is odd, and why."""

from dataclasses import replace

import pytest

from pipeline.identify.repeats import Repeats, compare_repeats
from pipeline.results import Estimate, LogDecrement, StepEdge, StepGain
from tests.helpers.analysis_factory import make_analysis

SWING = make_analysis(1).log_decrements[0]


def decay(run: str, omega: float, *, std: float = 1e-3) -> LogDecrement:
    return replace(SWING, experiment=run, cart=1, omega_n=omega, omega_n_std=std)


def step(run: str, gain: float, *, cart: int = 1, std: float = 0.01, size: float = 1.0) -> StepGain:
    edge = StepEdge(
        t=1.0,
        u_before=0.0,
        u_after=size,
        level_before=0.0,
        level_after=gain * size,
        window_before=(0.0, 1.0),
        window_after=(3.0, 4.0),
        gain=gain,
        gain_std=std,
    )
    return StepGain(
        experiment=run,
        cart=cart,
        edges=(edge,),
        gain=gain,
        gain_std=std,
        rest_shift=None,
        interval=None,
    )


def compared(decays=(), steps=(), *, dwells: bool = False, **fitted: float) -> Repeats:
    """Return the comparison with a fit of these parameters, to dwells if `dwells` is true."""
    estimates = {k: Estimate(value=v, std=0.01, source="bode_fit") for k, v in fitted.items()}
    by_dwells = estimates if dwells else {}
    return compare_repeats(decays, steps, carts=2, fitted=estimates, dwells=by_dwells)


def test_repeats_that_agree_pass():
    """Three gains within 2 % pass one check; a number that is measured once gets no check."""
    found = compared([decay("a", 20.0)], [step(f"{i}", g) for i, g in enumerate((2.0, 2.04, 2.02))])
    (check,) = found.checks
    assert (check.id, check.outcome) == ("repeats.K_1", "pass")
    assert found.odd == {}
    assert found.undecided == ()


def test_two_different_numbers_do_not_show_which_is_wrong():
    """If two repeats differ by a factor of 1000, the check fails, but neither run is called odd."""
    found = compared([decay("a", 20.0), decay("b", 0.02)])
    assert [c.outcome for c in found.checks if c.id == "repeats.omega_1"] == ["fail"]
    assert found.odd == {}
    assert found.undecided == ("omega_1",)


def test_the_fit_shows_which_of_two_numbers_is_wrong():
    """If the other records agree with 20 rad/s, a run that gives 0.02 rad/s is called odd."""
    found = compared([decay("a", 20.0), decay("b", 0.02)], omega_1=20.3)
    assert list(found.odd) == ["b"]
    assert found.odd["b"].excludes == "wrong"
    assert found.odd["b"].code == "odd_number"
    assert found.undecided == ()


def test_without_a_fit_the_majority_of_repeats_decides():
    """If one of three gains is off by a quarter, its run is odd, though the reason is unknown."""
    found = compared(steps=[step("a", 2.0), step("b", 2.5), step("c", 2.01)])
    assert list(found.odd) == ["b"]
    assert found.odd["b"].excludes == "odd"
    assert [check.outcome for check in found.checks] == ["fail"]


def test_a_run_with_one_odd_number_is_named():
    """A run in which only K_1 is odd is named, and the check of K_2 still passes."""
    steps = [step(run, gain, cart=cart) for run in "abc" for cart, gain in ((1, 2.0), (2, 1.5))]
    steps += [step("d", 2.3, cart=1), step("d", 1.5, cart=2)]
    found = compared(steps=steps)
    assert list(found.odd) == ["d"]
    assert found.odd["d"].excludes == "odd"
    assert {check.id: check.outcome for check in found.checks} == {
        "repeats.K_1": "fail",
        "repeats.K_2": "pass",
    }


def test_a_run_with_a_large_error_is_not_odd():
    """A run with a gain off by a quarter is odd, unless the gain's standard error is large."""
    steps = [step("a", 2.0), step("b", 2.6), step("c", 2.05), step("vague", 2.5, std=0.2)]
    assert list(compared(steps=steps, K_1=2.0).odd) == ["b"]


def damped(run: str, zeta: float, *, std: float = 1e-4) -> LogDecrement:
    return replace(decay(run, 20.0), zeta=zeta, zeta_std=std)


def test_dampings_of_repeats_are_compared():
    """A decay with three times the damping of two others is odd; up to 1.5 times is accepted."""
    found = compared([damped("a", 0.03), damped("b", 0.031), damped("c", 0.09)])
    assert list(found.odd) == ["c"]
    assert found.odd["c"].excludes == "odd"
    assert compared([damped("a", 0.03), damped("b", 0.04)]).undecided == ()
    assert compared([damped("a", 0.03), damped("b", 0.09)]).undecided == ("zeta_1",)
    assert compared([damped("a", 0.03), damped("b", 0.09, std=0.02)]).undecided == ()


def test_uncertain_numbers_neither_agree_nor_contradict():
    """Two uncertain gains that differ by a third neither pass nor fail the check."""
    found = compared(steps=[step("a", 2.0, std=0.2), step("b", 2.7, std=0.2)])
    assert [check.outcome for check in found.checks] == ["skip"]
    assert found.odd == {}
    assert found.undecided == ()


def test_gains_that_depend_on_the_step_size_are_not_odd():
    """If a cart sticks and small steps give less gain, the check fails, but no run is odd."""
    found = compared(
        steps=[
            *(step(f"small-{i}", 1.5, size=0.5) for i in range(2)),
            *(step(f"large-{i}", 2.0, size=1.0) for i in range(3)),
        ]
    )
    assert [check.outcome for check in found.checks] == ["fail"]
    assert found.odd == {}
    assert found.undecided == ()


@pytest.mark.parametrize(("gain", "excludes"), [(20.0, "wrong"), (-2.06, "odd"), (-20.0, "wrong")])
def test_steps_with_the_opposite_sign_of_the_dwells_may_be_right(gain, excludes):
    """Steps that agree on a gain ten times that of the dwells are wrong; a logged sign is legal."""
    found = compared(steps=[step("a", gain), step("b", gain, size=2.0)], dwells=True, K_1=2.0)
    assert {run: (one.code, one.excludes) for run, one in found.odd.items()} == {
        "a": ("odd_beside_dwells", excludes),
        "b": ("odd_beside_dwells", excludes),
    }
