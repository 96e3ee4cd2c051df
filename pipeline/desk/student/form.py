"""The form of `submission.toml`: show its keys as fields, and write typed values back.

Typed values are written into the file unchanged, with all their digits. The usual check of a
submission then reports mistakes, so nothing is checked twice. The model of a submission also
supplies the help and the type of each field.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import tomlkit
from tomlkit.items import AoT, Comment, Null

from pipeline.errors import SubmissionError
from pipeline.ingest.fill import UNSURE
from pipeline.names import parameter_names, read_name
from pipeline.setup import Units
from pipeline.submission import Submission
from pipeline.submission.edit import comment_text, toml_item
from pipeline.submission.load import InvalidSubmission, list_experiments, spring_names
from pipeline.submission.models import MOST_CARTS
from pipeline.words.text import symbol_text

# The groups of the form: key, title, keys of the file. Before the last group comes a group for the
# parameters, whose names depend on the number of carts.
_GROUPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("who", "Who and what", ("title", "section", "authors")),
    (
        "bench",
        "The bench",
        ("system.carts", "system.springs", "system.position.unit", "system.position.per_count",
         "system.input.unit", "system.input.sign", "system.input.per_count", "system.columns"),
    ),
    (
        "design",
        "The controller to design",
        ("design.cart", "design.reference", "design.overshoot_percent", "design.settling_time",
         "design.input_limit", "design.sample_time", "design.method"),
    ),
    (
        "model",
        "Your state model and controller",
        ("reported.state_space.A", "reported.state_space.B", "reported.feedback.gains",
         "reported.feedback.prefilter", "reported.feedback.overshoot_percent",
         "reported.feedback.settling_time"),
    ),
)  # fmt: skip
_OF_EXPERIMENT = ("kind", "carts", "frequency", "window", "note", "columns", "sample_rate")
_OF_LOOP = (
    "controlled_cart", "reference", "controller.type", "controller.gains", "controller.prefilter",
    "controller.kp", "controller.ki", "controller.kd", "controller.scale", "controller.cart",
)  # fmt: skip
_OF_CONTROLLER = {
    "state_feedback": ("gains", "prefilter"), "pid": ("kp", "ki", "kd", "scale", "cart"),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Why `submission.toml` is refused, as plain data.

    Attributes
    ----------
    text : the message.
    problems : the first problems, each with the path of its key; () if they have no keys.
    """

    text: str
    problems: Sequence[tuple[str, str]] = ()

    @classmethod
    def of(cls, error: SubmissionError) -> "Fault":
        """Return the fault that an error describes."""
        problems = error.problems if isinstance(error, InvalidSubmission) else ()
        located = tuple((".".join(map(str, at)), what) for at, what in problems)
        return cls(text=str(error), problems=located)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A possible answer to a question about a field: the text of its button, and the new value."""

    label: str
    value: str


@dataclass(frozen=True, kw_only=True)
class Field:
    """One key of `submission.toml` as a field of the form.

    Attributes
    ----------
    path : path of the key in the file.
    kind : text, number, numbers, rows (of numbers, one per line), flags, authors, columns, or words
        (a text of several lines).
    choices : the possible values; "" means that the key is left out.
    asked : question about a value that is doubtful but possible.
    symbol : symbol of the parameter, if the value is a parameter.
    """

    path: str
    label: str
    help: str = ""
    kind: str = "text"
    choices: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    value: str = ""
    wrong: str = ""
    asked: str = ""
    answers: tuple[Answer, ...] = ()
    symbol: str = ""

    @property
    def on(self) -> list[bool]:
        """The flags as booleans."""
        return [word == "true" for word in self.value.split()]


@dataclass(frozen=True, kw_only=True)
class Group:
    """Fields that belong together.

    Attributes
    ----------
    summary : the fields in one line.
    missing : fields that must still be filled in.
    """

    key: str
    title: str
    fields: tuple[Field, ...]
    summary: str = ""
    missing: str = ""

    @property
    def open(self) -> bool:
        """Whether the group is shown open, because something is missing or wrong in it."""
        return bool(self.missing) or any(field.wrong for field in self.fields)


def fill_form(document: Mapping[str, Any]) -> list[Group]:
    """Return the form of a submission, filled in from its file."""
    *first, last = [
        Group(key=key, title=title, fields=tuple(map(_describe_field, paths)))
        for key, title, paths in _GROUPS
    ]
    carts = count_carts(document)
    rigid = carts == 1 and _find(document, "system.springs") == [False, False]
    units = Units(
        position=str(_find(document, "system.position.unit") or "count"),
        input=str(_find(document, "system.input.unit") or "V"),
    )
    claims = tuple(
        Field(
            path=f"reported.{which}.{name}",
            label=f"{symbol_text(name)} {which}",
            symbol=symbol_text(name),
            help=read_name(name).unit(units),
            kind="number",
        )
        for name in parameter_names(carts, rigid=rigid)
        for which in ("initial", "final")
    )
    groups = [*first, Group(key="numbers", title="Your numbers", fields=claims), last]
    return [replace(group, fields=_fill(group.fields, document)) for group in groups]


def fill_experiment(document: Mapping[str, Any], index: int) -> tuple[Field, ...]:
    """Return the fields of one experiment, filled in from its table.

    These are the fields for the experiment's kind and controller, and any further fields in the
    table.
    """
    table = f"experiments.{index}"
    kind = _find(document, f"{table}.kind")
    chosen = _find(document, f"{table}.controller.type")
    of_type = [f"controller.{key}" for key in _OF_CONTROLLER.get(str(chosen), ())]
    used = {*_OF_EXPERIMENT, *_OF_LOOP[:3], *of_type} - ({"frequency"} if kind != "sine" else set())
    first, rest = _OF_EXPERIMENT[:2], _OF_EXPERIMENT[2:]
    keys = (*first, *_OF_LOOP, *rest) if kind == "closed_loop" else _OF_EXPERIMENT
    fields = _fill([_describe_field(f"{table}.{key}") for key in keys], document)
    return tuple(f for f, key in zip(fields, keys, strict=True) if key in used or f.value)


def sign_fields(document: Mapping[str, Any], signs: Mapping[str, int]) -> list[Field]:
    """Return a filled-in field for each input sign that its table does not state.

    Parameters
    ----------
    signs : sign of the input, by experiment.
    """
    return [
        replace(_describe_field(path), value=f"{signs[table['id']]:d}")
        for index, table in enumerate(list_experiments(document))
        for path in [f"experiments.{index}.input.sign"]
        if table.get("id") in signs and _find(document, path) is None
    ]


def is_of_loop(field: Field) -> bool:
    """Return whether a field of an experiment describes the controller that ran."""
    return field.path.split(".", 2)[2] in _OF_LOOP


def find_changes(fields: Iterable[Field], form: Mapping[str, Any], values: Any) -> list[Field]:
    """Return the fields that were changed or answered, with their new values.

    Parameters
    ----------
    form : typed text by path; a field without an entry was not shown.
    values : function that returns all values of a form field. For a field of flags, these are the
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
            on = values(field.path)
            text = " ".join("true" if str(i) in on else "false" for i in range(len(field.names)))
            shown = f"{field.path}.shown" in form
        else:
            text = str(form.get(field.path, "")).replace("\r\n", "\n").strip()
            shown = field.path in form
        if shown and text != field.value.strip():
            changed.append(replace(field, value=text))
    return changed


def mark_errors(
    fields: Sequence[Field], changed: Sequence[Field], fault: Fault | None
) -> tuple[tuple[Field, ...], list[str]]:
    """Return the fields with their typed values and problems; list other problems separately."""
    now = {field.path: field for field in changed}
    shown = [now.get(field.path, field) for field in fields]
    left: list[str] = []
    if fault is not None and not fault.problems:
        left.append(fault.text)
    for path, what in fault.problems if fault else ():
        place = next((i for i, f in enumerate(shown) if f"{path}.".startswith(f"{f.path}.")), None)
        if place is None:
            left.append(what)
        elif not shown[place].wrong:
            shown[place] = replace(shown[place], wrong=what.partition(": ")[2] or what)
    return tuple(shown), left


# ------------------------------------------------------------------- a key as a field


@cache
def _schema() -> dict[str, Any]:
    return Submission.model_json_schema()


def _variants(node: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the JSON Schemas of the types that a value may have, without null."""
    for key in ("anyOf", "oneOf"):
        if key in node:
            return [found for one in node[key] for found in _variants(one)]
    if "$ref" in node:
        return _variants(_schema()["$defs"][node["$ref"].rpartition("/")[2]])
    return [] if node.get("type") == "null" else [dict(node)]


def _describe_field(path: str) -> Field:
    """Return the empty field of a key, as described by the submission's model."""
    tables, keys, required = [_schema()], [], True
    for part in path.split("."):
        tables = [variant for key in keys for variant in _variants(key)] or tables
        if part.isdecimal():
            keys, required = [table["items"] for table in tables], True
        else:
            holders = [table for table in tables if part in table["properties"]]
            keys = [table["properties"][part] for table in holders]
            required &= all(part in table.get("required", ()) for table in holders)
    values = [variant for key in keys for variant in _variants(key)]
    return Field(
        path=path,
        label=keys[0]["title"],
        help=keys[0].get("description", ""),
        kind=_find_kind(values[0]),
        choices=_list_choices(values, first=[] if required else ["", keys[0].get("default")]),
    )


def _find_kind(value: Mapping[str, Any]) -> str:
    """Return the kind of a field; see `Field`."""
    kind = value["type"]
    if kind == "array":
        inner = _variants(value.get("items") or value["prefixItems"][0])[0]["type"]
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


def count_carts(document: Mapping[str, Any]) -> int:
    """Return the number of carts in a file; 1 if the file states no valid number."""
    carts = _find(document, "system.carts")
    return carts if isinstance(carts, int) and 1 <= carts <= MOST_CARTS else 1


def _fill(fields: Iterable[Field], document: Mapping[str, Any]) -> tuple[Field, ...]:
    springs = tuple(spring_names(count_carts(document)))
    return tuple(
        replace(
            field,
            names=springs if field.kind == "flags" else (),
            value=read_value(document, field),
        )
        for field in fields
    )


def _find(document: Any, path: str) -> Any:
    here = document
    for part in path.split("."):
        try:
            here = here[int(part)] if isinstance(here, list) else here[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return here


def read_value(document: Mapping[str, Any], field: Field) -> str:
    """Return the value of a field in a document, as a person would type it."""
    value = _find(document, field.path)
    if field.kind == "flags":
        every = [True] * (count_carts(document) + 1)
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


# --------------------------------------------------------------- from the form to the file


def write_fields(document: tomlkit.TOMLDocument, changed: Iterable[Field]) -> None:
    """Write typed values into a document; an empty field removes its key."""
    for field in changed:
        if field.path == "authors":
            _set_authors(document, field.value)
        else:
            # These two keys stay without a value, because they have comments in a new file.
            empty = not field.value and field.path not in ("title", "section")
            _set(document, field.path.split("."), None if empty else _make_item(field))
            _settle(document, field.path)
        # After a change of the number of carts, all springs count as present again.
        if field.path == "system.carts":
            _set(document, ["system", "springs"], None)


def _settle(document: tomlkit.TOMLDocument, path: str) -> None:
    """Remove the "doubtful" mark from a key of `[system]` that a person has just set."""
    table, key, *_ = [*path.split("."), ""]
    item: Any = document.get("system", {}).get(key) if table == "system" else None
    if item is not None and item.trivia.comment.startswith(f"# {UNSURE}"):
        item.trivia.comment_ws = item.trivia.comment = ""


def clear_marks(document: tomlkit.TOMLDocument, index: int, doubts: Iterable[str]) -> None:
    """Remove the comments that mark the given doubts from the table of an experiment."""
    texts = {f"# {_mark(doubt)}" for doubt in doubts}
    body: Any = document.get("experiments")
    if isinstance(body, AoT) and index < len(body):
        lines = body[index].value.body
        for place, (_, item) in enumerate(lines):
            if isinstance(item, Comment) and item.trivia.comment in texts:
                lines[place] = (None, Null())


def is_marked(doubt: str, marks: Sequence[str]) -> bool:
    """Return whether a table marks a doubt as unsure."""
    return _mark(doubt) in [UNSURE + mark for mark in marks]


def _mark(doubt: str) -> str:
    """Return the comment that marks a doubt, shortened to fit on a line of the file."""
    return comment_text(UNSURE + doubt)


def remove_experiment(document: tomlkit.TOMLDocument, index: int) -> None:
    """Remove the table of one experiment; its data file stays."""
    tables: Any = document["experiments"]
    if index < len(tables):
        del tables[index]


def _make_item(field: Field) -> Any:
    """Return a typed value as a TOML item."""
    match field.kind:
        case "number":
            return _make_number(field.value)
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


def _make_number(text: str) -> Any:
    """Return a number with its digits as typed.

    Other text stays text, which the check then refuses.
    """
    if re.fullmatch(r"[-+]?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?", text):
        return tomlkit.parse(f"x = {text}\n")["x"]
    return tomlkit.item(text)


def _make_numbers(text: str) -> Any:
    array = tomlkit.array()
    for word in re.split(r"[,;\s]+", text.strip("[] ")):
        if word:
            array.append(_make_number(word))
    return array


def _set(document: Any, parts: Sequence[str], item: Any) -> None:
    """Set the item at a path; None removes the key, and tables that become empty."""
    part, *rest = parts
    if isinstance(document, list):
        return _set(document[int(part)], rest, item)
    if not rest:
        if item is not None:
            document[part] = item
        elif part in document:
            del document[part]
        return
    if part not in document:
        if item is None:
            return
        above = bool(rest[1:])  # a table [reported.final] needs no heading [reported] above it
        in_one_line = part in ("input", "position", "controller", "columns")
        document[part] = tomlkit.inline_table() if in_one_line else tomlkit.table(above)
    _set(document[part], rest, item)
    if part not in ("system", "experiments") and not document[part]:
        del document[part]


def _set_authors(document: tomlkit.TOMLDocument, text: str) -> None:
    """Write the authors, one per line of text; an existing table keeps what was not changed."""
    lines = [line.partition(",")[::2] for line in text.splitlines() if line.strip()]
    people = [(id_.strip(), name.strip()) for id_, name in lines]
    if not people:
        document.pop("authors", None)
        return
    tables: Any = document.get("authors")
    if tables is None:
        tables = tomlkit.aot()
        for person in people:
            tables.append(_make_author(*person))
        document.append("authors", tables)
        return
    for i, person in enumerate(people):
        if i >= len(tables):
            tables.append(_make_author(*person))
            continue
        for key, value in zip(("id", "name"), person, strict=True):
            if str(tables[i].get(key, "")) != value:
                _set(tables[i], [key], tomlkit.item(value) if value else None)
    while len(tables) > len(people):
        del tables[len(tables) - 1]


def _make_author(id_: str, name: str) -> Any:
    table = tomlkit.table()
    table.add("id", id_)
    if name:
        table.add("name", name)
    return table
