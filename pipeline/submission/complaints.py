"""Describe faults of a submission, one line each, so that a student can fix them."""

import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from difflib import get_close_matches
from functools import cache
from typing import Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline.submission.models import Submission
from pipeline.words.numbers import first_few

Location = Sequence[int | str]

_LONGEST_QUOTE = 60  # most characters shown of a found value
MOST_LISTED = 20  # most faults listed for a file; finding the nearest valid key takes a while
_MOST_KNOWN = 40  # most valid values listed

# Descriptions of expected values, by pydantic's name for the error.
_EXPECTED = {
    "string_type": "text in quotes",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "tuple_type": "a list [ … ]",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "is_instance_of": "a number",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "too_long": "at most {max_length} values",
    "too_short": "at least {min_length} values",
    "string_too_long": "at most {max_length} characters",
    "string_pattern_mismatch": "one line of printable characters",
    "literal_error": "{expected}",
    "union_tag_invalid": "type = {expected_tags}",
    "union_tag_not_found": 'type = "state_feedback" or "pid"',
}


def quote(value: object) -> str:
    """Return a found value as one short printable line."""
    if isinstance(value, Decimal):
        text = str(value)
    else:
        text = _summary(value) if isinstance(value, dict | tuple | list) else repr(value)
    return text if len(text) <= _LONGEST_QUOTE else text[: _LONGEST_QUOTE - 1] + "…"


def _summary(value: dict | tuple | list) -> str:
    if isinstance(value, dict):
        return "a table"
    if len(value) > 4:
        return f"a list of {len(value)}"
    return f"[{', '.join(quote(item) for item in value)}]"


def nearest(name: object, candidates: Sequence[str]) -> str:
    """Return "; did you mean …?" or, if no candidate is similar, the first few candidates."""
    typed = str(name)[:_LONGEST_QUOTE]
    close = [one for one in candidates if _plain_name(one) == _plain_name(typed)]
    close = close or get_close_matches(typed, candidates, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {first_few(candidates, _MOST_KNOWN)}" if candidates else ""


def _plain_name(name: str) -> str:
    """Return a name in lower case, without the leading zeros of its numbers."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name.casefold())


@cache
def list_tables(root: type[BaseModel]) -> Mapping[str, type[BaseModel]]:
    """Return the tables of a format by dotted path; each variant of a table has a path."""
    found: dict[str, type[BaseModel]] = {}
    for name, field in root.model_fields.items():
        kinds = [kind for kind in _kinds(field.annotation) if isinstance(kind, type)]
        models = [kind for kind in kinds if issubclass(kind, BaseModel)]
        for model in models:
            tags = (
                get_args(one.annotation)
                for key, one in model.model_fields.items()
                if get_origin(one.annotation) is Literal
                and all(key in other.model_fields for other in models)
            )
            for tag in next(tags) if len(models) > 1 else ("",):
                path = f"{name}.{tag}".rstrip(".")
                found[path] = model
                found |= {f"{path}.{key}": below for key, below in list_tables(model).items()}
    return found


def list_keys(model: type[BaseModel]) -> tuple[str, ...]:
    """Return the keys allowed in a table."""
    return tuple(name for name, field in model.model_fields.items() if not field.exclude)


def takes_numbers(key: str, root: type[BaseModel]) -> bool:
    """Return whether a key holds numbers and never text, in any table of a format."""
    kinds = [
        kind
        for model in list_tables(root).values()
        if key in model.model_fields
        for kind in _kinds(model.model_fields[key].annotation)
    ]
    return any(kind in (int, float, Decimal) for kind in kinds) and str not in kinds


def _kinds(annotation: object) -> Iterator[object]:
    """Yield the plain types of an annotation."""
    inner = get_args(annotation)
    if not inner:
        yield annotation
    for one in inner:
        yield from [type(one)] if get_origin(annotation) is Literal else _kinds(one)


def dotted(location: Location, document: object) -> str:
    """Return a place such as `experiments[2].kind (step-a)`.

    Lists count from 1, and experiments also have their id.
    """
    path, here, name = "", document, ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part + 1}]"
        else:
            path += ("." if path else "") + (
                part if re.fullmatch(r"[A-Za-z0-9_-]{1,40}", part) else quote(part)
            )
        try:
            here = here[part]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            here = None
        if isinstance(here, dict) and isinstance(part, int) and isinstance(here.get("id"), str):
            name = f" ({quote(here['id'])[1:-1]})"
    return path + name


def explain(error: ErrorDetails, document: dict, *, root: type[BaseModel] = Submission) -> str:
    """Return one pydantic error as `key: what was expected, what was found, what was meant`.

    `root` is the model of the format.
    """
    location = [part for part in error["loc"] if not isinstance(part, str) or part != "str"]
    table = ".".join(part for part in location[:-1] if isinstance(part, str))
    location = without_tag(location, document)
    where, found, kind = dotted(location, document), error["input"], error["type"]
    if kind == "missing":
        return f"{where}: is required and missing"
    if kind == "extra_forbidden":
        keys = list_keys(list_tables(root).get(table, root))
        return f"{where}: unknown key{nearest(location[-1], keys)}"
    text = f"{where}: {refusal(error)}"
    if kind == "tuple_type" and isinstance(found, dict):
        text += f"; start each with [[{where}]], in double brackets"
    context = error.get("ctx", {})
    typed = context["tag"] if kind == "union_tag_invalid" else found
    if kind in ("literal_error", "union_tag_invalid") and isinstance(typed, str):
        valid = str(context.get("expected") or context.get("expected_tags"))
        close = get_close_matches(typed, re.findall(r"'([^']*)'", valid), n=1)
        text += f"; did you mean {close[0]!r}?" if close else ""
    return text


def first_refusal(error: ValidationError) -> str:
    """Return the first fault of a file written by another program, with its place."""
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {refusal(first)}" if where else refusal(first)


def refusal(error: ErrorDetails) -> str:
    """Return what was expected and what was found, for one pydantic error."""
    kind, found = error["type"], quote(error["input"])
    if kind == "union_tag_invalid":  # the input is the whole table
        found = quote(error.get("ctx", {})["tag"])
    if kind == "json_invalid":
        return "not JSON, or truncated"
    if kind == "value_error":  # its message says what was found
        return error["msg"].removeprefix("Value error, ").rstrip(".")
    if kind not in _EXPECTED:
        return f"{error['msg']}, found {found}"
    return f"expected {_EXPECTED[kind].format(**error.get('ctx', {}))}, found {found}"


def relevant_errors(errors: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Return the errors, unknown keys first.

    A missing key is left out if an unknown key is likely the same key, misspelt.
    """
    unknown = [error for error in errors if error["type"] == "extra_forbidden"]

    def is_misspelt(error: ErrorDetails) -> bool:
        *table, key = error["loc"]
        typed = [str(one["loc"][-1]) for one in unknown if [*one["loc"][:-1]] == table]
        return bool(get_close_matches(str(key), typed[:_MOST_KNOWN], n=1))

    others = [error for error in errors if error["type"] != "extra_forbidden"]
    return [*unknown, *(e for e in others if e["type"] != "missing" or not is_misspelt(e))]


def merge_equal(problems: Sequence[tuple[Location, str]]) -> list[str]:
    """Return the problems as text; equal ones in several tables of a list are counted.

    After a search-and-replace, problems differ only in the numbers and ids of the tables.
    """
    found: dict[tuple, list[str]] = {}
    for at, what in problems:
        keys = tuple("" if isinstance(part, int) else part for part in at)
        found.setdefault((keys, what.partition(": ")[2]), []).append(what)
    return [
        same[0] if len(same) == 1 else f"{same[0]} (and {len(same) - 1} more)"
        for same in found.values()
    ]


def list_faults(where: str, problems: Sequence[str], *, more: int = 0) -> str:
    """Return the faults of a file, one line each, and the number of further faults."""
    beyond = max(len(problems) - MOST_LISTED, 0) + more
    lines = [f"{where}: {what}" for what in problems[:MOST_LISTED]]
    return "\n".join([*lines, *([f"{where}: and {beyond} more"] if beyond else [])])


def without_tag(location: Location, document: object) -> list[int | str]:
    """Return a location without the names that pydantic adds for variants of a table.

    These names are not keys of the file.
    """
    kept: list[int | str] = []
    here = document
    for i, part in enumerate(location):
        selected = isinstance(here, dict) and part in here.values() and part not in here
        if selected and i < len(location) - 1:
            continue
        kept.append(part)
        try:
            here = here[part]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            here = None
    return kept
