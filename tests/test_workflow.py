"""The whole workflow on the shipped examples, and on submissions that lack a part."""

import io
import json
import math
import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import loadmat

from pipeline.errors import DataError
from pipeline.estimation.record_fit import record_fits
from pipeline.json_files import json_text
from pipeline.notebook import Lab
from pipeline.plant.chain import PRESETS
from pipeline.report.html import render_html
from pipeline.report.lab_report import build_document
from pipeline.report.solution.write import build_solution
from pipeline.report.tables import matlab_file
from pipeline.resources import EXAMPLES
from pipeline.submission import load_submission
from pipeline.workflow import analyse, reference_design
from tests.helpers.examples import analysed

PRESET_OF = {"one-cart": "throne-1dof", "two-cart": "throne-2dof", "three-cart": "throne-3dof"}


@pytest.fixture(scope="module")
def analyses():
    return {name: analysed(name) for name in PRESET_OF}


@pytest.mark.parametrize("name", PRESET_OF)
def test_examples_give_back_the_carts_that_made_them(analyses, name):
    """In each example all final parameters are within four standard errors of the truth."""
    truth = PRESETS[PRESET_OF[name]].parameters()
    final = {row.name: row.final for row in analyses[name].rows}
    assert list(final) == list(truth)
    for parameter, estimate in final.items():
        # With four standard errors and 32 parameters, one in 500 fixed seeds would fail by chance.
        assert abs(estimate.value - truth[parameter]) < 4 * estimate.std, parameter
        # About 30 dwells of 0.1 % each make the standard errors small.
        assert estimate.std < 2e-3 * truth[parameter], parameter


@pytest.mark.parametrize("name", PRESET_OF)
def test_examples_pass_every_check_and_skip_nothing(analyses, name):
    """In the shipped examples every stage runs and no check fails."""
    analysis = analyses[name]
    assert not analysis.skipped
    assert [check.id for check in analysis.checks if check.outcome == "fail"] == []
    assert {h.loop for h in analysis.hardware} == {"closed", "open"}
    assert {row.name for row in analysis.rows if row.initial is None} == set()


def test_same_input_gives_same_bytes(analyses):
    """Analysing the same folder twice gives the same bytes of results.json."""
    again = analyse(load_submission(EXAMPLES / "two-cart"))
    assert json_text(again) == json_text(analyses["two-cart"])


def test_unexplained_shares_are_returned(analyses):
    """`analyse` returns each record's unexplained share, as `record_fits` computes it."""
    for analysis in analyses.values():
        fits = record_fits(analysis.records, analysis.chain)
        assert fits
        assert analysis.unexplained == {name: fit.share for name, fit in fits.items()}


def _without(tmp_path, *, kinds, example="two-cart"):
    """Copy an example without the experiments of some kinds."""
    folder = tmp_path / "part"
    shutil.copytree(EXAMPLES / example, folder)
    path = folder / "submission.toml"
    head, *experiments = path.read_text(encoding="utf-8").split("[[experiments]]")
    last, reported, tail = experiments[-1].partition("[reported")
    experiments[-1] = last
    kept = [e for e in experiments if not any(f'kind = "{kind}"' in e for kind in kinds)]
    text = "[[experiments]]".join([head, *kept]) + reported + tail
    path.write_text(text, encoding="utf-8")
    return load_submission(folder)


@pytest.mark.parametrize(
    ("kind", "stage"),
    [
        ("decay", "log decrement, cart 1"),
        ("step", "step gain"),
        ("sine", "sine steady state"),
        ("closed_loop", "hardware check"),
    ],
)
def test_a_missing_experiment_skips_only_its_stage(tmp_path, kind, stage):
    """If one kind of experiment is missing, its stage is skipped; the carts are still found."""
    analysis = analyse(_without(tmp_path, kinds=[kind]))
    assert stage in {skip.name for skip in analysis.skipped}
    truth = PRESETS["throne-2dof"]
    # Without dwells, the fit to steps and a sweep is accurate to percents, not to tenths of a
    # percent.
    assert analysis.chain is not None
    assert_allclose(analysis.chain.m, truth.m, rtol=0.01)
    assert_allclose(analysis.chain.k[1:], truth.k[1:], rtol=0.01)


def test_steps_alone_still_give_a_full_report(tmp_path):
    """Without dwells and sweep the carts are fitted to the step records, and a warning says so."""
    analysis = analyse(_without(tmp_path, kinds=["sine", "sweep"]))
    assert analysis.fit is not None
    assert analysis.fit.method == "time_fit"
    assert_allclose(analysis.fit.chain.m, PRESETS["throne-2dof"].m, rtol=0.02)
    assert any("not from dwells" in warning for warning in analysis.warnings)
    assert analysis.frequency_responses


def test_decays_alone_give_reasons_not_a_crash(tmp_path):
    """From decays alone, each stage that needs the final estimate is skipped with a reason."""
    analysis = analyse(_without(tmp_path, kinds=["sine", "sweep", "step", "closed_loop"]))
    assert analysis.chain is None
    stages = {skip.stage for skip in analysis.skipped}
    assert {"final estimates", "state feedback", "hardware check"} <= stages
    assert "fit.identified" in {check.id for check in analysis.checks if check.outcome == "fail"}
    assert "null" in json_text(analysis)
    initial = {row.name: row.initial.value for row in analysis.rows if row.initial}
    assert math.isclose(initial["omega_2"], 32.926, rel_tol=1e-3)


def test_no_controller_is_designed_without_a_goal():
    """Without [design] there is no feedback, and the reason is given."""
    submission = load_submission(EXAMPLES / "one-cart").model_copy(update={"design": None})
    analysis = analyse(submission)
    assert analysis.feedback is None
    assert [skip.stage for skip in analysis.skipped] == ["state feedback"]


def test_the_design_can_be_computed_later(analyses):
    """A design that an analysis left out, as in grading, can be computed later with equal gains."""
    submission, whole = load_submission(EXAMPLES / "one-cart"), analyses["one-cart"].feedback
    without = analyse(submission, design=False)
    assert without.feedback is None
    assert not without.skipped
    assert_allclose(reference_design(submission, without.fit).gains, whole.gains, rtol=1e-12)


def test_a_failed_fit_gives_no_numbers(tmp_path):
    """If the fit fails, no result has its numbers: not JSON, report, solution, .mat or notebook."""
    submission = _unrelated(tmp_path / "lab")
    analysis = analyse(submission)
    assert analysis.fit is not None
    assert not analysis.fit.converged

    results = json.loads(json_text(analysis))
    assert results["chain"] is results["state_space"] is results["feedback"] is None
    assert {row["final"] for row in results["parameters"]} == {None}
    reasons = {skip["stage"]: skip["reason"] for skip in results["skipped"]}
    assert reasons["final estimates"].startswith("the fit failed")
    assert "carts failed: " in reasons["state feedback"]
    assert {check.kind for check in analysis.failed_checks} >= {"fit"}
    assert not {check.kind for check in analysis.checks} & {"redundancy", "order", "physical"}
    for document in (build_document(analysis), build_solution(analysis, rubric=None)):
        page = render_html(document)
        assert " data-copy=" not in page
        assert "The identified chain" not in page
        assert "No trustworthy model" in page
    lab = Lab(results=analysis, document=build_document(analysis))
    with pytest.raises(DataError, match="the fit failed"):
        _ = lab.system
    assert lab.parameters["final"].dropna().empty
    assert "A" not in loadmat(io.BytesIO(matlab_file(analysis)))


def _unrelated(folder):
    """Return a submission of two steps whose cart moves independently of the input."""
    (folder / "data").mkdir(parents=True)
    t, rng = np.arange(0.0, 6.0, 0.02), np.random.default_rng(1)
    text = "version = 1\n[system]\ncarts = 1\n[design]\ncart = 1\n"
    for i in (1, 2):
        u = np.where((t > 1) & (t < 5), 1.0, 0.0)
        x = np.sin(13 * t + i * t**1.3) + 0.02 * np.cumsum(rng.normal(size=t.size))
        rows, name = np.column_stack([t, u, x]), f"data/step-{i}.csv"
        np.savetxt(folder / name, rows, delimiter=",", header="time,u,x1", comments="", fmt="%.5f")
        text += f'[[experiments]]\nid = "step-{i}"\nkind = "step"\nfile = "{name}"\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    return load_submission(folder)
