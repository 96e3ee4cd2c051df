"""Checks of single estimates do not claim more than the recordings show."""

from dataclasses import replace

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.identify.findings import say
from pipeline.identify.model_checks import check_rows, check_steps
from pipeline.results import Estimate, ParameterRow, StepGain
from pipeline.setup import Setup
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.examples import analysed


def test_gain_intervals_of_a_sticking_cart_may_be_disjoint():
    """If a cart sticks, gain intervals of two steps may be disjoint and exclude the true gain."""
    steps = [
        StepGain(
            experiment=f"step-{i}",
            cart=1,
            edges=(),
            gain=sum(interval) / 2,
            gain_std=0.1,
            rest_shift=0.012,
            interval=interval,
            note="",
        )
        for i, interval in enumerate([(29.33, 30.55), (27.85, 28.75)])
    ]
    checks = check_steps(steps, bench=Setup(springs=(True, True)))
    assert [(check.outcome, check.code) for check in checks] == [("fail", "sticks")] * 2


@pytest.mark.slow
@pytest.mark.sample
def test_a_step_that_friction_stops_short_does_not_pass(tmp_path):
    """If friction stops a cart short at every edge, the step does not pass the check.

    In the test, some steps have one gain at all edges; only other recordings show the friction.
    """
    hidden = "coulomb_friction:cart=1,force=0.003"
    done = CliRunner().invoke(
        app,
        ["simulate", "--preset", "throne-1dof", "--hide", hidden, "--seed", "3",
         "--out", str(tmp_path / "s")],
    )  # fmt: skip
    assert done.exit_code == 0
    analysis = analyse(load_submission(tmp_path / "s"), design=False)
    alike = [gain for gain in analysis.step_gains if gain.interval is None]
    assert alike  # some steps have the same gain at all edges
    outcomes = {check.about: check for check in analysis.checks if check.kind == "step"}
    for gain in alike:
        check = outcomes[f"{gain.experiment}.cart_1"]
        assert check.outcome == "skip"
        assert "decay-1a" in check.message
    assert not any(check.outcome == "pass" for check in outcomes.values())


def test_one_edge_does_not_show_whether_a_cart_sticks():
    """A step with one edge cannot show whether a cart sticks, so the check is skipped.

    A step that goes on and off again has two edges and is checked.
    """
    (gain, *_) = analysed("one-cart").step_gains
    both, one = check_steps(
        [gain, replace(gain, edges=gain.edges[:1], rest_shift=None)],
        bench=Setup(springs=(True, True)),
    )
    assert (both.outcome, one.outcome) == ("pass", "skip")
    assert say("step_with_one_edge") in one.message
    assert "both edges" in both.message


def row(name: str, source: str, final: str) -> ParameterRow:
    """Return a parameter whose two estimates disagree."""
    return ParameterRow(
        name=name,
        unit="",
        initial=Estimate(value=1.0, std=0.01, source=source, experiments=("run-7",)),
        final=Estimate(value=2.0, std=0.01, source=final),
        change_percent=100.0,
        change_sigmas=70.0,
        consistent=False,
        independent=True,
    )


def test_advice_mentions_only_the_sources_of_the_estimates():
    """Advice mentions dwells, decays or steps only if the estimates come from them."""
    said = {
        (name, source, final): check_rows([row(name, source, final)])[0].message
        for name, source, final in (
            ("K_1", "step", "time_fit"),
            ("K_1", "step", "bode_fit"),
            ("K_1", "frequency_response", "bode_fit"),
            ("omega_1", "log_decrement", "time_fit"),
            ("omega_a", "frequency_response", "time_fit"),
            ("zeta_1", "log_decrement", "time_fit"),
        )
    }
    for (_, source, final), text in said.items():
        assert ("dwell" in text) <= (final == "bode_fit")
        assert ("peaks" in text) <= (source == "log_decrement")
        assert ("levels" in text) == (source == "step")
        assert ("run-7" in text) == ("peaks" in text or "levels" in text)
    assert "decay" not in " ".join(said.values())
