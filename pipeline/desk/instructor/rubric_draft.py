"""A rubric that a person typed: its text, with the numbers of the form inserted."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from starlette.datastructures import FormData

from pipeline.errors import ConfigError
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import InvalidRubric, key_lines, parse_rubric
from pipeline.grading.rubric_form import (
    RubricForm,
    WrongFields,
    changed_fields,
    rubric_form,
    with_values,
)

_AROUND = 2  # lines shown before and after a wrong line


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
    edited : text as the editor shows it, without the form's numbers if they cannot be inserted.
    rubric : the parsed rubric; None if something is wrong.
    form : the form with the numbers of the edited text; None if this text has a mistake.
    typed : by name, the changed numbers of the form that could not be inserted into the text.
    wrong : by name, what is wrong with a number of the form.
    """

    text: str
    edited: str
    rubric: Rubric | None
    mistakes: Sequence[Mistake]
    form: RubricForm | None
    typed: Mapping[str, str]
    wrong: Mapping[str, str]

    @property
    def shown(self) -> str:
        """The numbers that the page shows, as JSON; the next request finds changes by them."""
        if self.form is None:
            return json.dumps(dict.fromkeys(self.typed, ""))
        return json.dumps({field.name: field.value for field in self.form.fields()})

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
    edited = _read_text(sent)
    return make_draft(edited, _changed(sent))


def make_draft(edited: str, typed: Mapping[str, str]) -> RubricDraft:
    """Return a rubric from its text and from changed numbers, which are inserted if possible.

    Parameters
    ----------
    typed : by name, the changed numbers of the form.
    """
    rubric, mistakes = _parsed(edited)
    if rubric is None:
        return RubricDraft(text=edited, edited=edited, rubric=None, mistakes=mistakes, form=None,
                           typed=typed, wrong={})  # fmt: skip
    form = rubric_form(rubric)
    try:
        text = with_values(edited, changed_fields(form, typed))
    except ConfigError as error:
        problems = error.problems if isinstance(error, WrongFields) else {"": str(error)}
        mistakes = [
            Mistake(line=0, what=f"{name}: {what}" if name else what)
            for name, what in problems.items()
        ]
        return RubricDraft(text=edited, edited=edited, rubric=None, mistakes=mistakes, form=form,
                           typed=typed, wrong=problems)  # fmt: skip
    rubric, mistakes = _parsed(text)
    if rubric is None:
        return RubricDraft(text=text, edited=edited, rubric=None, mistakes=mistakes, form=form,
                           typed=typed, wrong=_by_field(text, mistakes, form))  # fmt: skip
    return RubricDraft(text=text, edited=text, rubric=rubric, mistakes=(),
                       form=rubric_form(rubric), typed={}, wrong={})  # fmt: skip


def _parsed(text: str) -> tuple[Rubric | None, list[Mistake]]:
    if not text.strip():
        return None, []
    try:
        return parse_rubric(text, where="rubric"), []
    except InvalidRubric as error:
        return None, [Mistake(line=line, what=what) for line, what in error.problems]


def _by_field(text: str, mistakes: Sequence[Mistake], form: RubricForm) -> dict[str, str]:
    """Return "see line N" for each field whose line is wrong, by name."""
    at = {one.line for one in mistakes}
    lines = {path: line for line, path in key_lines(text) if line in at}
    known = {field.name: lines.get(field.key) for field in form.fields()}
    return {name: f"see line {line}" for name, line in known.items() if line is not None}


def _changed(sent: FormData) -> dict[str, str]:
    """Return the numbers of the form that differ from those the page showed, by name."""
    try:
        shown = json.loads(str(sent.get("shown") or "{}"))
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
