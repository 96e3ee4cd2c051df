"""`submission.toml` becomes a checked model, with digits as typed and defaults filled in."""

import re
from decimal import Decimal
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError, SubmissionError
from pipeline.ingest.read import read_data
from pipeline.names import parameter_names
from pipeline.submission import (
    PidController,
    StateFeedbackController,
    load_submission,
    new_submission,
)
from pipeline.submission.edit import edit_submission
from pipeline.submission.load import InvalidSubmission
from pipeline.submission.toml import nearest, quote
from tests.helpers.places import ROOT

FULL = """\
version = 1
title = "Two carts · 弹簧"
section = "03"
[[authors]]
id = "s1024"
name = "Åsa"
[system]
carts = 2
springs = [false, true, true]
input = { unit = "V", sign = -1 }
position = { unit = "cm", per_count = 0.00227 }
[design]
cart = 2
reference = 1
overshoot_percent = 10.0
settling_time = 1.0
input_limit = 5
sample_time = 0.00884
method = "poles"
[[experiments]]
id = "decay-1"
kind = "decay"
carts = [1]
file = "data/a.csv"
[[experiments]]
id = "control"
kind = "closed_loop"
controlled_cart = 2
controller = { type = "state_feedback", gains = [1, 2, 3, 4.5], prefilter = 2 }
file = 'data\\a.csv'
window = [0, 2.5]
columns = { time = 1, x1 = "Encoder 1 Pos" }
[[experiments]]
id = "pid"
kind = "closed_loop"
carts = [2, 1]
controller = { type = "pid", kp = 0.05 }
file = "./data/a.csv"
[reported.initial]
K_1 = 25
zeta_a = 0.10
[reported.final]
omega_a = 1.0e1
[reported.state_space]
A = [[0, 1, 0, 0], [1, 2, 3, 4], [0, 0, 0, 1], [1, 2, 3, 4]]
B = [[0], [3196.70], [0], [0]]
[reported.feedback]
gains = [0.10, 0.2, 0.3, 0.4]
settling_time = 0.90
"""


@pytest.fixture
def folder(tmp_path):
    """Return a submission with every table of the format."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.csv").write_text("time,x1\n0,0\n")
    (tmp_path / "submission.toml").write_text(FULL, encoding="utf-8")
    return tmp_path


def test_every_table_of_the_format_is_read(folder):
    """Every table of `submission.toml` is read; missing carts mean all carts."""
    submission = load_submission(folder)

    decay, control, pid = submission.experiments
    assert submission.title == "Two carts · 弹簧"
    assert submission.system.springs == (False, True, True)
    assert submission.system.input.sign == -1
    assert submission.design is not None
    assert submission.design.input_limit == 5.0
    assert (decay.carts, control.carts, pid.carts) == ((1,), (1, 2), (1, 2))
    assert {e.file for e in submission.experiments} == {"data/a.csv"}
    assert isinstance(control.controller, StateFeedbackController)
    assert control.controller.gains == (1.0, 2.0, 3.0, 4.5)
    assert isinstance(pid.controller, PidController)
    assert pid.controller.cart == 1
    assert control.window == (0.0, 2.5)
    assert control.columns == {"time": 1, "x1": "Encoder 1 Pos"}


def test_reported_numbers_keep_their_digits(folder):
    """Reported numbers keep their decimals: two in 0.10, none in 25, one in 1.0e1.

    The last digit gives a tolerance.
    """
    reported = load_submission(folder).reported

    assert reported is not None
    assert str(reported.initial["zeta_a"]) == "0.10"
    assert reported.initial["K_1"] == Decimal(25)
    assert reported.final["omega_a"].as_tuple().digits == (1, 0)
    assert reported.state_space is not None
    assert str(reported.state_space.B[1]) == "3196.70"
    assert reported.feedback is not None
    assert str(reported.feedback.settling_time) == "0.90"


@given(
    st.decimals(min_value="1e-20", max_value="1e20", allow_nan=False, allow_infinity=False).filter(
        lambda number: "E" not in str(number)
    )
)
def test_any_typed_number_comes_back_as_typed(number):
    """Any number under [reported] keeps the text that was typed."""
    text = str(number)
    typed = text if "." in text else f"{text}.0"
    with TemporaryDirectory() as name:
        (Path(name) / "submission.toml").write_text(
            f"version = 1\n[system]\ncarts = 1\n[reported.final]\nK = {typed}\n"
        )
        reported = load_submission(Path(name)).reported
    assert reported is not None
    assert str(reported.final["K"]) == typed


@pytest.mark.parametrize("carts", [1, 2, 3, 4])
def test_springs_that_are_not_stated_exist(carts, tmp_path):
    """If `springs` is missing, n carts have n + 1 springs between the walls."""
    (tmp_path / "submission.toml").write_text(f"version = 1\n[system]\ncarts = {carts}\n")
    assert load_submission(tmp_path).system.springs == (True,) * (carts + 1)


def test_a_cart_without_springs_reports_mass_and_damping(tmp_path):
    """One cart with springs [false, false] is a rigid body, with mass and damping as parameters."""
    head = "version = 1\n[system]\ncarts = 1\nsprings = [false, false]\n[reported.final]\n"
    (tmp_path / "submission.toml").write_text(head + "mass = 2.0\ndamping = 0.1\n")
    reported = load_submission(tmp_path).reported
    assert reported is not None
    assert set(reported.final) == {"mass", "damping"}
    (tmp_path / "submission.toml").write_text(head + "K = 2.0\n")
    (part,) = load_submission(tmp_path).unread
    assert part.at == ("reported", "final", "K")
    assert all(name in part.message for name in ("mass", "damping"))


@pytest.mark.parametrize(
    "encode", [lambda t: b"\xef\xbb\xbf" + t, lambda t: t.replace(b"\n", b"\r\n")]
)
def test_windows_files_are_read(encode, folder):
    """A byte-order mark and CR LF line ends do not change what is read."""
    plain = load_submission(folder)
    raw = (folder / "submission.toml").read_bytes()
    (folder / "submission.toml").write_bytes(encode(raw))
    assert load_submission(folder) == plain


def test_the_toml_itself_may_be_named(folder):
    """The path of a submission may be its folder or the file `submission.toml` in it."""
    assert load_submission(folder / "submission.toml") == load_submission(folder)


def test_notes_are_the_discussion(folder):
    """`notes.md` is kept as written; if it has only comments, it counts as missing."""
    assert load_submission(folder).discussion is None
    (folder / "notes.md").write_text("<!-- hint\n -->\n", encoding="utf-8")
    assert load_submission(folder).discussion is None
    (folder / "notes.md").write_text("Friction *matters*.\n", encoding="utf-8")
    assert load_submission(folder).discussion == "Friction *matters*.\n"


@pytest.mark.parametrize(("lines", "kept"), [(2_900, 2_900), (4_000, 3_000)])
def test_long_notes_are_cut_at_a_line(lines, kept, folder):
    """Of notes with more than 30,000 characters, the first are shown, up to the end of a line."""
    (folder / "notes.md").write_text("ten chars\n" * lines, encoding="utf-8")
    shown = load_submission(folder).discussion or ""
    assert shown.count("ten chars\n") == kept
    assert (f"{10 * lines:,}" in shown) == (kept < lines)


# In the full file the first text is replaced by the second; the mistake is at the third.
MISTAKES = [
    ("window = [0, 2.5]", "window = [2.5, 2.5]", ("experiments", 1, "window")),
    ("window = [0, 2.5]", "window = [2.5, 2.4]", ("experiments", 1, "window")),
    ("{ time = 1,", "{ time = 0,", ("experiments", 1, "columns", "time")),
    ("{ time = 1,", "{ tine = 1,", ("experiments", 1, "columns", "tine")),
    ("carts = [1]", "carts = [1, 3]", ("experiments", 0, "carts", 1)),
    ("carts = [1]", "carts = [1, 1]", ("experiments", 0, "carts")),
    ('id = "pid"', 'id = "control"', ("experiments", 2, "id")),
    ('id = "pid"', f'id = "{101 * "x"}"', ("experiments", 2, "id")),
    ("1, 2, 3, 4.5]", "1, 2, 3]", ("experiments", 1, "controller", "gains")),
    ("kp = 0.05", "kp = 0.05, cart = 3", ("experiments", 2, "controller", "cart")),
    ("settling_time = 1.0\n", "settling_time = 1000.1\n", ("design", "settling_time")),
    ("settling_time = 1.0\n", "settling_time = 0\n", ("design", "settling_time")),
    ("overshoot_percent = 10.0", "overshoot_percent = 100", ("design", "overshoot_percent")),
    ("sample_time = 0.00884", "sample_time = 1.1", ("design", "sample_time")),
    ("per_count = 0.00227", "per_count = 0", ("system", "position", "per_count")),
    ("sign = -1", "sign = 2", ("system", "input", "sign")),
    ("[false, true, true]", "[false, true]", ("system", "springs")),
]


@pytest.mark.parametrize(("old", "new", "at"), MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_has_its_place(old, new, at, folder):
    """A value that is not allowed is refused with its key; lists count from 1 in the message."""
    assert FULL.count(old) == 1
    (folder / "submission.toml").write_text(FULL.replace(old, new), encoding="utf-8")
    with pytest.raises(InvalidSubmission) as told:
        load_submission(folder)
    ((where, _),) = told.value.problems
    assert tuple(where) == at
    shown = "".join(f"[{key + 1}]" if isinstance(key, int) else f".{key}" for key in at)
    assert shown.lstrip(".") in str(told.value)


def test_values_at_the_limits_are_read(folder):
    """The largest allowed values are read."""
    text = FULL.replace("settling_time = 1.0\n", "settling_time = 1000\n")
    text = text.replace("overshoot_percent = 10.0", "overshoot_percent = 99.9")
    text = text.replace('id = "pid"', f'id = "{100 * "x"}"')
    (folder / "submission.toml").write_text(text.replace("0.00884", "1"), encoding="utf-8")
    design = load_submission(folder).design
    assert design is not None
    assert (design.settling_time, design.overshoot_percent, design.sample_time) == (1000, 99.9, 1)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_edit_keeps_line_ends_and_other_text(end, folder):
    """An edit changes one value, and keeps all other bytes of the file."""
    toml = folder / "submission.toml"
    toml.write_bytes(FULL.replace("\n", end).encode())
    edit_submission(folder, lambda document: None)
    assert toml.read_bytes() == FULL.replace("\n", end).encode()
    edit_submission(folder, lambda document: document.update(title="new"))
    assert toml.read_bytes() == FULL.replace("Two carts · 弹簧", "new").replace("\n", end).encode()


def test_every_problem_is_listed(folder):
    """Three mistakes in one file give three lines, each with file and key."""
    text = FULL.replace("K_1 = 25", "K_7 = 25\nzeta_q = 1").replace(
        "cart = 2\nref", "cart = 9\nref"
    )
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SubmissionError) as told:
        load_submission(folder)
    where = f"{folder.name}/submission.toml: "
    wanted = ("design.cart: ", "reported.initial.K_7: ", "reported.initial.zeta_q: ")
    for line, start in zip(str(told.value).split("\n"), wanted, strict=True):
        assert line.startswith(where + start)


def test_an_unknown_table_does_not_hide_other_mistakes(folder):
    """A misspelt table does not hide a misspelt key in another table, or a wrong value."""
    text = FULL.replace("[design]", "[desing]").replace("version = 1", "version = 1\ncolour = 3")
    text = text.replace("carts = 2\n", 'carts = "two"\n')
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidSubmission) as told:
        load_submission(folder)
    for words in ("desing: ", "'design'", "colour: ", "system.carts: "):
        assert words in str(told.value)


def test_the_first_wrong_line_is_reported(folder):
    """Of the lines that are not TOML, the first is reported, with its number."""
    text = "version = 1\ntitle = “a”\n[system\ncarts = 2\n[design]\ncart = 1,5\nx = [1, two,\n 3]\n"
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SubmissionError, match=r" line 2: ") as told:
        load_submission(folder)
    assert len(str(told.value).split("\n")) == 1


@pytest.mark.parametrize("carts", [1, 2, 3, 4])
def test_a_new_submission_asks_for_experiments(carts, tmp_path):
    """A new submission is valid, but reading its data gives an error that asks for experiments."""
    new_submission(tmp_path / "team", carts=carts)

    submission = load_submission(tmp_path / "team")
    assert submission.system.carts == carts
    assert submission.discussion is None
    assert (tmp_path / "team" / "data").is_dir()
    with pytest.raises(SubmissionError, match=r"\[\[experiments\]\]"):
        read_data(submission)


@pytest.mark.parametrize("carts", [1, 2, 3, 4])
def test_every_commented_key_of_a_new_submission_is_valid(carts, tmp_path):
    """The template of a new submission is valid with every # before a key removed."""
    folder = tmp_path / "team"
    new_submission(folder, carts=carts)
    text = (folder / "submission.toml").read_text(encoding="utf-8")
    text = re.sub(r"^#(?=[\[a-zA-Z])", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(\w+) =\s*(#.*)?$", r"\1 = 1.0", text, flags=re.MULTILINE)
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    for name in re.findall(r'^file = "(.*)"', text, flags=re.MULTILINE):
        (folder / name).write_text("time,x1\n", encoding="utf-8")

    submission = load_submission(folder)

    kinds = {experiment.kind for experiment in submission.experiments}
    assert kinds == {"decay", "step", "sine", "sweep", "bode", "closed_loop"}
    assert submission.reported is not None
    assert list(submission.reported.final) == parameter_names(carts)
    assert submission.design is not None


def test_the_examples_of_the_documentation_are_valid(tmp_path):
    """The examples to copy in docs/submission.md make one valid submission with every kind."""
    page = (ROOT / "docs" / "submission.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^## Examples to copy$.*?^```toml\n(.*?)^```", page, re.DOTALL | re.M)
    text = f"version = 1\n[system]\ncarts = 2\n{block}"
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    (tmp_path / "data").mkdir()
    for name in re.findall(r'^file = "(.*)"', text, flags=re.MULTILINE):
        (tmp_path / name).write_text("time,x1\n", encoding="utf-8")

    submission = load_submission(tmp_path)

    kinds = {experiment.kind for experiment in submission.experiments}
    assert kinds == {"decay", "step", "sine", "sweep", "bode", "closed_loop"}
    assert not submission.unread


def test_a_new_submission_overwrites_nothing(tmp_path):
    """A folder that is not empty is not overwritten by a new submission."""
    (tmp_path / "mine.txt").write_text("work")
    with pytest.raises(ConfigError, match="not empty"):
        new_submission(tmp_path, carts=2)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(ConfigError, match="not empty"):
        new_submission(tmp_path / "mine.txt", carts=2)
    with pytest.raises(ConfigError, match=r"^carts: .*\b5$"):
        new_submission(tmp_path / "new", carts=5)
    assert not (tmp_path / "new").exists()


def test_a_wrong_number_of_carts_is_the_only_mistake(tmp_path):
    """If two lists of gains agree on another number of carts, only `carts` is called wrong."""
    text = """
version = 1
[system]
carts = 3
[[experiments]]
id = "loop"
kind = "closed_loop"
file = "loop.csv"
controller = { type = "state_feedback", gains = [1, 0, 1, 0] }
[reported.feedback]
gains = [1, 0, 1, 0]
"""
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SubmissionError, match=r"system\.carts: .*\b2\n"):
        load_submission(tmp_path)


def test_nearest_ignores_leading_zeros():
    """The nearest name to team-1 is team-01, although team-11 has more letters in common."""
    names = ["team-11", "team-01", "team-10"]
    assert "'team-01'" in nearest("team-1", names)
    assert "'team-10'" in nearest("team-010", names)


def test_a_quoted_value_is_short():
    """A short list is quoted whole, and a long one only counted."""
    assert quote((1, 2, 3, 4)) == "[1, 2, 3, 4]"
    assert "5" in quote((1, 2, 3, 4, 6))
    assert "6" not in quote((1, 2, 3, 4, 6))
    assert len(quote("x" * 1000)) == 60


def test_only_the_first_of_many_mistakes_are_listed(tmp_path):
    """Of thousands of mistakes, only the first ones are listed."""
    keys = "".join(f"k{i} = 1\n" for i in range(60_000))
    text = f"version = 1\n[system]\ncarts = 1\n{keys}"
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidSubmission, match="k0: ") as told:
        load_submission(tmp_path)
    assert len(str(told.value).split("\n")) == len(told.value.problems) == 20


LEFT_OUT = """\
version = 1
leave_out = [{names}]
[system]
carts = 1
[[experiments]]
id = "14-Feb-a"
kind = "decay"
file = "a.csv"
[[experiments]]
id = "21-Feb[b]"
kind = "decay"
file = "b.csv"
"""


@pytest.mark.parametrize(
    ("names", "used"),
    [
        ("", ["14-Feb-a", "21-Feb[b]"]),
        ('"14-Feb-*"', ["21-Feb[b]"]),
        ('"21-Feb[b]"', ["14-Feb-a"]),
        ('"22-Feb-*"', None),
        ('"*"', None),
    ],
)
def test_experiments_can_be_left_out(tmp_path, names, used):
    """Names and patterns in `leave_out` leave out experiments, but not none, and not all."""
    (tmp_path / "submission.toml").write_text(LEFT_OUT.format(names=names), encoding="utf-8")
    t = np.arange(300) / 100
    for name in "ab":
        rows = np.column_stack([t, np.round(np.exp(-t) * np.cos(20 * t), 4)])
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="time,x1", comments="")
    if used is None:
        with pytest.raises(InvalidSubmission, match="leave_out"):
            load_submission(tmp_path)
    else:
        data = read_data(load_submission(tmp_path))
        assert [record.id for record in data.records] == used
