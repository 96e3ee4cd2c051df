"""Any number, in any notation, in any file that people type, is read or refused."""

import re
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.desk.student.folder_tasks import read_document
from pipeline.desk.student.form import fill_experiment, fill_form, write_fields
from pipeline.desk.toml_form import Field
from pipeline.desk.users import read_users
from pipeline.errors import PipelineError, SubmissionError
from pipeline.experiments.plan import load_plan, plan_path, save_plan
from pipeline.experiments.propose import propose_plan
from pipeline.grading.rubric_file import parse_rubric
from pipeline.ingest.fill import fill_submission
from pipeline.protocol import Description, format_description, parse_description
from pipeline.resources import EXAMPLES, RUBRICS
from pipeline.submission import load_submission
from pipeline.submission.edit import edit_submission
from pipeline.submission.load import NAME, parse_submission
from pipeline.submission.toml import (
    MOST_LISTED,
    TomlSlip,
    find_deep_key,
    parse_toml,
    read_toml,
)
from tests.helpers.poison import damaged, few_lines_at_most, poisoned_toml

EXAMPLE = EXAMPLES / "two-cart"
SUBMISSION = (EXAMPLE / NAME).read_text(encoding="utf-8")
RUBRIC = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
USERS = """\
[proxy]
address = "127.0.0.1"
header = "x-user"
secret_header = "x-secret"
secret = "0123456789012345678901234567890123456789"
site = "https://desk.example.org"

[[users]]
name = "a"
role = "ta"
folders = ["."]
"""
# Numbers where a number is allowed: after a "=", or in a list.
_NUMBER = re.compile(r"(?<=[=\[,{] )-?\d[\d.eE+-]*(?=\s*(?:[,\]}#]|$))", re.MULTILINE)

digits = st.integers(1, 6000).map(lambda n: "1" + "0_7"[n % 3 :: 2].replace("_", "") * n)
exponents = st.one_of(
    st.integers(-400, 400), st.integers(-(10**9), 10**9), st.integers(-(10**30), 10**30)
)
mantissas = st.from_regex(r"[-+]?(0|[1-9][0-9]{0,9})(\.[0-9]{1,9})?", fullmatch=True)
numbers = st.one_of(
    st.builds("{}e{}".format, mantissas, exponents),
    st.builds("0.{}{}".format, st.integers(0, 2000).map("0".__mul__), mantissas.map(str.lower)).map(
        lambda text: re.sub(r"(?<=0)[-+]|(?<=\.)[-+]", "", text)
    ),
    digits,
    st.builds(
        "{}{}".format, st.sampled_from(["0x", "0o", "0b"]), digits.map(lambda d: "1" * len(d))
    ),
    st.sampled_from(
        ["inf", "-inf", "nan", "+nan", "-0.0", "0e1000000", "1_0.0_1e1_0", "1e-1000000"]
    ),
)


def with_number(text: str, number: str, at: int) -> tuple[str, str]:
    """Return a file with one number changed, and the key of that number."""
    places = list(_NUMBER.finditer(text))
    place = places[at % len(places)]
    line = text[text.rfind("\n", 0, place.start()) + 1 : place.start()]
    key = re.findall(r"([A-Za-z]\w*)\s*=", line)
    return text[: place.start()] + number + text[place.end() :], key[-1] if key else ""


def assert_read_or_refused(read: Callable[[], object], key: str, file: str) -> None:
    """Check that the file is read, or refused with its name and with the key or the line."""
    try:
        read()
    except PipelineError as error:
        said = str(error)
        assert file in said
        assert key in said or re.search(r"line \d+", said)
        assert len(said) < 2000


where = st.integers(0, 10**6)


@given(numbers, where)
@example("1e1000000", 0)
@example("-1e-99999999999999999999", 7)
@example("0x" + "f" * 5000, 3)
def test_any_number_of_a_submission(number, at):
    """Any number in `submission.toml` is read or refused, and can then be shown at the desk."""
    text, key = with_number(SUBMISSION, number, at)
    assert_read_or_refused(lambda: parse_submission(text, folder=EXAMPLE), key, NAME)
    document = read_document(text)
    shown = [field.value for group in fill_form(document) for field in group.fields]
    for index in range(len(document.get("experiments", []))):
        shown += [field.value for field in fill_experiment(document, index)]
    assert all(isinstance(value, str) for value in shown)


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), by_values=st.booleans())
def test_any_damage_of_a_submission(tmp_path_factory, seed, by_values):
    """A `submission.toml` with cuts, junk or absurd values is read, or gives few lines of error."""
    rng, raw = Random(seed), SUBMISSION[:3000].encode()
    spoilt = poisoned_toml(raw.decode(), rng).encode() if by_values else damaged(raw, rng, hits=4)
    folder = tmp_path_factory.mktemp("toml")
    (folder / NAME).write_bytes(spoilt)
    with few_lines_at_most(MOST_LISTED):
        load_submission(folder)


@given(numbers, where)
def test_any_number_of_a_rubric(number, at):
    """Any number in a rubric is read or refused, before points and tolerances are computed."""
    text, key = with_number(RUBRIC, number, at)
    assert_read_or_refused(lambda: parse_rubric(text, where="r.toml"), key, "r.toml")


@pytest.fixture(scope="module")
def planned(tmp_path_factory) -> Path:
    """Return a submission with a plan."""
    folder = tmp_path_factory.mktemp("planned")
    (folder / NAME).write_text(
        'version = 1\n[system]\ncarts = 2\nposition = { unit = "cm", per_count = 0.002 }\n',
        encoding="utf-8",
    )
    submission = load_submission(folder)
    save_plan(propose_plan(submission), submission)
    return folder


@given(numbers, where)
@example("0x" + "f" * 5000, 0)
def test_any_number_of_a_plan(planned, number, at):
    """Any number in `plan.toml` is read or refused, even 1e300 s."""
    submission = load_submission(planned)
    before = plan_path(submission).read_text(encoding="utf-8")
    text, key = with_number(before, number, at)
    plan_path(submission).write_text(text, encoding="utf-8")
    try:
        assert_read_or_refused(lambda: load_plan(submission), key, "plan.toml")
    finally:
        plan_path(submission).write_text(before, encoding="utf-8")


@given(numbers, st.sampled_from(["address", "header", "name", "role", "folders", "more"]))
def test_any_number_of_the_users_file(tmp_path_factory, number, key):
    """The file of users has no numbers, so any number in it is refused with its key."""
    path = tmp_path_factory.mktemp("users") / "users.toml"
    path.write_text(USERS, encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    new = re.sub(rf"(?m)^{key} = .*$", f"{key} = {number}", text)
    path.write_text(new if new != text else f"{text}more = {number}\n", encoding="utf-8")
    path.chmod(0o600)
    assert_read_or_refused(lambda: read_users(path), key, "users.toml")


@given(numbers, st.sampled_from(["period", "baud", "input", "position", "encoders", "carts"]))
def test_any_number_of_a_benchs_description(number, key):
    """Any number in a bench's description is either accepted or refused with its key."""
    line = format_description(Description(name="b", encoders=2, carts=2)).decode()
    new = re.sub(rf" {key}=[-\d.]+", f" {key}={number}", line)
    assert_read_or_refused(lambda: parse_description(new.encode()), key, "describes itself as")


@pytest.mark.parametrize("number", ["1e1000000", "-1e-1000000", "9" * 5000, "0x" + "f" * 5000])
def test_fill_and_desk_refuse_an_impossible_number(tmp_path, number):
    """`fill` and the desk refuse an impossible number with its key or line before they write.

    A submission is read without this number.
    """
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.csv").write_text("time,input,x1\n0,0,0\n0.1,0,0\n", encoding="utf-8")
    (tmp_path / NAME).write_text(
        f"version = 1\n[system]\ncarts = 2\n[reported.initial]\nK_1 = {number}\n", encoding="utf-8"
    )
    said = r"reported\.initial\.K_1: |line 5\b"
    with pytest.raises(SubmissionError, match=said):
        fill_submission(tmp_path)
    (part,) = load_submission(tmp_path).unread
    assert part.at == ("reported", "initial", "K_1")
    assert re.search(said, part.message)
    with pytest.raises(SubmissionError, match=said):
        edit_submission(tmp_path, lambda document: document.update({"title": "t"}))


def test_a_column_typed_with_thousands_of_digits_is_refused(tmp_path):
    """A column with thousands of digits, typed into the desk's form, is refused."""
    (tmp_path / NAME).write_text("version = 1\n[system]\ncarts = 2\n", encoding="utf-8")
    columns = Field(path="system.columns", label="", kind="columns", value=f"time = {'9' * 5000}")
    with pytest.raises(SubmissionError, match=r"too many digits$"):
        edit_submission(tmp_path, lambda document: write_fields(document, [columns]))


def test_valid_numbers_are_read_as_python_reads_them():
    """Numbers are read as tomllib reads them, lists as tuples; or with exact digits if asked."""
    text = "a = 0.1\nb = -1.5e-7\nc = [1, 2.50]\nd = { e = 1_000.0 }\n"
    read = parse_toml(text, where="f", error=PipelineError)
    assert read == tomllib.loads(text) | {"c": (1, 2.5)}
    exact = parse_toml(text, where="f", error=PipelineError, as_typed=True)
    assert str(exact["c"][1]) == "2.50"


@pytest.mark.parametrize("part", ["a", '" "', "' . '", "a1-b"])
@pytest.mark.parametrize("between", [".", " . "])
def test_a_key_of_many_parts_is_refused_at_once(part, between):
    """A key of thousands of parts is refused before TOML is parsed, however its parts are typed."""
    text = "x = 1\n" + between.join([part] * 50_000) + " = 1\n"
    begin = time.process_time()
    assert find_deep_key(text) == 2
    with pytest.raises(TomlSlip, match="deeply"):
        read_toml(text)
    assert time.process_time() - begin < 5  # s; it takes 0.1, parsing takes minutes
    value = f'"1{".5" * 100}"'
    assert not find_deep_key(f"a.b.c = {value}\n")
