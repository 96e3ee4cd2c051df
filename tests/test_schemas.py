"""The JSON files and their schemas: the shipped schemas describe the files we write."""

import json
import tomllib
from typing import Any

import jsonschema
import pytest

from pipeline.errors import ConfigError
from pipeline.gap.types import read_gap
from pipeline.json_files import DIALECT, json_text
from pipeline.report.solution.expected import solution_text
from pipeline.resources import RUBRICS
from pipeline.schemas import MODELS, schema_text
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.examples import analysed
from tests.helpers.gaps import make_gap
from tests.helpers.grades import write_class
from tests.helpers.places import ROOT

DOCS = ROOT / "docs"


def exact(schema: Any) -> Any:
    """Return a schema that demands exactly the keys that it describes."""
    if isinstance(schema, list):
        return [exact(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    made = {key: exact(value) for key, value in schema.items()}
    if schema.get("type") == "object" and "properties" in schema:
        made |= {"additionalProperties": False, "required": list(schema["properties"])}
    return made


def assert_fits(name: str, text: str) -> None:
    """Assert that a file obeys the shipped schema and has exactly its keys."""
    shipped = json.loads((DOCS / f"{name}.schema.json").read_text(encoding="utf-8"))
    for schema in (shipped, exact(shipped)):
        jsonschema.Draft202012Validator(schema).validate(json.loads(text))


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


def test_a_file_of_an_earlier_version_is_read():
    """A gap.json without the keys that came later is read; their defaults stand for them."""
    gap = make_gap("named", ("coulomb_friction",))
    text = json_text(gap)
    assert json_text(read_gap(text)) == text
    document = json.loads(text)
    for later in ("complete", "causes", "free_run", "left", "contenders", "next_recording"):
        del document[later]
    again = read_gap(json.dumps(document))
    assert (again.complete, again.causes, again.free_run) == (True, (), ())
    assert (again.contenders, again.proposal) == ((), None)
    del document["model"]["effects"]
    with pytest.raises(ConfigError, match=r"model\.effects"):
        read_gap(json.dumps(document))


def test_the_command_prints_the_schema():
    """`cartlab schema gap` prints the shipped schema; an unknown name gets the list of names."""
    done = cartlab_here("schema", "gap")
    assert done.stdout == (DOCS / "gap.schema.json").read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match="results, gap, solution"):
        schema_text("report")


@pytest.mark.parametrize("path", sorted(RUBRICS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_rubrics_obey_their_schema(path):
    """The schema of a rubric takes the shipped ones as they are typed, and refuses a wrong key."""
    validator = jsonschema.Draft202012Validator(json.loads(schema_text("rubric")))
    rubric = tomllib.loads(path.read_text(encoding="utf-8"))
    validator.validate(rubric)
    for wrong in ({"from": "mine"}, {"points": "two"}, {"sigma": 3}):
        criteria = [{**rubric["criteria"][0], **wrong}, *rubric["criteria"][1:]]
        assert not validator.is_valid({**rubric, "criteria": criteria})
