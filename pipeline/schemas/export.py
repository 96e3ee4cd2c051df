"""The JSON Schemas of all files, by name."""

import json

from pipeline.errors import ConfigError
from pipeline.schemas.base import Document, json_schema
from pipeline.schemas.gap import Gap
from pipeline.schemas.grade import Grade
from pipeline.schemas.results import Results
from pipeline.schemas.solution import Solution

MODELS: dict[str, type[Document]] = {
    "results": Results,
    "gap": Gap,
    "solution": Solution,
    "grade": Grade,
}


def schema_text(name: str) -> str:
    """Return the JSON Schema of `results.json`, `gap.json`, `solution.json` or `grade.json`.

    Raises
    ------
    ConfigError : there is no such file.
    """
    if name not in MODELS:
        raise ConfigError(f"{name}: no such schema; there are {', '.join(MODELS)}")
    schema = json_schema(MODELS[name], title=f"cartlab {name}.json")
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"
