"""The form of a TOML file: keys of its model as fields, and typed values written into its text.

The model of the file supplies the kind, the help and the choices of each field. Values are written
into the file as typed. The usual check of the file then reports mistakes, so nothing is checked
twice. Comments, order, and every line that a person did not change stay byte for byte.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from functools import cache
from typing import Any

import tomlkit
from pydantic import BaseModel
from tomlkit.items import InlineTable, Item, Table, Whitespace

from pipeline.submission.edit import toml_item
from pipeline.submission.toml import refuse_number

_IN_ONE_LINE = ("input", "position", "controller", "columns")  # tables written as { … }


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A possible answer to a question about a field: the text of its button, and the new value."""

    label: str
    value: str


@dataclass(frozen=True, kw_only=True)
class Field:
    """One key of a file as a field of the form.

    Attributes
    ----------
    path : path of the key in the file; tables in a list have their number.
    input : name of the HTML input, if it is not the path.
    kind : text, words (of several lines), number, numbers, rows (of numbers, one per line), flags,
        authors, columns or effect; amount, a number in its shortest form; or share, an amount in
        percent.
    unit : the unit of an amount.
    choices : the possible values; "" means that the key is left out.
    names : the names of the flags.
    wrong : why the value is refused.
    asked : question about a value that is doubtful but possible.
    symbol : symbol of the parameter, if the value is a parameter.
    """

    path: str
    label: str
    input: str = ""
    help: str = ""
    kind: str = "text"
    unit: str = ""
    choices: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    value: str = ""
    wrong: str = ""
    asked: str = ""
    answers: tuple[Answer, ...] = ()
    symbol: str = ""

    @property
    def name(self) -> str:
        """The name of the HTML input."""
        return self.input or self.path

    @property
    def on(self) -> list[bool]:
        """The flags as booleans."""
        return [word == "true" for word in self.value.split()]


# ------------------------------------------------------------------- a key as a field


def describe_field(path: str, root: type[BaseModel]) -> Field:
    """Return the empty field of a key, as described by the model of the file."""
    tables, keys, required = [_schema(root)], [], True
    for part in path.split("."):
        tables = [variant for key in keys for variant in _variants(key, root)] or tables
        if part.isdecimal():
            keys, required = [table["items"] for table in tables], True
        else:
            holders = [table for table in tables if part in table["properties"]]
            keys = [table["properties"][part] for table in holders]
            required &= all(part in table.get("required", ()) for table in holders)
    values = [variant for key in keys for variant in _variants(key, root)]
    return Field(
        path=path,
        label=keys[0].get("title", path),
        help=keys[0].get("description", ""),
        kind=_find_kind(values[0], root),
        choices=_list_choices(values, first=[] if required else ["", keys[0].get("default")]),
    )


@cache
def _schema(root: type[BaseModel]) -> dict[str, Any]:
    return root.model_json_schema()


def _variants(node: Mapping[str, Any], root: type[BaseModel]) -> list[dict[str, Any]]:
    """Return the JSON Schemas of the types that a value may have, without null."""
    for key in ("anyOf", "oneOf"):
        if key in node:
            return [found for one in node[key] for found in _variants(one, root)]
    if "$ref" in node:
        return _variants(_schema(root)["$defs"][node["$ref"].rpartition("/")[2]], root)
    return [] if node.get("type") == "null" else [dict(node)]


def _find_kind(value: Mapping[str, Any], root: type[BaseModel]) -> str:
    """Return the kind of a field; see `Field`."""
    kind = value["type"]
    if kind == "array":
        inner = _variants(value.get("items") or value["prefixItems"][0], root)[0]["type"]
        return {"object": "authors", "array": "rows", "boolean": "flags"}.get(inner, "numbers")
    if kind == "string":
        return "words" if value.get("maxLength", 0) > 200 else "text"
    return {"object": "columns"}.get(kind, "number")


def _list_choices(values: Sequence[Mapping[str, Any]], *, first: Sequence[Any]) -> tuple[str, ...]:
    """Return the possible values of a field, or () if any text can be typed."""
    every = [
        choice
        for value in values
        for choice in (value.get("enum") or ([value["const"]] if "const" in value else []))
    ]
    if values[0]["type"] == "integer" and "maximum" in values[0]:
        every = list(range(values[0]["minimum"], values[0]["maximum"] + 1))
    known = [one for one in first if one == "" or one in every] if every else []
    return tuple(map(str, dict.fromkeys([*known, *every])))


# --------------------------------------------------------------- from the file to the form


def find_value(document: Any, path: str) -> Any:
    """Return the value at a path of a document; None if the path leads nowhere."""
    here = document
    for part in path.split("."):
        try:
            here = here[int(part)] if isinstance(here, list) else here[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return here


def read_value(document: Mapping[str, Any], field: Field) -> str:
    """Return the value of a field in a document, as a person would type it."""
    value = find_value(document, field.path)
    if field.kind == "flags":
        every = [True] * len(field.names)
        stated = value if isinstance(value, list) and len(value) == len(every) else every
        return " ".join("true" if flag else "false" for flag in stated)
    if value is None:
        return ""
    if field.kind == "authors" and isinstance(value, list):
        people = [
            [_write_value(person.get(key, "")) for key in ("id", "name")]
            for person in value
            if isinstance(person, dict)
        ]
        return "\n".join(", ".join(filter(None, person)) for person in people)
    if field.kind == "columns" and isinstance(value, dict):
        return "\n".join(f"{role} = {_write_value(column)}" for role, column in value.items())
    if field.kind == "rows" and isinstance(value, list):
        return "\n".join(map(_write_value, value))
    return _write_value(value)


def _write_value(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_write_value, value))
    try:
        return str(value)
    except ValueError:  # a number with thousands of digits, which can only have been typed in hex
        return hex(value)


# --------------------------------------------------------------- what was typed


def find_changes(
    fields: Iterable[Field],
    form: Mapping[str, Any],
    values: Callable[[str], Sequence[Any]] = lambda name: (),
) -> list[Field]:
    """Return the fields that were changed or answered, with their new values.

    Parameters
    ----------
    form : typed text by name of the input; a field without an entry was not shown.
    values : function that returns all values of an input. For a field of flags, these are the
        numbers of the flags that are on. For `answer`, they are texts "path=value", one for each
        answered question.
    """
    changed = []
    answered = dict(one.partition("=")[::2] for one in values("answer"))
    for field in fields:
        if field.path in answered:
            changed.append(replace(field, value=answered[field.path]))
            continue
        if field.kind == "flags":
            on = values(field.name)
            text = " ".join("true" if str(i) in on else "false" for i in range(len(field.names)))
            shown = f"{field.name}.shown" in form
        else:
            text = str(form.get(field.name, "")).replace("\r\n", "\n").strip()
            shown = field.name in form
        if field.kind in ("amount", "share"):
            text = shortest_number(text)
        if shown and text != field.value.strip():
            changed.append(replace(field, value=text))
    return changed


def shortest_number(text: str) -> str:
    """Return a number, typed with a point or a comma, in its shortest form; other text as it is."""
    try:
        number = Decimal(text.replace(",", "."))
    except InvalidOperation:
        return text
    return text if refuse_number(number) else _digits(number)


def _digits(number: Decimal) -> str:
    """Return a number without exponent and without trailing zeros."""
    text = format(number.normalize(), "f")
    return "0" if text == "-0" else text


# --------------------------------------------------------------- from the form to the file


def write_field(document: tomlkit.TOMLDocument, field: Field, *, keep_empty: bool = False) -> None:
    """Write the value of a field into a document.

    Parameters
    ----------
    keep_empty : whether an empty field keeps its key, with an empty text; else its key is removed.
    """
    is_removed = not field.value and not keep_empty
    set_item(document, field.path.split("."), None if is_removed else _make_item(field))


def _make_item(field: Field) -> Item:
    """Return a typed value as a TOML item."""
    match field.kind:
        case "number" | "amount":
            return _make_number(field.value)
        case "share":
            number = _make_number(field.value)
            if isinstance(number, str) or refuse_number(Decimal(field.value)):
                return number
            return _make_number(_digits(Decimal(field.value) / 100))
        case "flags":
            return toml_item(field.on)
        case "numbers":
            return _make_numbers(field.value)
        case "columns":
            pairs = (line.partition("=")[::2] for line in field.value.splitlines())
            return toml_item(
                {
                    role.strip(): int(column) if column.strip().isdecimal() else column.strip()
                    for role, column in pairs
                }
            )
        case "rows":
            rows = tomlkit.array()
            for line in field.value.splitlines():
                rows.append(_make_numbers(line))
            return rows.multiline(True)
    return tomlkit.item(field.value)


def _make_number(text: str) -> Item:
    """Return a number with its digits as typed.

    Other text stays text, which the check then refuses.
    """
    if re.fullmatch(r"[-+]?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?", text):
        return tomlkit.value(text)
    return tomlkit.item(text)


def _make_numbers(text: str) -> Item:
    array = tomlkit.array()
    for word in re.split(r"[,;\s]+", text.strip("[] ")):
        if word:
            array.append(_make_number(word))
    return array


def set_item(document: Any, parts: Sequence[str], item: Item | None) -> None:
    """Set the item at a path; None removes the key, and tables that become empty."""
    part, *rest = parts
    if isinstance(document, list):
        return set_item(document[int(part)], rest, item)
    if not rest:
        if item is None:
            if part in document:
                del document[part]
        elif part in document or not isinstance(document, Table):
            document[part] = item
        else:
            _add_key(document, part, item)
        return
    if part not in document:
        if item is None:
            return
        above = bool(rest[1:])  # a table [reported.final] needs no heading [reported] above it
        inline = part in _IN_ONE_LINE or isinstance(document, InlineTable)
        document[part] = tomlkit.inline_table() if inline else tomlkit.table(above)
    set_item(document[part], rest, item)
    if part not in ("system", "experiments") and not document[part]:
        del document[part]


def _add_key(table: Table, key: str, item: Item) -> None:
    """Add a key below the last one of a table, above the comments before the next heading.

    A table without keys gets it after the comments that follow the heading.
    """
    body = table.value.body
    keys = [place for place, (name, _) in enumerate(body) if name is not None]
    blank = (place for place, (_, line) in enumerate(body) if isinstance(line, Whitespace))
    end = keys[-1] + 1 if keys else next(blank, len(body))
    below = body[end:]
    del body[end:]
    table[key] = item
    body.extend(below)
