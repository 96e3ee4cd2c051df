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


def damped(run: str, zeta: float, *, std: float = 1e-4) -> LogDecrement:
    return replace(decay(run, 20.0), zeta=zeta, zeta_std=std)


def compared(decays=(), steps=(), *, dwells: bool = False, **fitted: float) -> Repeats:
    """Return the comparison with a fit of these parameters, to dwells if `dwells` is true."""
    estimates = {k: Estimate(value=v, std=0.01, source="bode_fit") for k, v in fitted.items()}
    by_dwells = estimates if dwells else {}
    return compare_repeats(decays, steps, carts=2, fitted=estimates, dwells=by_dwells)


APART = [decay("a", 20.0), decay("b", 0.02)]
DAMPED = [damped("a", 0.03), damped("b", 0.031), damped("c", 0.09)]
GAINS = [step("a", 2.0), step("b", 2.5), step("c", 2.01)]
LARGE_ERROR = [step("a", 2.0), step("b", 2.6), step("c", 2.05), step("vague", 2.5, std=0.2)]
BY_SIZE = [step(f"{i}", gain, size=gain) for i, gain in enumerate((1.0, 1.0, 2.0, 2.0, 2.0))]
ONE_ODD = [step(run, gain, cart=cart) for run in "abc" for cart, gain in ((1, 2.0), (2, 1.5))]
ONE_ODD += [step("d", 2.3, cart=1), step("d", 1.5, cart=2)]
CASES = {
    # name: decays, steps, fitted; then outcomes of checks, odd runs, undecided numbers
    "alike": ([decay("a", 20.0)], [step(f"{i}", g) for i, g in enumerate((2.0, 2.04, 2.02))], {},
              {"K_1": "pass"}, {}, ()),  # a number that is measured once gets no check
    "two differ": (APART, [], {}, {"omega_1": "fail", "zeta_1": "pass"}, {}, ("omega_1",)),
    "the fit decides": (APART, [], {"omega_1": 20.3}, {"omega_1": "fail", "zeta_1": "pass"},
                        {"b": ("odd_number", "wrong")}, ()),
    "the majority decides": ([], GAINS, {}, {"K_1": "fail"}, {"b": ("odd_number", "odd")}, ()),
    "one number of a run": ([], ONE_ODD, {}, {"K_1": "fail", "K_2": "pass"},
                            {"d": ("odd_number", "odd")}, ()),
    "a large error": ([], LARGE_ERROR, {"K_1": 2.0}, {"K_1": "fail"},
                      {"b": ("odd_number", "odd")}, ()),
    "uncertain": ([], [step("a", 2.0, std=0.2), step("b", 2.7, std=0.2)], {}, {"K_1": "skip"},
                  {}, ()),
    "by the step size": ([], BY_SIZE, {}, {"K_1": "fail"}, {}, ()),  # the cart sticks
    "thrice the damping": (DAMPED, [], {}, {"omega_1": "pass", "zeta_1": "fail"},
                           {"c": ("odd_number", "odd")}, ()),
    "two dampings": (DAMPED[1:], [], {}, {"omega_1": "pass", "zeta_1": "fail"}, {}, ("zeta_1",)),
    "1.3 times the damping": ([damped("a", 0.03), damped("b", 0.04)], [], {},
                              {"omega_1": "pass", "zeta_1": "pass"}, {}, ()),
    "an uncertain damping": ([damped("a", 0.03), damped("b", 0.09, std=0.02)], [], {},
                             {"omega_1": "pass", "zeta_1": "skip"}, {}, ()),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_repeats_are_compared(name):
    """Repeats agree, or the fit or the majority shows which run is odd, or it stays undecided."""
    decays, steps, fitted, outcomes, odd, undecided = CASES[name]
    found = compared(decays, steps, **fitted)
    assert {check.parameter: check.outcome for check in found.checks} == outcomes
    assert {run: (one.code, one.excludes) for run, one in found.odd.items()} == odd
    assert found.undecided == undecided


@pytest.mark.parametrize(("gain", "excludes"), [(20.0, "wrong"), (-2.06, "odd"), (-20.0, "wrong")])
def test_steps_with_the_opposite_sign_of_the_dwells_may_be_right(gain, excludes):
    """Steps that agree on a gain ten times that of the dwells are wrong; a logged sign is legal."""
    found = compared(steps=[step("a", gain), step("b", gain, size=2.0)], dwells=True, K_1=2.0)
    assert {run: (one.code, one.excludes) for run, one in found.odd.items()} == {
        "a": ("odd_beside_dwells", excludes),
        "b": ("odd_beside_dwells", excludes),
    }
