"""`report --tables` saves the results of the analysis, for pandas and for MATLAB."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.report import tables
from pipeline.report.tables import matlab_file, save_tables
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.examples import analysed

TABLES = {"parameters", "checks", "decays", "steps", "dwells", "frequency_response"}


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return analysed("two-cart")


def matlab(analysis: Analysis) -> dict:
    return scipy.io.loadmat(
        io.BytesIO(matlab_file(analysis)), simplify_cells=True, chars_as_strings=True
    )


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}


def test_the_saved_tables_hold_the_analysis(analysis, tmp_path):
    """Saved tables hold the analysis to ten digits, and saving again gives the same bytes."""
    save_tables(analysis, tmp_path)
    assert {path.stem for path in (tmp_path / "tables").iterdir()} == TABLES
    dwells = pd.read_csv(tmp_path / "tables" / "dwells.csv", keep_default_na=True)
    own = tables.dwells(analysis)
    assert_allclose(dwells["omega [rad/s]"], own["omega"], rtol=1e-9)  # ten digits
    assert_allclose(dwells["gain [cm/V]"], own["gain"], rtol=1e-9)
    assert list(dwells["experiment"]) == list(own["experiment"])
    before = content(tmp_path)
    save_tables(analysis, tmp_path)
    assert content(tmp_path) == before


def test_matlab_finds_the_names_of_the_report(analysis):
    """The MAT-file has the report's names, and the state model and records of the analysis."""
    found = matlab(analysis)
    assert analysis.chain is not None
    assert analysis.feedback is not None
    for letter, own in zip("ABCD", analysis.chain.state_space(), strict=True):
        assert_array_equal(np.reshape(found[letter], own.shape), own)
    for name in "mck":
        assert_array_equal(found[name], getattr(analysis.chain, name))
    assert_array_equal(found["gains"], analysis.feedback.gains)
    assert found["prefilter"] == analysis.feedback.prefilter
    assert found["sample_time"] == analysis.feedback.sample_time
    assert found["margins"] == vars(analysis.feedback.margins)
    final = {row.name: row.final.value for row in analysis.rows if row.final}
    assert found["parameters"]["final"] == final
    second = found["frequency_response"][1]
    assert second["cart"] == 2
    for name in ("omega", "magnitude", "magnitude_std", "phase", "phase_std"):
        assert_array_equal(second[name], getattr(analysis.frequency_responses[1], name))
    record = next(record for record in analysis.records if record.id == "step-1")
    assert found["records"]["step_1"]["kind"] == "step"
    assert_array_equal(found["records"]["step_1"]["x2"], record.position(2))
    assert found["units"] == {"position": "cm", "input": "V", "time": "s"}


def test_a_mat_file_has_no_date(analysis):
    """The header of a MAT-file has no date, so the same results give the same bytes."""
    assert matlab_file(analysis)[:116] == b"MATLAB 5.0 MAT-file".ljust(116)


def test_bode_data_are_those_of_the_analysis(analysis):
    """The Bode table has a row for each cart and frequency, with the standard errors."""
    frame = tables.frequency_response(analysis)
    second = frame[frame["cart"] == 2]
    for name in ("omega", "magnitude", "magnitude_std", "phase", "phase_std"):
        assert_array_equal(second[name], getattr(analysis.frequency_responses[1], name))
    assert frame.attrs["units"] == {
        "omega": "rad/s", "magnitude": "cm/V", "magnitude_std": "cm/V", "phase": "rad",
        "phase_std": "rad",
    }  # fmt: skip


def test_a_table_of_ratios_has_no_phase(analysis):
    """If only ratios are known, the phase is missing in the table and empty in MATLAB."""
    first = replace(analysis.frequency_responses[0], phase=None, phase_std=None, source="table")
    reduced = replace(analysis, frequency_responses=(first,))
    assert np.isnan(tables.frequency_response(reduced)["phase"].to_numpy()).all()
    found = scipy.io.loadmat(io.BytesIO(matlab_file(reduced)))["frequency_response"]
    assert found["phase"][0, 0].size == 0


def test_records_get_names_that_matlab_accepts(analysis):
    """Records whose ids MATLAB would refuse or confuse get other names, and keep their ids."""
    record = analysis.records[0]
    ids = ("step-1", "step 1", "1", "end", "é" * 80, "é" * 81, "x" * 70, "x" * 71)
    found = matlab(replace(analysis, records=tuple(replace(record, id=id_) for id_ in ids)))
    names = found["records"]
    assert [entry["id"] for entry in names.values()] == list(ids)
    assert all(name.isidentifier() and name.isascii() and len(name) <= 63 for name in names)
    assert all(name[0].isalpha() and name != "end" for name in names)


def test_an_analysis_without_results_still_has_its_tables(analysis, tmp_path):
    """An analysis without results gives tables with headings only, and no A in the MAT-file."""
    nothing = replace(
        analysis, records=(), log_decrements=(), step_gains=(), sine_points=(), rows=(), checks=(),
        frequency_responses=(), fit=None, feedback=None,
    )  # fmt: skip
    save_tables(nothing, tmp_path)
    for name in TABLES:
        frame = pd.read_csv(tmp_path / "tables" / f"{name}.csv")
        assert frame.empty
        assert len(frame.columns) > 4
    assert "A" not in scipy.io.loadmat(tmp_path / "results.mat")


def test_a_missing_initial_value_is_nan(analysis):
    """If a parameter has only a final value, its initial value is NaN in the table."""
    first = replace(analysis.rows[0], initial=None)
    found = matlab(replace(analysis, rows=(first, *analysis.rows[1:])))["parameters"]
    assert np.isnan(found["initial"]["K_1"])
    assert np.isnan(found["initial_std"]["K_1"])


def test_report_saves_tables_when_asked(tmp_path):
    """`report --tables` writes tables; a later `report` without the option removes them."""
    out = tmp_path / "out"
    folder = EXAMPLES / "one-cart"
    assert cartlab_here("report", folder, "--out", out, "--no-pdf", "--tables").returncode == 0
    assert {path.stem for path in (out / "tables").iterdir()} == TABLES
    assert Path(out / "results.mat").stat().st_size > 1000
    assert cartlab_here("report", folder, "--out", out, "--no-pdf").returncode == 0
    assert not [*(out / "tables").iterdir(), *out.glob("*.mat")]  # the old ones are removed
