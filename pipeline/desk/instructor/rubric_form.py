"""A rubric as a form and a text; numbers typed into the form are written into the text."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

import tomlkit
from starlette.datastructures import FormData

from pipeline.desk.toml_form import (
    Field,
    describe_field,
    find_changes,
    shortest_number,
    write_field,
)
from pipeline.errors import ConfigError
from pipeline.grading import rubric as asked
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.rubric_file import InvalidRubric, parse_rubric
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.submission.edit import edit_text
from pipeline.submission.toml import key_lines
from pipeline.words.text import capital

_UNITS = {
    "points": "points",
    "step": "points",
    "grace_days": "days",
    "overshoot_full": "percentage points",
    "overshoot_none": "percentage points",
}
_LATE = ("percent_per_day", "grace_days", "most_percent")
_AROUND = 2  # lines shown before and after a wrong line


@dataclass(frozen=True, kw_only=True)
class CriterionFields:
    """The fields of one criterion.

    Attributes
    ----------
    tolerances : the field of each tolerance by its key, in the order of the rubric.
    source : the field of `from`; None if the criterion has no such key.
    """

    id: str
    title: str
    check: str
    points: Field
    tolerances: Mapping[str, Field]
    source: Field | None = None


@dataclass(frozen=True, kw_only=True)
class RubricForm:
    """All values of a rubric that the form can change.

    Attributes
    ----------
    step : step to which points are rounded.
    """

    criteria: tuple[CriterionFields, ...]
    late: Mapping[str, Field]
    costs: Mapping[str, Field]
    step: Field
    see: Field

    @property
    def charged(self) -> list[str]:
        """The codes of the flags that cost points."""
        return [code for code, field in self.costs.items() if field.value != "0"]

    def fields(self) -> Iterator[Field]:
        """Yield every field."""
        for criterion in self.criteria:
            yield criterion.points
            yield from criterion.tolerances.values()
            yield from [criterion.source] if criterion.source else []
        yield from self.late.values()
        yield from self.costs.values()
        yield self.step
        yield self.see


def rubric_form(rubric: Rubric, changed: Mapping[str, Field] = {}) -> RubricForm:
    """Return the values of a rubric as a form; missing values are filled in with their defaults.

    Parameters
    ----------
    changed : fields, by path, that are shown in place of the rubric's own.
    """

    def shown(field: Field) -> Field:
        return changed.get(field.path, field)

    criteria = enumerate(rubric.criteria)
    return RubricForm(
        criteria=tuple(_criterion(i, own, rubric.names, shown) for i, own in criteria),
        late={key: shown(_amount(f"late.{key}", getattr(rubric.late, key))) for key in _LATE},
        costs={
            code: shown(
                _amount(
                    f"flags.{code}" if cost.most == 1 else f"flags.{code}.least",
                    cost.least,
                    kind="share",
                    label=capital(WORDS.text(f"title_{code}")),
                )
            )
            for code, cost in rubric.flags
        },
        step=shown(_amount("step", rubric.step)),
        see=shown(replace(describe_field("students.see", Rubric), value=rubric.students.see)),
    )


def _criterion(
    index: int, own: asked.Criterion, names: list[str], shown: Callable[[Field], Field]
) -> CriterionFields:
    def field(key: str) -> Field:
        # The id finds the criterion again if its place in the text has changed.
        amount = _amount(f"criteria.{index}.{key}", getattr(own, key))
        return shown(replace(amount, input=f"criteria.{own.id}.{key}"))

    source = None
    if "from" in type(own).model_fields:
        path, name = f"criteria.{index}.from", f"criteria.{own.id}.from"
        empty = describe_field("from", type(own))
        choices = tuple(filter(None, empty.choices))
        value = asked.source_of(own)
        source = shown(replace(empty, path=path, input=name, choices=choices, value=value))
    return CriterionFields(
        source=source,
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


def _amount(path: str, value: float, *, kind: str = "amount", label: str = "") -> Field:
    number = Decimal(repr(value)) * (100 if kind == "share" else 1)
    return Field(
        path=path,
        label=label,
        kind=kind,
        unit=_UNITS.get(path.rpartition(".")[2], "percent"),
        value=shortest_number(f"{number:f}"),
    )


# ------------------------------------------------------------------------ written back


def with_values(text: str, changed: Sequence[Field]) -> str:
    """Return the text of a rubric with new values.

    A new table stands before the criteria, because a table below them is easily overlooked.

    Raises
    ------
    ConfigError : the text cannot be changed in this way.
    """

    def change(document: tomlkit.TOMLDocument) -> None:
        for field in changed:
            write_field(document, field, keep_empty=True)

    # tomlkit can only append a table, so new headings are inserted into the text.
    paths = {path[0] for _, path in key_lines(text) if path}
    tables = [field.path.partition(".")[0] for field in changed if "." in field.path]
    for table in dict.fromkeys(tables):
        text = text if table in paths else _with_heading(text, table)
    return edit_text(text, change, where="rubric", error=ConfigError) if changed else text


def _with_heading(text: str, table: str) -> str:
    """Return a text with the heading of a new table above the first criterion and its comments."""
    lines = text.split("\n")
    at = next((n for n, path in key_lines(text) if path == ("criteria", 0)), 0) - 1
    if at < 0:  # the criteria have no headings
        return text
    while at and lines[at - 1].lstrip().startswith("#"):
        at -= 1
    return "\n".join([*lines[:at], f"[{table}]", "", *lines[at:]])


# ------------------------------------------------------------------------ what was typed


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """What is wrong with a line of a rubric; line 0 means the whole file."""

    line: int
    what: str


@dataclass(frozen=True, kw_only=True)
class RubricDraft:
    """A rubric as typed in the editor.

    Attributes
    ----------
    text : text as it would be saved, with the numbers of the form inserted.
    edited : text as the editor shows it, without the form's numbers if they make mistakes.
    rubric : the parsed rubric; None if something is wrong.
    form : the form with the numbers of the edited text, and what was typed instead of them; None if
        this text has a mistake.
    shown : the numbers of the edited text, as JSON; the next request finds changes by them.
    waiting : by name, the changed numbers of the form while the edited text has a mistake.
    """

    text: str
    edited: str
    rubric: Rubric | None
    mistakes: Sequence[Mistake]
    form: RubricForm | None
    shown: str
    waiting: Mapping[str, str]

    @property
    def excerpts(self) -> list[list[tuple[int, str, list[str]]]]:
        """The lines around each mistake: number, text, and what is wrong."""
        lines = self.text.split("\n")
        near = {
            n
            for one in self.mistakes
            for n in range(one.line - _AROUND, one.line + _AROUND + 1)
            if one.line and 0 < n <= len(lines)
        }
        found: list[list[tuple[int, str, list[str]]]] = []
        for n in sorted(near):
            if not found or found[-1][-1][0] != n - 1:
                found.append([])
            what = [one.what for one in self.mistakes if one.line == n]
            found[-1].append((n, lines[n - 1], what))
        return found


def read_draft(sent: FormData) -> RubricDraft:
    """Return the rubric that the editor's page sent."""
    return make_draft(_read_text(sent), _read_numbers(sent))


def make_draft(edited: str, typed: Mapping[str, str]) -> RubricDraft:
    """Return a rubric from its text and from changed numbers, which are inserted if possible.

    Parameters
    ----------
    typed : by name, the changed numbers of the form.
    """
    before, mistakes = _parse(edited)
    if before is None:
        empty = json.dumps(dict.fromkeys(typed, ""))
        return RubricDraft(text=edited, edited=edited, rubric=None, mistakes=mistakes, form=None,
                           shown=empty, waiting=typed)  # fmt: skip
    form, rubric = rubric_form(before), None
    fields, text = {field.name: field for field in form.fields()}, edited
    changed = find_changes(fields.values(), typed)
    mistakes = [
        Mistake(line=0, what=f"{name}: the text no longer contains it")
        for name in typed
        if name not in fields
    ]
    try:
        text = with_values(edited, changed)
        rubric, found = _parse(text)
        mistakes += found
    except ConfigError as error:
        mistakes.append(Mistake(line=0, what=str(error)))
    if mistakes or rubric is None:
        fields |= {field.name: field for field in changed}
        marked = rubric_form(before, _mark(fields.values(), text, mistakes))
        return RubricDraft(text=text, edited=edited, rubric=None, mistakes=mistakes, form=marked,
                           shown=_list_shown(form), waiting={})  # fmt: skip
    form = rubric_form(rubric)
    return RubricDraft(text=text, edited=text, rubric=rubric, mistakes=(), form=form,
                       shown=_list_shown(form), waiting={})  # fmt: skip


def _parse(text: str) -> tuple[Rubric | None, list[Mistake]]:
    if not text.strip():
        return None, []
    try:
        return parse_rubric(text, where="rubric"), []
    except InvalidRubric as error:
        return None, [Mistake(line=line, what=what) for line, what in error.problems]


def _list_shown(form: RubricForm) -> str:
    return json.dumps({field.name: field.value for field in form.fields()})


def _mark(fields: Iterable[Field], text: str, mistakes: Sequence[Mistake]) -> dict[str, Field]:
    """Return the fields by path; a field whose line of the text is wrong says "see line N"."""
    at = {one.line for one in mistakes}
    lines = {".".join(map(str, path)): line for line, path in key_lines(text) if line in at}
    return {
        one.path: replace(one, wrong=f"see line {lines[one.path]}") if one.path in lines else one
        for one in fields
    }


def _read_numbers(sent: FormData) -> dict[str, str]:
    """Return the numbers of the form that differ from those the page showed, by name."""
    try:
        shown: Any = json.loads(str(sent.get("shown") or "{}"))
    except ValueError:
        shown = {}
    known = shown.items() if isinstance(shown, dict) else ()
    return {
        name: typed.strip()
        for name, value in known
        if isinstance(typed := sent.get(name), str) and typed.strip() != value
    }


def _read_text(sent: FormData) -> str:
    """Return the text with line ends as in a file, because forms send different ones."""
    text = sent.get("text")
    plain = text.replace("\r\n", "\n") if isinstance(text, str) else ""
    return plain.rstrip() + "\n"
