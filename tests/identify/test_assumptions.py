"""All assumptions behind the results are listed, each with its support in the data."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.identify.assumptions import list_assumptions
from pipeline.ingest.fill import fill_submission
from pipeline.ingest.read import read_data
from pipeline.json_files import file_model, json_text
from pipeline.report.document import Details, Table
from pipeline.report.lab_report import build_document
from pipeline.report.sections.summary import terminal_summary
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis, Assumption, HeadingUnit
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.examples import analysed, recorded
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import write_two_cart_submission

SPRINGS = "springs = [false, true, true]\n"
UNITS = 'input = { unit = "V", sign = 1 }\nposition = { unit = "cm" }\n'
FREE = {  # free carts, with the origin and the support of the statement
    ("carts", (1,)): ("stated", "supported"),
    ("carts", (2,)): ("stated", "supported"),
    ("carts", (1, 2)): ("default", "supported"),
}


def edited(folder: Path, *changes: tuple[str, str]) -> Analysis:
    """Return the analysis of a changed two-cart example."""
    shutil.copytree(EXAMPLES / "two-cart", folder)
    toml = folder / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    toml.write_text(text, encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def by_key(analysis: Analysis) -> dict[tuple[str, object], Assumption]:
    """Return the assumptions by key and subject: a spring, a tuple of free carts, or the value."""
    return {(a.key.rpartition(".")[2], a.about or a.value): a for a in analysis.assumptions}


def supports(analysis: Analysis) -> dict[tuple[str, object], tuple[str, str]]:
    """Return where each assumption comes from, and its support."""
    return {key: (a.origin, a.support) for key, a in by_key(analysis).items()}


def test_stated_values_are_listed_with_their_support():
    """Each stated value is listed with its origin and whether the data support it."""
    analysis = analysed("two-cart")
    assert supports(analysis) == {
        ("springs", "wall-1"): ("stated", "supported"),
        ("springs", "1-2"): ("stated", "supported"),
        ("springs", "2-wall"): ("stated", "supported"),
        ("unit", "cm"): ("stated", "open"),
        ("unit", "V"): ("stated", "open"),
        ("sign", 1.0): ("stated", "supported"),
        **FREE,
    }
    found = by_key(analysis)
    assert [found["springs", spring].value for spring in ("wall-1", "1-2")] == [False, True]
    assert analysis.chain is not None
    assert found["springs", "1-2"].found == analysis.chain.k[1]
    assert found["springs", "1-2"].found_std
    assert found["springs", "1-2"].reason.startswith(f"k_2 = {analysis.chain.k[1]:.5f} ± ")
    assert "Assumed" not in terminal_summary(analysis)


def test_an_unstated_value_is_a_default(tmp_path):
    """Unstated springs, unit and sign are listed as defaults; the data contradict one spring."""
    analysis = edited(tmp_path / "s", (SPRINGS, ""), (UNITS, ""))
    assert supports(analysis) == {
        ("springs", "wall-1"): ("default", "contradicted"),
        ("springs", "1-2"): ("default", "supported"),
        ("springs", "2-wall"): ("default", "supported"),
        ("unit", "count"): ("default", "contradicted"),
        ("unit", "V"): ("default", "open"),
        ("sign", 1.0): ("data", "supported"),
        **FREE,
    }
    findings = [line for line in terminal_summary(analysis).splitlines() if line.startswith("- ")]
    unit, spring = (check for check in analysis.failed_checks if check.is_cause)
    assert (unit.code, spring.code) == ("fractions", "no_end_spring")
    assert unit.message in findings[0]  # at the top of the list
    assert "system.input.unit" in findings[1]
    assert sum(SPRINGS.strip() in line and spring.id in line for line in findings) == 1


@pytest.mark.parametrize(("headed", "support"), [(0, "open"), (3, "open"), (4, "supported")])
def test_half_of_the_headings_support_a_unit(headed, support):
    """A unit in the headings of fewer than half of the recordings leaves the others open."""
    submission = recorded("two-cart", "step", "sine")
    data = read_data(submission)
    unit = HeadingUnit(role="position", heading="x1 [mm]", unit="mm", converts=True)
    records = tuple(
        replace(record, heading_units=(unit,) if i < headed else ())
        for i, record in enumerate(data.records[:8])
    )
    data = replace(data, records=records)
    found = list_assumptions(submission, data=data, fit=None, checks=())
    (position,) = (one for one in found if one.key == "system.position.unit")
    assert (position.support, len(position.experiments)) == (support, headed)


def test_the_report_and_results_json_list_the_assumptions():
    """The report has a section with a row for each assumption, and `results.json` has the same."""
    analysis = analysed("two-cart")
    document = build_document(analysis)
    (section,) = (s for s in document.sections if s.id == "assumptions")
    table, folded = section.blocks
    assert isinstance(table, Table)
    assert isinstance(folded, Details)
    (supported,) = folded.blocks
    assert isinstance(supported, Table)
    assert len(table.rows) + len(supported.rows) == len(analysis.assumptions)
    raw = json.loads(json_text(analysis))
    model = file_model(Analysis)
    checked = model.model_validate(raw).model_dump(by_alias=True)
    assert checked["assumptions"][3]["value"] == "cm"
    assert raw["assumptions"][1]["found"] == pytest.approx(analysis.assumptions[1].found)
    older = {key: value for key, value in raw.items() if key != "assumptions"}
    assert model.model_validate(older).model_dump(by_alias=True)["assumptions"] == ()


@pytest.mark.skipif(not (REAL_DATA / "ecp210-ucsd").is_dir(), reason="no real recordings here")
def test_a_held_cart_that_was_not_measured_is_open(tmp_path):
    """If a held cart was not measured, its assumption is "open", as nothing supports it."""
    folder = write_two_cart_submission(tmp_path / "s", REAL_DATA, steps=(1, 2, 3, 4, 5))
    found = by_key(analyse(load_submission(folder), design=False))
    assert found["carts", (1,)].support == "open"
    assert found["unit", "count"].support == "supported"
    sign = found["sign", -1.0]
    assert (sign.origin, sign.support) == ("data", "supported")
    assert "pid" not in sign.experiments  # the logged input has the opposite sign
    assert "pid" in sign.reason


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(not (REAL_DATA / "ecp210-ucsd").is_dir(), reason="no real recordings here")
def test_a_large_misfit_leaves_a_certain_spring_supported(tmp_path):
    """Even if the fit does not explain the data, springs that it finds for certain are supported.

    Their standard errors include the misfit: each of five recordings alone gives the spring between
    the carts within three standard errors.
    """
    folder = write_two_cart_submission(tmp_path / "s", REAL_DATA, steps=(1, 2, 3, 4, 5))
    analysis = analyse(load_submission(folder), design=False)
    assert analysis.fit is not None
    assert not analysis.fit.explains_data
    springs = [a.support for a in analysis.assumptions if a.key == "system.springs"]
    assert springs == ["supported", "supported", "open"]
    for step in range(1, 6):
        folder = write_two_cart_submission(tmp_path / str(step), REAL_DATA, steps=(step,))
        alone = analyse(load_submission(folder), design=False).fit
        assert alone is not None
        apart = alone.chain.k[1] - analysis.fit.chain.k[1]
        assert abs(apart) < 3 * alone.std["k_2"]


def test_a_free_cart_that_hardly_moves_is_open(tmp_path):
    """If `fill` asks whether a cart was held, the assumption that it is free is open."""
    data = tmp_path / "bench" / "data"
    data.mkdir(parents=True)
    source = EXAMPLES / "two-cart" / "data" / "decay-2a.csv"
    rows = np.loadtxt(source, delimiter=",", skiprows=1)
    rows[:, 2] = np.round(0.02 * rows[:, 3], 4)  # cart 1 moves 2 % as far as cart 2
    head = "time,input,x1,x2"
    np.savetxt(data / "decay.csv", rows, fmt="%.6g", delimiter=",", header=head, comments="")
    (found,) = fill_submission(data.parent)
    (asked,) = found.unsure
    assert asked.endswith("carts = [2]")
    free = by_key(analyse(load_submission(data.parent), design=False))["carts", (1, 2)]
    assert (free.support, free.experiments) == ("open", ("decay",))
