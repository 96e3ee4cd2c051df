"""The form of `submission.toml` writes what was typed and changes nothing else in the file."""

import tomllib
from decimal import Decimal

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st

from pipeline.desk.student.folder_tasks import read_document
from pipeline.desk.student.form import (
    Fault,
    fill_experiment,
    fill_form,
    mark_errors,
    summarise,
    write_fields,
)
from pipeline.desk.toml_form import Field, find_changes
from pipeline.errors import SubmissionError
from pipeline.resources import EXAMPLES
from pipeline.submission import new_submission
from pipeline.submission.load import parse_submission

WHOLE = (EXAMPLES / "two-cart" / "submission.toml").read_text(encoding="utf-8")


def fields(text: str) -> dict[str, Field]:
    """Return all fields of a file's form by path."""
    document = read_document(text)
    loop = [i for i, e in enumerate(document.get("experiments", [])) if e["kind"] == "closed_loop"]
    of_loop = fill_experiment(document, loop[0]) if loop else ()
    every = [field for group in fill_form(document) for field in group.fields]
    return {field.path: field for field in (*every, *of_loop)}


def changed(text: str, **values: str) -> str:
    """Return the file after these fields were filled in."""
    document = tomlkit.parse(text)
    write_fields(document, find_changes(fields(text).values(), values, lambda path: []))
    return tomlkit.dumps(document)


def test_an_untouched_form_changes_nothing():
    """Values sent back as they were shown change nothing."""
    form = {path: field.value for path, field in fields(WHOLE).items()}
    flags = {"system.springs.shown": "1"}
    on = [str(i) for i, flag in enumerate(fields(WHOLE)["system.springs"].on) if flag]
    assert find_changes(fields(WHOLE).values(), form | flags, lambda path: on) == []


NUMBER = st.from_regex(r"-?(0|[1-9][0-9]{0,5})(\.[0-9]{1,8})?", fullmatch=True)


@given(NUMBER, NUMBER, st.text(st.characters(exclude_categories=["C", "Z"]), max_size=20))
def test_numbers_are_written_as_typed(initial, final, title):
    """Numbers are written with the digits typed, and every other line stays as it was.

    A missing table is added first.
    """
    values = {"title": title, "reported.initial.K_1": initial, "reported.final.K_1": final}
    new = changed(WHOLE, **values)
    after = tomllib.loads(new, parse_float=Decimal)
    assert after["reported"]["initial"]["K_1"] == Decimal(initial)
    assert after["reported"]["final"]["K_1"] == Decimal(final)
    assert f"K_1 = {final}" in new.splitlines()
    assert after["title"] == title
    lines = new.splitlines()
    lost = [line for line in WHOLE.splitlines() if line.strip() and line not in lines]
    assert all(line.startswith(("title", "K_1")) for line in lost)


def test_every_kind_of_field_is_written_and_read_back():
    """A value typed into a field of any kind is written, read again and still valid."""
    given = {
        "authors": "s1, Ann\ns2", "system.position.per_count": "0.00227",
        "system.columns": "x1 = Encoder 1 Pos\ntime = 2", "design.method": "poles",
        "reported.state_space.A": "0 1 0 0\n-1, -2, 3.50, 0\n0 0 0 1\n1 0 -2 -3",
        "reported.feedback.gains": "[1, 2, 3.0, 4]",
    }  # fmt: skip
    loop = next(path for path in fields(WHOLE) if path.endswith("controller.type"))
    gain = loop.replace("type", "kp")
    assert gain not in fields(WHOLE)
    given |= {loop: "pid", gain: "0.05"}
    new = changed(changed(WHOLE, **{loop: "pid"}), **given)
    for path, value in given.items():
        assert fields(new)[path].value.replace(",", "").split() == (
            value.strip("[]").replace(",", "").split()
        ), path
    with pytest.raises(SubmissionError, match="gains"):  # the gains of the state feedback are there
        parse_submission(new, folder=EXAMPLES / "two-cart")
    gone = changed(new, **{loop.replace("type", key): "" for key in ("gains", "prefilter")})
    submission = parse_submission(gone, folder=EXAMPLES / "two-cart")
    assert submission.reported is not None
    assert submission.reported.state_space is not None
    assert str(submission.reported.state_space.A[1][2]) == "3.50"
    assert submission.system.columns == {"x1": "Encoder 1 Pos", "time": 2}
    assert [author.name for author in submission.authors] == ["Ann", ""]
    empty = changed(gone, **dict.fromkeys(given, ""))
    assert "A" not in tomllib.loads(empty)["reported"]["state_space"]
    assert "columns" not in tomllib.loads(empty)["system"]


def test_an_effect_is_chosen_filled_in_exchanged_and_removed():
    """A chosen effect gets fields for its place and sizes; without effects, the file is as before.

    A value for an effect that is exchanged in the same form is not written.
    """
    friction, delay = "Dry (Coulomb) friction", "Delay of the input"
    at = "reported.effects.coulomb_friction"
    chosen = changed(WHOLE, **{"reported.effects": friction})
    shown = [path for path in fields(chosen) if path.startswith("reported.effects")]
    assert shown == [at, f"{at}.cart", f"{at}.force", "reported.effects"]
    typed = changed(chosen, **{f"{at}.cart": "2", f"{at}.force": "0.0310"})
    (group,) = (one for one in fill_form(read_document(typed)) if one.key == "effects")
    assert [summarise(group).summary, summarise(group).missing] == [friction, ""]
    submission = parse_submission(typed, folder=EXAMPLES / "two-cart")
    assert submission.reported is not None
    effects = submission.reported.effects
    assert effects is not None
    assert [*map(str, effects["coulomb_friction"].values())] == ["2", "0.0310"]
    other = changed(typed, **{at: delay, f"{at}.force": "5"})
    assert tomllib.loads(other)["reported"]["effects"] == {"input_delay": {}}
    gone = changed(other, **{"reported.effects.input_delay": ""})
    assert tomllib.loads(gone) == tomllib.loads(WHOLE)


@pytest.mark.parametrize("above", ["", "effects = {}\n", "effects.input_delay.delay = 0.02\n"])
def test_an_effect_is_added_to_any_form_of_the_table(above):
    """The table may be missing, on one line, or written with dots."""
    text = changed(
        f"version = 1\n[reported]\n{above}", **{"reported.effects": "Dead zone of the input"}
    )
    effects = tomllib.loads(text)["reported"]["effects"]
    assert effects["dead_zone"] == {}
    assert len(effects) == 1 + ("delay" in above)


def test_an_effect_s_mistake_stands_at_its_field():
    """A wrong cart or size is marked at its own field, an unknown effect at the choice."""
    added = changed(WHOLE, **{"reported.effects": "Dry (Coulomb) friction"})
    for path, value, at in (
        ("reported.effects.coulomb_friction.cart", "5", "reported.effects.coulomb_friction.cart"),
        (
            "reported.effects.coulomb_friction.force",
            "0,1",
            "reported.effects.coulomb_friction.force",
        ),
        ("reported.effects", "magnetism", "reported.effects"),
    ):
        with pytest.raises(SubmissionError) as refused:
            parse_submission(changed(added, **{path: value}), folder=EXAMPLES / "two-cart")
        fault = Fault.of(refused.value)
        shown, left = mark_errors(list(fields(added).values()), (), fault)
        assert [field.path for field in shown if field.wrong] == [at]
        assert left == []


@pytest.mark.parametrize(
    ("table", "keys"),
    [
        ('kind = "decay"', ""),
        ('kind = "sine"', "frequency"),
        ('kind = "step"\nfrequency = 2', "frequency"),  # a mistake in the file can be corrected
        ('kind = "closed_loop"', "controlled_cart reference controller.type"),
        (
            'kind = "closed_loop"\ncontroller = { type = "pid", gains = [1] }',
            "controlled_cart reference controller.type controller.gains controller.kp "
            "controller.ki controller.kd controller.scale controller.cart",
        ),
    ],
)
def test_a_row_has_the_fields_of_its_kind_only(table, keys):
    """A recording's row has only the fields of its kind and controller.

    A field that the file already states is shown too.
    """
    shown = fill_experiment(read_document(f"[[experiments]]\n{table}\n"), 0)
    found = {field.path.removeprefix("experiments.0.") for field in shown}
    always = {"kind", "carts", "window", "note", "columns", "sample_rate"}
    assert found - always == set(keys.split())


def test_comments_survive_every_change(tmp_path):
    """All comments in the file that `cartlab new` writes survive every change."""
    new_submission(tmp_path / "team", carts=2)
    text = (tmp_path / "team" / "submission.toml").read_text(encoding="utf-8")
    values = {"title": "x", "system.position.unit": "cm", "system.position.per_count": "0.1",
              "design.cart": "2", "reported.initial.K_1": "1.50", "authors": "s1"}  # fmt: skip
    new = changed(changed(text, **values), **dict.fromkeys(values, ""))
    comments = [line[line.index("#") :] for line in text.splitlines() if "#" in line]
    assert [comment for comment in comments if comment not in new] == []


@pytest.mark.parametrize(
    ("path", "value", "wrong"),
    [
        ("system.input.per_count", "-1", "more than 0"), ("reported.final.K_1", "1e999", "between"),
        ("reported.final.K_1", ".5", "a number"), ("design.settling_time", "0", "more than 0"),
        ("system.columns", "foo = 1", "unknown column"), ("design.reference", "nan", "a number"),
        ("reported.feedback.gains", "1, 2", "expected 4 gains"), ("title", "x" * 300, "200"),
        ("reported.state_space.A", "1 2\n3 4", "4 rows"), ("authors", "x" * 300, "200"),
    ],
)  # fmt: skip
def test_an_error_is_shown_at_its_field(path, value, wrong):
    """An error appears at its field, in the words of the file's own check, and nowhere else."""
    now = [Field(path=path, label="", kind=fields(WHOLE)[path].kind, value=value)]
    document = tomlkit.parse(WHOLE)
    write_fields(document, now)
    with pytest.raises(SubmissionError) as error:
        parse_submission(tomlkit.dumps(document), folder=EXAMPLES / "two-cart")
    shown, left = mark_errors(tuple(fields(WHOLE).values()), now, Fault.of(error.value))
    assert {field.path: wrong in field.wrong for field in shown if field.wrong} == {path: True}
    assert left == []


def test_numbers_are_asked_for_by_their_symbols():
    """A field for a number is labelled with its symbol as in the lab's tables."""
    (claims,) = [g for g in fill_form({"system": {"carts": 2}}) if g.title == "Your numbers"]
    labels = {field.path: field.label for field in claims.fields}
    assert labels["reported.initial.zeta_1"] == "ζ₁ initial"
    assert labels["reported.final.omega_b"] == "ω_b final"
