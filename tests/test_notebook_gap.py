"""`explain` in a notebook gives tables and systems with the results of `cartlab gap`."""

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

import pipeline
from pipeline.errors import ConfigError
from pipeline.notebook import ExplainedGap, explain
from pipeline.plant.catalogue import find_effect
from pipeline.plant.effect import effect_name
from pipeline.report.compared_runs import compare_runs
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.words.progress import silent

FORCE, LAG = 0.004, 0.02  # V, s


@pytest.fixture(scope="module")
def gap(tmp_path_factory) -> ExplainedGap:
    """Return the gap of one cart with dry friction and a motor that lags."""
    folder = tmp_path_factory.mktemp("explained") / "lab"
    hide = [f"coulomb_friction:cart=1,force={FORCE}", f"actuator_lag:time_constant={LAG}"]
    bench = prepare_bench(preset="throne-1dof", hide=hide)
    write_submission(folder, bench, seed=0, compact=True)
    toml = folder / "submission.toml"
    head, *runs = toml.read_text(encoding="utf-8").split("[[experiments]]")
    kept = [run for run in runs if 'kind = "sine"' not in run]  # the dwells take longest
    toml.write_text("[[experiments]]".join([head, *kept]), encoding="utf-8")
    return explain(folder)


@pytest.mark.slow
@pytest.mark.sample
def test_effects_are_a_table(gap):
    """The table has one row for each parameter of an effect, in the order found, with its unit."""
    assert pipeline.explain is explain
    assert gap.verdict == "named"
    assert sorted(gap.effects["effect"]) == ["actuator_lag", "coulomb_friction"]
    assert list(gap.effects["nrmse_after"])[-1] == pytest.approx(gap.results.final)
    values = gap.parameters.set_index("parameter")
    assert values.loc["force", "value"] == pytest.approx(FORCE, rel=0.02)
    assert values.loc["force", "cart"] == 1
    assert values.loc["time_constant", "value"] == pytest.approx(LAG, rel=0.02)
    assert list(gap.parameters["unit"].sort_values()) == ["V", "s"]
    assert effect_name(find_effect("coulomb_friction"), {"cart": 1})[1:] in repr(gap)


def test_a_recording_is_simulated_by_both_models(gap):
    """The model with effects simulates a recording much better than the linear model."""
    frame = gap.simulate(gap.records[-1])

    assert frame.index.name == "time"
    assert list(frame.columns) == [("measured", "x1"), ("linear", "x1"), ("with_effects", "x1")]
    off = frame.sub(frame["measured"]["x1"], axis=0).pow(2).mean() ** 0.5
    assert off["with_effects", "x1"] < 0.2 * off["linear", "x1"]
    with pytest.raises(ConfigError, match="no recording 'nothing'"):
        gap.simulate("nothing")


def test_the_systems_are_those_of_the_models(gap):
    """The linear system is the chain; the full one adds a lag and friction that stops a cart."""
    assert gap.linear.state_labels == ["x1", "v1"]
    assert_allclose(gap.linear.A, gap.results.linear.chain.state_space()[0])
    assert isinstance(gap.system, control.NonlinearIOSystem)
    assert gap.system.state_labels == ["x1", "v1", "u_lag"]

    t = np.linspace(0.0, 8.0, 801)
    response = control.input_output_response(
        gap.system,
        t,
        np.zeros(t.size),  # pyright: ignore[reportArgumentType]
        [2.0, 0.0, 0.0],  # pyright: ignore[reportArgumentType]
        solve_ivp_method="LSODA",
    )

    (x,) = np.atleast_2d(response.outputs)
    assert np.abs(x[:100]).max() > 1.0
    # Friction holds the cart within force / stiffness of its spring's rest position.
    assert np.ptp(x[-100:]) < 1e-3
    assert abs(x[-1]) <= FORCE / gap.results.model.chain.k.sum()


def test_the_plots_show_what_the_gap_found(gap):
    """The plots show the gap's own curves and errors for the held-out runs."""
    runs = {run.id: run for run in compare_runs(gap.analysis, gap=gap.results, progress=silent)}
    held = [row for row in gap.results.by_record if row.held_out]
    assert {runs[row.experiment].kind for row in held} >= {"decay", "step"}

    for row in held:
        (cart,) = runs[row.experiment].carts
        (found,) = [one for one in cart.models if one.model == "effects"]
        frame = gap.simulate(row.experiment)
        shown = found.y[-len(frame) :]
        swing = np.ptp(cart.measured)
        # The start of each run is fitted again, within the noise of a few readings.
        assert_allclose(shown, frame["with_effects", "x1"], atol=2 * row.noise_floor * swing)
        assert found.nrmse < max(1.2 * row.final, 1.1 * row.noise_floor)
