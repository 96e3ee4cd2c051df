"""The package in a notebook.

One import is enough, results display themselves, and the example notebook runs to its end.
"""

import ast
import json
import subprocess
import sys
from dataclasses import replace

import control
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import pyplot
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import linear_sum_assignment

import pipeline
from pipeline.json_files import json_text, plain
from pipeline.notebook import Lab, analyse
from pipeline.report.sections.summary import terminal_summary
from pipeline.resources import EXAMPLES
from pipeline.setup import Units
from tests.helpers.examples import analysed
from tests.helpers.pages import Page
from tests.helpers.places import ROOT

NOTEBOOK = ROOT / "docs" / "example.ipynb"


@pytest.fixture(scope="module")
def lab() -> Lab:
    return analyse(EXAMPLES / "two-cart")


def test_the_package_exports_analyse(lab):
    """`from pipeline import analyse` gives the notebook's function; its results are a report's."""
    assert pipeline.analyse is analyse
    assert json_text(lab.results) == json_text(analysed("two-cart"))


def test_nothing_heavy_is_loaded_until_it_is_asked_for():
    """Importing the package loads no large library; asking it for an unknown name is an error."""
    code = (
        "import sys, pipeline; "
        "print({'numpy', 'matplotlib', 'pandas', 'control'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True
    )
    assert done.stdout.strip() == "set()"
    with pytest.raises(AttributeError, match="no attribute 'analyze'"):
        pipeline.analyze  # noqa: B018


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("module", ["notebook", "report.make_report", "grading.batch.grade_class"])
def test_the_compiled_simulator_is_loaded_only_for_a_simulation(module):
    """A report or a grade does not wait for the compiler of the simulator."""
    code = f"import sys, pipeline.{module}; print('numba' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True
    )
    assert done.stdout.strip() == "False"


def test_the_system_is_the_identified_chain(lab):
    """States, input and outputs of the system are named; A to D are those of results.json."""
    system = lab.system
    assert system.isctime()
    assert system.state_labels == ["x1", "v1", "x2", "v2"]
    assert (system.input_labels, system.output_labels) == (["u"], ["x1", "x2"])
    for own, letter in zip(lab.chain.state_space(), "ABCD", strict=True):
        assert_array_equal(getattr(system, letter), own)


def test_the_closed_loop_is_the_designed_one(lab):
    """The loop has the design's sample time and poles, and a pole at zero for the delay."""
    loop, design = lab.closed_loop, lab.design
    assert loop.dt == design.sample_time
    assert loop.input_labels == ["r"]
    expected = np.append(np.exp(design.poles * loop.dt), 0.0)
    away = np.abs(loop.poles()[:, None] - expected)
    # All poles are apart, so the pole at zero is as well conditioned as the others.
    assert away[linear_sum_assignment(away)].max() < 1e-9


def test_tables_have_the_names_of_the_results(lab):
    """Each table has one row per parameter, check, decay, step or dwell; attributes hold units."""
    results = plain(lab.results, digits=17)
    for frame, rows in (
        (lab.parameters, results["parameters"]),
        (lab.checks, results["checks"]),
    ):
        assert list(frame.columns) == list(rows[0])
        assert len(frame) == len(rows)
    assert lab.parameters.loc["omega_a", "final"] == results["parameters"][2]["final"]
    assert (lab.checks["outcome"] == "pass").all()
    assert list(lab.decays["experiment"]) == ["decay-1a", "decay-1b", "decay-2a", "decay-2b"]
    assert (lab.decays["law_name"] == "exponential").all()
    assert len(lab.steps) == len(results["step_gains"])
    assert lab.steps.attrs["units"]["gain"] == "cm/V"
    assert len(lab.dwells) == len(lab.results.sine_points)
    assert lab.dwells.attrs["units"]["omega"] == "rad/s"
    assert len(lab.frequency_response) == sum(
        len(response["omega"]) for response in results["frequency_response"]
    )


def test_records_are_tables_by_time(lab):
    """Each record has its measured times as index, and input and positions as columns."""
    run = lab.records["control"]
    (record,) = [record for record in lab.results.records if record.id == "control"]
    assert list(run.columns) == ["u", "reference", "x1", "x2"]
    assert run.index.name == "time"
    assert_array_equal(run.index, record.t)
    assert_array_equal(run["x2"], record.position(2))
    assert run.attrs["units"] == {
        "time": "s", "u": "V", "reference": "cm", "x1": "cm", "x2": "cm"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "units"),
    [("chain", {"V s²/cm", "V s/cm", "V/cm"}), ("design", {"V/cm", "V s/cm", "s", "V", "°"})],
)
def test_a_result_displays_as_a_table_with_units(lab, name, units):
    """Carts and design show one row per number, with its unit, as HTML and as text."""
    shown = getattr(lab, name)
    page = Page(shown._repr_html_())
    rows = [tag for tag, _ in page.tags].count("tr")
    assert rows == len(repr(shown).splitlines()) - 1 > 6
    for text in (page.text, repr(shown)):
        plain = text.replace("\u00a0", " ")
        assert all(unit in plain for unit in units)
    first = lab.chain.m[0] / 1e-4 if name == "chain" else lab.design.gains[0]
    assert f"{first:.4g}" in page.text


def test_units_in_a_table_are_escaped(lab):
    """A unit may be any text; in the HTML it is never markup."""
    odd = replace(lab.design, units=Units(position="<b>", input="V"))
    assert "<b>" not in odd._repr_html_()
    assert "<b>" in repr(odd)


def test_the_list_of_recordings_names_columns_and_units(lab):
    """`lab.records` displays one row per recording; it remains a dictionary."""
    page = Page(lab.records._repr_html_())
    for text in (page.text, repr(lab.records)):
        assert all(name in text for name in lab.records)
        assert "reference [cm]" in text
    assert isinstance(lab.records, dict)


@pytest.mark.parametrize("table", ["records", "transfer_functions", "frd", "questions"])
def test_a_wrong_name_is_answered_with_the_right_ones(lab, table):
    """A KeyError lists the names that exist."""
    with pytest.raises(KeyError) as error:
        getattr(lab, table)["nothing"]
    assert all(name in str(error.value) for name in getattr(lab, table))


def test_the_measured_frequency_response_is_python_controls(lab):
    """`lab.frd` has the points of the table, as an object that python-control plots."""
    table = lab.frequency_response.query("cart == 2")
    measured = lab.frd["x2"]
    assert isinstance(measured, control.FrequencyResponseData)
    assert_array_equal(measured.omega, table["omega"])
    assert_allclose(measured.magnitude, table["magnitude"], rtol=1e-12)  # rounding alone
    model = lab.transfer_functions["x2"](1j * measured.omega)
    assert np.median(np.abs(measured.complex / model - 1)) < 0.01  # a count in a hundred


def test_margins_have_python_controls_names_and_order(lab):
    """`gm, pm, sm, wpc, wgc, wms` are the margins of the design."""
    gm, pm, sm, wpc, wgc, _ = lab.stability_margins()
    margins = lab.design.margins
    assert_allclose([gm, pm, sm], [margins.gain, margins.phase_deg, margins.modulus], rtol=1e-9)
    assert_allclose([wpc, wgc], [margins.omega_gain, margins.omega_phase], rtol=1e-9)


def test_an_analysis_shows_its_summary_and_its_table(lab):
    """The HTML is one closed element with the summary and every parameter, and no script."""
    page = Page(lab._repr_html_())
    assert page.tags[0] == ("div", {"class": "cartlab"})
    summary = terminal_summary(lab.results).partition("\n")[0]
    assert summary.split(",")[0] in page.text
    assert {"script", "html", "link"}.isdisjoint(tag for tag, _ in page.tags)
    alts = page.values("alttext")
    assert {"K_1", "ω_a", "ζ_2"} <= set(alts)
    assert repr(lab).startswith(summary.split(",")[0])


@pytest.mark.slow
@pytest.mark.sample
def test_the_example_notebook_runs(monkeypatch):
    """Every code cell of the example runs, in order, and displays its last value."""
    mpl.use("agg")
    monkeypatch.chdir(EXAMPLES.parent)
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    names: dict[str, object] = {}
    shown = {}
    for cell in notebook["cells"]:
        assert {"cell_type", "id", "metadata", "source"} <= set(cell)
        if cell["cell_type"] != "code":
            continue
        assert (cell["outputs"], cell["execution_count"]) == ([], None)  # shipped clean
        *body, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        assert isinstance(last, ast.Expr)
        shown[cell["id"]] = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    pyplot.close("all")
    assert all(hasattr(shown[id_], "_repr_html_") for id_ in ("analyse", "bode", "steps"))
    assert list(shown["parameters"].index)[:2] == ["K_1", "K_2"]
    assert shown["checks"].empty
    assert "10.138" in shown["heavier"]
    steps = shown["steps"]
    # The bench ran the designed loop. Another controller would settle too, but overshoot.
    assert steps.loc["designed", "SettlingTime"] == steps.loc["measured", "SettlingTime"]
    assert_allclose(steps["SteadyStateValue"], 1.0, rtol=5e-3)  # two encoder steps of 0.0023 cm
    assert 5 < steps.loc["mine", "Overshoot"] < 10
