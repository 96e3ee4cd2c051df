"""Show the values of a rubric as a form, and write changed values back into its text.

A changed value is replaced in its line, or added as a new line. Everything else in the text stays
byte for byte.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any, Literal, get_args

from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.rubric import Rubric, matching
from pipeline.names import read_name
from pipeline.submission import Students
from pipeline.submission.toml import key_lines, quote

Unit = Literal["points", "percent", "share", "days", "percentage points", "choice"]
Key = tuple[str | int, ...]  # path of a value: ("criteria", 3, "points")
Value = Decimal | str

_UNITS: Mapping[str, Unit] = {
    "points": "points",
    "step": "points",
    "grace_days": "days",
    "overshoot_full": "percentage points",
    "overshoot_none": "percentage points",
}
_LATE = ("percent_per_day", "grace_days", "most_percent")
_SEE: tuple[str, ...] = get_args(Students.model_fields["see"].annotation)
_VALUE = re.compile(
    r"^(?P<before>\s*[A-Za-z0-9_.\"'-]+\s*=\s*)"
    r"(?:[-+]?[0-9][0-9_.eE+-]*|\"[a-z]*\"|'[a-z]*')(?P<after>\s*(?:#.*)?)$"
)


@dataclass(frozen=True, kw_only=True)
class RubricField:
    """A field of the form: a number, or a choice among words.

    Attributes
    ----------
    name : name of the HTML input; it contains the id of the criterion.
    key : path of the value in the rubric.
    value : the value as shown; a share is shown in percent.
    choices : the possible words; empty for a number.
    """

    name: str
    key: Key
    unit: Unit
    value: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class CriterionFields:
    """The fields of one criterion.

    Attributes
    ----------
    tolerances : the field of each tolerance by its key, in the order of the rubric.
    """

    id: str
    title: str
    check: str
    points: RubricField
    tolerances: Mapping[str, RubricField]


@dataclass(frozen=True, kw_only=True)
class RubricForm:
    """All values of a rubric that the form can change.

    Attributes
    ----------
    step : step to which points are rounded.
    """

    criteria: tuple[CriterionFields, ...]
    late: Mapping[str, RubricField]
    costs: Mapping[str, RubricField]
    step: RubricField
    see: RubricField

    @property
    def charged(self) -> list[str]:
        """The codes of the flags that cost points."""
        return [code for code, field in self.costs.items() if field.value != "0"]

    def fields(self) -> Iterator[RubricField]:
        """Yield every field."""
        for criterion in self.criteria:
            yield criterion.points
            yield from criterion.tolerances.values()
        yield from self.late.values()
        yield from self.costs.values()
        yield self.step
        yield self.see


class WrongFields(ConfigError):
    """Fields of the form have wrong values.

    Attributes
    ----------
    problems : the problem of each wrong field, by the name of the field.
    """

    def __init__(self, problems: Mapping[str, str]) -> None:
        self.problems = dict(problems)
        super().__init__("\n".join(f"{name}: {what}" for name, what in problems.items()))


def rubric_form(rubric: Rubric) -> RubricForm:
    """Return the values of a rubric as a form; missing values are filled in with their defaults."""
    return RubricForm(
        criteria=tuple(_criterion(i, own, rubric.names) for i, own in enumerate(rubric.criteria)),
        late={key: _field(("late", key), getattr(rubric.late, key)) for key in _LATE},
        costs={
            code: _field(
                ("flags", code) if cost.most == 1 else ("flags", code, "least"),
                cost.least,
                unit="share",
            )
            for code, cost in rubric.flags
        },
        step=_field(("step",), rubric.step),
        see=RubricField(
            name="students.see",
            key=("students", "see"),
            unit="choice",
            value=rubric.students.see,
            choices=_SEE,
        ),
    )


def _criterion(index: int, own: asked.Criterion, names: list[str]) -> CriterionFields:
    def field(key: str) -> RubricField:
        name = f"criteria.{own.id}.{key}"
        return _field(("criteria", index, key), getattr(own, key), name=name)

    return CriterionFields(
        id=own.id,
        title=own.title or own.id,
        check=own.check,
        points=field("points"),
        tolerances={key: field(key) for key in _tolerances(own, names)},
    )


def _tolerances(own: asked.Criterion, names: list[str]) -> Iterator[str]:
    """Yield the keys of the tolerances that apply to the numbers of a criterion."""
    judged = matching(getattr(own, "parameters", ("*",)), names)
    dampings = [read_name(name).is_damping for name in judged]
    for key in type(own).model_fields:
        of_dampings = key.startswith("damping_")
        by_kind = isinstance(own, asked.Parameters | asked.InitialFinal)
        if key.endswith(("_percent", "_full", "_none")) and not (
            by_kind and dampings and (not any(dampings) if of_dampings else all(dampings))
        ):
            yield key


def _field(
    key: Key, value: float, *, unit: Unit | None = None, name: str | None = None
) -> RubricField:
    number = Decimal(repr(value)) * (100 if unit == "share" else 1)
    return RubricField(
        name=name or ".".join(map(str, key)),
        key=key,
        unit=unit or _UNITS.get(str(key[-1]), "percent"),
        value=_digits(number),
    )


def _digits(number: Decimal) -> str:
    """Return a number without exponent and without trailing zeros."""
    text = format(number.normalize(), "f")
    return "0" if text == "-0" else text


# ------------------------------------------------------------------------ written back


def changed_fields(form: RubricForm, typed: Mapping[str, str]) -> dict[Key, Value]:
    """Return the values that a person changed in a form, as the rubric stores them.

    Parameters
    ----------
    typed : what was typed, by the name of the field; fields that are not in it stay unchanged.

    Raises
    ------
    WrongFields : some fields have wrong values, or are not fields of this rubric.
    """
    fields = {field.name: field for field in form.fields()}
    changed: dict[Key, Value] = {}
    wrong = {name: "the text no longer contains it" for name in typed if name not in fields}
    for name, field in fields.items():
        text = typed.get(name)
        if text is None or text.strip() == field.value:
            continue
        if field.choices:
            if text in field.choices:
                changed[field.key] = text
            else:
                wrong[name] = f"needs {' or '.join(field.choices)}, found {quote(text)}"
            continue
        try:
            number = Decimal(text.strip().replace(",", "."))
        except InvalidOperation:
            number = Decimal("nan")
        if not number.is_finite() or len(text) > 20:
            wrong[name] = f"needs a number, found {quote(text)}"
        elif number != Decimal(field.value):
            changed[field.key] = number / 100 if field.unit == "share" else number
    if wrong:
        raise WrongFields(wrong)
    return changed


def with_values(text: str, values: Mapping[Key, Value]) -> str:
    """Return the text of a rubric with new values.

    Raises
    ------
    ConfigError : a value shares its line with others; a person must change it in the text.
    """
    for key, value in values.items():
        text = _with_value(text, key, _toml(value))
    return text


def _toml(value: Value) -> str:
    return f'"{value}"' if isinstance(value, str) else _digits(value)


def _with_value(text: str, key: Key, value: str) -> str:
    wanted = _set(tomllib.loads(text), key, value)
    for candidate in _candidates(text, key, value):
        try:
            if tomllib.loads(candidate) == wanted:
                return candidate
        except tomllib.TOMLDecodeError:
            continue
    name = ".".join(map(str, key))
    raise ConfigError(f"{name}: is not on a line of its own; change it in the text")


def _set(document: dict[str, Any], key: Key, value: str) -> dict[str, Any]:
    """Return a document with one value replaced; the new value is given as TOML."""
    document = deepcopy(document)
    here: Any = document
    for part in key[:-1]:
        here = here.setdefault(part, {}) if isinstance(here, dict) else here[part]
    here[key[-1]] = tomllib.loads(f"x = {value}")["x"]
    return document


def _candidates(text: str, key: Key, value: str) -> Iterator[str]:
    """Yield texts that may have the new value in the right place, the most likely first.

    A line that looks like the key may be part of a longer value. So the caller parses each text to
    see whether it is right.
    """
    lines, places = text.split("\n"), list(key_lines(text))
    for number, path in places:
        found = _VALUE.match(lines[number - 1]) if path == key else None
        if found:
            line = f"{found['before']}{value}{found['after']}"
            yield "\n".join([*lines[: number - 1], line, *lines[number:]])
    new, table = f"{key[-1]} = {value}", key[:-1]
    inside = [n for n, path in places if path == table or path[:-1] == table]
    for number in reversed(inside):
        yield "\n".join([*lines[:number], new, *lines[number:]])
    heading = next((n for n, path in places if path == ("criteria", 0)), 0)
    if heading and not inside:
        at = _above(lines, heading - 1)
        yield "\n".join([*lines[:at], f"[{table[0]}]", new, "", *lines[at:]])


def _above(lines: Sequence[str], at: int) -> int:
    """Return the first line of the comments directly above a line."""
    while at and lines[at - 1].lstrip().startswith("#"):
        at -= 1
    return at
