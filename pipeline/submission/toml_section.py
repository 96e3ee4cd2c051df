"""Write tables of a TOML file; to edit a file that a person wrote, use `submission.edit`."""

import json
from collections.abc import Mapping, Sequence

from pipeline.submission.toml_file import Value


class TypedNumber(str):
    """A number as a person typed it: its digits are kept in the file."""


def toml_section(heading: str, entries: Mapping[str, Value]) -> str:
    """Return one table of a TOML file; no heading: the keys at its top."""
    lines = [f"{key} = {_toml(value)}" for key, value in entries.items()]
    return "\n".join([heading, *lines] if heading else lines) + "\n"


def _toml(value: Value) -> str:
    if isinstance(value, TypedNumber):
        return value
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False)  # TOML's basic strings are JSON's
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)
