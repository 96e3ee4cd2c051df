"""The form of `submission.toml`: its keys as fields, and what was typed back into the file.

What was typed goes into the file as it was typed, digits and all, and the submission's own check
says what is wrong with it: nothing is checked twice.
"""

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import tomlkit

from pipeline.errors import SubmissionError
from pipeline.ingest.fill import unit_doubt
from pipeline.names import parameter_names, read_name
from pipeline.report.words import symbol_text
from pipeline.resources import TEMPLATES
from pipeline.submission.edit import toml_item
from pipeline.submission.load import InvalidSubmission, spring_names
from pipeline.submission.models import MOST_CARTS

_NUMBER = re.compile(r"[-+]?(0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?")
_INLINE = ("input", "position", "controller", "columns")  # tables that stand in one line
_BLANK = ("title", "section")  # keys that stay where nothing is said, and their comments
_KEPT = ("system", "experiments")  # tables that stay where nothing is left in them


@dataclass(frozen=True, kw_only=True)
class Field:
    """One key of the file; `value` as it stands there or was typed, `wrong` what is wrong with it.

    Attributes
    ----------
    asked : what speaks against the value, though it can be used.
    names : of the flags.
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

    @property
    def on(self) -> list[bool]:
        """The flags."""
        return [word == "true" for word in self.value.split()]


@dataclass(frozen=True, kw_only=True)
class Group:
    """Fields that belong together."""

    title: str
    fields: tuple[Field, ...]
    optional: bool = False

    @property
    def open(self) -> bool:
        """Whether to show it at once: something stands in it, or it is needed."""
        return not self.optional or any(field.value or field.wrong for field in self.fields)

    def filled(self, fields: Mapping[str, Field]) -> "Group":
        """Return the group with fields of other values."""
        return replace(self, fields=tuple(fields[field.path] for field in self.fields))


def read_document(text: str) -> dict[str, Any]:
    """Return the tables of a file as they were typed: numbers as text; {} where it is no TOML."""
    try:
        return tomllib.loads(text, parse_float=str)  # type: ignore[arg-type]
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return {}


def groups(document: Mapping[str, Any]) -> list[Group]:
    """Return the form of a submission, filled in from its file."""
    carts = _carts(document)
    found = []
    for entry in _catalogue()["groups"]:
        fields = [_field(one, one["path"]) for one in entry["fields"]]
        optional = entry.get("optional", False)
        found.append(Group(title=entry["title"], fields=tuple(fields), optional=optional))
    rigid = carts == 1 and _at(document, "system.springs") == [False, False]
    units = {
        key: str(_at(document, f"system.{key}.unit") or unit)
        for key, unit in (("position", "count"), ("input", "V"))
    }
    claims = tuple(
        Field(
            path=f"reported.{which}.{name}",
            label=f"{symbol_text(name)} {which}",
            help=read_name(name).unit(**units),
            kind="number",
        )
        for name in parameter_names(carts, rigid=rigid)
        for which in ("initial", "final")
    )
    found.insert(3, Group(title="Your numbers", fields=claims, optional=True))
    return [replace(group, fields=_filled(group.fields, document, carts)) for group in found]


def asked_for_unit(fields: Iterable[Field], fractions: Sequence[str]) -> tuple[Field, ...]:
    """Return the fields, with what speaks against the unit of positions; see `unit_doubt`."""
    path = "system.position.unit"
    return tuple(
        replace(field, asked=unit_doubt(field.value or "count", fractions=fractions))
        if field.path == path
        else field
        for field in fields
    )


def field_text(document: Mapping[str, Any], field: Field) -> str:
    """Return the value of a field in another state of the file."""
    return _fill(field, document, _carts(document)).value


def experiment_fields(document: Mapping[str, Any], index: int) -> tuple[Field, ...]:
    """Return the fields of one experiment, filled in from its table."""
    entries = [*_catalogue()["experiment"]]
    if _at(document, f"experiments.{index}.kind") == "closed_loop":
        entries += _catalogue()["loop"]
    fields = [_field(one, f"experiments.{index}.{one['path']}") for one in entries]
    return _filled(fields, document, _carts(document))


def typed(fields: Iterable[Field], form: Mapping[str, Any], values: Any) -> list[Field]:
    """Return the fields whose value was changed, with what was typed.

    Parameters
    ----------
    form : by path, what was typed; a field that is not in it was not shown.
    values : likewise, of flags: the numbers of those that are on.
    """
    changed = []
    for field in fields:
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


def with_errors(
    fields: Sequence[Field], changed: Sequence[Field], error: SubmissionError | None
) -> tuple[tuple[Field, ...], list[str]]:
    """Return the fields as typed, each with what is wrong with it, and what belongs to none."""
    now = {field.path: field for field in changed}
    shown = [now.get(field.path, field) for field in fields]
    left: list[str] = []
    problems = error.problems if isinstance(error, InvalidSubmission) else ()
    if error is not None and not problems:
        left.append(str(error))
    for location, what in problems:
        path = ".".join(map(str, location))
        place = next((i for i, f in enumerate(shown) if f"{path}.".startswith(f"{f.path}.")), None)
        if place is None:
            left.append(what)
        elif not shown[place].wrong:
            shown[place] = replace(shown[place], wrong=what.partition(": ")[2] or what)
    return tuple(shown), left


def apply(document: tomlkit.TOMLDocument, changed: Iterable[Field]) -> None:
    """Write what was typed into a document; an emptied field takes its key away."""
    for field in changed:
        if field.path == "authors":
            _set_authors(document, field.value)
        else:
            empty = not field.value and field.path not in _BLANK
            _set(document, field.path.split("."), None if empty else _item(field))
        if field.path == "system.carts":  # springs for another number of carts: all are there
            _set(document, ["system", "springs"], None)


def remove_experiment(document: tomlkit.TOMLDocument, index: int) -> None:
    """Take the table of one experiment away; its file stays."""
    tables: Any = document["experiments"]
    if index < len(tables):
        del tables[index]


# --------------------------------------------------------------------------- values


@cache
def _catalogue() -> dict[str, Any]:
    return tomllib.loads((TEMPLATES / "desk" / "fields.toml").read_text(encoding="utf-8"))


def _field(entry: Mapping[str, Any], path: str) -> Field:
    return Field(**{**entry, "path": path, "choices": tuple(entry.get("choices", ()))})


def _carts(document: Mapping[str, Any]) -> int:
    carts = _at(document, "system.carts")
    return carts if isinstance(carts, int) and 1 <= carts <= MOST_CARTS else 1


def _filled(fields: Iterable[Field], document: Mapping[str, Any], carts: int) -> tuple[Field, ...]:
    return tuple(_fill(field, document, carts) for field in fields)


def _fill(field: Field, document: Mapping[str, Any], carts: int) -> Field:
    value = _at(document, field.path)
    if field.kind == "flags":
        names = tuple(spring_names(carts))
        flags = (
            value if isinstance(value, list) and len(value) == len(names) else [True] * len(names)
        )
        text = " ".join("true" if flag else "false" for flag in flags)
        return replace(field, names=names, value=text)
    return replace(field, value=_text(field, value))


def _at(document: Any, path: str) -> Any:
    here = document
    for part in path.split("."):
        try:
            here = here[int(part)] if isinstance(here, list) else here[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return here


def _text(field: Field, value: Any) -> str:
    """Return a value as it is typed."""
    if value is None:
        return ""
    if field.kind == "authors" and isinstance(value, list):
        people = [one for one in value if isinstance(one, dict)]
        lines = (
            ", ".join(filter(None, (_row(p.get("id", "")), _row(p.get("name", "")))))
            for p in people
        )
        return "\n".join(lines)
    if field.kind == "columns" and isinstance(value, dict):
        return "\n".join(f"{role} = {_row(column)}" for role, column in value.items())
    if field.kind == "rows" and isinstance(value, list):
        return "\n".join(_row(row) for row in value)
    return _row(value)


def _row(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_row, value))
    try:
        return str(value)
    except ValueError:  # a whole number of thousands of digits, which only fits one typed in hex
        return hex(value)


def _item(field: Field) -> Any:
    """Return what was typed as an item of the file."""
    match field.kind:
        case "number" | "count":
            return _number(field.value)
        case "flags":
            return toml_item([word == "true" for word in field.value.split()])
        case "numbers":
            return _numbers(field.value)
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
                rows.append(_numbers(line))
            return rows.multiline(True)
    return tomlkit.item(field.value)


def _number(text: str) -> Any:
    """Return a number with the digits it was typed with; what is none stays text, to be refused."""
    return tomlkit.parse(f"x = {text}\n")["x"] if _NUMBER.fullmatch(text) else tomlkit.item(text)


def _numbers(text: str) -> Any:
    array = tomlkit.array()
    for word in _words(text):
        array.append(_number(word))
    return array


def _words(text: str) -> Iterator[str]:
    return (word for word in re.split(r"[,;\s]+", text.strip("[] ")) if word)


def _set(document: Any, parts: Sequence[str], item: Any) -> None:
    """Put an item at its place, or take the key there away, and tables left empty with it."""
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
        inline = part in _INLINE
        above = bool(rest[1:])  # [reported.final] needs no [reported]
        document[part] = tomlkit.inline_table() if inline else tomlkit.table(above)
    _set(document[part], rest, item)
    if part not in _KEPT and not document[part]:
        del document[part]


def _set_authors(document: tomlkit.TOMLDocument, text: str) -> None:
    """Write the people, one a line; of a table that stays only what was changed is."""
    people = [line.partition(",")[::2] for line in text.splitlines() if line.strip()]
    tables: Any = document.get("authors")
    if not people:
        document.pop("authors", None)
        return
    if tables is None:
        new = tomlkit.aot()
        for id_, name in people:
            new.append(_author(id_, name))
        document.append("authors", new)
        return
    for i, (id_, name) in enumerate(people):
        if i >= len(tables):
            tables.append(_author(id_, name))
            continue
        for key, value in (("id", id_.strip()), ("name", name.strip())):
            if str(tables[i].get(key, "")) != value:
                _set(tables[i], [key], tomlkit.item(value) if value else None)
    while len(tables) > len(people):
        del tables[len(tables) - 1]


def _author(id_: str, name: str) -> Any:
    table = tomlkit.table()
    table.add("id", id_.strip())
    if name.strip():
        table.add("name", name.strip())
    return table
