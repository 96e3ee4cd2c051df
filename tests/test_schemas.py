"""The JSON files and their schemas: the shipped schemas describe the files we write."""

import json
from dataclasses import replace

import jsonschema
import pytest

from pipeline.errors import ConfigError
from pipeline.json_files import DIALECT, file_model, json_text
from pipeline.report.solution.expected import solution_text
from pipeline.schemas import MODELS, schema_text
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.examples import analysed
from tests.helpers.grades import write_class
from tests.helpers.places import ROOT
from tests.report.test_gap import make_gap

DOCS = ROOT / "docs"


def assert_fits(name: str, text: str) -> None:
    """Assert that a file obeys the shipped schema and has no key that the model lacks."""
    shipped = json.loads((DOCS / f"{name}.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(shipped).validate(json.loads(text))
    back = file_model(MODELS[name]).model_validate_json(text).model_dump_json(by_alias=True)
    assert json.loads(back) == json.loads(text)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_the_shipped_schema_is_the_models_own(name):
    """`docs/NAME.schema.json` is what `cartlab schema NAME` prints, and a valid schema."""
    text = (DOCS / f"{name}.schema.json").read_text(encoding="utf-8")
    assert text == schema_text(name)
    schema = json.loads(text)
    assert schema["$schema"] == DIALECT
    jsonschema.Draft202012Validator.check_schema(schema)


@pytest.fixture(scope="module", params=["one-cart", "two-cart", "three-cart"])
def example(request):
    return analysed(request.param)


def test_real_results_obey_the_schema(example):
    """Results and solution of every shipped example obey their schemas, which have all the keys."""
    assert_fits("results", json_text(example))
    assert_fits("solution", solution_text(example))


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_results_with_gaps_obey_the_schema(carts):
    """A number that could not be determined is null, and the schema allows that."""
    analysis = make_analysis(carts)
    for poorer in (analysis, replace(analysis, fit=None, rows=(), feedback=None, hardware=())):
        assert_fits("results", json_text(poorer))
        assert_fits("solution", solution_text(poorer))


@pytest.mark.parametrize("verdict", ["named", "partial", "none", "ambiguous", "unexplained"])
def test_gaps_obey_the_schema(verdict):
    """gap.json obeys the schema for every verdict, with effects, rivals and windows."""
    keys = () if verdict == "none" else ("coulomb_friction", "cubic_spring")
    assert_fits("gap", json_text(make_gap(verdict, keys)))


def test_grades_obey_the_schema(tmp_path):
    """Every kind of grade obeys the schema: failed, flagged, shared, late or changed by hand."""
    files = sorted((write_class(tmp_path) / "feedback").glob("*/grade.json"))
    assert len(files) == 16
    for file in files:
        assert_fits("grade", file.read_text(encoding="utf-8"))


def test_a_broken_file_is_refused():
    """The schema refuses an unknown outcome, a text in place of a number and a missing key."""
    schema = json.loads(schema_text("results"))
    validator = jsonschema.Draft202012Validator(schema)
    good = json.loads(json_text(make_analysis(1)))
    validator.validate(good)
    for change in (
        {"checks": [{**good["checks"][0], "outcome": "maybe"}]},
        {"parameters": [{**good["parameters"][0], "final": "24.3"}]},
    ):
        assert not validator.is_valid({**good, **change})
    assert not validator.is_valid({key: value for key, value in good.items() if key != "checks"})


def test_the_command_prints_the_schema():
    """`cartlab schema gap` prints the shipped schema; an unknown name gets the list of names."""
    done = cartlab_here("schema", "gap")
    assert done.stdout == (DOCS / "gap.schema.json").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match="there are results, gap, solution, grade"):
        schema_text("report")
