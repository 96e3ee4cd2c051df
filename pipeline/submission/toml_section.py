"""Write tables of a TOML file; to edit a file that a person wrote, use `submission.edit`."""

import json
from collections.abc import Mapping, Sequence

from pipeline.submission.toml_file import Value


class TypedNumber(str):
    """A number as a person typed it; the file keeps its digits."""


def toml_section(heading: str, entries: Mapping[str, Value]) -> str:
    """Return one table as TOML or, without a heading, the keys for the top of the file."""
    lines = [f"{key} = {_toml(value)}" for key, value in entries.items()]
    return "\n".join([heading, *lines] if heading else lines) + "\n"


def _toml(value: Value) -> str:
    if isinstance(value, TypedNumber):
        return value
    if isinstance(value, str | bool):
        # JSON's text is valid in TOML too, except that TOML escapes the delete character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)
