"""The JSON Schemas of all result files, by name."""

import json

from pipeline.errors import ConfigError
from pipeline.gap.types import Gap
from pipeline.grading.grade import Grade
from pipeline.grading.rubric import Rubric
from pipeline.grading.self_check.answers import CheckAnswer
from pipeline.json_files import json_schema
from pipeline.report.solution.expected import Solution
from pipeline.results import Analysis

MODELS: dict[str, type] = {
    "results": Analysis,
    "gap": Gap,
    "solution": Solution,
    "grade": Grade,
    "check": CheckAnswer,
    "rubric": Rubric,
}


def schema_text(name: str) -> str:
    """Return the JSON Schema of a file, such as "results", or "check" for a line of `checks.jsonl`.

    Raises
    ------
    ConfigError : there is no such schema.
    """
    if name not in MODELS:
        raise ConfigError(f"{name}: no such schema; there are {', '.join(MODELS)}")
    schema = json_schema(MODELS[name], title=f"cartlab {name}.json")
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"
