"""A form changes a rubric's numbers and nothing else in its file."""

import re
import tomllib
from decimal import Decimal
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.desk.instructor.rubric_form import make_draft, rubric_form, with_values
from pipeline.desk.toml_form import find_changes
from pipeline.grading.rubric_file import parse_rubric
from pipeline.resources import RUBRICS

SHIPPED = {path.stem: path.read_text(encoding="utf-8") for path in sorted(RUBRICS.glob("*.toml"))}


ONE = SHIPPED["throne-1dof"]
HEAD, CRITERIA = ONE[: ONE.index("[late]")], ONE[ONE.index("[[criteria]]") :]  # without `late`


def typed_into(text: str, **typed: str) -> str:
    """Return the text of a rubric after a form with these values has been saved."""
    form = rubric_form(parse_rubric(text, where=""))
    named = {name.replace("__", "."): value for name, value in typed.items()}
    return with_values(text, find_changes(form.fields(), named))


def _comments(text: str) -> list[str]:
    return [line.partition("#")[2] for line in text.splitlines() if "#" in line]


@settings(max_examples=25)
@given(data=st.data())
def test_a_form_keeps_comments_and_order(data):
    """The file has the new values, and every other line is as it was."""
    text = SHIPPED[data.draw(st.sampled_from(sorted(SHIPPED)))]
    form = rubric_form(parse_rubric(text, where=""))
    fields = data.draw(st.lists(st.sampled_from(list(form.fields())), min_size=1, max_size=6))
    typed = {
        field.name: data.draw(
            st.sampled_from(field.choices)
            if field.choices
            else st.decimals(0, 100, places=2, allow_nan=False).map(str)
        )
        for field in fields
    }

    changed = find_changes(form.fields(), typed)
    new = with_values(text, changed)

    document, before = tomllib.loads(new), tomllib.loads(text)
    for field in changed:
        key = [int(part) if part.isdecimal() else part for part in field.path.split(".")]
        here: Any = document
        for part in key[:-1]:
            here = here[part]
        found = here.pop(key[-1])
        scale = 100 if field.kind == "share" else 1
        shown = found if field.choices else Decimal(str(found)) * scale
        assert shown == (field.value if field.choices else Decimal(field.value))
        was: Any = before
        for part in key[:-1]:
            was = was.setdefault(part, {}) if isinstance(was, dict) else was[part]
        was.pop(key[-1], None)
    assert document == before
    assert _comments(new) == _comments(text)
    left = iter(_without_numbers(new))
    assert all(line in left for line in _without_numbers(text))  # the lines keep their order


def _without_numbers(text: str) -> list[str]:
    return [re.sub(r"(?<== )[0-9.]+", "a number", line) for line in text.splitlines()]


def test_an_unchanged_form_changes_no_byte():
    """If a form is sent back unchanged, or with extra zeros, no byte of the file changes."""
    for text in SHIPPED.values():
        form = rubric_form(parse_rubric(text, where=""))
        shown = {field.name: field.value for field in form.fields()}
        assert with_values(text, find_changes(form.fields(), shown)) == text
        zeros = {
            field.name: f"{field.value}0" if "." in field.value else f"{field.value}.0"
            for field in form.fields()
            if not field.choices
        }
        assert with_values(text, find_changes(form.fields(), zeros)) == text


def test_one_changed_number_changes_one_line():
    """One changed number changes one line; a new key adds one line to its table."""
    text = ONE
    late = typed_into(text, late__percent_per_day="50")
    assert late == text.replace("percent_per_day = 10", "percent_per_day = 50")
    hertz = typed_into(text, flags__hz_for_rad_s="50")
    added = [line for line in hertz.splitlines() if line not in text.splitlines()]
    assert added == ["hz_for_rad_s = 0.5"]
    assert hertz.index("data_problem = 0.25") < hertz.index(added[0]) < hertz.index("[late]")
    assert parse_rubric(hertz, where="").flags.of("hz_for_rad_s").least == 0.5


def test_a_missing_table_is_added_before_the_criteria():
    """A missing table is added before the criteria and before any comment above them."""
    new = typed_into(f"{HEAD}# what is judged\n{CRITERIA}", late__percent_per_day="12,5")
    head = new[: new.index("# what is judged")]
    assert head.endswith("[late]\npercent_per_day = 12.5\n\n")
    assert parse_rubric(new, where="").late.percent_per_day == 12.5


@pytest.mark.parametrize(
    ("late", "changed"),
    [
        (
            "late = { percent_per_day = 10 }  # a day\n",
            "late = { percent_per_day = 50 }  # a day\n",
        ),
        ("late.percent_per_day = 10\n", "late.percent_per_day = 50\n"),
    ],
)
def test_a_table_without_a_heading_is_changed_in_its_place(late, changed):
    """A value in a table that is written in one line, or with dots, is changed in its place."""
    new = typed_into(f"{late}{HEAD}{CRITERIA}", late__percent_per_day="50")
    assert new == f"{changed}{HEAD}{CRITERIA}"


def test_a_new_key_stands_above_the_comments_of_the_next_table():
    """A new key follows the last key of its table; a comment of the next heading comes later."""
    text = ONE.replace("[late]", "# an hour counts as a day\n[late]")
    new = typed_into(text, flags__hz_for_rad_s="50")
    assert new == text.replace("data_problem = 0.25\n", "data_problem = 0.25\nhz_for_rad_s = 0.5\n")


def test_a_line_of_a_longer_text_is_not_changed():
    """A line of a longer text is not changed, even if it looks like a key with its value."""
    text = ONE.replace(
        'title = "everything else that the lab asks for"\npoints = 1',
        'title = """the pieces\npoints = 7\n"""\npoints = 1',
    )
    new = typed_into(text, criteria__pieces__points="2")
    assert new == text.replace('"""\npoints = 1', '"""\npoints = 2')


def test_the_choice_of_what_students_see_is_saved():
    """The choice of what students see is saved in its own table; a comment after it stays."""
    text = ONE
    new = typed_into(text, students__see="check")
    assert '[students]\nsee = "check"\n' in new
    assert parse_rubric(new, where="").students.see == "check"
    told = new.replace('see = "check"', "see = 'check'  # until week 3")
    again = typed_into(told, students__see="report")
    assert again == told.replace("'check'", '"report"')


def test_a_wrong_value_is_marked_at_its_field():
    """All wrong values of a form are marked, each at its field, and stay as typed."""
    typed = {"step": "much", "criteria.pieces.points": "", "late.grace_days": "nan",
             "students.see": "all"}  # fmt: skip
    draft = make_draft(ONE, typed)
    assert draft.rubric is None
    assert draft.edited == ONE
    assert draft.form is not None
    wrong = {field.name: field.value for field in draft.form.fields() if field.wrong}
    assert wrong == typed
    assert len(draft.mistakes) == len(typed)
    assert make_draft(ONE, {"late.most_percent": "1e999999999"}).mistakes
